"""Places for curves of a run, and of several runs; static/charts.js draws them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from markupsafe import Markup

from onedemo.app.templates import render


def run_html(run: str, *, has_reward: bool) -> Markup:
    """The charts of one run over its iterations.

    Args:
        run: Its name.
        has_reward: Whether the demo's move has a hand-coded reward.
    """
    return render("charts.html:of_run", run=run, has_reward=has_reward)


class Comparison:
    """One figure of several runs over their control steps.

    Args:
        gui: The client's.
        key: Which figure of an iteration.
        title: Of the chart.
        dark: Not used: the page's colours are its style sheet's.
    """

    def __init__(self, gui: Any, key: str, title: str, *, dark: bool = False) -> None:
        self._key, self._title = key, title
        self._runs: list[str] = []
        self._handle = gui.add_html("")

    def draw(self, runs: Iterable[str]) -> None:
        """Shows the curves of some runs; those that grow are followed by the browser.

        Args:
            runs: Their names, in order; a mapping by name will do.
        """
        wanted = list(runs)
        if wanted != self._runs:
            self._runs = wanted
            html = render("charts.html:of_runs", runs=wanted, key=self._key, title=self._title)
            self._handle.content = str(html) if wanted else ""
