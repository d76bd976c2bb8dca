"""What moves in a video that is brought in: shown on it, marked by hand or keys, and kept with the demo."""

from __future__ import annotations

import pytest

from browser.test_page import DESKTOP, PHONE, opened
from helpers import filmed_movers as films
from onedemo.demos.library import find_demo
from onedemo.vision.mask_file import kept_masks

pytestmark = pytest.mark.seam

FOUND = "() => /^Found/.test(document.querySelector('[data-moves-part=said]').textContent)"
FREE = "() => !document.querySelector('[data-moves]').hasAttribute('data-busy')"
TINTED = """() => {
  const canvas = document.querySelector("[data-moves-part=drawn]");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let k = 3; k < data.length; k += 4) count += data[k] > 0;
  return count / (canvas.width * canvas.height);
}"""


def test_what_moves_is_shown_marked_and_kept(chromium, site, tmp_path):
    video = films.written(tmp_path / "figure.mp4", films.figure(3.0).frames[:36])
    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.click(".od-tabs >> text=Runs")
        page.click("[data-new-demo]")
        part = lambda name: page.locator(f'.od-demo-dialog [data-part="{name}"]')  # noqa: E731
        moves = lambda name: page.locator(f'[data-moves-part="{name}"]')  # noqa: E731
        part("file").set_input_files(str(video))
        page.wait_for_function("() => !document.querySelector('.od-demo-dialog [data-part=show]').disabled")
        part("show").click()
        page.wait_for_selector("[data-step=result]:visible")
        page.wait_for_function(FOUND)
        assert moves("said").inner_text().startswith("Found against a background that stands still. Sure in")
        # It is drawn over the frame that is looked at, and its frames are walked by keys.
        moves("at").focus()
        page.keyboard.press("End")
        page.wait_for_selector("[data-moves-part=frame-said] >> text=Frame 36 of 36")
        page.keyboard.press("Home")
        page.wait_for_selector("[data-moves-part=frame-said] >> text=Frame 1 of 36")
        page.wait_for_function(f"() => ({TINTED})() > 0.02")
        assert page.evaluate(TINTED) < 0.25
        moves("shown").uncheck()
        page.wait_for_function(f"() => ({TINTED})() === 0")
        moves("shown").check()
        # A box by hand.
        page.click("[data-moves-mode=box]")
        assert page.locator("[data-moves-mode=box]").get_attribute("aria-pressed") == "true"
        moves("pad").scroll_into_view_if_needed()
        box = moves("pad").bounding_box()
        x, y = box["x"] + 0.3 * box["width"], box["y"] + 0.25 * box["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 0.4 * box["width"], y + 0.65 * box["height"], steps=4)
        with page.expect_response("**/mask") as given:
            page.mouse.up()
        assert given.value.status == 200 and given.value.json()["method"] == "chosen"
        page.wait_for_function(FREE)
        assert "from what was marked in the picture" in moves("said").inner_text()
        # A place that is not it by keys: the cross begins in the middle.
        page.click("[data-moves-mode=not]")
        moves("pad").focus()
        for _ in range(3):
            page.keyboard.press("Shift+ArrowLeft")
        with page.expect_response("**/mask") as given:
            page.keyboard.press("Enter")
        sent = given.value.request.post_data_json
        assert len(sent["box"]) == 5 and [c[2:] for c in sent["clicks"]] == [[0, 0]]
        page.wait_for_function(FREE)
        page.keyboard.press("Escape")  # ends the marking, and not the dialog
        assert page.locator("[data-moves-mode=not]").get_attribute("aria-pressed") == "false"
        assert page.locator(".od-demo-dialog[open]").count() == 1
        # All of it has room on a phone, and fingers do.
        page.set_viewport_size(PHONE)
        for button in page.locator("[data-moves] .od-button:visible").all():
            assert button.bounding_box()["height"] >= 44
        assert page.evaluate("() => { const d = document.querySelector('.od-demo-dialog');"
                             " return d.scrollWidth <= d.clientWidth; }")  # fmt: skip
        page.set_viewport_size(DESKTOP)
        # What cannot be marked is said, and nothing is lost.
        refused = page.evaluate(
            """async (place) => {
              const headers = { "Content-Type": "application/json", ...page.named() };
              const body = '{"box": [0, 0, 4, 4, 0]}';
              const answer = await fetch(place, { method: "POST", headers, body });
              return [answer.status, await answer.text()];
            }""",
            given.value.url,
        )
        assert refused[0] == 400 and "too small" in refused[1]
        part("name").fill("figure")
        page.click("text=Keep")
        page.wait_for_selector("text=figure is a demo now.")
    demo = find_demo("figure", site.trainer.data_dir / "demos")
    kept = kept_masks(demo)
    assert kept.method == "chosen" and kept.masks.any() and len(kept.masks) == demo.frames == 36
