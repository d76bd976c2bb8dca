"""The ``onedemo`` command. Heavy libraries are imported by the command that needs them."""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from onedemo.app.cli.admin import add_care_commands
from onedemo.app.cli.bench import add_commands
from onedemo.app.cli.data import add_data_commands, add_data_dir, check_output, open_store
from onedemo.app.cli.people import add_people_commands
from onedemo.core.process import prepare_process
from onedemo.errors import UserError

_APP_ONLY = ("aiohttp", "jinja2", "krippendorff", "markupsafe", "mjviser", "packaging", "pyarrow", "viser")
"""Packages of the extra ``app``: the library does without, the page and the data set do not."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 0, or 2 for bad input."""
    prepare_process()
    try:
        arguments = _parser().parse_args(argv)
        return arguments.run(arguments) or 0
    except UserError as error:
        print(f"onedemo: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in _APP_ONLY:
            raise
        print(f"onedemo: {error.name} is not installed: pip install 'onedemo[app]'", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output has gone (head, less)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


class _Parser(argparse.ArgumentParser):
    """Argument errors in one sentence that names the nearest valid option."""

    def error(self, message: str) -> NoReturn:
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        if unknown:
            options = [o for action in self._actions for o in action.option_strings]
            nearest = difflib.get_close_matches(unknown[1].split("=")[0], options, n=1, cutoff=0.5)
            hint = f"; did you mean {nearest[0]}?" if nearest else ""
            message = f"unknown option {unknown[1]}{hint}"
        raise UserError(f"{message} (see `{self.prog} --help`)")

    def parse_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Lets the sub-command name its own nearest option."""
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            getattr(parsed, "parser", self).error(f"unrecognized arguments: {unknown[0]}")
        return parsed


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="onedemo", description="Teach a simulated robot a move from one video and your ratings."
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    serve = _command(commands, "serve", _serve, "the web app with its trainer thread")
    _run_options(serve)
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (127.0.0.1)")
    serve.add_argument("--port", type=_port, default=8080, help="port of the web page (8080)")
    serve.add_argument("--tls-cert", type=Path, metavar="FILE", help="certificate chain, PEM")
    serve.add_argument("--tls-key", type=Path, metavar="FILE", help="its private key, PEM")
    serve.add_argument(
        "--behind-proxy", action="store_true", help="a proxy that speaks TLS is before it, and is believed"
    )
    serve.add_argument(
        "--allow-host", action="append", default=[], metavar="NAME",
        help="a host name that people use, such as study.example.org; may be repeated",
    )  # fmt: skip
    serve.add_argument("--new-run", action="store_true", help="start over instead of going on")
    serve.add_argument(
        "--shared",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="of clips shown to several people (0.1)",
    )
    serve.add_argument(
        "--repeated", type=float, default=0.04, metavar="SHARE",
        help="of clips shown to the same person again (0.04)",
    )  # fmt: skip

    serve.add_argument(
        "--compare", action="store_true", help="annotators may also say which of two clips is nearer"
    )

    train = _command(commands, "train", _train, "the same trainer without a browser, rated by a program")
    _run_options(train)
    train.add_argument(
        "--rater", default="oracle", metavar="NAME",
        help="oracle (default), script[:TABLE.json], package.module:Class; or oracle+mistake:0.1+jitter",
    )  # fmt: skip
    train.add_argument(
        "--ratings", type=int, metavar="N", help="ratings in all, 4 of 7 before practice (350)"
    )
    train.add_argument("--steps", type=int, metavar="N", help="control steps of practice (10 million)")
    train.add_argument(
        "--predictor-from", metavar="RUN", help="start from what this run's predictor knows of another move"
    )
    train.add_argument("--json", type=Path, metavar="FILE", help="write the summary there too")
    train.add_argument("--quiet", action="store_true", help="no progress bar")

    demo = _command(commands, "demo", None, "bring in and look at demonstration videos")
    actions = demo.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    add = _command(actions, "add", _demo_add, "bring in a video")
    add.add_argument("video", type=Path, help="any file that OpenCV decodes: mp4, webm, mov, avi, gif")
    add.add_argument("--name", required=True, help="what to call it")
    add.add_argument("--start", type=float, metavar="S", help="begin at this second")
    add.add_argument("--end", type=float, metavar="S", help="end at this second")
    add.add_argument("--crop", type=_crop, metavar="X,Y,W,H", help="keep this rectangle, pixels")
    add.add_argument("--mirror", action="store_true", help="swap left and right")
    add.add_argument("--fps", type=float, default=30.0, help="frames per second to keep (30)")
    listing = _command(actions, "list", _demo_list, "the demos there are")
    show = _command(actions, "show", _demo_show, "what is known of a demo")
    show.add_argument("name")
    for command in (add, listing, show):
        add_data_dir(command)

    add_people_commands(commands, _command)
    add_data_commands(commands, _command)
    add_care_commands(commands, _command)

    baseline = _command(commands, "baseline", None, "what the method is compared with")
    actions = baseline.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    trpo = _command(actions, "trpo", _baseline_trpo, "TRPO on a hand-coded reward")
    trpo.add_argument("--task", choices=("backflip", "hop"), default="backflip")
    trpo.add_argument("--steps", type=int, default=3_000_000, help="control steps (3 million)")
    trpo.add_argument("--seed", type=int, default=0)
    trpo.add_argument("--lanes", type=int, default=64, help="episodes side by side (64)")
    trpo.add_argument("--physics", choices=("mujoco", "warp"), default="mujoco")
    trpo.add_argument("--device", default="cpu", metavar="NAME", help="of the policy: cpu (default) or cuda")
    preferences = _command(
        actions, "preferences", _baseline_preferences, "learning from comparisons of two segments"
    )
    preferences.add_argument(
        "--comparisons", type=int, default=350, metavar="N", help="in all, 4 of 7 before practice (350)"
    )
    preferences.add_argument(
        "--from-run", metavar="NAME", help="learn from what people compared in this run, and ask nobody"
    )
    add_data_dir(preferences)
    preferences.add_argument("--steps", type=int, default=3_000_000, help="control steps (3 million)")
    preferences.add_argument("--seed", type=int, default=0)
    for command in (trpo, preferences):
        command.add_argument(
            "--out",
            type=Path,
            required=True,
            metavar="PREFIX",
            help="where to write PREFIX.json, .policy.pt and .hidden.npz",
        )

    bench = _command(commands, "bench", None, "measure the program and the method")
    actions = bench.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=_Parser)
    add_commands(actions, _command)
    return parser


def _command(commands: Any, name: str, run: Any, summary: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=summary, description=summary[0].upper() + summary[1:] + ".")
    parser.set_defaults(run=run, parser=parser)
    return parser


def _run_options(parser: argparse.ArgumentParser) -> None:
    add_data_dir(parser)
    parser.add_argument("--demo", default="hopper-backflip", metavar="NAME", help="what to learn")
    parser.add_argument(
        "--run", dest="run_name", metavar="NAME", help="go on with this run, or name a new one"
    )
    parser.add_argument(
        "--method", choices=("onedemo", "paper"), help="how to learn: onedemo (default), or as in the paper"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of all random numbers (0)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings in TOML")
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE",
        help="one setting, such as trpo.max_kl=0.02; may be repeated",
    )  # fmt: skip
    parser.add_argument("--device", metavar="NAME", help="of predictor and policy: cpu (default) or cuda")
    parser.add_argument("--encoder", metavar="NAME", help="efficientnet-lite0 (default) or vgg16")
    parser.add_argument("--encoder-weights", type=Path, metavar="FILE", help="instead of fetching them")


_SETTINGS = ("method", "seed", "device", "encoder")
"""Options that are settings of a run."""


def _config(arguments: argparse.Namespace) -> Any:
    from onedemo.config import load_config, parse_override, split_ratings

    overrides = dict(parse_override(text) for text in arguments.settings)
    for key in _SETTINGS:
        if getattr(arguments, key) is not None:
            overrides[key] = getattr(arguments, key)
    ratings = getattr(arguments, "ratings", None)
    if ratings is not None:
        if ratings < 2:
            raise UserError(f"--ratings must be at least 2, got {ratings}")
        overrides["ratings.pretrain"], overrides["ratings.online"] = split_ratings(ratings)
    if getattr(arguments, "steps", None) is not None:
        overrides["rollouts.total_steps"] = arguments.steps
    return load_config(arguments.config, overrides)


def _serve(arguments: argparse.Namespace) -> None:
    from onedemo.app.annotation.assignment import Again
    from onedemo.app.cli.serve import serve
    from onedemo.app.http.bind import Listening
    from onedemo.demos.library import find_demo

    listening = Listening(
        host=arguments.host, port=arguments.port, tls_cert=arguments.tls_cert, tls_key=arguments.tls_key,
        behind_proxy=arguments.behind_proxy, names=tuple(arguments.allow_host),
    )  # fmt: skip
    config = _config(arguments)
    try:
        again = Again(shared=arguments.shared, repeated=arguments.repeated)
    except ValueError as error:
        raise UserError(str(error)) from None
    serve(
        data_dir=arguments.data_dir,
        demo=find_demo(arguments.demo, arguments.data_dir / "demos"),
        config=config,
        explicit=bool(arguments.settings)
        or any(getattr(arguments, key) is not None for key in ("config", *_SETTINGS)),
        encoder_weights=arguments.encoder_weights,
        listening=listening,
        run=arguments.run_name,
        new_run=arguments.new_run,
        again=again,
        compare=arguments.compare,
    )


def _train(arguments: argparse.Namespace) -> None:
    from onedemo.core.files import write_atomic
    from onedemo.demos.library import find_demo
    from onedemo.reward.warm_start import newest_snapshot
    from onedemo.storage.store import Store
    from onedemo.training.simulated_run import train
    from onedemo.vision.encoders import make_encoder

    config = _config(arguments)
    if arguments.json is not None:
        check_output(arguments.json, arguments.data_dir)
    demo = find_demo(arguments.demo, arguments.data_dir / "demos")
    store = Store(arguments.data_dir)
    try:
        start = None
        if arguments.predictor_from is not None:
            start = newest_snapshot(store, arguments.data_dir, arguments.predictor_from)
        summary = train(
            store=store,
            data_dir=arguments.data_dir,
            demo=demo,
            config=config,
            encoder=make_encoder(config.encoder, arguments.encoder_weights),
            rater=arguments.rater,
            name=arguments.run_name,
            progress=not arguments.quiet,
            start=start,
        )
    finally:
        store.close()
    for key, value in summary.items():
        if isinstance(value, dict):
            value = "  ".join(f"{k} {v:g}" for k, v in value.items())
        print(f"{key:28} {value}")
    if arguments.json is not None:
        write_atomic(arguments.json, (json.dumps(summary, indent=2) + "\n").encode())


def _demo_add(arguments: argparse.Namespace) -> None:
    from onedemo.demos.library import import_video

    demo = import_video(
        arguments.video,
        name=arguments.name,
        demos_dir=arguments.data_dir / "demos",
        start=arguments.start,
        end=arguments.end,
        crop=arguments.crop,
        mirror=arguments.mirror,
        fps=arguments.fps,
    )
    if demo.name != arguments.name:
        print(f"this video with these options is known already, as {demo.name}")
    print(f"{demo.name}: {demo.seconds:.1f} s, {demo.frames} frames, {demo.width}x{demo.height}")
    print(f"learn it with: onedemo serve --demo {demo.name} --data-dir {arguments.data_dir}")


def _demo_list(arguments: argparse.Namespace) -> None:
    from onedemo.demos.library import list_demos

    for demo in list_demos(arguments.data_dir / "demos"):
        print(f"{demo.name:24} {demo.seconds:5.1f} s  {demo.width}x{demo.height}  {demo.source}")


def _demo_show(arguments: argparse.Namespace) -> None:
    from onedemo.demos.library import find_demo, show

    print(show(find_demo(arguments.name, arguments.data_dir / "demos")))


def _baseline_trpo(arguments: argparse.Namespace) -> None:
    from dataclasses import asdict

    from onedemo.baselines.handcoded_trpo import HandcodedConfig, save_result, train_handcoded

    lanes = max(1, arguments.lanes)
    config = HandcodedConfig(
        task=arguments.task,
        steps=arguments.steps,
        seed=arguments.seed,
        lanes=arguments.lanes,
        batch=max(1, 32_000 // lanes),  # an iteration is as long however many lanes share it
        physics=arguments.physics,
        device=arguments.device,
    )
    result = train_handcoded(config)
    save_result(arguments.out, result)
    for key, value in asdict(result.best_score).items():
        print(f"{key:18} {value:g}")


def _baseline_preferences(arguments: argparse.Namespace) -> None:
    from dataclasses import asdict

    from onedemo.baselines.preferences import (
        PreferencesConfig,
        save_preferences,
        split_comparisons,
        stored_comparisons,
        train_preferences,
    )

    pretrain, online = split_comparisons(arguments.comparisons)
    config = PreferencesConfig(pretrain=pretrain, online=online, steps=arguments.steps, seed=arguments.seed)
    given = []
    if arguments.from_run is not None:
        with open_store(arguments, must_exist=True) as store:
            given = stored_comparisons(store, arguments.from_run)
    result = train_preferences(config, given=given)
    save_preferences(arguments.out, result)
    for key, value in asdict(result.curve[-1]).items():
        print(f"{key:18} {value:g}")


def _crop(text: str) -> tuple[int, int, int, int]:
    from onedemo.demos.import_checks import read_crop

    try:
        return read_crop(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _port(text: str) -> int:
    if not text.isdigit() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to 65535, got {text!r}")
    return int(text)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"onedemo {version('onedemo')}"
    except PackageNotFoundError:
        return "onedemo (not installed)"


if __name__ == "__main__":
    sys.exit(main())
