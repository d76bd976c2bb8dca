"""One browser's page: the header with its tabs, and which of them is shown.

A tab that is not shown is not in the browser at all: Viser removes what is invisible, its keys do
nothing, and it costs no messages. All text that comes from people is escaped.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any, Protocol

import viser

from onedemo.app.annotation.assignment import Ask
from onedemo.app.annotation.tutorial import Lesson
from onedemo.types import Rater, Status

if TYPE_CHECKING:
    from onedemo.app.ui.app import Page

_BRAND = (47, 93, 196)


class Tab(Protocol):
    """One tab of one session. It adds its elements under ``session.client.gui`` when made."""

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


TabMaker = Callable[["Session"], Tab]


class Session:
    """What one browser sees.

    Args:
        page: Shared by all sessions.
        client: The browser.
        rater: Who sits at it.
        dark: Whether the browser prefers dark colours.
        done: What was rated in this browser before, to be taken back.
        makers: Its tabs, in order.
    """

    def __init__(
        self,
        page: Page,
        client: viser.ClientHandle,
        rater: Rater,
        *,
        dark: bool,
        done: list[Ask],
        makers: list[TabMaker],
    ) -> None:
        self.page = page
        self.client = client
        self.rater = rater
        self.dark = dark
        self.done = done
        self.lesson = None if page.trainer.store.accounts.has_practised(rater.id) else Lesson()
        """The practice clips, until they are done."""
        self._lock = threading.RLock()
        self._closed = False
        self._banner = ""
        self._tabs: list[Tab] = []
        self._folders: list[Any] = []
        gui = client.gui
        with client.atomic():
            gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, brand_color=_BRAND)
            gui.set_panel_label("onedemo")
            self._header = gui.add_html("")
            self._notice = gui.add_html("")
            for number, maker in enumerate(makers, start=1):
                folder = gui.add_folder(None, visible=False)
                with folder:
                    tab = maker(self)
                self._tabs.append(tab)
                self._folders.append(folder)
                command = gui.add_command(f"Show: {tab.title}", hotkey=str(number), modifier="alt")  # type: ignore[arg-type]
                command.on_trigger(lambda _, index=number - 1: self.choose(index))
            self._shown = 0
            self.refresh(page.trainer.status())
            self.choose(0)

    def choose(self, index: int) -> None:
        """Shows the tab of that index and hides the others."""
        with self._lock:
            if self._closed:
                return
            with self.client.atomic():
                for number, (tab, folder) in enumerate(zip(self._tabs, self._folders, strict=True)):
                    if number != index and folder.visible:
                        tab.hide()
                        folder.visible = False
                self._shown = index
                self._folders[index].visible = True
                self._tabs[index].show()
                self._header.content = header_html(
                    [tab.title for tab in self._tabs], index, self.page.trainer.demo.name, self.rater
                )

    def practise(self) -> None:
        """Shows the practice clips (again)."""
        with self._lock:
            self.lesson = Lesson()
            self.choose([tab.title for tab in self._tabs].index("Rate"))

    def refresh(self, status: Status) -> None:
        """Brings counters and states up to date."""
        with self._lock:
            if self._closed:
                return
            # Not atomic: tabs ask the database here, and messages of a press would wait for that.
            banner = banner_html(status)
            if banner != self._banner:
                self._banner = self._notice.content = banner
            for tab in self._tabs:
                tab.refresh(status)

    def close(self) -> None:
        """Lets go of everything the session held."""
        with self._lock:
            self._closed = True
            for tab in self._tabs:
                tab.close()


def header_html(titles: list[str], shown: int, demo: str, rater: Rater) -> str:
    """The bar at the top: name, tabs, who is here."""
    tabs = "".join(
        f'<button type="button" data-key="alt+{number}"'
        f"{' aria-current=page' if number - 1 == shown else ''}>{escape(title)}</button>"
        for number, title in enumerate(titles, start=1)
    )
    return (
        f'<header class="od-header" data-tab="{escape(titles[shown].lower())}">'
        '<span class="od-brand"><img src="/static/icon.svg" alt="" width="24" height="24">onedemo</span>'
        f'<nav class="od-tabs" aria-label="Pages">{tabs}</nav>'
        f'<span class="od-who"><span class="od-demo">{escape(demo)}</span>'
        f'<span class="od-name">{escape(rater.name)}</span></span></header>'
    )


def banner_html(status: Status) -> str:
    """What everybody must know: that something failed, and that rating goes on."""
    if status.phase != "failed" and not status.error:
        return ""
    what = "The robot’s practice has stopped." if status.phase == "failed" else "Something went wrong."
    return (
        f'<div class="od-banner" role="alert"><b>{what}</b> '
        f"{escape(status.error or 'The reason is in the log.')} "
        "<span>You can go on rating: every rating is kept.</span></div>"
    )
