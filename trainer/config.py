"""One tree of frozen dataclasses with defaults, units and sources; TOML in, TOML out.

An unknown key is an error that names the nearest valid one. ``section.key=value`` overrides a file.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from onedemo.errors import UserError
from onedemo.queries.selection import CHOICES
from onedemo.reward.episode_rules import PracticeConfig
from onedemo.reward.model import PredictorConfig
from onedemo.rl.policy import PolicyConfig
from onedemo.rl.trpo import TrpoConfig

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, slots=True)
class RatingsConfig:
    """What raters are asked. Defaults: the paper's section "Evaluation of learning from observations"."""

    pretrain: int = 200
    """Ratings of clips of a random policy, before the policy is trained."""
    online: int = 150
    """Ratings of clips of the policy in training."""
    clip_seconds: float = 0.3
    """Length of a clip."""
    starts: str = "random"
    """Where the clips before practice come from: "random" states of the robot, or, as in the paper, a
    random policy that starts "standing"."""
    pairing: str = "any"
    """Before practice a clip is asked beside "any" moment of the demo, or beside the same "time"."""
    choice: str = "mix"
    """Which of the possible clips are asked: "uniform"; those rated "high"; those of most "disagreement"
    between the predictor's members; or a "mix" of all three. All but the first spread over the demo."""
    rounds: int = 10
    """A simulated rater's first ratings come in so many rounds, with a refit after each."""
    queue: int = 12
    """Clips kept ready to be rated."""
    stale_iterations: int = 10
    """A clip that nobody has rated is withdrawn after so many iterations: the policy has moved on."""
    online_share: float = 0.5
    """A simulated rater gives its online ratings evenly over this first share of the training."""

    def __post_init__(self) -> None:
        _at_least(self, "ratings", pretrain=1, online=0, rounds=1, queue=1, stale_iterations=1)
        if not 0.05 <= self.clip_seconds <= 5:
            raise ValueError(f"ratings.clip_seconds must be 0.05 to 5 s, got {self.clip_seconds}")
        _one_of("ratings.starts", self.starts, ("random", "standing"))
        _one_of("ratings.pairing", self.pairing, ("any", "time"))
        _one_of("ratings.choice", self.choice, tuple(CHOICES))
        if not 0 < self.online_share <= 1:
            raise ValueError(f"ratings.online_share must be in (0, 1], got {self.online_share}")


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
        _at_least(self, "rollouts", lanes=1, steps=1, total_steps=1, threads=1)
        if self.physics not in ("mujoco", "warp"):
            raise ValueError(f"rollouts.physics must be 'mujoco' or 'warp', got {self.physics!r}")


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
    """"onedemo", or "paper": the settings of Gandhi et al. 2019 (``METHODS``)."""
    seed: int = 0
    """Of every random number in the run."""
    env: str = "hopper"
    """The robot: a name in the registry of ``trainer/sim/vector_env.py``."""
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

    def __post_init__(self) -> None:
        _one_of("method", self.method, tuple(METHODS))
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise ValueError(f'device must be "cpu", "cuda" or "cuda:N", got {self.device!r}')


def split_ratings(total: int) -> tuple[int, int]:
    """A budget of ratings before practice and during it, in the paper's proportion of 200 to 150."""
    pretrain = max(1, round(total * 4 / 7))
    return pretrain, total - pretrain


def load_config(path: Path | None = None, overrides: dict[str, Any] | None = None) -> RunConfig:
    """The defaults, changed by a TOML file, changed by overrides.

    Args:
        path: TOML file, or None.
        overrides: ``{"trpo.max_kl": 0.02}``: dotted key to value, as TOML would give it.

    Raises:
        UserError: If the file cannot be read, a key does not exist or a value does not fit.
    """
    tree: dict[str, Any] = {}
    if path is not None:
        try:
            tree = tomllib.loads(path.read_text())
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"cannot read the config file {path}: {error}") from None
        except tomllib.TOMLDecodeError as error:
            raise UserError(f"{path} is not valid TOML: {error}") from None
    for dotted, value in (overrides or {}).items():
        branch, key = _place(tree, dotted)
        branch[key] = value
    for dotted, value in METHODS.get(str(tree.get("method")), {}).items():
        branch, key = _place(tree, dotted)
        branch.setdefault(key, value)
    return _build(RunConfig(), tree, "")


def settings_for_another(config: RunConfig, method: str) -> dict[str, Any]:
    """A run's settings as overrides for ``load_config``; for another method those that none decides."""
    decided = set() if method == config.method else set().union(*METHODS.values())
    flat: dict[str, Any] = {}
    for name, value in tomllib.loads(to_toml(config)).items():
        if isinstance(value, dict):
            flat |= {f"{name}.{key}": each for key, each in value.items()}
        else:
            flat[name] = value
    return {key: value for key, value in flat.items() if key not in decided} | {"method": method}


def _place(tree: dict[str, Any], dotted: str) -> tuple[dict[str, Any], str]:
    """The section of a dotted key, made if missing, and the key in it."""
    *sections, key = dotted.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise UserError(f"{dotted}: {section!r} is a value, not a section")
    return tree, key


def parse_override(text: str) -> tuple[str, Any]:
    """``"trpo.max_kl=0.02"`` as a dotted key and a TOML value; a bare word counts as a string.

    Raises:
        UserError: If there is no ``=``.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise UserError(f"--set takes section.key=value, got {text!r}")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def to_toml(config: Any) -> str:
    """A config tree as TOML text that ``load_config`` reads back to the same tree."""
    lines, sections = [], []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            sections.append(f"\n[{entry.name}]\n{to_toml(value)}")
        else:
            lines.append(f"{entry.name} = {_toml_value(value)}\n")
    return "".join(lines + sections)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return repr(value)


def _build(default: T, tree: dict[str, Any], prefix: str) -> T:
    hints = get_type_hints(type(default))
    known: dict[str, Any] = {}
    for key, value in tree.items():
        if key not in hints:
            nearest = difflib.get_close_matches(key, list(hints), n=1, cutoff=0)
            raise UserError(f"unknown key {prefix + key!r}; the nearest valid one is {prefix + nearest[0]!r}")
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            if not isinstance(value, dict):
                raise UserError(f"{prefix + key} is a section, not a value")
            known[key] = _build(getattr(default, key), value, f"{prefix}{key}.")
        else:
            known[key] = _fit(prefix + key, value, hint)
    try:
        return dataclasses.replace(default, **known)  # type: ignore[type-var]
    except ValueError as error:
        raise UserError(str(error)) from None


def _fit(key: str, value: Any, hint: Any) -> Any:
    """The value in the type of the field; whole numbers are also numbers."""
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is float and isinstance(value, float) and not math.isfinite(value):
        raise UserError(f"{key} must be a finite number, got {value}")
    if hint in (int, float, str, bool):
        if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
            names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
            raise UserError(f"{key} must be {names[hint]}, got {value!r}")
        return value
    if not isinstance(value, list) or not all(type(item) is int for item in value):
        raise UserError(f"{key} must be a list of whole numbers, got {value!r}")
    return tuple(value)


def _one_of(key: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{key} must be one of {', '.join(choices)}, got {value!r}")


def _at_least(config: Any, section: str, **minima: int) -> None:
    for name, minimum in minima.items():
        if getattr(config, name) < minimum:
            raise ValueError(f"{section}.{name} must be at least {minimum}, got {getattr(config, name)}")
