"""The Start tab: what a run still needs from people, in order, and who these people are."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from markupsafe import Markup

from onedemo.app.tabs.context import TabContext
from onedemo.app.templates import render
from onedemo.storage.accounts import Link, Presence
from onedemo.storage.database import now
from onedemo.types import HALTED, Rater, Status

_EVERY_S = 2.0
"""People are not looked up more often."""
_NOW_S = 60
"""Whoever was seen so long ago is here now."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Person:
    """Somebody who takes part, with what has become of their links."""

    id: int
    name: str
    role: str
    links: Sequence[Link]
    """Those that open, or else the newest; in the order they were made."""
    older: int
    """Links that do not open any more and are not among these."""
    browsers: int
    """Signed in."""
    seen: str
    """When last, in words; "" for never."""
    seen_at: str
    ratings: int
    """Given in this run, second opinions not counted."""
    excluded: bool

    @property
    def open(self) -> bool:
        """Whether anything is left to revoke."""
        return self.browsers > 0 or any(link.state == "open" for link in self.links)


class Start:
    """The Start tab of one session."""

    title = "Start"

    def __init__(self, context: TabContext) -> None:
        self._context, self._store, self._run = context, context.store, context.run
        self._shown = False
        self._looked_at = -_EVERY_S
        self._left_out: set[int] = set()
        self._content: dict[int, str] = {}
        self._iteration = 0
        self._best: dict[str, Any] | None = None
        gui = context.client.gui
        self._steps = gui.add_html("")
        # Drawn once, so that nothing that is being filled in is lost.
        gui.add_html(str(render("start.html:invite")))
        self._people = gui.add_html("")

    def show(self) -> None:
        """Looks how far things are."""
        self._shown = True
        self._looked_at = -_EVERY_S
        self.refresh(self._context.training.status())

    def hide(self) -> None:
        """Looks no more."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Steps and people, if somebody looks."""
        if not self._shown:
            return
        store, run = self._store, self._run
        left_out = store.ratings.left_out(run)
        # Who is excluded or included is seen at once: somebody has pressed a button and waits.
        if left_out == self._left_out and time.monotonic() - self._looked_at < _EVERY_S:
            return
        self._looked_at, self._left_out = time.monotonic(), left_out
        given: Counter[str] = Counter()
        for (name, _), counts in store.ratings.tallies(run).items():
            given[name] += sum(counts)
        everybody = store.accounts.raters()
        people = people_of(
            everybody, store.accounts.links(), store.accounts.presence(), given, left_out,
            now=datetime.fromisoformat(now()),
        )  # fmt: skip
        for row in store.runs.iterations(run, after=self._iteration):
            self._iteration = row["number"]
            if row.get("best") is not None and (self._best is None or row["best"] >= self._best["best"]):
                self._best = row
        outside = {rater.name for rater in everybody if rater.id in left_out}
        steps = render(
            "start.html:steps", run=run, demo=self._context.demo.name, robot=self._context.live.robot.name,
            status=status, people=people,
            given=[(name, count) for name, count in given.most_common() if name not in outside],
            left_out=sum(given[name] for name in outside), best=self._best, halted=status.phase in HALTED,
            version=self._context.version, picture=self._context.demo.sha256[:8], me=self._context.rater.id,
        )  # fmt: skip
        self._put(self._steps, steps)
        self._put(self._people, render("start.html:people", people=people, me=self._context.rater.id))

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _put(self, handle: Any, content: Markup) -> None:
        if self._content.get(id(handle)) != content:
            handle.content = self._content[id(handle)] = str(content)


def people_of(
    raters: Iterable[Rater], links: Iterable[Link], presence: Mapping[int, Presence],
    given: Mapping[str, int], left_out: set[int], *, now: datetime,
) -> list[Person]:  # fmt: skip
    """Everybody who takes part, in the order they were added; simulated raters do not.

    Args:
        raters: Everybody.
        links: Of everybody, in the order they were made.
        presence: By the rater's number.
        given: Ratings in this run, by name.
        left_out: Raters whose ratings nothing learns from.
        now: When that is.
    """
    people = []
    links = list(links)
    for rater in raters:
        if rater.role == "simulated":
            continue
        own = [link for link in links if link.rater.id == rater.id]
        shown = [link for link in own if link.state == "open"] or own[-1:]
        browsers, at = presence.get(rater.id, Presence(0, None))
        people.append(
            Person(
                id=rater.id, name=rater.name, role=rater.role, links=shown, older=len(own) - len(shown),
                browsers=browsers, seen=ago(at, now), seen_at=at or "", ratings=given.get(rater.name, 0),
                excluded=rater.id in left_out,
            )
        )  # fmt: skip
    return people


def ago(at: str | None, now: datetime) -> str:
    """How long ago that was, in words: "now", "5 min ago", "3 h ago", "2 days ago"; "" for never."""
    if at is None:
        return ""
    seconds = (now - datetime.fromisoformat(at)).total_seconds()
    if seconds < _NOW_S:
        return "now"
    for unit, length, most in (("min", 60, 60), ("h", 3600, 24)):
        if seconds < length * most:
            return f"{seconds // length:.0f} {unit} ago"
    days = int(seconds // 86400)
    return f"{days} day{'' if days == 1 else 's'} ago"
