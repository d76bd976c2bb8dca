"""What every report of a table has to say: what was run, with what, where, and what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from onedemo.experiments.registry import TUNING_FROM
from onedemo.experiments.report.blocks import Block, Document, Heading, Table, Text, number
from onedemo.experiments.report.document import about
from onedemo.experiments.runner import Outcome, by_label, kind_of

_IN_ITS_FILE = ("curve", "errors", "episode")
"""What a result may hold that is too long for a report's figures."""


def complete(report: Document, outcomes: Sequence[Outcome], *, command: str, quick: bool) -> Document:
    """A table's report with what every report has to say: what was run, with what, and what is missing.

    Args:
        report: Of the table.
        outcomes: What it was made of.
        command: What was typed.
        quick: Whether it is the quick form.
    """
    versions = {outcome.job.kind: kind_of(outcome.job).version for outcome in outcomes}
    warnings: list[Block] = []
    if quick:
        warnings.append(Text("**The quick form**: small and rough, to see that everything works."))
    if any(outcome.job.seed >= TUNING_FROM for outcome in outcomes):
        warnings.append(Text(f"**Not for reporting**: settings were tuned on seeds from {TUNING_FROM} on."))
    return replace(
        report,
        blocks=[*warnings, *report.blocks, Heading("The runs"), *_runs(outcomes)],
        about=about(command=command, method_versions=versions),
        data={**report.data, "runs": [_record(outcome) for outcome in outcomes]},
    )


def _runs(outcomes: Sequence[Outcome]) -> list[Block]:
    there = [outcome.kept for outcome in outcomes if outcome.kept is not None]
    rows = []
    for label, group in by_label(outcomes).items():
        kept = [outcome.kept for outcome in group if outcome.kept is not None]
        minutes = sum(each["wall_s"] for each in kept) / len(kept) / 60 if kept else None
        missing = [f"seed {o.job.seed} {o.state}" for o in group if o.kept is None]
        seeds = ", ".join(str(outcome.job.seed) for outcome in group)
        rows.append((label, seeds, f"{len(kept)} of {len(group)}", minutes, "; ".join(missing)))
    table = Table(heads=("runs", "seeds", "finished", "minutes each", "missing"), rows=rows)
    if not there:
        return [table]
    days = sorted({kept["date"][:10] for kept in there})
    made = sorted({f"{kept['version']} at commit {kept['commit'] or 'unknown'}" for kept in there})
    processors = sorted({kept["machine"]["processor"] for kept in there})
    loads = [kept["load_average"][0] / kept["machine"]["cores"] for kept in there]
    text = (
        f"{len(there)} of {len(outcomes)} runs, {number(sum(kept['wall_s'] for kept in there) / 3600)} hours "
        f"in all, each in a process of its own, {' to '.join(dict.fromkeys((days[0], days[-1])))}, "
        f"onedemo {', '.join(made)}, on {', '.join(processors)}; "
        f"load average {number(sum(loads) / len(loads))} a core when they ended."
    )
    return [Text(text), table]


def _record(outcome: Outcome) -> dict[str, Any]:
    """Of one run, without its curves and its episode: they are in its own file."""
    job = outcome.job
    kept = {key: value for key, value in (outcome.kept or {}).items() if key != "machine"}
    if outcome.result is not None:
        kept["result"] = {k: value for k, value in outcome.result.items() if k not in _IN_ITS_FILE}
    return {**job.description, **kept, "label": job.label, "key": job.key, "state": outcome.state}
