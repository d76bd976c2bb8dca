"""The Data tab: how many ratings there are, by whom, and how to get them."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from app.charts import classes_html
from app.words import ANSWERS
from trainer.records import Status

if TYPE_CHECKING:
    from app.session import Session


class Data:
    """The Data tab of one session."""

    title = "Data"

    def __init__(self, session: Session) -> None:
        self._trainer = session.page.trainer
        self._shown = False
        self._counted = -1
        self._html = session.client.gui.add_html("")

    def show(self) -> None:
        """Counts."""
        self._shown = True
        self.refresh(self._trainer.status())

    def hide(self) -> None:
        """Stops counting."""
        self._shown = False

    def refresh(self, status: Status) -> None:
        """Counts again if somebody looks."""
        if not self._shown:
            return
        store, run = self._trainer.store, self._trainer.run
        event = store.last_event()
        if event == self._counted:
            return
        self._counted = event
        self._html.content = data_html(run, status.method, store.tallies(run), str(store.path.absolute()))

    def close(self) -> None:
        """Nothing to do: it holds nothing."""


def data_html(run: str, method: str, counts: dict[tuple[str, str], list[int]], path: str) -> str:
    """The whole tab.

    Args:
        run: Whose ratings.
        method: How it learns.
        counts: As ``Store.tallies``.
        path: Of the database.
    """
    classes = [sum(row[value] for row in counts.values()) for value in range(5)]
    total = sum(classes)
    heads = "".join(
        f'<th scope="col" title="{answer}">{value}</th>' for value, answer in enumerate(ANSWERS, 1)
    )
    rows = "".join(
        f'<tr><th scope="row">{escape(rater)}</th><td>{escape(stage)}</td>'
        + "".join(f"<td>{count or '·'}</td>" for count in row)
        + f"<td><b>{sum(row)}</b></td></tr>"
        for (rater, stage), row in counts.items()
    )
    table = (
        '<div class="od-scroll"><table><thead><tr><th scope="col">Rater</th><th scope="col">Stage</th>'
        f'{heads}<th scope="col">All</th></tr></thead><tbody>{rows}</tbody></table></div>'
        if rows
        else '<p class="od-quiet">Nobody has rated yet. The table fills as ratings come in.</p>'
    )
    where = f"in run <b>{escape(run)}</b>, method <b>{escape(method)}</b>"
    return (
        '<article class="od-data"><div class="od-data-top"><div><h1>Ratings</h1>'
        f"<p>{total} rating{'' if total == 1 else 's'} {where}</p></div>"
        '<a class="od-button od-primary" href="/export.csv" download>Download CSV</a></div>'
        f"{classes_html(classes)}<section><h3>By rater and stage</h3>{table}</section>"
        "<section><h3>Where they are</h3><p>Every rating is a row of the view <code>ratings</code> in this "
        "SQLite file, which other programs may read while onedemo runs:</p>"
        f"<p><code>{escape(path)}</code></p>"
        "<p class=od-quiet>The CSV has the same columns, for all runs: one header, times in UTC, "
        "formula-like cells made harmless.</p></section></article>"
    )
