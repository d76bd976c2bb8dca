"""Inviting people and ending their links: one way for the page and for ``onedemo rater``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

import segno
from markupsafe import Markup

from onedemo.app.http.tokens import issue_link, passing_link, read_secret, read_span
from onedemo.app.network.bind import Listening, is_loopback
from onedemo.core.names import check_new_name, check_person
from onedemo.errors import UserError
from onedemo.storage.accounts import Link
from onedemo.storage.store import Store
from onedemo.types import Rater

MOST_AT_ONCE = 100
"""People who are invited with one press."""
_ADDRESS = re.compile(r"https?://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?(/[A-Za-z0-9_-]+)*/?")


@dataclass(frozen=True, kw_only=True, slots=True)
class Invitation:
    """A link that was made for somebody; shown to whoever made it, and kept nowhere."""

    rater: Rater
    url: str

    @property
    def qr(self) -> Markup:
        """The link as a QR code: an SVG element, black on white with its margin, without a size."""
        code = segno.make_qr(self.url, error="m")
        # A cast as wide as ours: every part of it is made by segno from numbers.
        return Markup(code.svg_inline(omitsize=True, dark="#000", light="#fff", border=4))


def invite(
    store: Store, names: Sequence[str], role: str, url: str, *,
    by: str, once: bool = False, expires: str | None = None,
) -> list[Invitation]:  # fmt: skip
    """Makes a link for each name, and the people who are not there yet; all of them or none.

    A link that neither opens once nor expires is the same each time until it is revoked.

    Args:
        store: Keeps people, hashes of tokens and the audit log.
        names: Whom to invite.
        role: "annotator" or "researcher".
        url: Address that people reach the page at.
        by: Who invites, for the audit log.
        once: Links that open once.
        expires: A time after which the links end: 30m, 12h, 7d.

    Raises:
        UserError: If a name is none, is nearly that of somebody else, or belongs to another role; or the
            time is none.
    """
    lasts = read_span(expires) if expires else None
    people = list(dict.fromkeys(check_person(name) for name in names))
    if not 1 <= len(people) <= MOST_AT_ONCE:
        raise UserError(f"name 1 to {MOST_AT_ONCE} people, one on each line; got {len(people)}")
    known = {rater.name for rater in store.accounts.raters()}
    alike = {name.casefold(): name for name in [*people, *known]}
    for name in people:
        if name not in known:
            check_new_name(name)
            if (other := alike[name.casefold()]) != name:
                raise UserError(
                    f"{name!r} and {other!r} would be two people; write the name the same way, or "
                    "choose another"
                )
    kind = ("once" if once else "standing") + (f", {expires}" if expires else "")
    secret = read_secret(store.path.parent)
    invitations = []
    with store.database.transaction():
        for name in people:
            rater = store.accounts.ensure(name, role)
            if once or lasts is not None:
                link = passing_link(store, rater, url, once=once, lasts=lasts)
            else:
                link = issue_link(store, secret, rater, url)
            store.audit.add(by, "made a link", f"for {name}, {role} ({kind})")
            invitations.append(Invitation(rater=rater, url=link))
    return invitations


def revoke(store: Store, rater: Rater, *, by: str) -> int:
    """Ends all links and open pages of somebody; returns how many links and sessions those were."""
    count = store.accounts.revoke_tokens(rater.id)
    store.audit.add(by, "revoked a rater", rater.name)
    return count


def revoke_link(store: Store, link: int, *, by: str) -> Link:
    """Ends one link, by its number, and the pages that were opened with it.

    Raises:
        UserError: If there is no such link.
    """
    ended = store.accounts.revoke_link(link)
    store.audit.add(by, "revoked a link", f"{ended.id} of {ended.rater.name}")
    return ended


def check_address(url: str) -> str:
    """An address that links may begin with, such as ``https://study.example.org/study1``.

    Raises:
        UserError: If it is none.
    """
    if len(url) > 200 or not _ADDRESS.fullmatch(url):
        raise UserError(f"an address is such as https://study.example.org, got {url[:80]!a}")
    return url.rstrip("/")


def page_address(listening: Listening, port: int, origin: str) -> str:
    """The address for links that are made at a page: the page's own, since it is reached there.

    But a page that is open on the server's own machine may have an address that holds nowhere else; then it
    is that of the server, as ``serve`` prints it.

    Args:
        listening: Where the server is.
        port: That is open.
        origin: Of the page, such as ``https://study.example.org``, checked by who got the request.
    """
    known = listening.address(port)
    return known if local(origin) and not local(known) else f"{origin}{listening.base_path}"


def local(url: str) -> bool:
    """Whether an address is one that only this machine reaches."""
    return is_loopback(urlsplit(url).hostname or "")
