"""Draws in a process of its own: no picture waits for Python code of page or practice, nor these for one.

What goes through the pipe, pickled: a number, an order, a job and a robot there; the number, a result and
an error back. The process ends when the other end of the pipe does, however that ends.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from typing import Any, TypeVar

from onedemo.core.process import prepare_process
from onedemo.errors import in_words
from onedemo.render.render_thread import Order, RenderThread
from onedemo.render.renderer import Renderer
from onedemo.robots.robot import Robot

log = logging.getLogger("onedemo")

_ENDING_S = 5.0
"""For the picture in hand, when the process is told to end."""

T = TypeVar("T")


class DrawingProcess:
    """As ``RenderThread``, but for jobs that can be pickled. One that has died is begun anew by the next job.

    A machine that cannot draw says so in each future.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._closed = False
        self._begin()

    def submit(
        self, job: Callable[[Renderer], T], order: Order = Order.AHEAD, robot: Robot | None = None
    ) -> Future[T]:
        """Runs ``job(renderer)`` there; of equal order in the order of submission.

        Args:
            job: A function of a module, or a ``partial`` of one.
            order: What it comes before, or after.
            robot: Whose positions it draws; the hopper's if None.

        Returns:
            The future of what ``job`` returns or raises. It is cancelled if this is closed first, and raises
            RuntimeError if the process dies.

        Raises:
            RuntimeError: If this is closed.
        """
        future: Future[T] = Future()
        with self._lock:
            if self._closed:
                raise RuntimeError("the drawing process is closed")
            number = next(self._numbers)
            data = pickle.dumps((number, int(order), job, robot))
            if self._dead:
                self._begin()
            self._waiting[number] = future
            with suppress(OSError):  # it has died, which the listener tells
                self._pipe.send_bytes(data)
        return future

    def close(self) -> None:
        """Ends the process after the picture in hand; jobs still waiting are cancelled."""
        with self._lock:
            self._closed = True
            with suppress(OSError):
                self._pipe.send_bytes(b"")
        try:
            self._child.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
        self._listener.join()

    def __enter__(self) -> DrawingProcess:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._child.pid

    def _begin(self) -> None:
        self._pipe, theirs = Pipe()
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-m", "onedemo.render.drawing_process", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        self._dead = False
        self._waiting: dict[int, Future[Any]] = {}
        self._listener = threading.Thread(
            target=self._listen, args=(self._child, self._pipe, self._waiting), name="drawn", daemon=True
        )
        self._listener.start()

    def _listen(
        self, child: subprocess.Popen[bytes], pipe: Connection, waiting: dict[int, Future[Any]]
    ) -> None:
        with pipe:
            try:
                while True:
                    number, result, error = pickle.loads(pipe.recv_bytes())
                    future = waiting.pop(number)
                    if not future.set_running_or_notify_cancel():
                        continue
                    if error is None:
                        future.set_result(result)
                    else:
                        future.set_exception(error)
            except (EOFError, OSError):
                pass
            except Exception:  # whatever was said: the next job begins another process
                log.exception("an answer of the process that draws pictures cannot be read")
                child.kill()
            code = child.wait()
            with self._lock:  # nothing is added any more
                self._dead = True
                left = list(waiting.values())
        for future in left:
            if self._closed:
                future.cancel()
            if future.set_running_or_notify_cancel():
                future.set_exception(RuntimeError(f"the process that draws pictures ended with code {code}"))


def main(descriptor: int) -> None:
    """The process: draws what comes through the pipe until it ends."""
    prepare_process()
    for number in (signal.SIGINT, signal.SIGTERM):  # may be sent to the whole group; the pipe's end counts
        signal.signal(number, signal.SIG_IGN)
    turn = threading.Lock()

    def answer(number: int, drawn: Future[Any]) -> None:
        if drawn.cancelled():
            return
        error = drawn.exception()
        try:
            data = pickle.dumps((number, None if error else drawn.result(), error))
            if error is not None:
                pickle.loads(data)  # not every error that can be pickled can be read again
        except Exception as unsent:  # what cannot be pickled is told in words
            data = pickle.dumps((number, None, RuntimeError(in_words(error or unsent))))
        with turn, suppress(OSError):
            pipe.send_bytes(data)

    with (
        Connection(descriptor) as pipe,
        RenderThread(at_once=False, exact=False) as drawing,
        suppress(EOFError, OSError),
    ):
        while data := pipe.recv_bytes():
            number, order, job, robot = pickle.loads(data)
            drawn = drawing.submit(job, Order(order), robot)
            drawn.add_done_callback(lambda done, n=number: answer(n, done))


if __name__ == "__main__":
    main(int(sys.argv[1]))
    os._exit(0)  # without taking down a driver's threads one by one
