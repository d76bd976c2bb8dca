"""What an annotator does besides pressing 1 to 5, on two screens: practice, slow motion, marks, reasons."""

from __future__ import annotations

import numpy as np
import pytest

from browser.test_page import DESKTOP, GUARD_MS, PHONE, drawn, opened, press_and_wait, shown_clip, until

pytestmark = pytest.mark.seam

BOTH = pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])


def frame_of(page) -> int:
    return int(page.locator(".od-clip .od-player").get_attribute("data-frame"))


def marks_of(site) -> list[tuple]:
    return site.trainer.store.database.rows(
        "SELECT clip_id, value, mark_from, mark_to FROM events WHERE kind = 'rate' ORDER BY id"
    )


def newcomer(site) -> str:
    """A link of somebody who has never rated."""
    from onedemo.app.http.tokens import issue_link, read_secret

    store = site.trainer.store
    new = store.accounts.ensure("new", "annotator")
    return issue_link(store, read_secret(store.path.parent), new, site.url)


def practice_clip(page, number, of):
    page.wait_for_selector(f".od-progress >> text=Practice {number} of {of}")
    page.wait_for_selector(".od-practice .od-player[data-frame]", timeout=60_000)


@BOTH
def test_a_first_visit_opens_with_the_demo_then_practice(chromium, site, viewport):
    from helpers.fake_trainer import drawn_track
    from onedemo.demos.video import write_webm

    site.trainer.track = drawn_track()
    write_webm(site.trainer.demo.path, site.trainer.frames[:60], fps=30.0)
    practice = site.page.pictures.chosen().practice
    with opened(chromium, newcomer(site), viewport) as page:
        page.wait_for_selector("[data-introduction] video")
        page.wait_for_function("() => document.querySelector('[data-introduction] video')?.currentTime > 0.3")
        assert page.locator("[data-introduction] li").count() == 3
        (button,) = page.locator("[data-introduction] button").all()  # one thing to do
        box = button.bounding_box()
        assert box["y"] + box["height"] <= viewport["height"], "without scrolling"
        page.keyboard.press("3")  # nothing to rate yet
        page.keyboard.press("Enter")
        practice_clip(page, 1, len(practice))
        page.keyboard.press("ArrowRight")  # both sides stand still
        assert np.abs(np.subtract(drawn(page, "left"), drawn(page, "right"))).max() < 40
        page.keyboard.press("2")
        page.wait_for_selector(".od-feedback >> text=You gave 2; most people would give 5.")
        assert not page.locator(".od-answers").is_visible()
        page.keyboard.press("Enter")
        for number, example in enumerate(practice[1:], start=2):
            practice_clip(page, number, len(practice))
            page.click(f'.od-answers [data-key="{example.rating}"]')
            page.wait_for_selector(f".od-feedback >> text={example.rating} is what most people would give.")
            page.click("[data-go]")
        clip = shown_clip(page)
        assert site.events() == []
        assert press_and_wait(page, site, lambda: page.keyboard.press("3")) == ("rate", clip, 3, "new")
        page.reload()
        shown_clip(page)  # not again
        page.click('.od-tabs >> text="Guide"')
        page.wait_for_function("() => document.querySelector('.od-guide video')?.currentTime > 0.1")
        shown = page.locator(".od-example figcaption b").all_inner_texts()
        assert shown == sorted(shown) and len(shown) > 2  # in the order of the scale
        page.click("text=Practise again")
        practice_clip(page, 1, len(practice))  # without the introduction
        page.keyboard.press("s")
        shown_clip(page)
        assert len(site.events()) == 1


def test_more_examples_come_once_the_robot_was_looked_at(chromium, site):
    from helpers.fake_trainer import drawn_track

    with opened(chromium, newcomer(site)) as page:
        page.wait_for_selector("[data-introduction] button >> text=Practise")
        page.click('.od-tabs >> text="Guide"')
        page.wait_for_selector(".od-example .od-player[data-frame]", timeout=60_000)
        assert page.locator(".od-example").count() == 1
        site.trainer.track = drawn_track()
        page.wait_for_function("() => document.querySelectorAll('.od-example').length > 2")
        page.click("text=Practise again")
        practice_clip(page, 1, 5)


