"""The line to the server in a real browser: cut, stalled, the server started again, the session ended.

The page's times are shortened where it says so; ``ONEDEMO_LONG=1`` waits as long as people did.
"""

from __future__ import annotations

import os
import socket
import threading

import pytest

from browser.test_page import DESKTOP, opened, press_and_wait, shown_clip, until

pytestmark = pytest.mark.seam

LONG = bool(os.environ.get("ONEDEMO_LONG"))
QUICK = "window.lineSettings = { lookMs: 50, askMs: 150, graceMs: 100, lateMs: 400, answerMs: 1500 };"
NO_FOCUS = "document.hasFocus = () => false;"  # a window on the second screen: Viser does not even try
PILL, CARD = ".od-line.od-pill", ".od-line .od-card"


class Line:
    """A relay before a server, which can be cut (refused) or stalled (nothing arrives, nothing is said)."""

    def __init__(self, port: int) -> None:
        self._to, self.stalled, self.cut = port, False, False
        self.rewrite: tuple[bytes, bytes] | None = None
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def url(self, link: str) -> str:
        return link.replace(f":{self._to}/", f":{self.port}/")

    def break_off(self) -> None:
        self.cut = True
        for pair in self._pairs:
            for end in pair:
                with_close(end)
        self._pairs.clear()

    def close(self) -> None:
        self.break_off()
        with_close(self._listener)

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            if self.cut:
                near.close()
                continue
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                near.close()
                continue
            self._pairs.append((near, far))
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(1 << 16):
                while self.stalled:
                    threading.Event().wait(0.02)
                sink.sendall(data.replace(*self.rewrite) if self.rewrite else data)
        except OSError:
            pass
        with_close(sink)


def with_close(end: socket.socket) -> None:
    try:
        end.shutdown(socket.SHUT_RDWR)  # a thread that waits at it is woken
    except OSError:
        pass
    end.close()


@pytest.fixture
def relay(site):
    line = Line(site.front.port)
    yield line
    line.close()


def stop(site):
    site.front.close()
    site.page.close()


def start(site):
    """Another server on the same port, which knows nothing of pages that were open."""
    from onedemo.app.annotation.assignment import Again
    from onedemo.app.http.server import Front
    from onedemo.app.network.bind import Listening
    from onedemo.app.services.demo_images import Pictures
    from onedemo.app.ui.app import Page

    pictures = Pictures(site.trainer.demo, read=lambda _: site.trainer.frames)
    again = Again(shared=0, repeated=0)
    site.page = Page(site.trainer, pictures=pictures, again=again, guard_seconds=0.05, live_fps=5.0)
    site.front = Front(site.page, Listening(port=site.front.port))
    site.front.start()


@pytest.mark.parametrize("away", [45, 240] if LONG else [0])
def test_a_page_comes_back_after_a_restart_and_keeps_the_press_and_the_tab(chromium, site, away):
    scripts = [NO_FOCUS] if away else [NO_FOCUS, QUICK]
    with (
        opened(chromium, site.links["annotator"], scripts=scripts) as page,
        opened(chromium, site.links["researcher"], scripts=scripts) as other,
    ):
        clip = shown_clip(page)
        other.click(".od-tabs >> text=Guide")
        other.wait_for_selector('.od-header[data-tab="guide"]')
        page.route("**/press", lambda route: route.abort())
        page.keyboard.press("4")  # on its way when the server goes
        page.wait_for_selector(".od-problem.od-late >> text=Not saved yet")
        stop(site)
        page.wait_for_selector(f"{PILL} >> text=Connection lost. Trying again; nothing is lost.")
        page.keyboard.press("5")  # it was answered already
        page.unroute("**/press")
        page.wait_for_timeout(1000 * away)
        assert page.locator(f"{PILL} button >> text=Reload").is_visible()
        start(site)
        until(lambda: page.wait_for_timeout(50) or site.events(), 60)
        page.wait_for_selector(f'.od-clip [data-clip]:not([data-clip="{clip}"])', timeout=30_000)
        assert page.locator(f".od-problem, {PILL}").count() == 0
        second = shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("2"))
        assert site.events() == [("rate", clip, 4, "bo"), ("rate", second, 2, "bo")]
        other.wait_for_selector('.od-header[data-tab="guide"]', timeout=30_000)
        assert other.locator(PILL).count() == 0


def test_a_proxy_that_says_503_neither_drops_a_press_nor_is_shown_in_place_of_the_page(chromium, site, relay):
    asked = []

    def refuse(route):
        asked.append(route.request.url)
        route.fulfill(status=503, content_type="text/html", body="<h1>Service Unavailable</h1>")

    with opened(chromium, relay.url(site.links["annotator"]), scripts=[QUICK]) as page:
        clip = shown_clip(page)
        page.evaluate("() => { window.same = true }")
        page.route("**/*", refuse)
        page.keyboard.press("4")
        page.wait_for_selector(".od-problem.od-late >> text=Not saved yet")
        relay.break_off()
        page.wait_for_selector(f"{PILL} >> text=Connection lost. Trying again; nothing is lost.")
        # Asked often enough to have loaded the page anew, had that been an answer.
        until(lambda: page.wait_for_timeout(50) or sum(url.endswith("/session") for url in asked) > 8)
        assert any(url.endswith("/press") for url in asked)
        assert page.evaluate("() => window.same") and site.events() == []
        page.unroute_all()
        relay.cut = False
        until(lambda: page.wait_for_timeout(50) or site.events(), 60)
        page.wait_for_selector(f'.od-clip [data-clip]:not([data-clip="{clip}"])', timeout=30_000)
        assert page.locator(f".od-problem, {PILL}").count() == 0
        assert site.events() == [("rate", clip, 4, "bo")]


