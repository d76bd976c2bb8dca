"""The commands for people and their links: ``rater``, ``audit``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from onedemo.app.cli.data import add_data_dir, check_output, open_store
from onedemo.errors import UserError

COMMAND_LINE = "command line"
"""Who did what is done here, as the audit log has it."""


def add_people_commands(commands: Any, command: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds them to the command line.

    Args:
        commands: Where sub-commands are added.
        command: Adds one: (commands, name, function, summary).
    """
    rater = command(commands, "rater", None, "people and their links")
    actions = rater.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=type(rater))
    new = command(actions, "add", _add, "a new rater, or another link of one; prints the link to send")
    new.add_argument("name")
    new.add_argument("--researcher", action="store_true", help="may watch, steer and export too")
    new.add_argument("--url", default="http://127.0.0.1:8080", help="address people reach the page at")
    new.add_argument("--once", action="store_true", help="a link that opens once")
    new.add_argument("--expires", metavar="TIME", help="a link that ends after a time: 30m, 12h, 7d")
    people = command(actions, "list", _list, "everybody")
    links = command(
        actions, "links", _links, "all links and what has become of them, not the links themselves"
    )
    revoke = command(actions, "revoke", _revoke, "end a rater's links and open pages; ratings stay")
    revoke.add_argument("name", nargs="?")
    revoke.add_argument("--link", type=int, metavar="N", help="only this link, by its number")
    audit = command(commands, "audit", _audit, "who came in, took data out or changed a run")
    audit.add_argument("--csv", type=Path, metavar="FILE", help="write it there, as CSV")
    for parser in (new, people, links, revoke, audit):
        add_data_dir(parser)


def _add(arguments: argparse.Namespace) -> None:
    from onedemo.app.http.tokens import issue_link, passing_link, read_secret, read_span
    from onedemo.core.names import check_person

    name = check_person(arguments.name)
    lasts = read_span(arguments.expires) if arguments.expires is not None else None
    with open_store(arguments) as store:
        rater = store.accounts.ensure(name, "researcher" if arguments.researcher else "annotator")
        if arguments.once or lasts is not None:
            link = passing_link(store, rater, arguments.url, once=arguments.once, lasts=lasts)
        else:
            link = issue_link(store, read_secret(arguments.data_dir), rater, arguments.url)
        kind = ("once" if arguments.once else "standing") + (f", {arguments.expires}" if lasts else "")
        store.audit.add(COMMAND_LINE, "made a link", f"for {rater.name}, {rater.role} ({kind})")
        print(link)


def _list(arguments: argparse.Namespace) -> None:
    with open_store(arguments, must_exist=True) as store:
        for rater in store.accounts.raters():
            print(f"{rater.name:24} {rater.role}")


def _links(arguments: argparse.Namespace) -> None:
    with open_store(arguments, must_exist=True) as store:
        heads = ("link", "rater", "role", "state", "once", "made", "expires", "last used")
        rows = [
            (str(link.id), link.rater.name, link.rater.role, link.state, "once" if link.once else "-",
             *(time[:16].replace("T", " ") if time else "-"
               for time in (link.created_at, link.expires_at, link.last_used_at)))
            for link in store.accounts.links()
        ]  # fmt: skip
    widths = [max(len(row[column]) for row in (heads, *rows)) for column in range(len(heads))]
    for row in (heads, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _revoke(arguments: argparse.Namespace) -> None:
    if (arguments.name is None) == (arguments.link is None):
        raise UserError("name the rater whose links are to end, or one link with --link N")
    with open_store(arguments, must_exist=True) as store:
        if arguments.link is not None:
            link = store.accounts.revoke_link(arguments.link)
            store.audit.add(COMMAND_LINE, "revoked a link", f"{link.id} of {link.rater.name}")
            print(f"ended link {link.id} of {link.rater.name} and the pages opened with it; the ratings stay")
            return
        raters = {rater.name: rater for rater in store.accounts.raters()}
        if arguments.name not in raters:
            raise UserError(f"no rater {arguments.name!r}; there are: {', '.join(raters) or 'none'}")
        ended = store.accounts.revoke_tokens(raters[arguments.name].id)
        store.audit.add(COMMAND_LINE, "revoked a rater", arguments.name)
        print(f"ended {ended} links and sessions of {arguments.name}; the ratings stay")


def _audit(arguments: argparse.Namespace) -> None:
    from onedemo.app.dataset.ratings_csv import csv_blocks
    from onedemo.core.files import write_atomic
    from onedemo.storage.audit_log import AUDIT_COLUMNS

    with open_store(arguments, must_exist=True) as store:
        if arguments.csv is not None:
            check_output(arguments.csv, arguments.data_dir)
            write_atomic(arguments.csv, csv_blocks(store.audit.lines(), AUDIT_COLUMNS))
            return
        for at, who, what, detail in store.audit.lines():
            print(f"{at[:19].replace('T', ' ')}  {who:24} {what}{': ' if detail else ''}{detail}")
