"""Charts on Watch and Runs: that they show their lines, whatever happens to the page, and what they tell."""

from __future__ import annotations

import pytest

from browser.test_page import DESKTOP, opened
from helpers.curves import train

pytestmark = pytest.mark.seam

PAINTED = """() => [...document.querySelectorAll(".uplot canvas")]
  .filter((canvas) => canvas.clientWidth).map((canvas) => {
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


def lines_drawn(page, charts: int = 3) -> None:
    """Waits until so many charts show their lines; a second without load, more on a machine that is busy."""
    try:
        page.wait_for_function(
            f"() => {{ const painted = ({PAINTED})(); return painted.length >= {charts}"
            f" && painted.every((pixels) => pixels > {LEAST}) }}",
            timeout=8_000,
        )
    except Exception:
        raise AssertionError(f"coloured pixels: {page.evaluate(PAINTED)}") from None


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_charts_show_their_lines_at_each_load_resize_and_reconnect(chromium, site, scheme):
    store, run = site.trainer.store, site.trainer.run
    train(store, run, 1, 40)
    site.trainer.set_status(phase="online", iteration=40)
    number = 40
    with opened(chromium, site.links["researcher"], DESKTOP, color_scheme=scheme) as page:
        for load in range(6):
            if load:
                page.reload()
            page.wait_for_selector(".uplot", timeout=60_000)
            lines_drawn(page)
            number += 1  # another iteration while somebody looks
            train(store, run, number, number)
            page.wait_for_timeout(1200)
            lines_drawn(page)
        for size in ({"width": 2560, "height": 1440}, {"width": 390, "height": 844}, DESKTOP):
            page.set_viewport_size(size)
            page.wait_for_timeout(300)
            lines_drawn(page)
        for client in list(site.page._server.get_clients()):  # the connection goes; Viser comes back
            from onedemo.app.ui.viser_private import hang_up

            hang_up(site.page._server, client)
        train(store, run, number + 1, number + 1)
        page.wait_for_timeout(1500)
        page.wait_for_selector(".uplot", timeout=60_000)
        lines_drawn(page)
