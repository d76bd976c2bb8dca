"""Where things stand on Rate and Compare: measured boxes, from a small phone to a very wide screen."""

from __future__ import annotations

import threading
from itertools import combinations

import pytest

from browser.test_page import GUARD_MS, opened, press_and_wait, shown_clip, until

pytestmark = pytest.mark.seam

SIZES = (
    (360, 640), (390, 844), (390, 664), (844, 390), (683, 384), (720, 450), (820, 1180), (1180, 820),
    (1280, 620), (1366, 650), (1440, 900), (1536, 730), (1680, 920), (1920, 970), (1920, 1080),
    (2560, 1440), (3440, 1440),
)  # fmt: skip
"""Phones upright, with the browser's bars, and on their side; a zoom of 200 %; tablets; laptops; screens."""
UPRIGHT = 0.8
"""Narrower than that for its height, a screen has the clips below one another."""
SEEN = {
    "question": ".od-rate-top h1", "progress": ".od-progress", "notice": ".od-notice:not(.od-noted)",
    "side": ".od-clip .od-side", "play": ".od-play", "track": ".od-track", "answer": ".od-answers button",
    "slider": ".od-slide", "submit": "[data-submit]", "tool": ".od-tools button", "feedback": ".od-feedback",
    "chip": ".od-chip", "reason": ".od-notice input", "next": "[data-go]", "waiting": ".od-waiting",
    "banner": ".od-banner", "tab": ".od-tabs button", "brand": ".od-brand img", "account": ".od-account",
    "run": ".od-where",
}  # fmt: skip
INSIDE = {"chip": "notice", "reason": "notice", "next": "feedback"}
"""What stands in something else that is measured."""
MEASURE = """async ([names, width, height]) => {
  while (innerWidth !== width || innerHeight !== height) await new Promise(requestAnimationFrame);
  await new Promise(go => requestAnimationFrame(() => requestAnimationFrame(go)));
  const panel = document.querySelector('.mantine-Paper-root:has(.od-header)');
  const shown = e => e.checkVisibility({ visibilityProperty: true }) && e.getBoundingClientRect().width > 0;
  const box = e => { const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; };
  const boxes = Object.entries(names).flatMap(([name, selector]) =>
    [...document.querySelectorAll(selector)].filter(shown).map(e => [name, ...box(e)]));
  const text = '.od-notice, :is(.od-notice, .od-rate-top, .od-answers, .od-tools, .od-tabs, .od-feedback) *';
  const cut = [...document.querySelectorAll(text)].filter(shown)
    .filter(e => e.scrollWidth > e.clientWidth + 1 && e.clientWidth && !e.matches('input'))
    .map(e => e.textContent.trim());
  return { width: panel.clientWidth, height: innerHeight, wide: panel.scrollWidth, boxes, cut };
}"""


def measured(page, size):
    page.set_viewport_size({"width": size[0], "height": size[1]})
    said = page.evaluate(MEASURE, [SEEN, *size])
    found: dict[str, list] = {}
    for name, *box in said["boxes"]:
        found.setdefault(name, []).append(box)
    return said, found


