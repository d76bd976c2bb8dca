"""The Runs tab: all runs of the data directory, side by side; another one is opened, made or deleted here.

And the demos: brought in, renamed, removed (static/demos.js, static/forms.js).
"""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from markupsafe import Markup

from onedemo.app.annotation.phases import NAMES
from onedemo.app.http.uploads import LARGEST
from onedemo.app.tabs import charts
from onedemo.app.tabs.context import TabContext
from onedemo.app.templates import render
from onedemo.config import METHODS, RunConfig, describe
from onedemo.demos.edits import USEFUL_SECONDS
from onedemo.demos.library import list_demos
from onedemo.queries.settings import CHOICES
from onedemo.robots.registry import names
from onedemo.storage.rating_counts import Counts
from onedemo.types import HALTED, Demo, Status

_NEWEST = 6
"""Runs that are compared before anybody says which."""
_COMPARED = 12
"""Runs whose curves are drawn at most: more lines cannot be told apart."""
_DEMOS_EVERY = 4
"""Looks at the runs between two at the library of demos."""


class Runs:
    """The Runs tab of one session."""

    title = "Runs"

    def __init__(self, context: TabContext) -> None:
        self._store, self._run, self._training = context.store, context.run, context.training
        self._demos_dir = context.data_dir / "demos"
        self._lock = threading.RLock()
        self._shown = False
        self._rows: dict[str, list[dict]] = {}
        self._said: dict[str, str] = {}
        self._looks = 0
        gui = context.client.gui
        self._table = gui.add_html("")
        # Which runs are compared: the browser writes their names here, and nobody sees it.
        self._wanted = gui.add_text("Compared runs", "")
        self._wanted.on_update(lambda _: self.refresh(self._training.status()))
        self._told_which = gui.add_html("")
        self._client, self._drawn = context.client, []
        self._curves = [
            charts.Comparison(gui, key, title, dark=context.dark)
            for key, title in (("predicted", "Predicted rating"), ("true_reward", "True reward"))
        ]
        # The forms are drawn once, so that nothing that is being filled in is lost.
        runs = self._store.runs.all()
        config = next((run["config"] for run in runs if run["id"] == self._run), "")
        gui.add_html(
            str(
                render(
                    "runs.html:new_run",
                    demos=[(demo.name, demo.robot) for demo in list_demos(self._demos_dir)],
                    robots=names(), robot=settings_of(config)["env"],
                    methods=list(METHODS), runs=[run["id"] for run in reversed(runs)],
                    fields=fields_of(config), choices=list(CHOICES), said=_meanings(),
                )
            )
        )  # fmt: skip
        self._demos = gui.add_html("")
        dialogs = (
            render("runs.html:edit_run"), render("runs.html:edit_demo"),
            render("runs.html:new_demo", megabytes=LARGEST >> 20, useful=USEFUL_SECONDS),
        )  # fmt: skip
        gui.add_html(f'<div class="od-dialogs">{"".join(map(str, dialogs))}</div>')

    def show(self) -> None:
        """Lists the runs."""
        with self._lock:
            self._shown, self._looks = True, 0
            self.refresh(self._training.status())

    def hide(self) -> None:
        """Stops following."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Follows the run at hand."""
        with self._lock:
            if not self._shown:
                return
            runs = self._store.runs.all()
            wanted = self._wanted.value
            drawn, more = chosen_runs([run["id"] for run in runs], wanted, self._run)
            grown = drawn != self._drawn
            for run in drawn:
                rows = self._rows.setdefault(run, [])
                if run == self._run or not rows:
                    new = self._store.runs.iterations(run, after=rows[-1]["number"] if rows else 0)
                    rows += new
                    grown |= bool(new)
            figures = self._figures(runs)
            demos = self._entries(runs) if self._looks % _DEMOS_EVERY == 0 else None
            self._looks += 1
            with self._client.atomic():
                self._say("table", self._table, runs_html(runs, figures, self._run, status, drawn))
                if demos is not None:
                    self._say("demos", self._demos, render("runs.html:demos", entries=demos))
                usual = not wanted.strip()
                which = render("runs.html:which", drawn=len(drawn), more=more, usual=usual)
                self._say("which", self._told_which, which)
                if grown or not self._drawn:
                    self._drawn = drawn
                    for curve in self._curves:
                        curve.draw({run: self._rows[run] for run in drawn})

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _say(self, what: str, handle: Any, markup: Markup) -> None:
        """Draws what is new: a browser would lose its focus in what is drawn again."""
        if self._said.get(what) != str(markup):
            self._said[what] = handle.content = str(markup)

    def _figures(self, runs: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        figures = {}
        for run in runs:
            name = run["id"]
            rows = self._rows.get(name)
            last = rows[-1] if rows else (self._store.runs.last_iteration(name) or {})
            given = {
                "ratings": sum(self._store.ratings.counts(name).values(), Counts()),
                "comparisons": self._store.comparisons.count(name),
            }
            figures[name] = last | given
        return figures

    def _entries(self, runs: Sequence[Mapping[str, Any]]) -> list[tuple[Demo, list[str], bool]]:
        """Each demo, the runs that learn from it, the newest first, and whether it can be renamed."""
        return [
            (
                demo,
                [run["title"] or run["id"] for run in reversed(runs) if run["demo_sha256"] == demo.sha256],
                _lies_in(demo, self._demos_dir),
            )
            for demo in list_demos(self._demos_dir)
        ]


def _lies_in(demo: Demo, demos_dir: Path) -> bool:
    return demo.path.parent.parent == demos_dir


def chosen_runs(runs: Sequence[str], wanted: str, current: str) -> tuple[list[str], int]:
    """Which runs are compared.

    Args:
        runs: All, oldest first.
        wanted: Their names, separated by commas. Nothing: the newest, and the one at hand; a comma: none.
        current: The one at hand.

    Returns:
        Their names, the newest first, at most so many as can be told apart; and how many more were wanted.
    """
    newest = list(reversed(runs))
    if not wanted.strip():
        others = [run for run in newest if run != current]
        kept = {current, *others[: _NEWEST - 1]}
        return [run for run in newest if run in kept], 0
    names = {name.strip() for name in wanted.split(",")}
    found = [run for run in newest if run in names]
    return found[:_COMPARED], max(0, len(found) - _COMPARED)


def runs_html(
    runs: Sequence[Mapping[str, Any]], figures: Mapping[str, Mapping[str, Any]], current: str,
    status: Status, drawn: Sequence[str],
) -> Markup:  # fmt: skip
    """The table of runs: the one that is served, then the newest first.

    Args:
        runs: As ``Store.runs.all``.
        figures: Of each: ``ratings``, as ``Counts``, ``comparisons``, and the newest iteration's.
        current: The one that is served.
        status: Of that one.
        drawn: Those whose curves are drawn.
    """
    rows = [
        _line(run, figures[run["id"]], status if run["id"] == current else None)
        | {"compared": run["id"] in drawn}
        for run in sorted(reversed(runs), key=lambda run: run["id"] != current)
    ]
    return render("runs.html:table", rows=rows)


def _line(run: Mapping[str, Any], figures: Mapping[str, Any], status: Status | None) -> dict[str, Any]:
    """What the table says of a run; its status if it is the one that is served."""
    settings = settings_of(run["config"])
    steps, total = figures.get("env_steps", 0), settings["rollouts.total_steps"]
    if status is not None:
        state, words = status.phase, NAMES[status.phase]
    elif steps >= total:
        state, words = "done", "Done"
    elif steps or figures["ratings"].given:
        state, words = "closed", "Stopped"
    else:
        state, words = "closed", "Not begun"
    act, act_words = "", ""
    if status is not None and status.phase != "done":
        act = "resume" if status.phase in HALTED else "pause"
        act_words = "Try again" if status.phase == "failed" else act.capitalize()
    return {
        "name": run["id"], "title": run["title"], "note": run["note"], "demo": run["demo"],
        "robot": settings["env"], "method": settings["method"], "seed": run["seed"],
        "here": status is not None, "state": state,
        "state_words": words, "why": status.error if status is not None and state == "failed" else "",
        "ratings": figures["ratings"], "comparisons": figures["comparisons"], "env_steps": steps,
        "total_steps": total, "predicted": figures.get("predicted"),
        "true_reward": figures.get("true_reward"), "act": act, "act_words": act_words,
    }  # fmt: skip


_FIELDS = {
    "ratings.pretrain": ("Ratings before practice", 1, 100_000, "1", "a whole number from 1 to 100,000"),
    "ratings.online": ("Ratings during practice", 0, 100_000, "1", "a whole number from 0 to 100,000"),
    "rollouts.total_steps": ("Control steps", 1, 10**12, "1", "a whole number of control steps, 1 or more"),
    "ratings.clip_seconds": ("Clip length, seconds", 0.05, 5, "any", "a number of seconds from 0.05 to 5"),
}
"""Settings of a new run: label, least, most, step, and what would be right."""


def fields_of(config: str) -> list[dict[str, Any]]:
    """The numbers of the form for a new run, as a run has them.

    Args:
        config: That run's settings, TOML.
    """
    usual, now = settings_of(""), settings_of(config)
    return [
        {
            "key": key, "label": label, "least": least, "most": most, "step": step, "value": now[key],
            "usual": f"{usual[key]:,}", "said": _meanings()[key], "wrong": f"This is {right}.",
        }
        for key, (label, least, most, step, right) in _FIELDS.items()
    ]  # fmt: skip


@cache
def _meanings() -> dict[str, str]:
    """Of each setting, what its docstring says of it."""
    return {key: said.replace("``", "") for key, _, said in describe()}


@lru_cache(256)
def settings_of(config: str) -> dict[str, Any]:
    """What a run's settings, TOML, say of those that are shown; the defaults where they say nothing.

    A legacy run that names no method has the paper's.
    """
    usual = RunConfig()
    flat = {
        "method": "paper" if config.strip() else usual.method,
        "env": usual.env,
        "rollouts.total_steps": usual.rollouts.total_steps,
        **{
            f"ratings.{name}": getattr(usual.ratings, name) for name in ("pretrain", "online", "clip_seconds")
        },
    }
    try:
        tree = tomllib.loads(config)
    except tomllib.TOMLDecodeError:  # edited by somebody
        return flat
    for key in flat:
        *section, name = key.split(".")
        found = tree.get(section[0], {}) if section else tree
        value = found.get(name) if isinstance(found, dict) else None
        if isinstance(value, type(flat[key])) or (isinstance(flat[key], float) and isinstance(value, int)):
            flat[key] = value
    return flat
