"""One tree of frozen dataclasses with defaults, units and sources; TOML in, TOML out.

An unknown key is an error that names the nearest valid one. ``section.key=value`` overrides a file.
"""

from __future__ import annotations

import ast
import difflib
import json
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from onedemo.core.ranges import at_least, one_of
from onedemo.errors import UserError
from onedemo.queries.settings import RatingsConfig
from onedemo.reward.settings import PracticeConfig, PredictorConfig
from onedemo.rl.settings import PolicyConfig, TrpoConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class RolloutConfig:
    """How the policy practises."""

    lanes: int = 64
    """Episodes that run side by side."""
    steps: int = 250
    """Control steps of each lane in one iteration."""
    total_steps: int = 10_000_000
    """Control steps, all lanes together, after which the run is done."""
    threads: int = 2
    """Threads of the physics and of the learning. Any number gives the same numbers."""
    physics: str = "mujoco"
    """Where the robot is simulated: "mujoco", the processor, or "warp", an NVIDIA GPU (extra ``warp``)."""

    def __post_init__(self) -> None:
        at_least("rollouts", self, lanes=1, steps=1, total_steps=1, threads=1)
        if self.physics not in ("mujoco", "warp"):
            raise ValueError(f"rollouts.physics must be 'mujoco' or 'warp', got {self.physics!r}")


@dataclass(frozen=True, kw_only=True, slots=True)
class StorageConfig:
    """What a run leaves on the disk. No part of it changes what is learned."""

    pictures_gb: float = 0.02
    """Gigabytes of pictures that a run keeps: of what is answered or has expired, the newest that fit in
    beside those that wait to be rated. The others are drawn again when somebody looks back at them."""

    def __post_init__(self) -> None:
        at_least("storage", self, pictures_gb=0)


METHODS: dict[str, dict[str, Any]] = {
    "onedemo": {},
    "paper": {
        "ratings.starts": "standing",
        "ratings.pairing": "time",
        "ratings.choice": "uniform",
        "ratings.rounds": 1,
        "predictor.kind": "network",
        "predictor.appearance": False,
        "predictor.members": 1,
        "predictor.visual_dims": 0,
        "practice.elastic": False,
        "practice.bank_share": 0.0,
        "practice.give_up": 0.0,
        "policy.kind": "clock",
        "trpo.final_kl": 0.05,
    },
}
"""What each method sets where nothing else is said: the defaults are onedemo's."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RunConfig:
    """Everything that decides a run, besides the ratings."""

    method: str = "onedemo"
    """"onedemo", or "paper": the settings of Gandhi et al. 2019."""
    seed: int = 0
    """Of every random number in the run."""
    env: str = "hopper"
    """The robot: one that comes with the program, one of your own (``onedemo robot add``), or gym:ID. Where
    nothing is said, the one that the demo was made with, or the hopper."""
    env_sha256: str = ""
    """Of the robot's model: noted when a run is made, which goes on with no other."""
    device: str = "cpu"
    """Where predictor and policy compute: "cpu", "cuda" or "cuda:N"."""
    encoder: str = "efficientnet-lite0"
    """The frozen network that looks at the demo's frames."""
    ratings: RatingsConfig = field(default_factory=RatingsConfig)
    rollouts: RolloutConfig = field(default_factory=RolloutConfig)
    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    practice: PracticeConfig = field(default_factory=PracticeConfig)
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(kind="table"))
    trpo: TrpoConfig = field(default_factory=TrpoConfig)
    storage: StorageConfig = field(default_factory=StorageConfig)

    def __post_init__(self) -> None:
        one_of("method", self.method, METHODS)
        if not 0 <= self.seed < 2**63:  # as large as SQLite's numbers
            raise ValueError(f"seed must be at least 0 and less than 2**63, got {self.seed}")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise ValueError(f'device must be "cpu", "cuda" or "cuda:N", got {self.device!r}')


def split_ratings(total: int) -> tuple[int, int]:
    """A budget of ratings before practice and during it, in the paper's proportion of 200 to 150."""
    pretrain = max(1, round(total * 4 / 7))
    return pretrain, total - pretrain


