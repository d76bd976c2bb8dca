"""What the page asks of a tab, and the tabs at which something is answered."""

from __future__ import annotations

import logging
import threading
from typing import Any, ClassVar, Protocol

from onedemo.app.annotation.presses import Press
from onedemo.app.annotation.rating_session import AnsweredElsewhere
from onedemo.types import Status

log = logging.getLogger("onedemo.page")

_KEPT = 100
"""Presses by which one that is sent again is known."""


class Tab(Protocol):
    """One tab of one session. It adds its elements under ``context.client.gui`` when made."""

    title: str

    def show(self) -> None:
        """It comes into view."""
        ...

    def hide(self) -> None:
        """It goes out of view; its keys must not act any more."""
        ...

    def refresh(self, status: Status) -> None:
        """Called twice a second, shown or not."""
        ...

    def close(self) -> None:
        """The browser has gone."""
        ...


class Pressing:
    """A tab at which something is answered.

    Args:
        client: The browser.
    """

    takes: ClassVar[tuple[type[Press], ...]] = ()
    """The presses that are for this tab."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._lock = threading.RLock()
        self._shown = False
        self._counted: dict[str, bool] = {}
        self._content: dict[int, str] = {}

    def press(self, press: Press) -> bool:
        """Carries a press out and shows at once what follows; whether it counted.

        Raises:
            AnsweredElsewhere: As ``RatingSession.rate``.
            ValueError: If it cannot be carried out.
            sqlite3.Error: If it could not be committed; everything stays as it was.
        """
        with self._lock:
            if press.id not in self._counted:
                try:
                    self._counted[press.id] = self._shown and self._carry_out(press)
                except AnsweredElsewhere:
                    self._draw_now()
                    raise
                if len(self._counted) > _KEPT:
                    del self._counted[next(iter(self._counted))]
                if self._counted[press.id]:
                    self._draw_now()
            return self._counted[press.id]

    def _carry_out(self, press: Any) -> bool:
        raise NotImplementedError

    def _draw(self) -> None:
        raise NotImplementedError

    def _draw_now(self) -> None:
        try:
            self._draw()
            self._client.flush()
        except Exception:  # the press counts all the same; the next tick draws again
            log.exception("a page could not be drawn")

    def _put(self, handle: Any, content: str) -> None:
        # Setting the same HTML again would start its clip over.
        if self._content.get(id(handle)) != content:
            self._content[id(handle)] = content
            handle.content = str(content)
