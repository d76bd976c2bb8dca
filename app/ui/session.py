"""One browser's page: the header with its tabs, and which of them is shown.

A tab that is not shown is not in the browser at all: Viser removes what is invisible, its keys do
nothing, and it costs no messages.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

from onedemo.app.annotation.presses import Press
from onedemo.app.annotation.rating_session import AnsweredElsewhere
from onedemo.app.templates import render
from onedemo.app.ui.context import TabContext
from onedemo.types import Status

log = logging.getLogger("onedemo.page")

_BRAND = (47, 93, 196)
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


TabMaker = Callable[[TabContext], Tab]


class Session:
    """What one browser sees.

    Args:
        context: What its tabs may use.
        makers: Its tabs, in order.
    """

    def __init__(self, context: TabContext, makers: list[TabMaker]) -> None:
        self.rater = context.rater
        self.token = secrets.token_urlsafe(16)
        """Names this page to requests of its browser."""
        self._context, self._client = context, context.client
        self._lock = threading.RLock()
        self._closed = False
        self._banner = ""
        self._tabs: list[Tab] = []
        self._folders: list[Any] = []
        gui = self._client.gui
        with self._client.atomic():
            gui.configure_theme(
                dark_mode=context.dark, show_logo=False, show_share_button=False, brand_color=_BRAND
            )
            gui.set_panel_label("onedemo")
            self._header = gui.add_html("")
            self._notice = gui.add_html("")
            for number, maker in enumerate(makers, start=1):
                folder = gui.add_folder(None, visible=False)
                with folder:
                    tab = maker(context)
                self._tabs.append(tab)
                self._folders.append(folder)
                command = gui.add_command(f"Show: {tab.title}", hotkey=str(number), modifier="alt")  # type: ignore[arg-type]
                command.on_trigger(lambda _, index=number - 1: self.choose(index))
            gui.add_command("Practise again", hotkey="A", modifier="alt").on_trigger(
                lambda _: self.practise()
            )
            self._shown = 0
            self.refresh(context.training.status())
            self.choose(0)

    def choose(self, index: int) -> None:
        """Shows the tab of that index and hides the others."""
        with self._lock:
            if self._closed:
                return
            with self._client.atomic():
                for number, (tab, folder) in enumerate(zip(self._tabs, self._folders, strict=True)):
                    if number != index and folder.visible:
                        tab.hide()
                        folder.visible = False
                self._shown = index
                self._folders[index].visible = True
                self._tabs[index].show()
                header = render(
                    "session.html:header", titles=[tab.title for tab in self._tabs], shown=index,
                    demo=self._context.demo.name, name=self.rater.name, page=self.token,
                )  # fmt: skip
                self._header.content = str(header)

    def practise(self) -> None:
        """Shows the practice clips (again)."""
        with self._lock:
            self._context.lesson.begin()
            self.choose([tab.title for tab in self._tabs].index("Rate"))

    def press(self, press: Press) -> bool:
        """Carries out what was pressed at this page; whether it counted. As ``Pressing.press``.

        Raises:
            ValueError: If this page has no tab that takes it, too.
        """
        for tab in self._tabs:
            if isinstance(tab, Pressing) and isinstance(press, tab.takes):
                return tab.press(press)
        raise ValueError("this page has no such tab")

    def refresh(self, status: Status) -> None:
        """Brings counters and states up to date."""
        with self._lock:
            if self._closed:
                return
            # Not atomic: tabs ask the database here, and messages of a press would wait for that.
            banner = str(render("session.html:banner", status=status, lost=self._lost()))
            if banner != self._banner:
                self._banner = self._notice.content = banner
            for tab in self._tabs:
                tab.refresh(status)

    def _lost(self) -> str:
        """The name of the demo if its video is gone."""
        demo = self._context.demo
        return "" if demo.path.is_file() else demo.name

    def close(self) -> None:
        """Lets go of everything the session held."""
        with self._lock:
            self._closed = True
            for tab in self._tabs:
                tab.close()
