"""What a tab may use: of the run that is served, and of the browser it is drawn in."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import viser

from onedemo.app.annotation.assignment import Assignment
from onedemo.app.annotation.tutorial import Lesson
from onedemo.app.services.demo_images import Pictures
from onedemo.app.services.live_rollout import Live
from onedemo.storage.store import Store
from onedemo.types import Demo, Rater, Status


class Training(Protocol):
    """What tabs see and do of the training of a run."""

    def status(self) -> Status:
        """What it is doing."""
        ...

    def pause(self) -> None:
        """Holds it."""
        ...

    def resume(self) -> None:
        """Lets it go on."""
        ...

    def stop(self, timeout_s: float = 60.0) -> None:
        """Ends it after the iteration in hand; waits for that so long."""
        ...

    def rollout_picture(self, iteration: int, suffix: str) -> Future[Path]:
        """The best rollout of an iteration as "jpg" or "webm", once it is drawn."""
        ...

    def want_pairs(self) -> None:
        """Says that somebody looks at pairs."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class TabContext:
    """Of one session."""

    client: viser.ClientHandle
    """The browser."""
    rater: Rater
    """Who sits at it."""
    dark: bool
    """Whether the browser prefers dark colours."""
    lesson: Lesson
    """The practice clips."""

    store: Store
    run: str
    version: str
    """What the addresses of the run's pictures end in."""
    data_dir: Path
    demo: Demo
    dt: float
    """Seconds of a control step."""
    training: Training
    pictures: Pictures
    live: Live
    assignment: Assignment
    pair_assignment: Assignment
    guard_seconds: float
    """A press that comes sooner after a clip was not made for it."""
