"""The Data tab: how good the ratings are, by whom, and how to get them."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from onedemo.app.annotation.agreement import Quality, quality, quality_by_rater, rating_rows
from onedemo.app.annotation.scale import ANSWERS
from onedemo.app.ui.charts import classes_html
from onedemo.app.ui.strings import nobody_html
from onedemo.storage.ratings import SKIP_COLUMNS
from onedemo.types import Rater, Status

if TYPE_CHECKING:
    from onedemo.app.ui.session import Session

log = logging.getLogger("onedemo.page")

_EVERY_S = 3.0
"""Figures are not worked out more often."""


class Data:
    """The Data tab of one session."""

    title = "Data"

    def __init__(self, session: Session) -> None:
        self._trainer = session.page.trainer
        self._shown = False
        self._counted = -1
        self._counted_at = 0.0
        self._busy = threading.Lock()
        gui = session.client.gui
        self._html = gui.add_html("")
        gui.add_html(export_html(self._trainer.run, str(self._trainer.store.path.absolute())))

    def show(self) -> None:
        """Counts."""
        self._shown = True
        self.refresh(self._trainer.status())

    def hide(self) -> None:
        """Stops counting."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Counts again if somebody looks, beside the thread that serves all pages."""
        event = self._trainer.store.ratings.last_event()
        old = time.monotonic() - self._counted_at > _EVERY_S
        if not self._shown or event == self._counted or not (old or self._counted < 0):
            return
        if self._busy.acquire(blocking=False):
            threading.Thread(target=self._count, args=(event, status.method), daemon=True).start()

    def close(self) -> None:
        """Nothing to do: it holds nothing."""

    def _count(self, event: int, method: str) -> None:
        try:
            store, run = self._trainer.store, self._trainer.run
            rows = rating_rows(store, run)
            skips = Counter(row[SKIP_COLUMNS.index("rater")] for row in store.ratings.stream_skips(run))
            people = {rater.name: rater for rater in store.accounts.raters()}
            self._html.content = data_html(
                run, method, store.ratings.tallies(run), quality(rows), quality_by_rater(rows, raters=skips),
                skips, people, store.ratings.left_out(run),
            )  # fmt: skip
            self._counted, self._counted_at = event, time.monotonic()
        except Exception:
            log.exception("the figures of the Data tab could not be worked out")
        finally:
            self._busy.release()


def data_html(
    run: str, method: str, counts: Mapping[tuple[str, str], list[int]], whole: Quality,
    each: Mapping[str, Quality], skips: Mapping[str, int], people: Mapping[str, Rater], left_out: set[int],
) -> str:  # fmt: skip
    """The tab's figures.

    Args:
        run: Whose ratings.
        method: How it learns.
        counts: As ``Store.ratings.tallies``.
        whole: Quality of all ratings.
        each: Of each rater's, by name.
        skips: Clips that each skipped, by name.
        people: Raters by name.
        left_out: Raters whose ratings nothing learns from.
    """
    classes = [sum(row[value] for row in counts.values()) for value in range(5)]
    total = sum(classes)
    learned = sum(sum(row) for (name, _), row in counts.items() if people[name].id not in left_out)
    where = f"in run <b>{escape(run)}</b>, method <b>{escape(method)}</b>"
    return (
        '<article class="od-data"><div class="od-data-top"><div><h1>Ratings</h1>'
        f"<p>{total} rating{'' if total == 1 else 's'} {where}</p></div></div>"
        f"{nobody_html(total, learned)}"
        f"{_summary(whole)}{classes_html(classes)}"
        f"<section><h3>By rater</h3>{_raters_table(each, skips, people, left_out)}</section>"
        f"<section><h3>By rater and stage</h3>{_stages_table(counts)}</section></article>"
    )


def _summary(whole: Quality) -> str:
    alike = whole.agreement
    alpha, interval = "–", "no clip rated by two people yet"
    if alike.alpha is not None:
        alpha, interval = f"{alike.alpha:.2f}", f"{alike.clips} clips"
        if alike.low is not None and alike.high is not None:
            interval = f"{alike.low:.2f} to {alike.high:.2f}, {alike.clips} clips"
    elif alike.clips:
        interval = f"{alike.clips} clips, all rated the same"
    cells = (
        ("Agreement between raters", alpha, f"Krippendorff’s alpha, good from 0.67; {interval}"),
        ("Same on a second look", *_steady(whole)),
        ("Time per rating", _number(whole.seconds, "s"), "median"),
        (
            "Drift",
            _number(whole.drift, "points", sign=True),
            "last third above the first, for like clips",
        ),
    )
    return '<dl class="od-quality">' + "".join(
        f"<div><dt>{name}</dt><dd>{value}<small>{note}</small></dd></div>" for name, value, note in cells
    ) + "</dl>"  # fmt: skip


def _steady(figures: Quality) -> tuple[str, str]:
    if figures.same is None or figures.apart is None:
        return "–", "no clip shown twice yet"
    return f"{100 * figures.same:.0f} %", f"of {figures.repeats} clips; {figures.apart:.1f} points apart"