def test_slow_motion_steps_and_replay(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        page.keyboard.press("ArrowRight")
        here, before = frame_of(page), drawn(page, "right")
        page.wait_for_timeout(300)
        assert frame_of(page) == here  # a step stands still
        page.keyboard.press("ArrowLeft")
        if here > 0:
            assert frame_of(page) == here - 1 and drawn(page, "right") != before
        for _ in range(12):
            page.keyboard.press("ArrowRight")
        assert frame_of(page) == 9
        page.click('[data-step="-1"]')
        assert frame_of(page) == 8
        assert page.locator("[data-slow]").get_attribute("aria-pressed") == "false"
        page.keyboard.press("f")
        page.wait_for_selector('[data-slow][aria-pressed="true"]')
        seconds = page.evaluate(
            """() => new Promise(done => {
                const player = document.querySelector('.od-clip .od-player'), began = performance.now();
                document.querySelector('[data-replay]').click();
                new MutationObserver((_, o) => {
                  if (player.dataset.frame !== '9') return;
                  o.disconnect();
                  done((performance.now() - began) / 1000);
                }).observe(player, { attributes: true });
            })"""
        )
        assert 1.0 < seconds < 3.0  # nine thirtieths of a second, at a quarter of the speed
        clip = shown_clip(page)
        press_and_wait(page, site, lambda: page.keyboard.press("4"))
        shown_clip(page)
        assert page.locator("[data-slow]").get_attribute("aria-pressed") == "true"  # it stays on
        assert site.events() == [("rate", clip, 4, "bo")]


@BOTH
def test_a_mark_by_dragging_goes_with_the_rating(chromium, site, viewport):
    with opened(chromium, site.links["annotator"], viewport, has_touch=viewport is PHONE) as page:
        clip = shown_clip(page)
        box = page.locator("[data-track]").bounding_box()
        y = box["y"] + box["height"] / 2
        page.mouse.move(box["x"] + 0.31 * box["width"], y)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.55 * box["width"], y, steps=4)
        page.mouse.up()
        page.wait_for_selector(".od-bar-note >> text=Goes wrong from 0.10 to 0.20 s")
        page.wait_for_selector(
            ".od-clip [data-still]"
        )  # it stands still, and a button shows that it can go on
        page.click("[data-play]")
        page.wait_for_selector(".od-clip .od-player:not([data-still])")
        press_and_wait(page, site, lambda: page.keyboard.press("2"))
        assert marks_of(site) == [(clip, 2, 13, 25)]  # pictures 3 to 5: steps 13 to 24
        second = shown_clip(page)
        page.mouse.click(box["x"] + 0.75 * box["width"], y)  # a tap shows that moment and marks nothing
        assert frame_of(page) == 7
        press_and_wait(page, site, lambda: page.keyboard.press("5"))
        assert marks_of(site)[1:] == [(second, 5, None, None)]


def mark_by_dragging(page, start, end):
    box = page.locator("[data-track]").bounding_box()
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + start * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + end * box["width"], y, steps=4)
    page.mouse.up()


