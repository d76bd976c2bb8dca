"""What the Rate and the Compare tab share: a press that is saved or explained, and drawing what changed."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable
from typing import Any

from onedemo.app.annotation.rating_session import AnsweredElsewhere

log = logging.getLogger("onedemo.page")


class Pressing:
    """A tab whose keys commit something.

    Args:
        client: The browser.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._lock = threading.RLock()
        self._shown = False
        self._problem = ""
        """Why the last press was not committed, one sentence; "" if it was."""
        self._content: dict[int, str] = {}

    def _draw(self) -> None:
        raise NotImplementedError

    def _press(self, action: Callable[[], bool]) -> None:
        with self._lock:
            if self._shown and (self._attempt(action) or self._problem):
                self._draw()
                self._client.flush()

    def _attempt(self, action: Callable[[], bool], *, keep_problem: bool = False) -> bool:
        try:
            moved = action()
        except AnsweredElsewhere as told:
            self._problem = str(told)
            return True
        except (sqlite3.Error, ValueError) as error:
            log.exception("a press could not be saved")
            self._problem = f"This could not be saved ({error}). Nothing is lost: please try again."
            return False
        if not keep_problem:
            self._problem = ""
        return moved

    def _put(self, handle: Any, content: str) -> None:
        # Setting the same HTML again would start its clip over.
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = content
