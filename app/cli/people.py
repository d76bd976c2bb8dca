"""The commands for people, their links and their ratings: ``rater``, ``rating``, ``audit``."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from onedemo.app.cli.data import DATA, DataDir, Whole, check_output, open_store
from onedemo.errors import UserError

COMMAND_LINE = "command line"
"""Who did what is done here, as the audit log has it."""

rater = App(name="rater", help="People and their links.")
rating = App(name="rating", help="Single ratings.")


@rater.command
def add(
    name: str, /, *, researcher: bool = False, url: str | None = None, once: bool = False,
    expires: str | None = None, data_dir: DataDir = DATA,
) -> None:  # fmt: skip
    """A new rater, or another link of one; prints the link to send.

    Args:
        name: What to call them.
        researcher: May watch, steer and export too.
        url: Address people reach the page at [default: that of the server of this data directory].
        once: A link that opens once.
        expires: A link that ends after a time: 30m, 12h, 7d.
    """
    from onedemo.app.http.invitations import invite
    from onedemo.app.http.tokens import read_address, read_span
    from onedemo.core.names import check_person

    name = check_person(name)  # before anything is written
    if expires is not None:
        read_span(expires)
    role = "researcher" if researcher else "annotator"
    with open_store(data_dir) as store:
        address = url or read_address(data_dir)
        (made,) = invite(store, [name], role, address, by=COMMAND_LINE, once=once, expires=expires)
        print(made.url)


@rater.command(name="list")
def list_(*, data_dir: DataDir = DATA) -> None:
    """Everybody."""
    with open_store(data_dir, must_exist=True) as store:
        for person in store.accounts.raters():
            print(f"{person.name:24} {person.role}")


@rater.command
def links(*, data_dir: DataDir = DATA) -> None:
    """All links and what has become of them, not the links themselves."""
    with open_store(data_dir, must_exist=True) as store:
        heads = ("link", "rater", "role", "state", "once", "made (UTC)", "expires (UTC)", "last used (UTC)")
        rows = [
            (str(link.id), link.rater.name, link.rater.role, link.state, "once" if link.once else "-",
             *(time[:16].replace("T", " ") if time else "-"
               for time in (link.created_at, link.expires_at, link.last_used_at)))
            for link in store.accounts.links()
        ]  # fmt: skip
    widths = [max(len(row[column]) for row in (heads, *rows)) for column in range(len(heads))]
    for row in (heads, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


@rater.command
def revoke(name: str | None = None, /, *, link: Whole | None = None, data_dir: DataDir = DATA) -> None:
    """End a rater's links and open pages; ratings stay.

    Args:
        name: The rater.
        link: Only this link, by its number.
    """
    from onedemo.app.http import invitations

    if (name is None) == (link is None):
        raise UserError("name the rater whose links are to end, or one link with --link N")
    with open_store(data_dir, must_exist=True) as store:
        if link is not None:
            ended = invitations.revoke_link(store, link, by=COMMAND_LINE)
            whose = f"link {ended.id} of {ended.rater.name}"
            print(f"ended {whose} and the pages opened with it; the ratings stay")
            return
        raters = {person.name: person for person in store.accounts.raters()}
        if name not in raters:
            raise UserError(f"no rater {name!r}; there are: {', '.join(raters) or 'none'}")
        count = invitations.revoke(store, raters[name], by=COMMAND_LINE)
        print(f"ended {count} links and sessions of {name}; the ratings stay")


@rating.command
def withdraw(number: Whole, /, *, reason: str, data_dir: DataDir = DATA) -> None:
    """Take one rating back for its rater: nothing learns from it any more.

    It stays in the data with the reason, as what was taken back.

    Args:
        number: Its id, as the export and the Data tab have it.
        reason: Why, for whoever reads the data.
    """
    with open_store(data_dir, must_exist=True) as store:
        try:
            given = store.ratings.withdraw(number, reason)
        except ValueError as error:
            raise UserError(str(error)) from None
        store.audit.add(COMMAND_LINE, "withdraw", f"rating {number}, reason {given.withdrawn}")
    print(f"withdrew rating {number}: {given.rater} gave clip {given.clip} a {given.value}")


def audit(*, csv: Path | None = None, data_dir: DataDir = DATA) -> None:
    """Who signed in, took data out or changed a run.

    Args:
        csv: Write it there, as CSV.
    """
    from onedemo.app.dataset.csv_writer import csv_blocks
    from onedemo.core.files import write_atomic
    from onedemo.storage.audit_log import AUDIT_COLUMNS

    with open_store(data_dir, must_exist=True) as store:
        if csv is not None:
            check_output(csv, data_dir)
            write_atomic(csv, csv_blocks(store.audit.lines(), AUDIT_COLUMNS))
            return
        for at, who, what, detail in store.audit.lines():
            print(f"{at[:19].replace('T', ' ')} UTC  {who:24} {what}{': ' if detail else ''}{detail}")
