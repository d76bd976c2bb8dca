"""The page in a real headless Chromium: rate by key, button and slider; watch; download."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from playwright.sync_api import Error

pytestmark = pytest.mark.seam

DESKTOP = {"width": 1440, "height": 900}
PHONE = {"width": 390, "height": 844}
SMALL = {"width": 900, "height": 700}
"""Where layout is not the claim: the 3-D view is drawn in software, each pixel costs."""
GUARD_MS = 60
"""A little more than the time in which a press at ``site`` cannot be meant for the clip."""


_left: list[Any] = []
"""Pages that nobody uses any more. Their process has compiled Viser's code: a new one takes 2 s to do so."""


@contextmanager
def opened(
    chromium, link: str, viewport=DESKTOP, scripts: Iterable[str] = (), **options: Any
) -> Iterator[Any]:
    """A page opened by a link, its header drawn: that of a new browser profile as far as anybody can tell.

    With scripts, which run before its own, or options of ``browser.new_context`` it is a new one; else
    cookies, stores and routes are cleared afterwards, and the next takes it over. What else is set of page
    or context needs an option, too.
    """
    new = bool(scripts or options)
    page = _left.pop() if _left and not new else chromium.new_context(**options).new_page()
    for script in scripts:
        page.context.add_init_script(script)
    page.set_default_timeout(90_000)  # of each wait; the machine may have much else to do
    page.set_viewport_size(viewport)
    page.goto(link)
    page.wait_for_selector(".od-header")
    kept = False
    try:
        yield page
        kept = not new
    finally:
        if kept:
            _leave(page)
        else:
            page.context.close()


def _leave(page) -> None:
    """Makes a page as good as new."""
    for other in page.context.pages:
        if other is not page:
            other.close()
    page.unroute_all()
    try:
        page.goto(page.evaluate("() => location.origin") + "/healthz")
    except Error:  # the server has ended
        page.context.close()
        return
    page.evaluate("() => { sessionStorage.clear(); localStorage.clear() }")
    page.context.clear_cookies()
    page.mouse.move(0, 0)
    _left.append(page)


def shown_clip(page, guard_ms: int = GUARD_MS) -> int:
    """The clip on screen, its picture drawn, old enough to be rated."""
    page.wait_for_selector(".od-clip .od-player[data-clip][data-frame]", timeout=90_000)
    page.wait_for_timeout(guard_ms)
    player = page.locator(".od-clip .od-player")
    clip = int(player.get_attribute("data-clip"))
    assert player.get_attribute("data-src").startswith(f"clips/{clip}.jpg?v=")
    assert len(set(drawn(page, "left"))) > 5
    return clip


def drawn(page, side: str) -> list[int]:
    """Some pixels of what a side of the clip shows, as grey values."""
    return page.evaluate(
        "side => { const c = document.querySelector(`.od-clip canvas[data-side=${side}]`);"
        " const all = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        " return Array.from({ length: 2400 }, (_, i) => all[4 * Math.floor(i * all.length / 4 / 2400)]) }",
        side,
    )


def until(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Waits until something is true, and returns it."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)
    return value


def press_and_wait(page, site, act: Callable[[], Any]) -> tuple:
    """Does something that rates, waits until another clip or none is on screen, returns the new event."""
    before = len(site.events())
    clip = page.locator(".od-clip .od-player").get_attribute("data-clip")
    act()
    # Waiting by the page lets a test's own routes be served meanwhile, which a sleeping thread would not.
    event = until(lambda: page.wait_for_timeout(20) or site.events()[before:])[0]
    page.wait_for_function(
        "clip => document.querySelector('.od-clip .od-player')?.dataset.clip !== clip",
        arg=clip,
        timeout=10_000,
    )
    return event


def drag_slider(page, value: int) -> None:
    box = page.locator(".od-slide input").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * (value - 1) / 4, box["y"] + box["height"] / 2, steps=5)
    page.mouse.up()


