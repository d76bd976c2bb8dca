"""A clip on screen: how it plays, what is drawn beside it, how sharp it is."""

from __future__ import annotations

import numpy as np
import pytest

from browser.test_page import DESKTOP, PHONE, opened, press_and_wait, shown_clip
from helpers.paths import ROOT
from onedemo.demos.library import find_demo, read_frames

pytestmark = pytest.mark.seam

PLAYER = ".od-clip > .od-player[data-frame]"
# Of each frame of the screen for three seconds: when it was, the frame of the clip, its speed.
WATCHED = """(player) => new Promise((done) => {
  const seen = [], until = performance.now() + 3000;
  const look = (now) => {
    seen.push([now, Number(player.dataset.frame), Number(player.dataset.pace)]);
    if (now < until) requestAnimationFrame(look);
    else done(seen);
  };
  requestAnimationFrame(look);
})"""
# How many pixels of a side have exactly this colour.
COUNT = """([side, colour]) => {
  const canvas = document.querySelector(`.od-clip canvas[data-side=${side}]`);
  const all = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let i = 0; i < all.length; i += 4) count += colour.every((value, c) => all[i + c] === value);
  return count;
}"""
HEAD, FOOT = [200, 52, 24], [158, 96, 0]
"""Of static/drawing.js."""


@pytest.fixture
def real(site, tmp_path):
    """The site with pictures of the backflip, and its first clips drawn beside it for real."""
    from onedemo.render.renderer import Renderer
    from onedemo.training.pictures import draw_clip

    demo = find_demo("hopper-backflip", tmp_path)
    site.trainer.frames = read_frames(demo)
    with np.load(ROOT / "static/demos/hopper-hop.hidden.npz") as truth:
        qpos = truth["qpos"][100:140:4]
    with Renderer(exact=False) as renderer:
        for file in sorted(site.trainer.directory.glob("*.jpg"))[:3]:
            draw_clip(renderer, file=file, demo=demo, frames=np.arange(40, 50), robots=[qpos])
    return site


def test_it_plays_at_full_and_half_speed_in_turn_without_a_freeze(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        seen = np.array(page.locator(PLAYER).evaluate(WATCHED))
        times = np.diff(seen[:, 0])
        frames, paces = seen[:-1, 1], seen[:-1, 2]
        assert set(paces) == {1, 0.5}
        turns = np.flatnonzero(np.diff(frames) < -4)
        assert len(turns) >= 3 and (paces[turns] != paces[turns + 1]).all()
        assert times[frames == 9].sum() < 0.45 * times.sum()  # it was 65 %: people compared last poses
        assert times[paces == 0.5].sum() > times[paces == 1].sum()


def test_slow_motion_and_trail_stay_as_chosen_after_a_reload(chromium, real):
    with opened(chromium, real.links["annotator"]) as page:
        shown_clip(page)
        page.keyboard.press("f")
        page.click("[data-trail]")
        page.wait_for_selector('[data-trail][aria-pressed="true"]')
        page.reload()
        shown_clip(page)
        page.wait_for_selector('[data-slow][aria-pressed="true"]')
        page.wait_for_selector('[data-trail][aria-pressed="true"]')
        page.wait_for_selector(f'{PLAYER}[data-pace="0.25"]')
        page.keyboard.press("f")
        page.keyboard.press("t")
        page.wait_for_selector('[data-slow][aria-pressed="false"]')
        page.reload()
        shown_clip(page)
        assert page.locator("[data-trail]").get_attribute("aria-pressed") == "false"
        assert page.locator("[data-slow]").get_attribute("aria-pressed") == "false"


def test_a_clip_that_stands_still_says_how_it_goes_on(chromium, site):
    with opened(chromium, site.links["annotator"]) as page:
        shown_clip(page)
        hint = page.locator(".od-clip .od-hint")
        assert not hint.is_visible()
        page.keyboard.press("ArrowRight")
        hint.wait_for(state="visible")
        assert "Space" in hint.inner_text()
        page.keyboard.press("Space")
        hint.wait_for(state="hidden")
        box = page.locator("[data-track]").bounding_box()
        page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 5)
        hint.wait_for(state="visible")
        hint.click()
        hint.wait_for(state="hidden")


