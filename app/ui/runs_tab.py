"""The Runs tab: all runs of the data directory, side by side; another one is opened or made here."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from onedemo.app.http.uploads import form_html
from onedemo.app.ui import charts
from onedemo.config import METHODS
from onedemo.demos.library import list_demos
from onedemo.types import HALTED, Status

if TYPE_CHECKING:
    from onedemo.app.ui.session import Session

_NEWEST = 6
"""Runs that are compared before anybody says which."""
_COMPARED = 12
"""Runs whose curves are drawn at most: more lines cannot be told apart."""


class Runs:
    """The Runs tab of one session."""

    title = "Runs"

    def __init__(self, session: Session) -> None:
        page = session.page
        self._store, self._run, self._trainer = page.trainer.store, page.trainer.run, page.trainer
        self._lock = threading.RLock()
        self._shown = False
        self._rows: dict[str, list[dict]] = {}
        self._told = ""
        gui = session.client.gui
        self._table = gui.add_html("")
        self._wanted = gui.add_text("Compare", "", hint="Names or parts of names, with commas between")
        self._wanted.on_update(lambda _: self.refresh(self._trainer.status()))
        self._told_which = gui.add_html("")
        self._client, self._drawn = session.client, []
        self._curves = [
            charts.Comparison(gui, key, title, dark=session.dark)
            for key, title in (
                ("predicted", "Predicted rating (1 to 5)"),
                ("true_reward", "True reward of an episode (points; never trained on)"),
            )
        ]
        demos = [demo.name for demo in list_demos(page.trainer.data_dir / "demos")]
        gui.add_html(new_run_html(demos, [entry["id"] for entry in self._store.runs.all()]))
        gui.add_html(form_html())

    def show(self) -> None:
        """Lists the runs."""
        with self._lock:
            self._shown = True
            self.refresh(self._trainer.status())

    def hide(self) -> None:
        """Stops following."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Follows the run at hand."""
        with self._lock:
            if not self._shown:
                return
            runs = self._store.runs.all()
            drawn, more = chosen_runs([run["id"] for run in runs], self._wanted.value, self._run)
            grown = drawn != self._drawn
            for run in drawn:
                rows = self._rows.setdefault(run, [])
                if run == self._run or not rows:
                    new = self._store.runs.iterations(run, after=rows[-1]["number"] if rows else 0)
                    rows += new
                    grown |= bool(new)
            told = runs_html(runs, self._figures(runs), self._run, status, drawn)
            with self._client.atomic():
                if told != self._told:
                    self._told = self._table.content = told
                if grown or not self._told_which.content:
                    self._drawn = drawn
                    self._told_which.content = which_html(drawn, more)
                    for curve in self._curves:
                        curve.draw({run: self._rows[run] for run in drawn})

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _figures(self, runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        figures = {}
        for run in runs:
            name = run["id"]
            rows = self._rows.get(name)
            last = rows[-1] if rows else (self._store.runs.last_iteration(name) or {})
            figures[name] = {"ratings": sum(self._store.ratings.by_class(name)), **last}
        return figures


def chosen_runs(runs: Sequence[str], wanted: str, current: str) -> tuple[list[str], int]:
    """Which runs are compared.

    Args:
        runs: All, oldest first.
        wanted: Names or parts of names, with commas between; a whole name means that run alone. Nothing: the
            newest, and the one at hand.
        current: The one at hand.

    Returns:
        Their names, the newest first, at most so many as can be told apart; and how many more were wanted.
    """
    newest = list(reversed(runs))
    parts = [part.strip().lower() for part in wanted.split(",") if part.strip()]
    if not parts:
        others = [run for run in newest if run != current]
        kept = {current, *others[: _NEWEST - 1]}
        return [run for run in newest if run in kept], 0
    whole = {run.lower() for run in runs}
    found = [
        run
        for run in newest
        if any(part == run.lower() or (part not in whole and part in run.lower()) for part in parts)
    ]
    return found[:_COMPARED], max(0, len(found) - _COMPARED)


def which_html(drawn: Sequence[str], more: int) -> str:
    """What the curves show, in words."""
    if not drawn:
        told = "No run has such a name."
    elif more:
        told = f"The newest {len(drawn)} of {len(drawn) + more} such runs are drawn."
    else:
        told = f"{len(drawn)} run{'' if len(drawn) == 1 else 's'} drawn."
    return f'<p class="od-which od-quiet" role="status">{told}</p>'


def runs_html(
    runs: Sequence[Mapping[str, Any]], figures: Mapping[str, Mapping[str, Any]], current: str,
    status: Status, drawn: Sequence[str],
) -> str:  # fmt: skip
    """The table of runs, the newest first.

    Args:
        runs: As ``Store.runs.all``.
        figures: Of each: ``ratings``, and the newest iteration's.
        current: The one that is served.
        status: Of that one.
        drawn: Those whose curves are drawn.
    """
    heads = (
        "Run", "Demonstration", "Method", "Seed", "Ratings", "Iterations", "Control steps",
        "Predicted rating", "True reward", "Compare", "",
    )  # fmt: skip
    rows = ""
    for run in reversed(runs):
        name, row = run["id"], figures[run["id"]]
        here = name == current
        what = f'data-do="open run" data-run="{escape(name)}"'
        action = f'<button type="button" class="od-button od-small" {what}>Open</button>'
        if here:
            action = _here_html(status)
        cells = (
            escape(run["demo"]), escape(method_of(run["config"])), run["seed"], row["ratings"],
            f"{row['number']:,}" if "number" in row else "–",
            charts.short(row["env_steps"]) if "env_steps" in row else "–",
            _figure(row.get("predicted"), "of 5"), _figure(row.get("true_reward"), "points"),
            f'<button type="button" class="od-button od-small" data-compare="{escape(name)}" '
            f'aria-pressed="{str(name in drawn).lower()}" aria-label="Compare {escape(name)}">'
            f"{'✓' if name in drawn else '+'}</button>",
            action,
        )  # fmt: skip
        made = f"made {run['created_at'][:16].replace('T', ' ')} UTC"
        rows += (
            f'<tr{" class=od-current" if here else ""}>'
            f'<th scope="row" title="{escape(made)}">{escape(name)}</th>'
            + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        )  # fmt: skip
    head = "".join(f'<th scope="col">{text}</th>' for text in heads)
    return (
        '<article class="od-data od-runs"><div class="od-data-top"><div><h1>Runs</h1>'
        "<p>One at a time is trained and rated. Opening another stops this one after its iteration; nothing "
        "is lost. To branch off a run, make a new one whose predictor starts from that run’s.</p></div></div>"
        '<section><div class="od-scroll" tabindex="0" role="region" aria-label="Runs">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div></section>"
        "<h2>Compare</h2><p class=od-quiet>Tick a run in the column Compare, or write a part of its name."
        "</p></article>"
    )


def _here_html(status: Status) -> str:
    """What the run at hand does, and the button that halts it or lets it go on."""
    act, label = ("resume", "Resume") if status.phase in HALTED else ("pause", "Pause")
    button = f'<button type="button" class="od-button od-small" data-do="{act} run">{label}</button>'
    return f"<b>{escape(status.phase)}</b> {button if status.phase != 'done' else ''}"


def new_run_html(demos: Sequence[str], runs: Sequence[str]) -> str:
    """The form for a new run. Drawn once, so that nothing that is being filled in is lost."""

    def options(values: Sequence[str], first: str = "") -> str:
        return first + "".join(f"<option>{escape(value)}</option>" for value in values)

    nothing = '<option value="">nothing: from scratch</option>'
    return (
        '<article class="od-data od-new-run"><section><h3>New run</h3>'
        '<form class="od-filter" data-act="new run">'
        f'<label>Demonstration <select name="demo">{options(demos)}</select></label>'
        f'<label>Method <select name="method">{options(list(METHODS))}</select></label>'
        '<label>Seed <input name="seed" type="number" min="0" max="999999" value="0" required></label>'
        '<label>Name <input name="name" maxlength="64" placeholder="given if left empty"></label>'
        '<label>Predictor starts from <select name="predictor_from">'
        f"{options(runs, nothing)}</select></label>"
        '<button class="od-button od-primary">Start</button></form>'
        '<p class="od-form-note" role="status"></p>'
        "<p class=od-quiet>A run that starts from another’s predictor keeps what raters looked at there; it "
        "must be of the same method.</p></section></article>"
    )


def method_of(config: str) -> str:
    """The method in a run's settings; runs of before there were two are the paper's."""
    for line in config.splitlines():
        if line.startswith("method = "):
            return line.partition('"')[2].rstrip('"')
    return "paper"


def _figure(value: float | None, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value:,.{0 if unit == 'points' else 1}f} <small>{unit}</small>"