def test_annotator_rates_by_key_button_and_slider_and_researcher_downloads_it(chromium, site, tmp_path):
    expected = []
    with opened(chromium, site.links["annotator"]) as page:
        assert page.locator(".od-tabs button").all_inner_texts() == ["Rate", "Guide"]
        ways: list[tuple[int, Callable[[], Any]]] = [
            (4, lambda: page.keyboard.press("4")),
            (2, lambda: page.click('.od-answers [data-key="2"]')),
            (5, lambda: (drag_slider(page, 5), page.click("[data-submit]"))),
            (1, lambda: page.keyboard.press("1")),
            (
                3,
                lambda: (page.click(".od-slide input"), page.click("[data-submit]")),
            ),  # pressed in the middle
        ]
        for value, act in ways:
            clip = shown_clip(page)
            # Of another clip the slider says nothing, and does not stand on 3.
            page.wait_for_selector('.od-slide:not([data-moved]) [aria-valuetext="not set"]')
            assert page.locator("[data-submit]").is_disabled()
            expected.append((clip, value))
            assert press_and_wait(page, site, act) == ("rate", clip, value, "bo")
        assert len(set(expected)) == 5
        page.wait_for_selector(".od-progress >> text=Everybody: 5 of 200")
        assert page.request.get(f"{site.url}/export.csv").status == 403
    with opened(chromium, site.links["researcher"], SMALL) as page:
        page.click('.od-tabs >> text="Data"')
        with page.expect_download() as download:
            page.click("text=Download CSV")
        path = tmp_path / "ratings.csv"
        download.value.save_as(path)
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [(int(row["clip_id"]), int(row["value"])) for row in rows] == expected
        assert {row["rater"] for row in rows} == {"bo"}
        assert all(50 <= int(row["latency_ms"]) < 60_000 for row in rows)


def test_tabs_of_one_browser_keep_their_own_rater(chromium, site):
    with opened(chromium, site.links["annotator"]) as first:
        second = first.context.new_page()
        second.set_viewport_size(SMALL)
        second.goto(site.links["researcher"])
        second.wait_for_selector(".od-header")
        # However slow the line is, our script runs before Viser, which would change the address.
        first.route("**/static/page.js", lambda route: (time.sleep(0.7), route.continue_()))
        first.reload()
        first.wait_for_selector(".od-header")
        assert first.locator(".od-name").inner_text() == "bo"
        assert second.locator(".od-name").inner_text() == "ada"
        assert "websocket" not in first.url
        clip = shown_clip(first)
        assert press_and_wait(first, site, lambda: first.keyboard.press("Shift+Numpad4")) == (
            "rate",
            clip,
            4,
            "bo",
        )


RIGHT = (
    "() => Math.max(...[...document.querySelectorAll('[class*=od-]')]"
    ".filter(e => !e.closest('.od-scroll, .od-preload, .od-side, .od-view, .od-tabs'))"
    ".filter(e => e.offsetParent)"
    ".map(e => e.getBoundingClientRect().right))"
)
"""The right edge of whatever is ours."""


def settled(page, measure: str) -> Any:
    """What a script says once it says the same three times, a few frames apart: the page is laid out."""
    said = [page.evaluate(measure)]
    while len(said) < 3 or len(set(said[-3:])) > 1:
        page.wait_for_timeout(40)
        said.append(page.evaluate(measure))
    return said[-1]


