"""The data card of a data set of ratings, in Markdown: what it is, how it came about, what it is worth."""

from __future__ import annotations

import html
import re
from datetime import UTC, datetime
from typing import Any

from onedemo.app.annotation.agreement import Quality, quality, quality_by_rater, rating_rows
from onedemo.app.annotation.scale import ANSWERS
from onedemo.app.dataset.columns import COMPARISONS, HISTORY, PAIRS, RATINGS, SEGMENTS, SKIPS, as_table
from onedemo.demos.library import list_demos
from onedemo.storage.rating_counts import Counts
from onedemo.storage.store import Store
from onedemo.training.runs import program_version

_MOST_WITHDRAWN = 1000
"""Withdrawn ratings of a run that are listed, the newest."""


def card(store: Store, run: str | None = None, *, now: datetime | None = None) -> str:
    """The card of one run's ratings, or of all runs.

    Args:
        store: Where they are.
        run: Of this run alone.
        now: When it is written.
    """
    runs = [entry for entry in store.runs.all() if run in (None, entry["id"])]
    edits = {demo.sha256: demo.edits for demo in list_demos(store.path.parent / "demos")}
    when = f"{now or datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    parts = [
        f"# Ratings of robot motion: {_text(run) if run else 'all runs'}\n\n"
        f"Written by onedemo {program_version()}, {when}.\n",
        "## What it is\n\n"
        "People (or programs) saw two short movements side by side: a moment of one demonstration video, and "
        "something a simulated robot did (which one: `env` in the settings). They rated how alike the two "
        "are:\n\n"
        + "".join(f"- {value}: {answer}\n" for value, answer in enumerate(ANSWERS, 1))
        + "\nThe question was: *How alike are the two movements?* Raters had two practice clips before the "
        "first real one, could skip, take back, and mark where in a clip it goes wrong. The motion comes "
        "from random actions at first (stage *pretrain*) and from the policy in training later (*online*); "
        "which clips were asked is in `choice`. It is no random sample of anything: later clips depend on "
        "earlier ratings.\n",
        "## Runs\n\n" + "".join(_run(store, entry, edits.get(entry["demo_sha256"], "")) for entry in runs),
        "## Columns of the ratings (CSV)\n\nUTF-8, one header, one row a rating that holds. A text that a "
        "spreadsheet would take for a formula begins with an apostrophe. Names may look like numbers: read "
        "them as text, in pandas with `dtype={'rater': str, 'run': str, 'demo': str}`.\n\n"
        + as_table(RATINGS),
        "## Columns of the segments (Parquet)\n\nOne row a clip that somebody rated or skipped, key "
        "`clip_id`. The file's metadata `onedemo.training.runs` holds the settings of each run.\n\n"
        + as_table(SEGMENTS),
        "## Columns of the comparisons (CSV)\n\nAnswers to *Which of the two is closer to the video?*\n\n"
        + as_table(COMPARISONS),
        "## Columns of the pairs (Parquet)\n\nOne row a pair that somebody compared or skipped, key "
        "`pair_id`.\n\n" + as_table(PAIRS),
        "## Columns of the skips (CSV)\n\n" + as_table(SKIPS),
        "## Columns of the history (CSV)\n\nWhat does not hold any more, and who was left out.\n\n"
        + as_table(HISTORY),
        "## Limits\n\n"
        "- Names of raters are in the data. Replace them before you publish it, and ask the raters.\n"
        "- Ratings are of one robot beside one video, at the speed of the page; they say nothing of others.\n"
        "- A rating says how alike two movements look, not how good either is.\n",
    ]
    return "\n".join(parts)


def _run(store: Store, entry: dict[str, Any], edits: str) -> str:
    run = entry["id"]
    people = {rater.name: rater for rater in store.accounts.raters()}
    rows = rating_rows(store, run)
    whole, each = quality(rows), quality_by_rater(rows)
    left_out, counts = store.ratings.left_out(run), sum(store.ratings.counts(run).values(), Counts())
    classes = map(str, range(1, 6))
    heads = ("rater", "role", "ratings", *classes, "alpha", "same on repeats", "median s", "note")
    lines = [_line(("all", "", *_figures(whole), ""))]
    for rater, figures in each.items():
        person = people[rater]
        notes = [*figures.warnings, *(["left out of training"] if person.id in left_out else [])]
        lines.append(_line((rater, person.role, *_figures(figures), "; ".join(notes))))
    return (
        f"### {_text(run)}\n\nDemonstration {_text(entry['demo'])} (SHA-256 "
        f"{_text(entry['demo_sha256'][:16])}…), seed {_text(entry['seed'])}, "
        f"made {_text(entry['created_at'])} with onedemo {_text(entry['version'])}.\n\n"
        + (f"What was done to the video of the demonstration: {_text(edits)}.\n\n" if edits else "")
        + f"{counts.given} ratings given, a row each in the CSV: {counts.used} used for training, "
        f"{counts.repeats} repeats, {counts.excluded} of excluded raters. Beside them "
        f"{counts.skipped} skipped clips and {counts.withdrawn} withdrawn ratings.\n\n"
        + _line(heads) + _line(["---"] * len(heads)) + "".join(lines) + "\n" + _withdrawn(store, run)
    )  # fmt: skip


def _withdrawn(store: Store, run: str) -> str:
    """What a researcher took back, and why; it is not among the ratings."""
    rows = store.ratings.given(run, withdrawn=True, most=_MOST_WITHDRAWN)
    if not rows:
        return ""
    heads = ("withdrawn rating", "clip", "rater", "value", "reason")
    lines = (_line((row.event, row.clip, row.rater, row.value, row.withdrawn)) for row in rows[::-1])
    return _line(heads) + _line(["---"] * len(heads)) + "".join(lines) + "\n"


def _figures(figures: Quality) -> list[str]:
    shares = [f"{100 * share:.0f} %" for share in figures.shares]
    alike = figures.agreement
    alpha = "–" if alike.alpha is None else f"{alike.alpha:.2f}"
    if alike.alpha is not None and alike.low is not None and alike.high is not None:
        alpha += f" ({alike.low:.2f} to {alike.high:.2f}, {alike.clips} clips)"
    same = "–" if figures.same is None else f"{100 * figures.same:.0f} % of {figures.repeats}"
    seconds = "–" if figures.seconds is None else f"{figures.seconds:.1f}"
    return [str(figures.ratings), *shares, alpha, same, seconds]


def _line(cells: Any) -> str:
    return f"| {' | '.join(_text(cell) for cell in cells)} |\n"


def _text(cell: object) -> str:
    """As text in Markdown: nothing in it makes a column, a tag or a link."""
    return re.sub(r"([\\|`*_\[\]])", r"\\\1", html.escape(str(cell), quote=False))