def hull(boxes):
    lefts, tops, rights, bottoms = zip(*boxes, strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def check(page, size, where, *, sides=2, answers=5):
    """One column in the middle, clips and answers in view, nothing over anything else, nothing cut off."""
    said, found = measured(page, size)
    width, height = said["width"], said["height"]
    where = (where, size)
    assert said["wide"] <= width and not said["cut"], (where, said["cut"])
    assert len(found.get("side", ())) == sides and len(found.get("answer", ())) == answers, where
    for name, boxes in found.items():
        for left, top, right, bottom in boxes:
            assert left >= 0 and right <= width and top >= 0, (where, name, left, top, right)
            # What is not needed for each answer may be below on the lowest screens.
            assert name in ("slider", "submit") or bottom <= height, (where, name, bottom)
    for name in {"side", "answer", "waiting", "feedback"} & set(found):
        left, _, right, _ = hull(found[name])
        assert abs(left + right - width) <= 2, (where, name, left, right)
    boxes = [(name, box) for name, some in found.items() for box in some]
    for (name, a), (other, b) in combinations(boxes, 2):
        if INSIDE.get(name) == other or INSIDE.get(other) == name:
            continue
        over = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        assert min(over) <= 0.6, (where, name, a, other, b)
    if sides:
        shapes = {(round(r - left), round(b - t)) for left, t, r, b in found["side"]}
        assert max(w for w, _ in shapes) - min(w for w, _ in shapes) <= 1, (where, shapes)
        if sides == 2:
            (first, second) = found["side"]
            upright = size[0] / size[1] < UPRIGHT
            assert (first[0] == second[0]) == upright and (first[1] == second[1]) != upright, where
    return said, found


def as_large_as_the_screen_allows(size, found):
    left, _, right, _ = hull(found["side"])
    side = found["side"][0][2] - found["side"][0][0]
    bottoms = [box[3] for name in ("answer", "tool", "slider") for box in found[name]]
    lowest = max(bottom for bottom in bottoms if bottom <= size[1])
    return side >= 959 or right - left >= size[0] - 60 or lowest >= size[1] - 70


def test_rate_is_one_column_in_the_middle_at_every_size_and_in_every_state(chromium, site):
    store, run = site.trainer.store, site.trainer.run
    with opened(chromium, site.links["annotator"], color_scheme="light") as page:
        shown_clip(page)
        for size in SIZES:
            _, found = check(page, size, "a clip")
            assert as_large_as_the_screen_allows(size, found), (size, hull(found["side"]))
        press_and_wait(page, site, lambda: page.keyboard.press("s"))
        page.wait_for_selector(".od-notice >> text=Why?")
        for size in SIZES:
            _, found = check(page, size, "skipped")
            assert len(found["chip"]) == 3 and len(found["reason"]) == 1, size
        page.click(".od-chip >> nth=0")
        page.wait_for_selector(".od-noted")
        for size in SIZES:
            _, found = check(page, size, "noted")
            assert found["question"], size
        page.wait_for_timeout(GUARD_MS)
        press_and_wait(page, site, lambda: page.keyboard.press("4"))
        shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("u"))
        page.wait_for_selector(".od-notice >> text=Undone: you rated it 4: Mostly.")
        for size in SIZES:
            _, found = check(page, size, "undone")
            assert found["notice"] and found["question"], size
        site.trainer.set_status(
            phase="failed",
            error="The graphics memory is full. Close other programs, or start with --threads 1.",
        )
        page.wait_for_selector(".od-banner")
        for size in SIZES[1:]:
            check(page, size, "failed")
        site.trainer.set_status(
            phase="online", error="", message="The robot is practising.", next_clips_s=20.0
        )
        page.wait_for_selector(".od-banner", state="detached")
        store.clips.set_state([clip.id for clip in store.clips.waiting(run)], "withdrawn")
        while page.locator(".od-clip").count():
            shown_clip(page)
            press_and_wait(page, site, lambda: page.keyboard.press("3"))
        page.wait_for_selector(".od-waiting >> h2")
        for size in SIZES:
            check(page, size, "waiting", sides=0, answers=0)
        site.trainer.set_status(target_ratings=1)
        page.wait_for_selector(".od-waiting >> text=Thank you")
        for size in SIZES:
            check(page, size, "done", sides=0, answers=0)


def test_practice_is_one_column_in_the_middle_at_every_size(chromium, site):
    from onedemo.app.http.tokens import issue_link, read_secret

    store = site.trainer.store
    new = store.accounts.ensure("new", "annotator")
    with opened(chromium, issue_link(store, read_secret(store.path.parent), new, site.url)) as page:
        page.wait_for_selector(".od-intro")
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            # Viser makes everything anew where a phone's width begins.
            video, words = (
                until(page.locator(f".od-intro > {part}").bounding_box) for part in ("video", "div")
            )
            left = min(box["x"] for box in (video, words))
            right = max(box["x"] + box["width"] for box in (video, words))
            assert video["width"] > min(width, height) * 0.3, ("introduction", width, height, video)
            assert words["width"] > min(width * 0.4, 300), ("introduction", width, height, words)
            assert 0 <= left and right <= width, ("introduction", width, height, left, right)
        page.click(".od-intro [data-go]")
        page.wait_for_selector(".od-practice [data-frame]", timeout=60_000)
        for size in SIZES:
            check(page, size, "practice")
        page.keyboard.press("1")
        page.wait_for_selector(".od-feedback")
        for size in SIZES:
            check(page, size, "feedback", answers=0)