def test_no_tab_is_wider_than_the_screen(chromium, site):
    store = site.trainer.store
    long_name = store.accounts.ensure("Annabella-Victoria of a Long Name", "annotator")
    store.ratings.rate(1, long_name.id, 3, 900)
    site.trainer.add_pairs(2)
    store.runs.add_iteration(
        site.trainer.run, 1, snapshot=1, env_steps=16_000, stats={"predicted": 2.0, "best": 2.5}
    )
    with opened(chromium, site.links["researcher"]) as page:
        for viewport in (DESKTOP, PHONE):  # not within a tab: Viser makes all anew where a phone begins
            page.set_viewport_size(viewport)
            for tab, content in (
                ("Rate", ".od-clip"),
                ("Runs", ".od-new-run"),
                ("Compare", ".od-pair [data-frame]"),
                ("Data", ".od-quality"),
                ("Guide", ".od-example [data-frame]"),
                ("Watch", ".od-gallery img"),
            ):
                page.click(f'.od-tabs >> text="{tab}"')
                page.wait_for_selector(content, timeout=60_000)
                assert settled(page, RIGHT) <= viewport["width"], (tab, viewport)


def test_a_browser_without_webgl_is_told(chromium, site):
    context = chromium.new_context()
    page = context.new_page()
    page.add_init_script(
        "const any = HTMLCanvasElement.prototype.getContext;"
        " HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return kind.startsWith('webgl') ? null : any.call(this, kind, ...more) }"
    )
    page.goto(site.links["annotator"])
    assert "needs WebGL" in page.wait_for_selector(".od-nowebgl", timeout=60_000).inner_text()
    context.close()


