"""One browser's page: the header with its tabs, and which of them is shown.

A tab that is not shown is not in the browser at all: Viser removes what is invisible, its keys do
nothing, and it costs no messages.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from typing import Any

from onedemo.app.annotation.presses import Press
from onedemo.app.tabs.context import TabContext
from onedemo.app.tabs.pressing import Pressing, Tab
from onedemo.app.templates import render
from onedemo.types import Status

_BRAND = (47, 93, 196)
TabMaker = Callable[[TabContext], Tab]


class Session:
    """What one browser sees.

    Args:
        context: What its tabs may use.
        makers: Its tabs, in order.
        first: The tab that is shown first, as its address ends; the first one if there is none of that name.
    """

    def __init__(self, context: TabContext, makers: list[TabMaker], first: str = "") -> None:
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
            names = [tab.title.lower() for tab in self._tabs]
            self.choose(names.index(first) if first in names else self._first())

    def _first(self) -> int:
        """The tab that is shown first: of a researcher's page Watch, once there is an iteration."""
        titles, context = [tab.title for tab in self._tabs], self._context
        practised = context.store.runs.last_iteration(context.run) is not None
        return titles.index("Watch") if practised and "Start" in titles else 0

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
                    run=self._context.run, demo=self._context.demo.name, name=self.rater.name,
                    page=self.token,
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