def test_compare_and_the_header_are_in_the_middle_at_every_size(chromium, site):
    site.trainer.add_pairs(3)
    with opened(chromium, site.links["researcher"], {"width": 900, "height": 700}) as page:
        page.click('.od-tabs >> text="Compare"')
        page.wait_for_selector(".od-pair [data-frame]", timeout=60_000)
        page.wait_for_selector("text=The robot of this run learns from the Rate tab alone")
        page.wait_for_selector('.od-header[data-tab="compare"]')
        for size in SIZES:
            _, found = check(page, size, "a pair", sides=3, answers=3)
            assert len(found["tab"]) >= 6 and found["account"], size
            assert size[0] <= 700 or found["run"], size
        page.wait_for_timeout(GUARD_MS)
        page.keyboard.press("1")
        page.wait_for_selector("[data-undo-pair]")
        page.wait_for_timeout(GUARD_MS)
        page.keyboard.press("u")
        page.wait_for_selector(".od-notice >> text=Undone: you said the left one. Compare them again.")
        for size in SIZES:
            check(page, size, "a pair again", sides=3, answers=3)
        page.wait_for_selector(".od-pair [data-frame]")
        page.wait_for_timeout(GUARD_MS)
        page.keyboard.press("s")
        page.wait_for_selector(".od-notice >> text=Skipped.")
        page.click(".od-account")
        menu = page.locator(".od-menu").inner_text()
        assert "ada" in menu and site.trainer.run in menu and site.trainer.demo.name in menu


def test_a_phone_has_no_keys_and_targets_for_fingers(chromium, site):
    small = """() => [...document.querySelectorAll('[class^=od-] :is(button, input:not([type=range]))')]
      .filter(e => e.checkVisibility({ visibilityProperty: true }))
      .map(e => [e.textContent.trim() || e.ariaLabel, e.getBoundingClientRect()])
      .filter(([, box]) => Math.min(box.width, box.height) < 43.5)
      .map(([name, box]) => [name, box.width, box.height])"""
    size = {"width": 390, "height": 844}
    with opened(chromium, site.links["annotator"], size, is_mobile=True, has_touch=True) as page:
        shown_clip(page)
        assert page.evaluate("() => matchMedia('(hover: none) and (pointer: coarse)').matches")
        assert page.evaluate(small) == []
        assert page.locator(".od-track").bounding_box()["height"] >= 43.5
        assert not page.locator("[data-help]").is_visible()
        assert page.locator(".od-tools kbd:visible").count() == 0
        press_and_wait(page, site, lambda: page.tap('.od-tools [data-key="s"]'))
        page.wait_for_selector(".od-notice")
        assert page.evaluate(small) == []
        check(page, (390, 844), "a phone, skipped")
        page.tap('.od-tabs >> text="Guide"')
        page.wait_for_selector(".od-scale")
        assert not page.locator(".od-keys").is_visible()


def test_something_is_said_before_anything_of_the_page_has_come(chromium, site):
    context = chromium.new_context()
    page = context.new_page()
    held, go_on = [], threading.Event()
    page.route("**/static/*", lambda route: route.continue_() if go_on.is_set() else held.append(route))
    page.goto(site.links["annotator"], wait_until="commit")
    page.wait_for_selector(".od-loading >> text=Loading")
    page.wait_for_function("() => performance.getEntriesByName('first-contentful-paint').length")
    go_on.set()
    for route in held:
        route.continue_()
    page.wait_for_selector(".od-header", timeout=90_000)
    assert not page.locator(".od-loading").is_visible()
    context.close()