def test_held_key_gives_one_rating(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        for _ in range(40):  # Playwright repeats the key as a keyboard does.
            page.keyboard.down("5")
            page.wait_for_timeout(30)
        page.keyboard.up("5")
        page.wait_for_timeout(300)
        assert site.events() == [("rate", clip, 5, "bo")]


def test_the_next_clip_is_fetched_before_the_press(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        for _ in range(2):
            shown_clip(page)
            ahead = page.locator(".od-ahead").get_attribute("data-ahead", timeout=10_000)

            def fetched(ahead=ahead):
                loaded = page.evaluate("performance.getEntriesByType('resource').map(entry => entry.name)")
                return [name for name in loaded if name.endswith(ahead)]

            assert until(fetched)
            press_and_wait(page, site, lambda: page.keyboard.press("3"))
            assert page.locator(".od-clip .od-player").get_attribute("data-src") == ahead


def test_undo_and_skip(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        first = shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("1"))
        second = shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("s"))
        shown_clip(page)
        assert press_and_wait(page, site, lambda: page.keyboard.press("u")) == ("undo", second, None, "bo")
        page.wait_for_selector(f'.od-clip .od-player[data-clip="{second}"]')
        page.wait_for_selector(".od-notice >> text=Undone: you skipped it. Rate it again.")
        assert press_and_wait(page, site, lambda: page.keyboard.press("Backspace")) == (
            "undo",
            first,
            None,
            "bo",
        )
        assert shown_clip(page) == first
        page.wait_for_selector(".od-notice >> text=Undone: you rated it 1: Not at all.")
        press_and_wait(page, site, lambda: page.keyboard.press("2"))
        page.wait_for_selector(".od-notice", state="detached")
        assert [row[1:6:4] for row in site.trainer.store.ratings.stream()] == [(first, 2)]


def test_keys_do_nothing_on_another_tab(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("2"))  # there is something to take back
        given = site.events()
        page.click('.od-tabs >> text="Guide"')
        page.wait_for_selector(".od-example [data-frame]")
        for key in ("1", "s", "u"):
            page.keyboard.press(key)
        page.wait_for_timeout(300)
        assert site.events() == given
        page.click('.od-tabs >> text="Rate"')
        clip = shown_clip(page)
        assert press_and_wait(page, site, lambda: page.keyboard.press("3")) == ("rate", clip, 3, "bo")


def test_waiting_thanks_failure_and_a_database_that_cannot_write(chromium, site, monkeypatch):
    import sqlite3

    store = site.trainer.store
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        with monkeypatch.context() as patch:
            patch.setattr(
                store.ratings,
                "rate",
                lambda *_, **__: (_ for _ in ()).throw(sqlite3.OperationalError("disk is full")),
            )
            page.keyboard.press("3")
            site.trainer.set_status(phase="failed", error="The disk is full.")
            page.wait_for_selector(".od-problem >> text=disk is full")
            assert "kept" not in page.wait_for_selector(".od-banner").inner_text()
            assert page.locator(".od-clip .od-player").get_attribute("data-clip") == str(clip)
        site.trainer.set_status(phase="failed", error="The graphics memory is full.")
        page.wait_for_selector(".od-banner >> text=The graphics memory is full.")
        page.wait_for_timeout(GUARD_MS)
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
        page.wait_for_selector(".od-problem", state="detached")
        site.trainer.set_status(phase="online", iteration=2, next_clips_s=20.0)
        store.clips.set_state([c.id for c in store.clips.waiting(site.trainer.run)], "withdrawn")
        shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
        page.wait_for_selector("text=The robot is practising, and new clips show what it does.")
        page.wait_for_selector("text=New clips in about 20 s.")
        (new,) = site.trainer.add_clips(1)
        assert shown_clip(page) == new
        site.trainer.set_status(target_ratings=3)
        press_and_wait(page, site, lambda: page.keyboard.press("5"))
        page.wait_for_selector("text=Thank you")


@pytest.mark.parametrize("live_fps", [2.0])
def test_researcher_sees_the_robot_move(chromium, site):
    with opened(chromium, site.links["researcher"], SMALL) as page:
        page.click('.od-tabs >> text="Watch"')
        canvas = page.locator("canvas[data-engine]")
        page.wait_for_function("() => document.querySelector('canvas[data-engine]').clientWidth > 300")
        page.wait_for_selector(".od-time >> text=/Video at [0-9.]+ s of 8.0 s/")
        seen: set[bytes] = set()
        until(lambda: seen.add(canvas.screenshot()) or len(seen) >= 4)  # empty, drawn, and moving
        picture = page.locator(".od-demonstration img")
        before = picture.get_attribute("src")
        until(lambda: picture.get_attribute("src") != before)
        assert page.locator(".od-figures div").first.inner_text().split() == ["Method", "onedemo"]
        page.wait_for_selector(".od-time >> text=has not practised yet")
        site.trainer.set_status(iteration=1)
        page.wait_for_selector(".od-time >> text=has not practised yet", state="detached")
        site.trainer.store.runs.add_iteration(
            site.trainer.run, 1, snapshot=1, env_steps=16000, stats={"predicted": 1.5, "kl": 0.01}
        )
        until(lambda: page.locator(".uplot:visible").count() == 1)  # what has no values yet is not drawn
        page.click(".od-controls >> text=Pause")
        until(lambda: site.trainer.calls == ["pause"])
        page.click(".od-controls >> text=Resume")
        until(lambda: site.trainer.calls == ["pause", "resume"])
        for _ in range(10):
            page.click(".od-controls >> text=Stop")
            with suppress(Error):  # it may be confirmed for five seconds, which a busy machine lets pass
                page.click(".od-controls >> text=Press again to stop", timeout=5000)
                break
        until(lambda: site.trainer.calls == ["pause", "resume", "stop"])


def test_everything_needed_to_rate_is_on_one_screen(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        for viewport in (DESKTOP, PHONE):
            page.set_viewport_size(viewport)
            shown_clip(page)
            assert settled(page, RIGHT) <= viewport["width"]
            for selector in (".od-rate-top", ".od-clip", ".od-answers", ".od-sliding", ".od-tools"):
                box = page.locator(selector).bounding_box()
                assert box["x"] >= 0 and box["x"] + box["width"] <= viewport["width"], selector
                assert box["y"] >= 0 and box["y"] + box["height"] <= viewport["height"], selector


def test_closed_page_frees_its_clip(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        with opened(chromium, site.links["second annotator"]) as other:
            assert shown_clip(other) not in (clip, clip + 1)
    until(lambda: not site.page._sessions)
    with opened(chromium, site.links["second annotator"]) as other:
        assert shown_clip(other) == clip
