"""The commands that learn: ``serve`` and ``train``. Their options are also all settings of a run."""

from __future__ import annotations

import json
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from onedemo.app.cli.data import DATA, DataDir, Whole, check_output
from onedemo.config import RunConfig, describe, load_config, parse_override, split_ratings
from onedemo.errors import UserError

if TYPE_CHECKING:
    from onedemo.types import Demo


@Parameter(name="*")
@dataclass(kw_only=True)
class RunOptions:
    """What ``serve`` and ``train`` have in common."""

    data_dir: DataDir = DATA
    demo: str = "hopper-backflip"
    """What to learn."""
    robot: str | None = None
    """Who learns it: see `onedemo robot list`, or gym:ID [default: whom the demo was made with]."""
    run: str | None = None
    """Resume this run, or name a new one."""
    method: Literal["onedemo", "paper"] | None = None
    """How to learn: onedemo (default), or as in the paper."""
    seed: Whole | None = None
    """Of all random numbers [default: 0]."""
    device: str | None = None
    """Of predictor and policy: cpu (default) or cuda."""
    encoder: str | None = None
    """efficientnet-lite0 (default) or vgg16."""
    config: Path | None = None
    """Settings in TOML."""
    set: list[str] | None = None
    """One setting as KEY=VALUE, such as trpo.max_kl=0.02; may be repeated."""
    encoder_weights: Path | None = None
    """Weights of the encoder, instead of fetching them."""

    def overrides(self) -> dict[str, Any]:
        """The settings that were typed; an option beats ``--set``."""
        typed = {key: getattr(self, key) for key in ("method", "seed", "device", "encoder")}
        typed["env"] = self.robot
        given = {key: value for key, value in typed.items() if value is not None}
        return dict(parse_override(text) for text in self.set or ()) | given

    def found(self, overrides: dict[str, Any]) -> tuple[Demo, RunConfig]:
        """The demo, and the settings of a run of it.

        Raises:
            UserError: If there is no such demo or setting.
        """
        from onedemo.demos.library import find_demo

        load_config(self.config, overrides)  # what is wrong with the settings comes first
        demo = find_demo(self.demo, self.data_dir / "demos")
        return demo, load_config(self.config, overrides, {"env": demo.robot} if demo.robot else {})


NONE = RunOptions()


def settings_help() -> str:
    """All settings, their defaults and what they mean, for the help."""
    lines = ["Settings, for --config and --set KEY=VALUE:"]
    for key, default, meaning in describe():
        lines.append(f"  {key} = {default}")
        lines += textwrap.wrap(meaning, 100, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def serve(
    options: RunOptions = NONE, *,
    host: str = "127.0.0.1", port: Whole = 8080, tls_cert: Path | None = None, tls_key: Path | None = None,
    behind_proxy: bool = False, allow_host: list[str] | None = None, base_path: str = "",
    new_run: bool = False, shared: float = 0.1, repeated: float = 0.04, compare: bool = False,
) -> None:  # fmt: skip
    """The web app with its trainer thread.

    Args:
        options: Of a run.
        host: Address to listen on.
        port: Port of the web page.
        tls_cert: Certificate chain, PEM.
        tls_key: Its private key, PEM.
        behind_proxy: A proxy that speaks TLS is before it, and is believed.
        allow_host: A host name that people use, such as study.example.org; may be repeated.
        base_path: What all addresses begin with, such as /study1, if a proxy passes on only that.
        new_run: Start over instead of resuming.
        shared: Share of clips shown to several people.
        repeated: Share of clips shown to the same person again.
        compare: Annotators may also say which of two clips is nearer.
    """
    if not 0 <= port <= 65535:
        raise UserError(f"argument --port: must be a whole number from 0 to 65535, got '{port}'")
    from onedemo.app.annotation.assignment import Again
    from onedemo.app.network.bind import Listening, check_port

    listening = Listening(
        host=host.removeprefix("[").removesuffix("]"), port=port, tls_cert=tls_cert, tls_key=tls_key,
        behind_proxy=behind_proxy, names=tuple(allow_host or ()),
        base_path=base_path.rstrip("/"),
    )  # fmt: skip
    overrides = options.overrides()
    demo, config = options.found(overrides)
    try:
        again = Again(shared=shared, repeated=repeated)
    except ValueError as error:
        raise UserError(str(error)) from None
    listening.ssl_context()
    check_port(listening.host, listening.port)
    # Only now: it loads all that computes and draws, which takes seconds.
    from onedemo.app.cli.serve import serve as serve_page

    serve_page(
        data_dir=options.data_dir,
        demo=demo,
        config=config,
        explicit=bool(overrides) or options.config is not None,
        encoder_weights=options.encoder_weights,
        listening=listening,
        run=options.run,
        new_run=new_run,
        again=again,
        compare=compare,
    )


def train(
    options: RunOptions = NONE, *,
    rater: str = "oracle", ratings: Whole | None = None, steps: Whole | None = None,
    predictor_from: str | None = None, json_: Annotated[Path | None, Parameter("--json")] = None,
    quiet: bool = False,
) -> None:  # fmt: skip
    """The same trainer without a browser, rated by a program.

    Args:
        options: Of a run.
        rater: oracle, script[:TABLE.json], package.module:Class; or oracle+mistake:0.1+jitter.
        ratings: Ratings in all, 4 of 7 before practice [default: 350].
        steps: Control steps of practice [default: 10 million].
        predictor_from: Start from what this run's predictor knows of another move.
        json_: Write the summary there too.
        quiet: No progress bar.
    """
    overrides = options.overrides()
    if ratings is not None:
        if ratings < 2:
            raise UserError(f"--ratings must be at least 2, got {ratings}")
        overrides["ratings.pretrain"], overrides["ratings.online"] = split_ratings(ratings)
    if steps is not None:
        overrides["rollouts.total_steps"] = steps
    demo, config = options.found(overrides)

    from onedemo.core.files import write_atomic
    from onedemo.reward.warm_start import newest_snapshot
    from onedemo.robots import registry
    from onedemo.storage.store import Store
    from onedemo.training.simulated_run import train as train_run
    from onedemo.vision.encoders import make_encoder

    if json_ is not None:
        check_output(json_, options.data_dir)
    registry.use(options.data_dir)
    store = Store(options.data_dir)
    try:
        start = None
        if predictor_from is not None:
            start = newest_snapshot(store, options.data_dir, predictor_from)
        summary = train_run(
            store=store,
            data_dir=options.data_dir,
            demo=demo,
            config=config,
            encoder=make_encoder(config.encoder, options.encoder_weights),
            rater=rater,
            name=options.run,
            progress=not quiet,
            start=start,
        )
    finally:
        store.close()
    for key, value in summary.items():
        if isinstance(value, dict):
            value = "  ".join(f"{k} {v:g}" for k, v in value.items())
        print(f"{key:28} {value}")
    if json_ is not None:
        write_atomic(json_, (json.dumps(summary, indent=2) + "\n").encode())
