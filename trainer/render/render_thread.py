"""Renderers in a thread of its own, for callers in any thread: what is most urgent is drawn first."""

from __future__ import annotations

import itertools
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np

from onedemo.core.cpu import give_way
from onedemo.errors import UserError
from onedemo.render.renderer import HEIGHT, WIDTH, Renderer
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.robots.robot import Robot

log = logging.getLogger("onedemo")

T = TypeVar("T")


class Order(IntEnum):
    """What is drawn first."""

    AWAITED = 0
    """Somebody looks at an empty frame."""
    AHEAD = 1
    """Somebody will."""
    FILM = 2
    """A long job, which lets others go first between its pictures (``Renderer.between``)."""


class Drawing(Protocol):
    """Whatever draws: a ``RenderThread``, or a process of its own."""

    def submit(
        self, job: Callable[[Renderer], T], order: Order = ..., robot: Robot | None = ...
    ) -> Future[T]:
        """As ``RenderThread.submit``."""
        ...


class RenderThread:
    """A renderer for each robot, of the last few, in one daemon thread; for callers in any thread.

    Args:
        width: Pixels, even.
        height: Pixels, even.
        robot: Whose positions are drawn where a job does not say; the hopper's if None.
        at_once: Whether to raise if this machine cannot draw; otherwise each job does, until one can.
        exact: As of ``Renderer``.

    Raises:
        UserError: If this machine cannot draw without a screen.
    """

    def __init__(
        self, width: int = WIDTH, height: int = HEIGHT, *, robot: Robot | None = None, at_once: bool = True,
        exact: bool = True,
    ) -> None:  # fmt: skip
        self._robot = robot or robot_named(DEFAULT)
        self._make = partial(Renderer, width, height, exact=exact)
        self._jobs: queue.PriorityQueue[_Entry] = queue.PriorityQueue()
        self._numbers = itertools.count()
        self._lock = threading.Lock()
        self._closed = False
        self._renderers: dict[Robot, Renderer] = {}  # the last one used is the last one here
        started: Future[None] = Future()
        self._put(Order.AWAITED, started, lambda _: None, self._robot)
        self._thread = threading.Thread(target=self._work, name="render", daemon=True)
        self._thread.start()
        try:
            started.result()
        except Exception as error:
            if at_once or not isinstance(error, UserError):
                self.close()
                raise
            log.error("%s", error)

    def submit(
        self, job: Callable[[Renderer], T], order: Order = Order.AHEAD, robot: Robot | None = None
    ) -> Future[T]:
        """Runs ``job(renderer)`` in the render thread; of equal order in the order of submission.

        Args:
            job: Called with the robot's renderer.
            order: What it comes before, or after.
            robot: Whose positions it draws; those of the thread's robot if None.

        Returns:
            The future of what ``job`` returns or raises.

        Raises:
            RuntimeError: If the thread is closed.
        """
        future: Future[T] = Future()
        with self._lock:
            if self._closed:
                raise RuntimeError("the render thread is closed")
            self._put(order, future, job, robot or self._robot)
        return future

    def render(self, qpos_Tq: np.ndarray, robot: Robot | None = None) -> Future[np.ndarray]:
        """The future of ``Renderer.render(qpos_Tq)``; of the thread's robot if none is given."""
        return self.submit(lambda renderer: renderer.render(qpos_Tq), robot=robot)

    def close(self) -> None:
        """Ends the thread after the picture in hand; jobs still waiting are cancelled."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._put(_LAST, Future(), lambda _: None, self._robot)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def __enter__(self) -> RenderThread:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _put(self, order: int, future: Future[Any], job: Callable[[Renderer], Any], robot: Robot) -> None:
        self._jobs.put(_Entry(order, next(self._numbers), future, job, robot))

    def _work(self) -> None:
        give_way(_NICE)  # before the driver starts threads of its own
        try:
            while (entry := self._jobs.get()).order < _LAST:
                self._do(entry)
        finally:
            for renderer in self._renderers.values():
                renderer.close()

    def _do(self, entry: _Entry) -> None:
        if self._closed:
            entry.future.cancel()
        if not entry.future.set_running_or_notify_cancel():
            return
        try:
            entry.future.set_result(entry.job(self._of(entry.robot)))
        except BaseException as error:
            entry.future.set_exception(error)

    def _of(self, robot: Robot) -> Renderer:
        """The robot's renderer; of those of other robots the one that was used longest ago makes room."""
        renderer = self._renderers.pop(robot, None)
        if renderer is None:
            renderer = self._make(robot=robot)
            renderer.between = self._between
            while len(self._renderers) >= _KEPT:
                self._renderers.pop(next(iter(self._renderers))).close()
        self._renderers[robot] = renderer
        return renderer

    def _between(self) -> None:
        """Does what is more urgent than the film in hand; for a second at most, so that it ends some day."""
        until = time.monotonic() + _PATIENCE_S
        while not self._closed and time.monotonic() < until:
            try:
                entry = self._jobs.get_nowait()
            except queue.Empty:
                return
            if entry.order >= Order.FILM:
                self._jobs.put(entry)
                return
            self._do(entry)
        if self._closed:
            raise CancelledError("the render thread is closed")


_LAST = max(Order) + 1
_KEPT = 2
"""Robots that are drawn: that of the run, and of a run that was served before; a context takes 30 MB."""
_PATIENCE_S = 1.0
_NICE = 5
"""Behind the page, before practice: people wait for pictures."""


@dataclass(frozen=True, slots=True, order=True)
class _Entry:
    order: int
    number: int
    future: Future[Any] = field(compare=False)
    job: Callable[[Renderer], Any] = field(compare=False)
    robot: Robot = field(compare=False)
