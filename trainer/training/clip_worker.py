"""Makes the pictures of clips: renders the robot, lays it beside the demo, writes one file per clip."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from onedemo.core.files import jpeg_fault, read_whole, sealed, write_atomic
from onedemo.errors import in_words
from onedemo.render.clip_image import compose_clip
from onedemo.render.renderer import Renderer, RenderThread
from onedemo.storage.store import Store
from onedemo.types import Clip

log = logging.getLogger("onedemo")

_RETRY_S = 5.0


class ClipMaker:
    """Turns clips of state "cut" into clips of state "ready", in the render thread.

    Args:
        store: Holds the segments; is told when a picture is there.
        file: Where the picture of a clip goes, by its number.
        frames: The demo's frames, (F, H, W, 3), uint8.
        frames_of: Demo frame at given control steps.
        renderer: The thread that owns the GL context; not closed here.
    """

    def __init__(
        self,
        store: Store,
        *,
        file: Callable[[int], Path],
        frames: np.ndarray,
        frames_of: Callable[[np.ndarray], np.ndarray],
        renderer: RenderThread,
    ) -> None:
        self._store = store
        self._file = file
        self._frames, self._frames_of = frames, frames_of
        self._renderer = renderer
        self._failed: list[Clip] = []
        self._failed_at = 0.0
        self.error = ""
        """Why the last clip could not be drawn, one sentence; "" if it could."""

    def submit(self, clips: list[Clip]) -> None:
        """Queues clips; each becomes "ready" when its picture is on disk."""
        for clip in clips:
            future = self._renderer.submit(lambda renderer, clip=clip: self._make(renderer, clip))
            future.add_done_callback(lambda future, clip=clip: self._note(future, clip))

    def retry(self) -> None:
        """Queues the clips that failed once more, a few seconds after: a full disk may have room now."""
        if self._failed and time.monotonic() - self._failed_at > _RETRY_S:
            failed, self._failed = self._failed, []
            self.submit(failed)

    def recover(self, run: str) -> None:
        """After a restart: queues what was cut but never drawn, and what lost its picture or a part of it."""
        lost = [c for c in self._store.clips.waiting(run) if not read_whole(self._file(c.id), jpeg_fault)]
        self._store.clips.set_state([c.id for c in lost], "cut")
        self.submit(self._store.clips.waiting(run, state="cut"))

    def _make(self, renderer: Renderer, clip: Clip) -> None:
        segment = self._store.clips.segment(clip.id)
        index, first = np.unique(self._frames_of(clip.demo_step + np.arange(clip.steps)), return_index=True)
        agent = renderer.render(segment.qpos[first])
        write_atomic(self._file(clip.id), sealed(compose_clip(self._frames[index], agent)))
        self._store.clips.set_state([clip.id], "ready")

    def _note(self, future: Future[None], clip: Clip) -> None:
        if future.cancelled():
            return
        error, before = future.exception(), self.error
        self.error = in_words(error) if error is not None else ""
        if error is not None:
            if self.error != before:  # once, not with every try
                log.error("clip %d could not be drawn: %s", clip.id, self.error, exc_info=error)
            self._failed_at = time.monotonic()
            self._failed.append(clip)
