"""The ``onedemo`` command. Heavy libraries are imported by the command that needs them."""

from __future__ import annotations

import difflib
import io
import os
import sys
from collections.abc import Sequence

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    Parameter,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from onedemo.app.admin import environment
from onedemo.core.process import prepare_process
from onedemo.errors import UserError

_APP_ONLY = (
    "aiohttp",
    "jinja2",
    "krippendorff",
    "markupsafe",
    "mjviser",
    "packaging",
    "pyarrow",
    "rich",
    "segno",
    "viser",
    "zstandard",
)
"""Packages of the extra ``app``: the library does without, the page and the data set do not."""


_COMMANDS = {
    "run:serve": "The web app with its trainer thread.",
    "run:train": "The same trainer without a browser, rated by a program.",
    "demos:demo": "Bring in and look at demonstration videos.",
    "robot:robot": "Bring in and look at robots: any MuJoCo model.",
    "people:rater": "People and their links.",
    "proxy:proxy": "Lines for nginx or Caddy before the server.",
    "people:rating": "Single ratings: withdraw one.",
    "people:audit": "Who signed in, took data out or changed a run.",
    "data:export": "The ratings as CSV, what was rated as Parquet.",
    "data:import_": "An export back into an empty data directory.",
    "admin:backup": "Everything in one file, also while the server runs.",
    "admin:restore": "A backup into a new data directory.",
    "admin:doctor": "What is wrong with installation and data, if anything.",
    "tidy:tidy": "Pictures that can be drawn again, deleted.",
    "baseline:baseline": "What the method is compared with.",
    "bench:bench": "Measure the program and the method.",
}
"""Where each command is, imported only when it is asked for, and its line of the help."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line and returns the exit code: 0, or 2 for bad input."""
    _speak_any_terminal()
    if said := environment.unsupported():
        print(f"onedemo: {said}", file=sys.stderr)
        return 2
    prepare_process()
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        command, bound, _ = _app().parse_args(words, exit_on_error=False, print_error=False)
        helps = getattr(command, "__name__", "") == "help_print"
        if helps and not {"--help", "-h"} & set(words):
            raise UserError(f"a command is missing (see `{' '.join(['onedemo', *words])} --help`)")
        code = command(*bound.args, **bound.kwargs) or 0
        if helps and words[0] in ("serve", "train"):
            from onedemo.app.cli.run import settings_help

            print(settings_help())
        return code
    except CycloptsError as error:
        where = " ".join(["onedemo", *(error.command_chain or ())])
        print(f"onedemo: {_sentence(error)} (see `{where} --help`)", file=sys.stderr)
        return 2
    except UserError as error:
        print(f"onedemo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of our output has gone (head, less)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:  # a broken installation fails anywhere, and in any way
        said = _what_is_missing(error)
        if not said:
            raise
        print(f"onedemo: {said}", file=sys.stderr)
        return 2


def _speak_any_terminal() -> None:
    """A name that the terminal's character set lacks is written with its number, and ends no command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _what_is_missing(error: Exception) -> str:
    """What is wrong with the installation, if that may be why something failed; else ""."""
    if isinstance(error, ModuleNotFoundError) and (error.name or "").split(".")[0] in _APP_ONLY:
        return f"{error.name} is not installed: pip install 'onedemo[app]'"
    said = "; ".join(environment.faults())
    return f"{said} (after {type(error).__name__}: {error})" if said else ""


def _app() -> App:
    app = App(
        name="onedemo",
        help="Teach a simulated robot a move from one video and your ratings.",
        version=_version,
        help_format="plaintext",
        help_formatter="plain",
        default_parameter=Parameter(negative=(), allow_repeating=True),  # the last one holds
    )
    for place, summary in _COMMANDS.items():
        name = place.split(":")[1].rstrip("_")
        app.command(f"onedemo.app.cli.{place}", name=name, help=summary)
    return app


def _sentence(error: CycloptsError) -> str:
    """What was wrong with the words of a command line."""
    if isinstance(error, UnknownOptionError):
        word = error.token.keyword or error.token.value
        options = [name for argument in error.argument_collection for name in argument.names]
        nearest = difflib.get_close_matches(word, options, n=1, cutoff=0.5)
        return f"unknown option {word}" + (f"; did you mean {nearest[0]}?" if nearest else "")
    if isinstance(error, UnknownCommandError):
        word = (error.unused_tokens or ["?"])[0]
        known = sorted(name for name in error.app if not name.startswith("-")) if error.app else []
        return f"invalid choice: {word!r}; choose from {', '.join(known)}"
    if isinstance(error, CoercionError) and error.token is not None:
        kinds = getattr(error.target_type, "__args__", (error.target_type,))
        number = next((kind.__name__ for kind in kinds if kind in (int, float)), "")
        wrong = f"invalid {number} value" if number else "invalid choice"
        return f"argument {error.token.keyword}: {wrong}: {error.token.value!r}"
    if isinstance(error, UnusedCliTokensError):
        return f"unexpected argument: {' '.join(error.unused_tokens or ())}"
    said = " ".join(str(error).split()).rstrip(".")
    return said[:1].lower() + said[1:]


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"onedemo {version('onedemo')}"
    except PackageNotFoundError:
        return "onedemo (not installed)"


if __name__ == "__main__":
    sys.exit(main())
