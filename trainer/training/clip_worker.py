"""Has clips drawn: those to come ahead of time, and again those that somebody looks back at."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path

from onedemo.core.files import jpeg_fault, read_whole
from onedemo.errors import DatabaseLost, in_words
from onedemo.render.render_thread import Order
from onedemo.storage.store import Store
from onedemo.training.pictures import PictureFiles
from onedemo.types import Clip

log = logging.getLogger("onedemo")

_RETRY_S = 5.0
_AGAIN_S = 1.0
"""Between two tries to write into a database that another program holds."""


class Notes:
    """Tells the database what has been drawn, in a thread of its own: whoever draws waits for no lock.

    What cannot be written now is written when it can be, in the order in which it was told.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._left: deque[Callable[[], object]] = deque()
        self._writing = False

    def add(self, write: Callable[[], object]) -> None:
        """Has something written as soon as that can be; waits for nothing."""
        with self._lock:
            self._left.append(write)
            if self._writing:
                return
            self._writing = True
        threading.Thread(target=self._write, name="notes", daemon=True).start()

    def _write(self) -> None:
        while True:
            with self._lock:
                if not self._left:
                    self._writing = False
                    return
                write = self._left[0]
            try:
                write()
            except (DatabaseLost, sqlite3.ProgrammingError):  # lost, closed: the next process looks by itself
                return
            except sqlite3.OperationalError as error:
                log.warning("what was drawn cannot be noted yet: %s", error)
                time.sleep(_AGAIN_S)
                continue
            except Exception:
                log.exception("what was drawn could not be noted")
            self._left.popleft()


class ClipMaker:
    """Turns clips of state "cut" into clips of state "ready".

    Args:
        store: Holds the segments; is told when a picture is there.
        file: Where the picture of a clip goes, by its number.
        pictures: Has them drawn.
    """

    def __init__(self, store: Store, *, file: Callable[[int], Path], pictures: PictureFiles) -> None:
        self._store = store
        self._file = file
        self._pictures = pictures
        self._notes = Notes()
        self._failed: dict[int, Clip] = {}
        self._failed_at = 0.0
        self.error = ""
        """Why the last clip could not be drawn, one sentence; "" if it could."""

    def submit(self, clips: list[Clip]) -> None:
        """Queues clips; each becomes "ready" when its picture is on disk."""
        for clip in clips:
            future = self._drawn(clip, Order.AHEAD)
            future.add_done_callback(lambda future, clip=clip: self._note(future, clip))

    def picture(self, clip: Clip) -> Future[Path]:
        """The future of a clip's picture, which is drawn again if it was deleted."""
        return self._drawn(clip, Order.AWAITED)

    def retry(self) -> None:
        """Queues the clips that failed once more, a few seconds after: a full disk may have room now."""
        if self._failed and time.monotonic() - self._failed_at > _RETRY_S:
            failed, self._failed = self._failed, {}
            self.submit(list(failed.values()))

    def recover(self, run: str) -> None:
        """After a restart: queues what was cut but never drawn, and what lost its picture or a part of it."""
        lost = [c for c in self._store.clips.waiting(run) if not read_whole(self._file(c.id), jpeg_fault)]
        self._store.clips.set_state([c.id for c in lost], "cut")
        cut = self._store.clips.waiting(run, state="cut")
        for clip in cut:
            read_whole(self._file(clip.id), jpeg_fault)  # one that is damaged is set aside
        self.submit(cut)

    def _drawn(self, clip: Clip, order: Order) -> Future[Path]:
        return self._pictures.clip(
            self._file(clip.id), clip.demo_step, lambda: [self._store.clips.segment(clip.id)], order
        )

    def _note(self, future: Future[Path], clip: Clip) -> None:
        if future.cancelled():
            return
        if (error := future.exception()) is None:
            self.error = ""
            self._notes.add(partial(self._store.clips.set_state, [clip.id], "ready"))
            return
        said = in_words(error)
        if said != self.error:  # once, not with every try
            log.error("clip %d could not be drawn: %s", clip.id, said, exc_info=error)
        self.error = said
        self._failed_at = time.monotonic()
        self._failed[clip.id] = clip