def test_a_mark_is_there_again_after_another_tab_after_undo_and_on_the_last_picture(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        mark_by_dragging(page, 0.95, 1.2)
        words = page.wait_for_selector(".od-bar-note >> text=Goes wrong from 0.30 to 0.33 s").inner_text()
        page.wait_for_timeout(GUARD_MS)
        page.click('.od-tabs >> text="Guide"')
        page.wait_for_selector(".od-scale")
        page.click('.od-tabs >> text="Rate"')
        shown_clip(page)
        assert page.locator(".od-bar-note").inner_text() == words
        assert page.locator(".od-wrong").bounding_box()["width"] > 10
        press_and_wait(page, site, lambda: page.keyboard.press("2"))
        shown_clip(page)
        assert "Goes wrong" not in page.locator(".od-bar-note").inner_text()
        press_and_wait(page, site, lambda: page.keyboard.press("u"))
        assert shown_clip(page) == clip and page.locator(".od-bar-note").inner_text() == words
        press_and_wait(page, site, lambda: page.keyboard.press("1"))
        assert marks_of(site) == [(clip, 2, 38, 41), (clip, 1, 38, 41)]


def test_a_press_that_does_not_arrive_says_so_and_is_sent_until_it_does(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        page.route("**/r/**", lambda route: route.abort())
        mark_by_dragging(page, 0.05, 0.15)
        page.keyboard.press("2")
        page.wait_for_selector(".od-problem.od-late >> text=Not saved yet")
        assert site.events() == []
        assert page.locator(".od-wrong").bounding_box()["width"] > 10  # still there
        page.unroute("**/r/**")
        page.wait_for_selector(".od-problem", state="detached")
        assert marks_of(site) == [(clip, 2, 0, 9)]
        second = shown_clip(page)
        assert press_and_wait(page, site, lambda: page.keyboard.press("4")) == ("rate", second, 4, "bo")


def test_a_press_whose_answer_is_lost_is_sent_again_and_counts_once(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip, bodies = shown_clip(page), []

        def lose(route):
            bodies.append(route.request.post_data)
            if len(bodies) == 1:
                assert route.fetch().json() == {"counted": True}
                route.abort()
            else:
                route.continue_()

        page.route("**/press", lose)
        press_and_wait(page, site, lambda: page.keyboard.press("2"))
        second = shown_clip(page)
        until(lambda: page.wait_for_timeout(50) or len(bodies) == 2)
        assert bodies[0] == bodies[1]
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
        assert site.events() == [("rate", clip, 2, "bo"), ("rate", second, 3, "bo")]
        assert page.locator(".od-problem").count() == 0


def test_on_a_slow_line_a_press_is_for_the_clip_that_was_on_screen(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        page.route("**/press", lambda route: (page.wait_for_timeout(600), route.continue_()))
        page.keyboard.press("2")
        page.keyboard.press("5")  # it was answered already
        page.keyboard.press("u")  # takes back what is on its way
        until(lambda: page.wait_for_timeout(50) or len(site.events()) == 2)
        page.unroute("**/press")
        assert site.events() == [("rate", clip, 2, "bo"), ("undo", clip, None, "bo")]
        page.wait_for_selector(".od-notice >> text=Undone: you rated it 2")
        assert shown_clip(page) == clip
        press_and_wait(page, site, lambda: page.keyboard.press("4"))


def test_the_same_clip_answered_at_another_page_is_said(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        rater = {rater.name: rater.id for rater in site.trainer.store.accounts.raters()}["bo"]
        site.trainer.store.ratings.rate(clip, rater, 1, 900)
        page.keyboard.press("4")
        page.wait_for_selector(".od-problem >> text=You have already rated that clip on another page")
        assert shown_clip(page) != clip
        press_and_wait(page, site, lambda: page.keyboard.press("4"))
        assert [event[2] for event in site.events()] == [1, 4]


def test_a_held_enter_on_a_button_gives_one_rating(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        page.focus('.od-answers [data-key="4"]')
        for _ in range(40):  # without an up in between: held
            page.keyboard.down("Enter")
            page.wait_for_timeout(30)
        page.keyboard.up("Enter")
        page.wait_for_timeout(GUARD_MS)
        assert site.events() == [("rate", clip, 4, "bo")]


def test_digits_are_keys_by_their_place(chromium, site):
    keys = [  # of French, Czech and programmers' Dvorak keyboards, French with Shift, and the keypad
        (4, "Digit4", "'", 52, 0), (2, "Digit2", "ě", 50, 0), (1, "Digit1", "%", 49, 0),
        (3, "Digit3", "3", 51, 8), (5, "Numpad5", "5", 101, 0), (1, "Digit1", "&", 49, 0),
        (1, "Digit1", "1", 49, 8),
    ]  # fmt: skip
    with opened(chromium, site.links["annotator"]) as page:
        for _, *key in keys:
            shown_clip(page)
            press_and_wait(page, site, lambda key=key: type_key(page, *key))
        assert [event[2] for event in site.events()] == [key[0] for key in keys]
        shown_clip(page)
        type_key(page, "Digit2", "~", 50, modifiers=1 | 2)  # AltGr of Windows: another sign
        page.wait_for_timeout(GUARD_MS)
        assert len(site.events()) == len(keys)


def test_a_button_flashes_once_the_server_has_taken_the_press(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        held = []
        page.route("**/press", lambda route: held.append(route))
        page.keyboard.press("4")
        page.wait_for_selector('.od-answers .od-sent[data-key="4"]')
        page.wait_for_timeout(400)
        assert page.locator(".od-pressed").count() == 0
        page.evaluate(
            "() => new MutationObserver(() => {"
            " window.flashed ||= document.querySelector('.od-pressed')?.dataset.key"
            "}).observe(document.querySelector('.od-answers'), { attributes: true, subtree: true })"
        )
        held[0].continue_()
        page.wait_for_function("() => window.flashed")
        assert page.evaluate("() => window.flashed") == "4" and len(site.events()) == 1


def test_the_usual_keys_for_undo_undo(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        expected = []
        for modifier in ("Control", "Meta"):
            clip = shown_clip(page)
            press_and_wait(page, site, lambda: page.keyboard.press("4"))
            shown_clip(page)
            page.keyboard.press(f"{modifier}+Shift+z")  # to do again what was undone, elsewhere
            press_and_wait(page, site, lambda key=f"{modifier}+z": page.keyboard.press(key))
            expected += [("rate", clip, 4, "bo"), ("undo", clip, None, "bo")]
            assert site.events() == expected


def test_letters_of_other_scripts_are_keys_by_their_place_and_latin_ones_by_their_label(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        press_and_wait(page, site, lambda: type_key(page, "KeyS", "ы", 83))
        press_and_wait(page, site, lambda: type_key(page, "KeyU", "г", 85))
        assert shown_clip(page) == clip
        type_key(page, "KeyF", "а", 70)
        page.wait_for_selector('[data-slow][aria-pressed="true"]')
        press_and_wait(page, site, lambda: type_key(page, "Semicolon", "s", 83))  # Dvorak
        shown_clip(page)
        for code, key in (("KeyS", "o"), ("KeyU", "g"), ("KeyS", ";")):  # labels that mean nothing here
            type_key(page, code, key, 79)
        page.wait_for_timeout(GUARD_MS)
        assert [event[0] for event in site.events()] == ["skip", "undo", "skip"]
        type_key(page, "Digit2", "é", 50, modifiers=1)  # Alt: the second tab
        page.wait_for_selector('.od-header[data-tab="guide"]')
        type_key(page, "KeyA", "ф", 65, modifiers=1)
        page.wait_for_selector(".od-progress >> text=Practice 1 of 1")


def type_key(page, code, key, number, modifiers=0):
    """A real key press of another layout, as the browser gets it from the system."""
    devtools = page.context.new_cdp_session(page)
    what = {"code": code, "key": key, "windowsVirtualKeyCode": number, "modifiers": modifiers}
    devtools.send("Input.dispatchKeyEvent", {"type": "rawKeyDown", **what})
    devtools.send("Input.dispatchKeyEvent", {"type": "keyUp", **what})
    devtools.detach()


CLICK_ONCE_IT_IS_ANOTHERS = """clip => {
  const undo = () => document.querySelector('.od-tools [data-key="u"]');
  new MutationObserver((_, observer) => {
    if (!undo() || undo().dataset.undoClip === clip) return;
    observer.disconnect();
    undo().click();
  }).observe(document.body, {subtree: true, childList: true, attributes: true});
}"""
"""Clicks "undo" a second time as soon as it would take back what was said before."""


def test_a_double_click_on_undo_takes_back_one(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        for _ in range(2):
            clip = shown_clip(page)
            press_and_wait(page, site, lambda: page.keyboard.press("4"))
        undo = page.locator('.od-tools [data-key="u"]')
        box = undo.bounding_box()
        at = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.evaluate(CLICK_ONCE_IT_IS_ANOTHERS, str(clip))  # in the page: a busy machine is late
        page.mouse.click(*at)
        until(lambda: page.wait_for_timeout(20) or undo.get_attribute("data-undo-clip") != str(clip))
        page.wait_for_timeout(700)
        assert [event[:2] for event in site.events()][2:] == [("undo", clip)]
        page.mouse.click(*at)  # a moment later it is meant
        until(lambda: page.wait_for_timeout(20) or len(site.events()) == 4)


def test_a_mark_by_keys_and_taking_it_away(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        for _ in range(10):
            page.keyboard.press("ArrowLeft")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("m")
        for _ in range(2):
            page.keyboard.press("ArrowRight")
        page.keyboard.press("m")
        page.keyboard.press("3")
        until(site.events)
        assert marks_of(site) == [(clip, 3, 5, 17)]  # pictures 1 to 3: steps 5 to 16
        shown_clip(page)
        page.keyboard.press("m")
        page.keyboard.press("m")
        page.click("[data-unmark]")
        page.wait_for_selector("[data-unmark]", state="hidden")
        assert page.locator(".od-wrong").bounding_box()["width"] == 0
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
        assert marks_of(site)[1][2:] == (None, None)


def test_a_skip_may_be_explained_and_typing_never_rates(chromium, site):
    def reasons():
        return site.trainer.store.database.rows(
            "SELECT reason FROM events WHERE reason IS NOT NULL ORDER BY id"
        )

    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        place = page.locator(".od-clip").bounding_box()
        press_and_wait(page, site, lambda: page.keyboard.press("s"))
        asked = page.locator(".od-notice").bounding_box()  # in plain sight, and nothing moves
        assert page.locator(".od-clip").bounding_box() == place
        assert asked["y"] >= 0 and asked["y"] + asked["height"] <= place["y"]
        page.click(".od-notice >> text=It is too short to tell")
        page.wait_for_selector(".od-notice >> text=Noted. Thank you.")
        page.wait_for_timeout(1200)  # the page is drawn anew twice a second
        assert page.locator(".od-notice").inner_text() == "Noted. Thank you."
        shown_clip(page)
        press_and_wait(page, site, lambda: page.click('.od-tools [data-key="s"]'))
        shown_clip(page)
        before = len(site.events())
        page.click(".od-notice input")
        page.keyboard.type("12345 s u m f ? <b>")
        page.wait_for_timeout(GUARD_MS)
        assert len(site.events()) == before and not page.locator(".od-help").is_visible()
        page.keyboard.press("Enter")
        page.wait_for_selector(".od-notice >> text=Noted. Thank you.")
        assert reasons() == [("It is too short to tell",), ("12345 s u m f ? <b>",)]


def test_the_keys_are_shown_and_meanwhile_nothing_is_rated(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        page.keyboard.press("?")
        page.wait_for_selector(".od-help >> text=slow motion, on and off")
        for key in ("3", "s", "u"):
            page.keyboard.press(key)
        page.wait_for_timeout(GUARD_MS)
        assert site.events() == []
        page.keyboard.press("Escape")
        page.wait_for_selector(".od-help", state="hidden")
        assert press_and_wait(page, site, lambda: page.keyboard.press("3")) == ("rate", clip, 3, "bo")
        shown_clip(page)
        page.click("[data-help]")
        page.wait_for_selector(".od-help")
        page.click(".od-help >> text=Close")
        page.wait_for_selector(".od-help", state="hidden")


def test_with_reduced_motion_clips_play_once_on_space(chromium, site):
    with opened(chromium, site.links["annotator"], reduced_motion="reduce") as page:
        page.wait_for_selector(".od-clip [data-frame]")
        page.wait_for_timeout(600)
        assert frame_of(page) == 0
        page.keyboard.press("Space")
        page.wait_for_selector('.od-clip [data-frame="9"]')
        page.wait_for_timeout(1200)
        assert frame_of(page) == 9
        clip = int(page.locator(".od-clip .od-player").get_attribute("data-clip"))
        assert press_and_wait(page, site, lambda: page.keyboard.press("4")) == ("rate", clip, 4, "bo")


def test_everything_can_be_done_with_the_keyboard_and_the_focus_is_seen(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        clip = shown_clip(page)
        reached = set()
        for _ in range(30):
            page.keyboard.press("Tab")
            name, outline = page.evaluate(
                "() => { const e = document.activeElement;"
                " const ours = e.matches('button, a, input, [role=slider]');"
                " const name = ours ? e.getAttribute('aria-label') || e.textContent : '';"
                " return [name.trim(), getComputedStyle(e).outlineStyle] }"
            )
            if name:
                reached.add(name.split(" ")[0])
                assert outline != "none", name
            if name == "Rating":
                page.keyboard.press("ArrowRight")  # until then there is nothing to submit
            if name.startswith("4") and not site.events():
                press_and_wait(page, site, lambda: page.keyboard.press("Enter"))
                assert site.events() == [("rate", clip, 4, "bo")]
                assert page.evaluate("() => document.activeElement.textContent").startswith("4")
        assert {
            "Rate",
            "Guide",
            "1Not",
            "5The",
            "Rating",
            "Submit",
            "Skip",
            "Replay",
            "Slow",
            "Keys",
        } <= reached


def test_undo_outlives_a_reload_a_new_browser_and_a_restart(chromium, site):
    from onedemo.app.http.server import Front
    from onedemo.app.http.tokens import issue_link, read_secret
    from onedemo.app.network.bind import Listening
    from onedemo.app.services.demo_images import Pictures
    from onedemo.app.ui.app import Page

    store, clips = site.trainer.store, []
    bo = store.accounts.ensure("bo", "annotator")

    def take_back(page):
        shown_clip(page)
        clip = clips.pop()
        assert press_and_wait(page, site, lambda: page.keyboard.press("u")) == ("undo", clip, None, "bo")
        assert shown_clip(page) == clip

    with opened(chromium, site.links["annotator"]) as page:
        for _ in range(3):
            clips.append(shown_clip(page))
            mark_by_dragging(page, 0.31, 0.55)
            press_and_wait(page, site, lambda: page.keyboard.press("1"))
        page.reload()
        take_back(page)
        page.wait_for_selector(".od-bar-note >> text=Goes wrong from 0.10 to 0.20 s")  # as it was marked
    with opened(chromium, site.links["annotator"]) as page:
        take_back(page)
    pictures = Pictures(site.trainer.demo, read=lambda _: site.trainer.frames)
    restarted = Page(site.trainer, pictures=pictures, guard_seconds=0.1)
    front = Front(restarted, Listening(port=0))
    try:
        link = issue_link(store, read_secret(store.path.parent), bo, front.start())
        with opened(chromium, link) as page:
            take_back(page)
            assert page.locator('.od-tools [data-key="u"]').is_disabled()
    finally:
        front.close()
        restarted.close()


def test_presses_of_others_pages_and_hostile_ones_change_nothing(chromium, site):
    with (
        opened(chromium, site.links["annotator"]) as page,
        opened(chromium, site.links["second annotator"]) as other,
    ):
        clip, others_clip = shown_clip(page), shown_clip(other)
        path = page.evaluate("() => new URL('press', location.href).pathname")

        def token(of):
            return of.locator(".od-header").get_attribute("data-page")

        def post(body, **options):
            return page.request.post(f"{site.url}{path}", data=body, headers={"Origin": site.url}, **options)

        good = {"press": "rate", "page": token(page), "id": "1", "clip": clip, "value": 3, "mark": [0, 3]}
        assert post({**good, "page": "guessed"}).status == 410
        assert post({**good, "page": token(other), "clip": others_clip}).status == 410  # not this rater's
        for other_clip in (clip + 5, others_clip, 10**9):
            assert post({**good, "id": str(other_clip), "clip": other_clip}).json() == {"counted": False}
        reason = {"press": "reason", "page": token(page), "id": "2", "clip": clip, "reason": "not skipped"}
        assert post(reason).json() == {"counted": False}
        pair = {"press": "compare", "page": token(page), "id": "3", "pair": 1, "answer": "left"}
        assert post(pair).status == 400  # an annotator's page has no such tab here
        for bad in (
            {}, [], "x", {**good, "more": 1}, {**good, "value": 6}, {**good, "mark": [5, 1]},
            {**good, "mark": [9, 11]}, {**reason, "reason": "a\nb"},
        ):  # fmt: skip
            assert post(bad).status == 400, bad
        assert post({**reason, "reason": "x" * 70_000}).status == 413
        elsewhere = page.request.post(
            f"{site.url}{path}", data=good, headers={"Origin": "http://evil.example"}
        )
        assert elsewhere.status == 403
        nobody = page.context.browser.new_context()
        assert nobody.request.post(f"{site.url}{path}", data=good, headers={"Origin": site.url}).status == 401
        nobody.close()
        assert site.events() == []
        for _ in range(3):  # sent again, it counts once
            assert post({**good, "id": "9"}).json() == {"counted": True}
        assert site.events() == [("rate", clip, 3, "bo")] and marks_of(site) == [(clip, 3, 0, 13)]
        # What was saved is, though the page at which it was pressed has gone.
        assert post({**good, "page": "gone", "id": "10"}).json() == {"counted": True}
        page.wait_for_selector(f'.od-clip [data-clip]:not([data-clip="{clip}"])')  # drawn by Viser