def load_config(
    path: Path | None = None, overrides: dict[str, Any] | None = None, defaults: dict[str, Any] | None = None
) -> RunConfig:
    """The defaults, changed by a TOML file, changed by overrides.

    Args:
        path: TOML file, or None.
        overrides: ``{"trpo.max_kl": 0.02}``: dotted key to value, as TOML would give it.
        defaults: Of the same kind: what holds where nothing else is said.

    Raises:
        UserError: If the file cannot be read, a key does not exist or a value does not fit.
    """
    in_file = _by_key(_read(path)) if path is not None else {}
    given = in_file | (overrides := _by_key(overrides or {}))
    known = _by_key(asdict(RunConfig())) | (defaults or {})

    def wrong(key: str, said: str) -> UserError:
        return UserError(f"{path}: {said}" if key in in_file.keys() - overrides.keys() else said)

    for key, value in given.items():
        if any(other.startswith(f"{key}.") for other in known):
            if value != {}:
                raise wrong(key, f"{key} is a section, not a value")
        elif key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0)[0]
            raise wrong(key, f"unknown key {key!r}; the nearest valid one is {nearest!r}")
        if isinstance(value, float) and isinstance(known.get(key), float) and not math.isfinite(value):
            raise wrong(key, f"{key} must be a finite number, got {value}")
    import msgspec  # here: the help does without

    tree: dict[str, Any] = {}
    for key, value in (known | METHODS.get(str(given.get("method")), {}) | given).items():
        *section, name = key.split(".")
        if value != {} or key in known:
            (tree.setdefault(section[0], {}) if section else tree)[name] = value
    try:
        return msgspec.convert(tree, RunConfig)
    except msgspec.ValidationError as error:
        if error.__cause__ is not None:  # a section's own check, whose sentence begins with the key
            said = str(error.__cause__)
            raise wrong(said.split()[0], said) from None
        key = str(error).partition("`$.")[2].rstrip("`").partition("[")[0]
        raise wrong(key, f"{key} must be {_TYPES[type(known[key])]}, got {given[key]!r}") from None


_TYPES = {
    int: "a whole number", float: "a number", str: "a text", bool: "true or false",
    tuple: "a list of whole numbers",
}  # fmt: skip


def _read(path: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read the config file {path}: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path} is not valid TOML: {error}") from None


def _by_key(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys to values; an empty section is a value."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        nested = isinstance(value, dict) and value
        flat |= _by_key(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return flat


def settings_for_another(config: RunConfig, method: str) -> dict[str, Any]:
    """A run's settings as overrides for ``load_config``; for another method those that none decides."""
    decided = set() if method == config.method else set().union(*METHODS.values())
    flat = _by_key(asdict(config))
    return {key: value for key, value in flat.items() if key not in decided} | {"method": method}


def describe(config: Any = None, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Of each setting its dotted key, its default in TOML, and the docstring beneath it on one line."""
    config = RunConfig() if config is None else config
    module = ast.parse(Path(sys.modules[type(config).__module__].__file__ or "").read_text())
    (body,) = (node.body for node in module.body if getattr(node, "name", "") == type(config).__name__)
    said = {ast.unparse(a.target): ast.literal_eval(b.value) for a, b in pairwise(body)
            if isinstance(a, ast.AnnAssign) and isinstance(b, ast.Expr)}  # fmt: skip
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            yield from describe(value, f"{entry.name}.")
        else:
            yield prefix + entry.name, json.dumps(value), " ".join(said[entry.name].split())


def parse_override(text: str) -> tuple[str, Any]:
    """``"trpo.max_kl=0.02"`` as a dotted key and a TOML value; a bare word counts as a string.

    Raises:
        UserError: If there is no ``=``.
    """
    import tomllib

    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise UserError(f"--set takes section.key=value, got {text!r}")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def to_toml(config: Any) -> str:
    """A config tree as TOML text that ``load_config`` reads back to the same tree."""
    lines, sections = "", ""
    for name, value in (config if isinstance(config, dict) else asdict(config)).items():
        if isinstance(value, dict):
            sections += f"\n[{name}]\n{to_toml(value)}"
        else:  # JSON's texts, numbers, truths and lists of them are TOML's
            lines += f"{name} = {json.dumps(value, ensure_ascii=False)}\n"
    return lines + sections