def test_without_a_connection_answers_are_seen_to_be_off_and_none_is_taken_in_silence(chromium, site, relay):
    with opened(chromium, relay.url(site.links["annotator"]), scripts=[QUICK]) as page:
        clip = shown_clip(page)
        relay.break_off()
        page.wait_for_selector(f"{PILL} >> text=Connection lost. Trying again; nothing is lost.")
        button = page.locator('.od-answers [data-key="4"]')
        until(
            lambda: page.wait_for_timeout(50) or button.evaluate("e => getComputedStyle(e).opacity") == "0.45"
        )
        for key in ("4", "s"):
            page.keyboard.press(key)
            page.wait_for_selector(".od-problem >> text=Not taken: there is no connection.")
        page.keyboard.press("ArrowRight")  # what concerns this browser alone goes on
        page.wait_for_selector(".od-clip [data-still]")
        relay.cut = False
        page.wait_for_selector(PILL, state="detached", timeout=60_000)
        assert shown_clip(page) == clip and site.events() == []
        assert button.evaluate("e => getComputedStyle(e).opacity") == "1"
        assert press_and_wait(page, site, lambda: page.keyboard.press("4")) == ("rate", clip, 4, "bo")


def test_a_change_of_a_run_that_takes_long_is_not_cut_off(chromium, site, monkeypatch):
    begun, go_on, pause = threading.Event(), threading.Event(), site.trainer.pause

    def take_long():
        begun.set()
        assert go_on.wait(60)
        pause()

    monkeypatch.setattr(site.trainer, "pause", take_long)
    try:
        with opened(chromium, site.links["researcher"], scripts=[QUICK]) as page:
            page.click(".od-tabs >> text=Runs")
            page.click('[data-do="pause run"]')
            until(lambda: page.wait_for_timeout(50) or begun.is_set())
            page.evaluate("() => new Promise((go) => setTimeout(go, 2 * lineSettings.answerMs))")
            button = page.locator('[data-do="pause run"]')
            assert button.inner_text() == "Pause" and button.is_disabled()
            go_on.set()
            page.wait_for_selector('[data-do="resume run"]', timeout=20_000)
            assert site.trainer.calls == ["pause"]
    finally:
        go_on.set()


@pytest.mark.skipif(not LONG, reason="as long as the line of a person was cut: ONEDEMO_LONG=1")
def test_a_page_comes_back_after_its_line_was_cut_for_40_s(chromium, site, relay):
    with opened(chromium, relay.url(site.links["annotator"])) as page:
        clip = shown_clip(page)
        page.route("**/press", lambda route: route.abort())
        page.keyboard.press("4")
        page.wait_for_timeout(100)
        relay.break_off()
        page.unroute("**/press")
        page.wait_for_timeout(40_000)
        relay.cut = False
        until(lambda: page.wait_for_timeout(50) or site.events(), 60)
        assert shown_clip(page) != clip and site.events() == [("rate", clip, 4, "bo")]


def test_on_a_stalled_line_a_press_is_not_saved_yet_and_then_saved_once(chromium, site, relay):
    with opened(chromium, relay.url(site.links["annotator"]), scripts=[QUICK]) as page:
        clip = shown_clip(page)
        relay.stalled = True
        page.keyboard.press("4")
        page.wait_for_selector(".od-problem.od-late >> text=Not saved yet")
        page.wait_for_timeout(2500)  # it was given up and sent again meanwhile
        relay.stalled = False
        page.wait_for_selector(".od-problem", state="detached")
        assert shown_clip(page) != clip
        page.wait_for_timeout(500)
        assert site.events() == [("rate", clip, 4, "bo")]


def test_a_page_whose_link_was_revoked_says_so(chromium, site):
    store = site.trainer.store
    with opened(chromium, site.links["annotator"], scripts=[QUICK]) as page:
        shown_clip(page)
        store.accounts.revoke_tokens(store.accounts.ensure("bo", "annotator").id)
        said = page.wait_for_selector(CARD).inner_text()
        assert "This page is closed" in said and "revoked" in said and "rying" not in said
        page.keyboard.press("4")
        page.wait_for_timeout(500)
        assert site.events() == [] and page.locator(PILL).count() == 0


def test_a_proxy_without_websockets_is_named_and_no_panel_of_viser_is_seen(chromium, site, relay):
    relay.rewrite = (b"Upgrade: websocket", b"Xpgrade: websocket")
    context = chromium.new_context(viewport=DESKTOP)
    context.add_init_script(QUICK)
    page = context.new_page()
    page.goto(relay.url(site.links["annotator"]))
    page.wait_for_function("() => document.querySelector('#root')?.textContent.includes('Dev Settings')")
    assert not page.locator("text=Dev Settings").first.is_visible()
    said = page.wait_for_selector(CARD).inner_text()
    assert "it must pass WebSockets and the Host header on" in said
    relay.rewrite = None
    page.click(f"{CARD} >> text=Reload")
    shown_clip(page)
    context.close()
