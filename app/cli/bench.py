"""``onedemo bench``: speed, and the tables of the paper and ours."""

from __future__ import annotations

import importlib.util
import json
import shlex
import sys
import time
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from onedemo.app.cli.data import Whole
from onedemo.core.files import write_atomic
from onedemo.core.outputs import check_outputs
from onedemo.errors import UserError
from onedemo.experiments.registry import TABLES, TUNING_FROM, default_seeds, find_table, parse_seeds

Seeds = Annotated[
    str | None,
    Parameter(
        help="How many of the reporting seeds 0, 1, 2, ..., or a list such as 3,7,9; "
        f"settings were tuned on seeds from {TUNING_FROM} on, never on those reported."
    ),
]
Quick = Annotated[bool, Parameter(help="Small and rough: under 2 minutes for speed, 5 for a table.")]
Json = Annotated[Path | None, Parameter("--json", help="Write all figures there.")]
Out = Annotated[Path | None, Parameter(help="Write a report with charts there.")]


def __getattr__(name: str) -> App:
    """``bench``: the command, with one for each table that there is when it is asked for."""
    if name != "bench":
        raise AttributeError(name)
    app = App(name="bench", help="Measure the program and the method.")
    app.command(speed)
    for table, entry in TABLES.items():
        app.command(_table(table), name=table, help=f"{entry.summary[0].upper()}{entry.summary[1:]}.")
    return app


def speed(*, part: list[str] | None = None, quick: Quick = False, json_: Json = None, out: Out = None) -> int:
    """Speed, memory and waiting beside peers and limits.

    Args:
        part: Only this part; may be repeated.
    """
    from onedemo.experiments.speed import parts, report

    unknown = {name for name in part or () if "." not in name} - set(parts.PARTS)
    if unknown:
        raise UserError(f"unknown part {min(unknown)!r}; choose from: {', '.join(parts.PARTS)}")
    _check_outputs(json_, out)
    began = time.monotonic()
    measured = parts.measure(quick=quick, parts=part or parts.PARTS, tell=_tell)
    about = report.as_json(measured, command=_command_line(), seconds=time.monotonic() - began)
    print(report.table(measured))
    if out is not None:
        report.write_report(out, "onedemo: speed", measured, about)
    _write_json(json_, about)
    return int(any(getattr(result, "failed", False) for result in measured))


def _table(name: str) -> Any:
    """The command of a table."""

    def table(
        *, seeds: Seeds = None, quick: Quick = False, json_: Json = None, out: Out = None,
        results: Path = Path("bench-results"), workers: Whole | None = None, report_only: bool = False,
    ) -> int:  # fmt: skip
        """A table.

        Args:
            results: Where finished runs are kept; they are not run again.
            workers: Runs side by side (one per core).
            report_only: Run nothing; report what there is, and what is not.
        """
        from onedemo.experiments import runner
        from onedemo.experiments.report import document
        from onedemo.experiments.report.account import complete

        try:
            numbers = parse_seeds(seeds) if seeds is not None else None
        except ValueError as error:
            raise UserError(f"argument --seeds: {error}") from None
        if workers is not None and workers < 1:
            raise UserError(f"argument --workers: must be a whole number of at least 1, got '{workers}'")
        _check_outputs(json_, out, results)
        asked = find_table(name)
        jobs = asked.plan(numbers or default_seeds(asked, quick=quick), quick=quick)
        if report_only:
            outcomes = runner.peek(jobs, results)
        else:
            try:
                outcomes = runner.run_jobs(jobs, results, workers=workers, tell=_tell)
            except KeyboardInterrupt:
                _tell(f"stopped; finished runs are in {results}, and the same command goes on from them")
                raise
        report = asked.report(outcomes, quick=quick)
        report = complete(report, outcomes, command=_command_line(), quick=quick)
        print(document.as_text(report))
        if out is not None:
            document.write(report, out)
        _write_json(json_, document.record(report))
        return int(any(outcome.failed for outcome in outcomes))

    return table


def _check_outputs(file: Path | None, out: Path | None, results: Path | None = None) -> None:
    """Raises UserError now, and not after hours of work."""
    check_outputs(file, directories={"--out": out, "--results": results})
    if out is not None and importlib.util.find_spec("matplotlib") is None:
        raise UserError("--out needs matplotlib for its charts: pip install -e '.[bench]'")


def _write_json(file: Path | None, record: dict[str, Any]) -> None:
    if file is not None:
        write_atomic(file, (json.dumps(record, indent=1) + "\n").encode())


def _command_line() -> str:
    return shlex.join(["onedemo", *sys.argv[1:]])


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
