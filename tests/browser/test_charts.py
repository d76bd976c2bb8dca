"""Charts on Watch and Runs: that they show their lines, whatever happens to the page, and what they tell."""

from __future__ import annotations

import time

import pytest

from browser.test_page import DESKTOP, SMALL, opened, until
from helpers.curves import iteration_stats, train
from onedemo.app.ui.viser_private import hang_up

pytestmark = pytest.mark.seam

PAINTED = """() => [...document.querySelectorAll(".uplot canvas")]
  .filter((canvas) => canvas.checkVisibility()).map((canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  let coloured = 0;
  for (let i = 0; i < data.length; i += 4) {
    const rgb = data.subarray(i, i + 3);
    coloured += data[i + 3] > 120 && Math.max(...rgb) - Math.min(...rgb) > 40;
  }
  return coloured;
})"""
"""Pixels in colour of each chart that is shown: axes, grid and words are grey."""
LEAST = 60


def lines_drawn(page, charts: int = 2) -> None:
    """Waits until so many charts show their lines; a second without load, more on a machine that is busy."""
    try:
        page.wait_for_function(
            f"() => {{ const painted = ({PAINTED})(); return painted.length >= {charts}"
            f" && painted.every((pixels) => pixels > {LEAST}) }}",
            polling=200,
            timeout=30_000,
        )
    except Exception:
        raise AssertionError(f"coloured pixels: {page.evaluate(PAINTED)}") from None


def test_charts_show_their_lines_at_each_load_resize_and_reconnect_in_both_schemes(chromium, site):
    store, run = site.trainer.store, site.trainer.run
    train(store, run, 1, 40)
    site.trainer.set_status(phase="online", iteration=40)
    number = 40
    with opened(chromium, site.links["researcher"], SMALL, color_scheme="light") as page:
        for load in ("first", "again", "dark", "again"):
            if load == "dark":
                with page.expect_navigation():  # by itself
                    page.emulate_media(color_scheme="dark")
            elif load == "again":
                page.reload()
            page.wait_for_selector(".uplot", timeout=60_000)
            lines_drawn(page)
            number += 1  # another iteration while somebody looks
            train(store, run, number, number)
            page.locator(f".od-value >> text='{iteration_stats(number)['predicted']:.3g}'").wait_for()
            lines_drawn(page)
        for size in ({"width": 2560, "height": 1440}, {"width": 390, "height": 844}, DESKTOP):
            page.set_viewport_size(size)
            page.wait_for_timeout(300)
            lines_drawn(page)
        page.set_viewport_size(SMALL)
        name = page.locator(".od-header").get_attribute("data-page")
        for client in list(site.page._server.get_clients()):  # the connection goes; Viser comes back
            hang_up(site.page._server, client)
        train(store, run, number + 1, number + 1)
        page.wait_for_selector(f'.od-header:not([data-page="{name}"])', timeout=60_000)
        page.wait_for_selector(".uplot", timeout=60_000)
        lines_drawn(page)


def series_colours(page) -> dict[str, str]:
    """The colour of each run in the first chart's legend."""
    return page.evaluate(
        """() => {
          const chart = document.querySelector(".od-chart");
          const items = [...(chart?.querySelectorAll(".od-legend-of-chart span") ?? [])];
          return Object.fromEntries(items.map((item) => [item.childNodes[1].textContent.trim(),
            item.querySelector("i").style.color]));
        }"""
    )


def stroke_on_watch(page) -> str:
    """The colour of the one line of the first chart, as its tip has it."""
    return page.locator(".od-tip i").first.evaluate("element => element.style.color")


def test_a_chart_tells_values_zooms_smooths_and_marks(chromium, site):
    store, run = site.trainer.store, site.trainer.run
    ann = store.accounts.ensure("Ann <i>", "annotator")
    train(store, run, 1, 20)
    store.runs.mark(run, 20, "paused")
    store.ratings.leave_out(run, ann.id, by=ann.id)
    time.sleep(0.01)  # times are kept to the millisecond
    train(store, run, 21, 40)
    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.wait_for_selector(".uplot", timeout=60_000)
        over = page.locator(".od-chart .u-over").first
        box = over.bounding_box()

        def point(share, y=0.5):
            page.mouse.move(box["x"] + box["width"] * share, box["y"] + box["height"] * y)

        point(20 / 40)
        tip = page.locator(".od-tip")
        tip.wait_for()
        value = iteration_stats(20)["predicted"]
        assert f"{value:.3g}" in tip.inner_text() and "the demo itself" in tip.inner_text()
        assert "Iteration 20" in tip.inner_text() and "Paused" in tip.inner_text()
        assert "Ann <i> excluded" in tip.inner_text()
        watched = stroke_on_watch(page)
        # All charts tell their value at the place that is pointed at in one.
        reward = page.locator(".od-chart", has_text="True reward").locator(".od-value")
        assert reward.inner_text() == f"{iteration_stats(20)['true_reward']:,.0f}"
        point(0.25)
        page.mouse.down()
        point(0.5)
        page.mouse.up()
        page.click("[data-zoom-out]")
        page.wait_for_selector("[data-zoom-out]", state="hidden")
        page.fill("[data-smooth]", "0.8")
        point(20 / 40)
        page.wait_for_selector(".od-tip >> text=measured")
        page.click('.od-tabs >> text="Watch"')
        page.fill("[data-smooth]", "0")
        # Another run is made and compared: neither changes its colour, nor does unticking one.
        store.runs.add(run="hop-1", demo="hop", demo_sha256="1", seed=1, config="", version="0")
        train(store, "hop-1", 1, 10)
        page.click('.od-tabs >> text="Runs"')
        page.wait_for_selector(".od-comparison .uplot")
        until(lambda: set(series_colours(page)) == {run, "hop-1"})
        colours = series_colours(page)
        assert colours[run] == watched != colours["hop-1"]
        page.locator(f'[data-compare="{run}"]').click()
        until(lambda: set(series_colours(page)) == {"hop-1"})
        assert series_colours(page)["hop-1"] == colours["hop-1"]
        # The address says what is compared, so that a reload and a link show the same; a title is shown.
        assert page.evaluate("() => location.hash") == "#compare=hop-1"
        store.runs.describe("hop-1", title="The <b>second</b> try", note="")
        page.reload()
        until(lambda: set(series_colours(page)) == {"The <b>second</b> try"})
        assert page.evaluate("() => location.hash") == "#compare=hop-1"
        both = page.url.partition("#")[0] + f"#compare={run},hop-1"
        page.goto("about:blank")
        page.goto(both)
        until(lambda: set(series_colours(page)) == {run, "The <b>second</b> try"})
        over = page.locator(".od-comparison .u-over").first
        over.hover()
        page.wait_for_selector(".od-comparison .od-tip >> text=the demo itself")
        page.click('.od-tabs >> text="Data"')
        page.wait_for_url("**/data")
        page.click('.od-tabs >> text="Runs"')
        page.wait_for_url(f"**/runs#compare={run},hop-1")
        page.click("text=Clear")
        page.wait_for_selector("text=No run is drawn.")
        assert page.evaluate("() => location.hash") == "#compare="
        page.click("text=The newest ones")
        until(lambda: series_colours(page).keys() == {run, "The <b>second</b> try"})
        assert page.evaluate("() => location.hash") == ""