def test_first_pose_and_paths_are_drawn_on_both_sides_and_only_then(chromium, real):
    with opened(chromium, real.links["annotator"]) as page:
        shown_clip(page)
        for _ in range(10):
            page.keyboard.press("ArrowRight")
        plain = [page.evaluate(COUNT, [side, c]) for side in ("left", "right") for c in (HEAD, FOOT)]
        page.keyboard.press("t")
        page.wait_for_selector('[data-trail][aria-pressed="true"]')
        drawn = [page.evaluate(COUNT, [side, c]) for side in ("left", "right") for c in (HEAD, FOOT)]
        assert max(plain) < 5 and min(drawn) > 40
        page.keyboard.press("t")
        page.wait_for_selector('[data-trail][aria-pressed="false"]')
        assert plain == [page.evaluate(COUNT, [side, c]) for side in ("left", "right") for c in (HEAD, FOOT)]


def test_a_frame_that_began_before_it_was_asked_for_does_not_hang_the_page(chromium, real):
    late = "const ask = requestAnimationFrame; requestAnimationFrame = (go) => ask((now) => go(now - 500));"
    with opened(chromium, real.links["annotator"]) as page:
        shown_clip(page)
        page.add_init_script(late)
        page.reload()
        shown_clip(page)
        page.keyboard.press("ArrowRight")
        page.keyboard.press(" ")
        assert page.evaluate("1 + 1") == 2


def test_a_clip_has_the_pixels_of_the_screen(chromium, real):
    with opened(chromium, real.links["annotator"]) as page:
        shown_clip(page)
        for viewport in (DESKTOP, {"width": 2560, "height": 1440}, PHONE):
            page.set_viewport_size(viewport)
            page.wait_for_function(
                "() => [...document.querySelectorAll('.od-clip canvas')].every("
                "(c) => Math.abs(c.width - c.clientWidth * devicePixelRatio) < 2)"
            )
        # The robot's side, which is drawn for the page, has 720 x 540 of its own.
        sizes = page.evaluate(
            "async () => { const src = document.querySelector('.od-clip > .od-player').dataset.src;"
            " const image = await createImageBitmap(await (await fetch(src)).blob());"
            " return [image.width, image.height] }"
        )
        assert sizes[1] == 5400 and sizes[0] > 1000


def test_head_and_foot_are_named_once_in_the_first_practice_clip(chromium, real):
    from helpers.fake_trainer import drawn_track
    from onedemo.app.http.tokens import issue_link, read_secret

    real.trainer.track = drawn_track()  # five clips to practise with
    store = real.trainer.store
    link = issue_link(
        store, read_secret(store.path.parent), store.accounts.ensure("new", "annotator"), real.url
    )
    counts = "(colours) => colours.map((colour) => (" + COUNT + ")(['left', colour]))"
    with opened(chromium, link) as page:
        page.click(".od-intro [data-go]")
        page.wait_for_selector(".od-practice [data-frame]", timeout=60_000)
        assert min(page.evaluate(counts, [HEAD, FOOT])) > 100
        page.wait_for_function(f"(colours) => Math.max(...({counts})(colours)) < 5", arg=[HEAD, FOOT])
        page.keyboard.press("5")
        page.click("[data-go]")
        page.wait_for_selector(".od-progress >> text=Practice 2 of")
        page.wait_for_selector(".od-practice .od-player[data-frame]", timeout=60_000)
        assert max(page.evaluate(counts, [HEAD, FOOT])) < 5


def test_who_prefers_stillness_sees_one_pass_when_asking_for_it(chromium, site):
    options = {"reduced_motion": "reduce"}
    with opened(chromium, site.links["annotator"], **options) as page:
        shown_clip(page)
        player = page.locator(PLAYER)
        assert player.get_attribute("data-frame") == "0"
        page.keyboard.press("Space")
        page.wait_for_selector(f'{PLAYER}[data-frame="9"]')
        page.wait_for_timeout(600)
        assert player.get_attribute("data-frame") == "9"
        press_and_wait(page, site, lambda: page.keyboard.press("3"))
