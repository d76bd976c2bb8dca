"""``onedemo bench``: speed, and the tables of the paper and ours."""

from __future__ import annotations

import argparse
import importlib.util
import json
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from onedemo.core.files import check_writable, write_atomic
from onedemo.errors import UserError
from onedemo.experiments.registry import TABLES, TUNING_FROM, default_seeds, find_table, parse_seeds


def add_commands(actions: Any, command: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds the sub-commands.

    Args:
        actions: Sub-parsers of ``onedemo bench``.
        command: Adds one: (actions, name, run, summary) to its parser.
    """
    speed = command(actions, "speed", _speed, "speed, memory and waiting beside peers and limits")
    _outputs(speed, quick="small and rough: under 2 minutes")
    speed.add_argument(
        "--part", dest="parts", action="append", metavar="PART", help="only this part; may be repeated"
    )
    for name, entry in TABLES.items():
        table = command(actions, name, _table, entry.summary)
        table.set_defaults(table=name)
        table.add_argument(
            "--seeds", type=_seeds, metavar="N or LIST",
            help="how many of the reporting seeds 0, 1, 2, ..., or a list such as 3,7,9; "
            f"settings were tuned on seeds from {TUNING_FROM} on, never on those reported",
        )  # fmt: skip
        _outputs(table, quick="small and rough: under 5 minutes")
        table.add_argument(
            "--results", type=Path, default=Path("bench-results"), metavar="DIR",
            help="where finished runs are kept; they are not run again (./bench-results)",
        )  # fmt: skip
        table.add_argument(
            "--workers", type=_at_least_1, metavar="N", help="runs side by side (one per core)"
        )
        table.add_argument(
            "--report-only", action="store_true", help="run nothing; report what there is, and what is not"
        )


def _outputs(parser: argparse.ArgumentParser, *, quick: str) -> None:
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write a report with charts there")


def _speed(arguments: argparse.Namespace) -> int:
    from onedemo.experiments.speed import parts, report

    unknown = {part for part in arguments.parts or () if "." not in part} - set(parts.PARTS)
    if unknown:
        raise UserError(f"unknown part {min(unknown)!r}; choose from: {', '.join(parts.PARTS)}")
    _check_outputs(arguments)
    began = time.monotonic()
    results = parts.measure(quick=arguments.quick, parts=arguments.parts or parts.PARTS, tell=_tell)
    about = report.as_json(results, command=_command_line(), seconds=time.monotonic() - began)
    print(report.table(results))
    if arguments.out is not None:
        report.write_report(arguments.out, "onedemo: speed", results, about)
    _write_json(arguments.json, about)
    return int(any(getattr(result, "failed", False) for result in results))


def _table(arguments: argparse.Namespace) -> int:
    from onedemo.experiments import runner
    from onedemo.experiments.report import document
    from onedemo.experiments.report.account import complete

    _check_outputs(arguments)
    _check_directory("--results", arguments.results)
    table, quick = find_table(arguments.table), arguments.quick
    jobs = table.plan(arguments.seeds or default_seeds(table, quick=quick), quick=quick)
    if arguments.report_only:
        outcomes = runner.peek(jobs, arguments.results)
    else:
        try:
            outcomes = runner.run_jobs(jobs, arguments.results, workers=arguments.workers, tell=_tell)
        except KeyboardInterrupt:
            _tell(
                f"stopped; finished runs are in {arguments.results}, and the same command goes on from them"
            )
            raise
    report = complete(table.report(outcomes, quick=quick), outcomes, command=_command_line(), quick=quick)
    print(document.as_text(report))
    if arguments.out is not None:
        document.write(report, arguments.out)
    _write_json(arguments.json, document.record(report))
    return int(any(outcome.failed for outcome in outcomes))


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Raises UserError now, and not after hours of work."""
    if arguments.json is not None:
        check_writable(arguments.json)
    if arguments.out is not None:
        _check_directory("--out", arguments.out)
        if importlib.util.find_spec("matplotlib") is None:
            raise UserError("--out needs matplotlib for its charts: pip install -e '.[bench]'")


def _check_directory(option: str, directory: Path) -> None:
    if directory.exists() and not directory.is_dir():
        raise UserError(f"{option} {directory} is a file; give the name of a directory")
    there = directory.absolute()
    while not there.exists():
        there = there.parent
    check_writable(there / "report")


def _write_json(file: Path | None, record: dict[str, Any]) -> None:
    if file is not None:
        write_atomic(file, (json.dumps(record, indent=1) + "\n").encode())


def _command_line() -> str:
    return shlex.join(["onedemo", *sys.argv[1:]])


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _seeds(text: str) -> tuple[int, ...]:
    try:
        return parse_seeds(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _at_least_1(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)