def test_a_chart_says_that_it_is_loading_until_it_knows_that_there_is_nothing(chromium, site):
    said = []

    def late(route):
        said.append(page.locator(".od-chart .od-nothing").first.inner_text())
        route.continue_()

    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.route("**/curves.json*", late)
        page.click('.od-tabs >> text="Watch"')
        page.wait_for_selector(".od-chart >> text=From the first iteration on.")
        assert said[0] == "Loading…"


def test_rollouts_stay_where_they_are_and_a_film_has_its_size_before_it_comes(chromium, site):
    store, run = site.trainer.store, site.trainer.run
    train(store, run, 1, 30)
    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.wait_for_selector(".od-gallery img", timeout=60_000)
        page.evaluate("() => (window.cards = [...document.querySelectorAll('.od-gallery li')])")
        before = page.locator(".od-gallery li").all_inner_texts()
        assert before[0].startswith("Best so far: iteration ") and 8 <= len(before) <= 14
        page.locator(".od-gallery button").first.hover()
        train(store, run, 31, 45)  # better ones among them
        until(lambda: page.locator(".od-gallery li").count() > len(before))
        assert page.evaluate(
            "() => { const now = [...document.querySelectorAll('.od-gallery li')];"
            " return window.cards.every((card, k) => card === now[k]) }"
        )
        page.route("**/*.webm*", lambda route: (page.wait_for_timeout(700), route.continue_()))
        page.locator("[data-film]").nth(2).click()
        dialog = page.locator(".od-film[open]")
        size = dialog.bounding_box()
        assert size["height"] > 350
        page.wait_for_function("() => document.querySelector('.od-film video').currentTime > 0.1")
        assert dialog.bounding_box() == size
        assert page.locator(".od-film h2").inner_text().startswith("Best rollout of iteration ")
        assert page.locator(".od-film-sides").inner_text().split() == ["Demonstration", "Robot"]


def test_robot_and_demo_have_one_scale_and_leave_room_for_charts(chromium, site):
    train(site.trainer.store, site.trainer.run, 1, 10)
    boxes = """() => Object.fromEntries(Object.entries({
      canvas: "[data-dock-root] > div:has(canvas[data-engine])", robot: ".od-robot",
      demo: ".od-demonstration", strip: ".od-strip", charts: ".od-charts",
    }).map(([name, selector]) => {
      const { x, y, width, height } = document.querySelector(selector).getBoundingClientRect();
      return [name, { x, y, width, height }];
    }))"""
    scroll = "y => document.querySelector('.mantine-Paper-root:has(.od-header)').scrollTo(0, y)"
    with opened(chromium, site.links["researcher"], DESKTOP) as page:
        page.wait_for_selector(".uplot", timeout=60_000)
        for width, height in ((1440, 900), (1366, 650), (2560, 1440), (820, 1180), (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            for scrolled in (0, 300):
                page.evaluate(scroll, scrolled)
                sides = ("x", "y", "width", "height")
                found = until(
                    lambda sides=sides: (
                        (at := page.evaluate(boxes))
                        and all(abs(at["canvas"][side] - at["robot"][side]) < 1.5 for side in sides)
                        and at
                    ),
                    30,
                )
                where = (width, height, scrolled, found)
                assert abs(found["robot"]["height"] - found["demo"]["height"]) < 1, where
                assert abs(found["robot"]["width"] / found["robot"]["height"] - 4 / 3) < 0.02, where
                assert abs(found["demo"]["width"] / found["demo"]["height"] - 4 / 3) < 0.02, where
            if width > 900:  # what scrolls has all below the strip
                assert found["strip"]["y"] + found["strip"]["height"] < 160 and found["charts"]["width"] > 500
        page.set_viewport_size(DESKTOP)
        assert page.locator(".od-classes li i i").first.evaluate("bar => bar.clientWidth") == 0