def _raters_table(
    each: Mapping[str, Quality], skips: Mapping[str, int], people: Mapping[str, Rater], left_out: set[int]
) -> str:
    if not each:
        return '<p class="od-quiet">Nobody has rated yet. The table fills as ratings come in.</p>'
    heads = ("Rater", "Ratings", "Skipped", "1 to 5", "Agreement", "Second look", "Median time", "Drift", "")
    rows = "".join(
        _rater_row(people[name], figures, skips.get(name, 0), people[name].id in left_out)
        for name, figures in each.items()
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in heads)
    return (
        '<div class="od-scroll" tabindex="0" role="region" aria-label="Raters"><table><thead><tr>'
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        '<p class="od-quiet">Agreement is on the clips that others have rated too: 1 is perfect, 0 chance; '
        "from 0.67 conclusions hold. Second look: the share rated the same again. Drift, in points: how much "
        "higher the last third of the ratings is than the first, for clips that were predicted alike. "
        "A rater who is left out stays in the data, marked, and nothing learns from the ratings until they "
        "are taken in again.</p>"
    )


def _rater_row(rater: Rater, figures: Quality, skipped: int, left_out: bool) -> str:
    most = max(max(figures.shares), 1e-9)
    bars = "".join(f'<i style="height:{max(4, 100 * share / most):.0f}%"></i>' for share in figures.shares)
    shares = ", ".join(f"{100 * share:.0f} % {value}" for value, share in enumerate(figures.shares, 1))
    warned = "".join(f"<em>{escape(warning)}</em>" for warning in figures.warnings)
    alpha = figures.agreement.alpha
    act, label = ("take in", "Take in") if left_out else ("leave out", "Leave out")
    what = f'data-do="{act}" data-rater="{rater.id}"'
    button = f'<button type="button" class="od-button od-small" {what}>{label}</button>'
    bars = f'<span class="od-bars" role="img" aria-label="{shares}">{bars}</span>'
    return (
        f'<tr{" class=od-left-out" if left_out else ""}><th scope="row">{escape(rater.name)}{warned}</th>'
        f"<td>{figures.ratings}</td><td>{skipped}</td><td>{bars}</td>"
        f"<td>{'–' if alpha is None else f'{alpha:.2f}'}</td><td>{_steady(figures)[0]}</td>"
        f"<td>{_number(figures.seconds, 's')}</td><td>{_number(figures.drift, '', sign=True)}</td>"
        f"<td>{button}</td></tr>"
    )


def _stages_table(counts: Mapping[tuple[str, str], list[int]]) -> str:
    if not counts:
        return '<p class="od-quiet">Nothing yet.</p>'
    heads = "".join(
        f'<th scope="col" title="{answer}">{value}</th>' for value, answer in enumerate(ANSWERS, 1)
    )
    rows = "".join(
        f'<tr><th scope="row">{escape(rater)}</th><td>{escape(stage)}</td>'
        + "".join(f"<td>{count or '·'}</td>" for count in row)
        + f"<td><b>{sum(row)}</b></td></tr>"
        for (rater, stage), row in counts.items()
    )
    return (
        '<div class="od-scroll" tabindex="0" role="region" aria-label="Stages"><table><thead><tr>'
        '<th scope="col">Rater</th><th scope="col">Stage</th>'
        f'{heads}<th scope="col">All</th></tr></thead><tbody>{rows}</tbody></table></div>'
    )


def export_html(run: str, path: str) -> str:
    """Filter, preview, download. Drawn once, so that nothing that is being filled in is lost."""
    values = "".join(f'<option value="{value}">{value}</option>' for value in range(1, 6))
    query = f"?run={quote(run)}"
    return (
        '<article class="od-data od-export"><section><h3>Preview and download</h3>'
        f'<form class="od-filter" data-filter><input type="hidden" name="run" value="{escape(run)}">'
        '<label>Run <select name="run-which"><option value="this">this one</option>'
        '<option value="all">all</option></select></label>'
        '<label>Rater <input name="rater" maxlength="64" placeholder="anybody"></label>'
        '<label>Stage <select name="stage"><option value="">any</option><option>pretrain</option>'
        "<option>online</option></select></label>"
        f'<label>Rating <select name="value"><option value="">any</option>{values}</select></label>'
        '<label>Left out <select name="left_out"><option value="">with</option>'
        '<option value="0">without</option></select></label>'
        '<button class="od-button">Preview</button></form><div class="od-preview" aria-live="polite"></div>'
        '<div class="od-downloads">'
        f'<a class="od-button od-primary" href="/export.csv{query}" data-filtered="/export.csv" download>'
        "Download CSV</a>"
        f'<a class="od-button" href="/segments.parquet{query}" data-of-run="/segments.parquet" download>'
        "Segments (Parquet)</a>"
        f'<a class="od-button" href="/comparisons.csv{query}" data-of-run="/comparisons.csv" download>'
        "Comparisons (CSV)</a>"
        f'<a class="od-button" href="/skips.csv{query}" data-of-run="/skips.csv" download>Skips (CSV)</a>'
        f'<a class="od-button" href="/card.md{query}" data-of-run="/card.md" download>Data card</a></div>'
        "<p class=od-quiet>The CSV has one header, times in UTC, formula-like cells made harmless. The "
        "segments are the states and actions behind the clips. <code>onedemo import</code> reads both "
        "back.</p></section>"
        "<section><h3>Where they are</h3><p>Every rating is a row of the view <code>ratings</code> in this "
        "SQLite file, which other programs may read while onedemo runs:</p>"
        f"<p><code>{escape(path)}</code></p></section></article>"
    )


def _number(value: Any, unit: str, *, sign: bool = False) -> str:
    if value is None:
        return "–"
    return f"{value:+.1f} {unit}".strip() if sign else f"{value:.1f} {unit}".strip()
