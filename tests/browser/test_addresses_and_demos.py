"""Addresses of tabs, and a video that becomes a demo and a run, in a real browser."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from data.videos import corners_of, encode, number_of

from browser.test_accessible import assert_nothing_serious
from browser.test_page import DESKTOP, PHONE, SMALL, opened, until
from helpers.fake_trainer import _zeros, drawn_frames
from onedemo.demos.library import find_demo, list_demos, read_frames
from onedemo.demos.video import write_webm
from onedemo.errors import UserError
from onedemo.storage.clips import NewClip

pytestmark = pytest.mark.seam


def at(page, tab):
    page.wait_for_selector(f'.od-header[data-tab="{tab}"]', timeout=60_000)


def test_back_reload_a_link_and_the_title_know_the_tab(chromium, site):
    base, run = f"{site.url}/r/1/", site.trainer.run
    with opened(chromium, site.links["researcher"], SMALL) as page:
        at(page, "start")
        assert page.url == base + "start"
        page.click(".od-tabs >> text=Data")
        page.wait_for_url(base + "data")
        page.keyboard.press("Alt+7")
        page.wait_for_url(base + "guide")
        assert page.title() == f"Guide - {run} - onedemo"
        page.go_back()
        at(page, "data")
        page.go_back()
        at(page, "start")
        assert page.url == base + "start" and page.title() == f"Start - {run} - onedemo"
        page.go_forward()
        at(page, "data")
        page.reload()
        at(page, "data")
        assert page.url == base + "data" and page.title() == f"Data - {run} - onedemo"
        assert run in page.locator(".od-header").inner_text()
        # Viser comes back by itself, with the tab that the page began with.
        page.click(".od-tabs >> text=Rate")
        page.wait_for_url(base + "rate")
        name = page.locator(".od-header").get_attribute("data-page")
        site.page.serve(site.trainer)
        page.wait_for_selector(f'.od-header:not([data-page="{name}"])', timeout=60_000)
        at(page, "rate")
        assert page.url == base + "rate"
        for keys in ("Control+k", "Meta+k"):
            page.keyboard.press(keys)
        page.wait_for_timeout(400)  # as long as it took to open
        assert page.locator(".mantine-Spotlight-search").count() == 0
        page.goto(f"{base}nothing")
        page.click("text=Go to your page")
        at(page, "start")
        page.goto(f"{base}data#x")  # would have become part of Viser's address
        at(page, "data")
    with opened(chromium, site.links["annotator"], SMALL) as page:
        page.goto(f"{base}data")  # as a researcher sent it
        assert "You are signed in as bo" in page.inner_text("main")
        page.click("text=Go to your page")
        at(page, "rate")
        page.keyboard.press("Control+k")
        page.wait_for_timeout(400)
        assert page.locator(".mantine-Spotlight-search").count() == 0


@pytest.fixture
def made(site):
    """Runs that were asked for, in place of a trainer that makes them."""
    asked = []

    def create(**wanted):
        if wanted["settings"].get("ratings.clip_seconds") == 4:
            raise UserError("ratings.clip_seconds must be shorter than the demo, got 4")
        asked.append(wanted)

    runs = site.trainer.store.runs
    site.page.study = SimpleNamespace(create=create, describe=runs.describe, delete=runs.delete)
    return asked


def test_a_video_is_trimmed_cropped_looked_at_kept_and_learned_from(chromium, site, made, tmp_path):
    file = tmp_path / "a turning stick.webm"
    write_webm(file, drawn_frames(90), fps=30)
    demos_dir = site.trainer.data_dir / "demos"
    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.click(".od-tabs >> text=Runs")
        page.click("[data-new-demo]")
        part = lambda name: page.locator(f'.od-demo-dialog [data-part="{name}"]')  # noqa: E731
        part("file").set_input_files(str(file))
        page.wait_for_function("() => document.querySelector('[data-part=video]').videoWidth === 480")
        # Trimmed by keyboard, and by dragging.
        part("start").focus()
        for _ in range(6):
            page.keyboard.press("ArrowRight")
        assert part("start").get_attribute("aria-valuetext") == "0.20 s"
        bar, handle = part("trim").bounding_box(), part("end").bounding_box()
        y = handle["y"] + handle["height"] / 2
        page.mouse.move(handle["x"] + handle["width"] / 2, y)
        page.mouse.down()
        page.mouse.move(bar["x"] + bar["width"] * 2 / 3, y, steps=4)
        page.mouse.up()
        assert float(part("end-s").input_value()) == pytest.approx(2, abs=0.05)
        part("end-s").fill("2")
        part("end-s").press("Enter")
        # Cropped by dragging a corner, by keyboard, and in numbers.
        corner, frame = page.locator('[data-corner="nw"]').bounding_box(), part("frame").bounding_box()
        page.mouse.move(corner["x"] + corner["width"] / 2, corner["y"] + corner["height"] / 2)
        page.mouse.down()
        page.mouse.move(frame["x"] + frame["width"] / 4, frame["y"] + frame["height"] / 8, steps=4)
        page.mouse.up()
        assert int(part("crop-x").input_value()) == pytest.approx(120, abs=3)
        part("crop-w").fill("240")
        part("crop-w").press("Enter")
        part("crop-x").fill("100")
        part("crop-x").press("Enter")
        part("crop").focus()
        page.keyboard.press("Shift+ArrowRight")
        assert part("crop-x").input_value() == "110"
        with page.expect_response("**/result") as given:
            part("show").click(timeout=60_000)
        assert given.value.status == 200
        page.wait_for_selector("[data-step=result]:visible")
        terms, values = (part("facts").locator(tag).all_inner_texts() for tag in ("dt", "dd"))
        facts = dict(zip(terms, values, strict=True))
        assert facts["Length"] == "1.80 s" and facts["Frames"] == "54" and facts["Size"].startswith("240 x ")
        page.wait_for_function("() => document.querySelector('[data-part=result]').currentTime > 0.1")
        assert_nothing_serious(page, "the result")
        follows_each_change(page, part)
        assert [demo for demo in list_demos(demos_dir) if demo.source == "uploaded"] == []
        assert part("name").input_value() == "a-turning-stick"
        part("name").fill("a stick")
        page.click("text=Keep")
        page.wait_for_selector("text=A name is 1 to 64 letters")
        part("name").fill("stick")
        page.click("text=Keep")
        page.wait_for_selector("text=stick is a demo now.")
        demo = find_demo("stick", demos_dir)
        assert (demo.frames, demo.width) == (54, 240)
        expected = drawn_frames(90)[6, :, 110:350]
        shown = read_frames(demo)[0]
        top = expected.shape[0] - shown.shape[0]
        assert abs(shown.astype(int) - expected[top:]).mean() < 12
        page.click("text=Start a run with it")
        form = page.locator(".od-new-run")
        assert form.locator("[name=demo]").input_value() == "stick"
        # What is wrong is said at the field, here and by the server.
        field = lambda name: form.locator(f'.od-field:has([name="{name}"])')  # noqa: E731
        form.locator('[name="ratings.pretrain"]').fill("0")
        form.locator("text=Start the run").click()
        field("ratings.pretrain").locator(".od-field-wrong >> text=a whole number from 1").wait_for()
        form.locator('[name="ratings.pretrain"]').fill("12")
        form.locator('[name="ratings.clip_seconds"]').fill("4")
        form.locator("text=Start the run").click()
        wrong = field("ratings.clip_seconds").locator(".od-field-wrong")
        wrong.wait_for()
        assert wrong.inner_text() == "Clip length, seconds must be shorter than the demo, got 4."
        form.locator('[name="ratings.clip_seconds"]').fill("0.5")
        form.locator('[name="ratings.choice"]').select_option("high")
        form.locator("text=Start the run").click()
        page.wait_for_selector(".od-told >> text=The new run is open now")
        assert page.locator('.od-header[data-tab="runs"]').count() == 1
        (wanted,) = made
        assert (wanted["demo"], wanted["method"], wanted["seed"], wanted["name"]) == (
            "stick",
            "onedemo",
            0,
            None,
        )
        assert wanted["settings"] == {
            "env": "hopper", "ratings.pretrain": 12, "ratings.online": 150,
            "rollouts.total_steps": 10_000_000,
            "ratings.clip_seconds": 0.5, "ratings.choice": "high",
        }  # fmt: skip
        # The library: renamed, and removed after a question.
        page.click('[data-edit-demo="stick"]', timeout=20_000)
        assert_nothing_serious(page, "a demo")
        page.fill(".od-dialog [name=name]", "twig")
        page.click(".od-dialog >> text=Rename")
        page.click('[data-edit-demo="twig"]', timeout=20_000)
        page.click(".od-dialog >> text=Remove it")
        page.click(".od-dialog >> text=Press again to remove it for good")
        page.wait_for_selector('[data-demo="twig"]', state="detached", timeout=20_000)
        assert not demo.path.exists()
        # A title and a note.
        page.click(f'[data-edit-run="{site.trainer.run}"]')
        assert_nothing_serious(page, "a run")
        page.fill(".od-dialog [name=title]", "First <b>try</b>")
        page.fill(".od-dialog [name=note]", "Two raters.")
        page.click(".od-dialog >> text=Save")
        page.wait_for_selector(".od-run-name >> text=First <b>try</b>", timeout=20_000)
        assert page.locator(".od-run-note").inner_text() == "Two raters."
        assert page.locator(".od-dialog[open]").count() == 0
        # A run goes after a question that says what people gave, and offers it first.
        store = site.trainer.store
        store.runs.add(run="old", demo="hop", demo_sha256="0", seed=0, config="", version="0")
        new = NewClip(demo_step=0, segment=_zeros(), stage="pretrain", iteration=0)
        (clip,) = store.clips.add("old", [new])
        store.ratings.rate(clip.id, store.accounts.ensure("bo", "annotator").id, 3, 900)
        page.click('tr[data-run="old"] [data-edit-run][data-rated="1"]', timeout=20_000)
        assert "with 1 rating that people gave" in page.inner_text(".od-dialog[open]")
        saved = page.request.get(page.locator(".od-dialog >> text=Export it first").evaluate("a => a.href"))
        assert saved.status == 200 and saved.body()[:2] == b"PK"
        page.click(".od-dialog >> text=Delete the run and its 1 rating")
        assert len(store.runs.all()) == 2
        page.click(".od-dialog >> text=Press again to delete it for good")
        page.wait_for_selector('tr[data-run="old"]', state="detached", timeout=20_000)
        assert [run["id"] for run in store.runs.all()] == [site.trainer.run]
        page.click(f'[data-edit-run="{site.trainer.run}"]')
        page.wait_for_selector(".od-dialog >> text=This run is the one being served.")
        assert page.locator(".od-dialog [data-delete]").is_hidden()


def preview(page):
    """Address of the preview, once it is that of what is chosen, with its two stills."""
    page.wait_for_function(
        "() => !document.querySelector('.od-making') &&"
        " ['first', 'last'].every(end => document.querySelector(`[data-part=${end}]`).naturalWidth)"
    )
    return page.locator("[data-part=result]").get_attribute("src")


def number_in(page, part, end):
    """What the browser shows of an end of the preview, as a picture."""
    data = page.request.get(part(end).evaluate("image => image.src")).body()
    return cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]


def follows_each_change(page, part):
    """What cannot be done is said, undone, and loses nothing; the video is not sent again."""
    sent = []
    page.on("request", lambda request: sent.append(request.url) if request.url.endswith("/demos") else None)
    told = "document.addEventListener('demo-result', event => window.told = event.detail, { once: true })"
    before, first, last = preview(page), number_in(page, part, "first"), number_in(page, part, "last")
    page.evaluate(told)
    part("speed").fill("2")
    part("reverse").check()
    part("loop").select_option("3")
    page.wait_for_function("() => document.querySelector('[data-part=facts]').innerText.includes('2.70 s')")
    after = preview(page)
    assert after != before and part("facts").locator("dd").all_inner_texts()[1] == "81"
    assert abs(number_in(page, part, "last").astype(int) - first).mean() < 6
    assert (
        abs(number_in(page, part, "first").astype(int) - last).mean() < abs(first.astype(int) - last).mean()
    )
    assert page.evaluate("told.options.speed") == 2 and page.evaluate("told.place").startswith("demos/")
    for wrong in ("0", "-1", "21", ""):
        part("speed").fill(wrong)
        assert part("speed-wrong").inner_text() == "The speed is a number from 0.1 to 20."
        assert part("keep-it").is_disabled()
    part("speed").fill("2")
    part("loop").select_option("10")
    page.wait_for_function("() => document.querySelector('[data-part=facts]').innerText.includes('9.00 s')")
    part("stabilise").focus()
    page.keyboard.press("Space")  # a stick before a sky: there is nothing to hold on to
    page.wait_for_selector("[data-part=edits-wrong] >> text=“Hold the background still” finds no background")
    assert not part("stabilise").is_checked() and part("loop").input_value() == "10"
    assert part("keep-it").is_enabled() and preview(page)
    part("speed").fill("1")
    part("reverse").uncheck()
    part("loop").select_option("1")
    page.wait_for_function("() => document.querySelector('[data-part=facts]').innerText.includes('1.80 s')")
    assert preview(page) and part("edits-wrong").inner_text() == "" and sent == []


def test_a_video_that_the_browser_cannot_play_is_shown_by_the_server_and_used(chromium, site, tmp_path):
    file = tmp_path / "move.mov"
    encode(file, "prores_ks", frames=40, pix_fmt="yuv422p10le", size=(320, 240))
    with opened(chromium, site.links["researcher"], PHONE, color_scheme="dark") as page:
        page.click(".od-tabs >> text=Runs")
        page.click("[data-new-demo]")
        assert_nothing_serious(page, "which video")
        page.set_input_files("[data-part=file]", str(file))
        page.wait_for_selector(".od-form-note:visible >> text=This browser cannot play the video.")
        page.wait_for_function(
            "() => document.querySelector('[data-part=poster]').naturalWidth === 320", timeout=60_000
        )
        page.focus("[data-part=start]")
        with page.expect_response("**/poster.jpg?at=0.333") as given:
            for _ in range(10):
                page.keyboard.press("ArrowRight")
        assert given.value.status == 200
        page.click("[data-press=turn]")
        box = page.locator("[data-part=frame]").bounding_box()
        assert box["width"] / box["height"] == pytest.approx(240 / 320, abs=0.02)
        assert page.input_value("[data-part=crop-w]") == "240"
        assert_nothing_serious(page, "which part")
        page.click("[data-part=show]")
        page.wait_for_selector("[data-step=result]:visible", timeout=60_000)
        page.check("[data-part=mirror]")
        page.select_option("[data-part=loop]", "fill")
        page.wait_for_function(
            "() => document.querySelector('[data-part=facts]').innerText.includes('240\\n')", timeout=60_000
        )
        preview(page)
        sizes = page.evaluate(
            "() => [...document.querySelectorAll('[data-step=result] :is(button, input, select)')]"
            ".map(each => (each.type === 'checkbox' ? each.closest('label') : each).offsetHeight)"
        )
        assert min(sizes) >= 40, sizes
        assert page.evaluate("() => document.querySelector('dialog[open]').scrollWidth") <= PHONE["width"]
        assert_nothing_serious(page, "the result")
        page.fill("[data-part=name]", "mov")
        page.click("text=Keep")
        page.wait_for_selector("text=mov is a demo now.")
        demo = find_demo("mov", site.trainer.data_dir / "demos")
        frames = read_frames(demo)
        assert len(frames) == 240 and corners_of(frames[0]) == "RB/GY"
        assert [number_of(np.rot90(frames[k][:, ::-1])) for k in (0, 29, 30)] == [10, 39, 10]
        done = "turned by 90°, mirrored, repeated to fill 8 s"
        assert demo.edits == f"from 0.333333 s on, {done}"
        page.click("[data-press=close]")
        page.wait_for_selector(f"[data-demo=mov] [data-edits] >> text={done}", timeout=20_000)
        until(lambda: list((site.trainer.data_dir / "uploads").iterdir()) == [])
