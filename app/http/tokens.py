"""Links for people. The database holds nothing but the SHA-256 of the token in each.

The token of a standing link is HMAC-SHA256(secret, rater), with a secret file in the data directory,
so the same links are printed at every start. That of a link that ends by itself is random.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import io
import os
import secrets
from datetime import timedelta
from pathlib import Path

from onedemo.core.directories import locked, make_directory, sync_directory
from onedemo.core.files import copy_synced, write_atomic
from onedemo.errors import UserError
from onedemo.storage.store import Store
from onedemo.types import Rater

SECRET_FILE = "link-secret"
SECRET_BYTES = 32
ADDRESS_FILE = "address"
_USUAL_ADDRESS = "http://127.0.0.1:8080"
_UNITS = {"m": timedelta(minutes=1), "h": timedelta(hours=1), "d": timedelta(days=1)}


def link_token(secret: bytes, rater: Rater, generation: int = 0) -> str:
    """The token in a rater's link: 43 URL-safe characters that cannot be guessed without the secret.

    Args:
        secret: From ``read_secret``.
        rater: Whom the link is for.
        generation: How many earlier links of this rater were revoked.
    """
    text = f"onedemo link {rater.id} {rater.name} {generation}"
    digest = hmac.new(secret, text.encode(), hashlib.sha256).digest()
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def hash_token(token: str) -> str:
    """What the database keeps of a token: its SHA-256, hex."""
    # A cookie may hold any bytes; those that are no UTF-8 are the token of nobody.
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()


def new_session_token() -> str:
    """A fresh random token for a cookie."""
    return secrets.token_urlsafe(SECRET_BYTES)


def session_token_of(link_token: str, nonce: str) -> str:
    """The token of the session that a browser gets by a link, if it is to be the same each time.

    Args:
        link_token: Of the link: nobody else knows it.
        nonce: What was given to the browser before.
    """
    key, text = link_token.encode("utf-8", "surrogateescape"), nonce.encode("utf-8", "surrogateescape")
    digest = hmac.new(key, b"onedemo session " + text, hashlib.sha256).digest()
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def read_secret(data_dir: Path) -> bytes:
    """The secret of a data directory, 32 bytes; made (mode 0600, atomically) if there is none.

    Raises:
        UserError: If the file cannot be read or written, or is not 32 bytes long.
    """
    path = Path(data_dir) / SECRET_FILE
    try:
        if not path.exists():
            _create(path)
        secret = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"the secret for links {path} cannot be used ({error.strerror}); check its permissions"
        ) from None
    if len(secret) != SECRET_BYTES:
        raise UserError(
            f"the secret for links {path} should be {SECRET_BYTES} bytes long, it has {len(secret)}; "
            "restore it, or delete it to make new links"
        )
    return secret


def issue_link(store: Store, secret: bytes, rater: Rater, base_url: str) -> str:
    """The standing link that lets a rater in, known to the store from now on: the same until it is revoked.

    Args:
        store: Keeps the hash of the token.
        secret: From ``read_secret``.
        rater: Whom the link is for.
        base_url: Of the front, such as ``http://127.0.0.1:8080``.
    """
    token = link_token(secret, rater, store.accounts.count_revoked_links(rater.id))
    store.accounts.add_token(hash_token(token), rater.id, "link")
    return f"{base_url.rstrip('/')}/login?token={token}"


def passing_link(
    store: Store, rater: Rater, base_url: str, *, once: bool = False, lasts: timedelta | None = None
) -> str:
    """A new link that ends by itself; nobody can print it again.

    Args:
        store: Keeps the hash of the token.
        rater: Whom the link is for.
        base_url: Of the front.
        once: Whether it opens once.
        lasts: Until it expires; None: it does not.
    """
    token = new_session_token()
    store.accounts.add_token(hash_token(token), rater.id, "link", once=once, lasts=lasts)
    return f"{base_url.rstrip('/')}/login?token={token}"


def write_address(data_dir: Path, url: str) -> None:
    """Leaves the address of the server in the data directory, for links that another process makes."""
    write_atomic(Path(data_dir) / ADDRESS_FILE, f"{url}\n".encode())


def read_address(data_dir: Path) -> str:
    """Where the server of a data directory is, or was last; where one is by default if there was none."""
    try:
        return (Path(data_dir) / ADDRESS_FILE).read_text().strip() or _USUAL_ADDRESS
    except FileNotFoundError:
        return _USUAL_ADDRESS


def read_span(text: str) -> timedelta:
    """A time such as "30m", "12h" or "7d".

    Raises:
        UserError: If it is none, or not from a minute to ten years.
    """
    number, unit = text[:-1], _UNITS.get(text[-1:])
    if unit is not None and number.isascii() and number.isdigit() and len(number) <= 6:
        span = int(number) * unit
        if timedelta(minutes=1) <= span <= timedelta(days=3653):
            return span
    raise UserError(
        f"a time is a number with m, h or d, such as 12h or 7d, up to ten years; got {text[:40]!r}"
    )


def _create(path: Path) -> None:
    # Written beside its place and renamed, one process at a time: a reader never sees half a secret, and of
    # two processes that start at once the first one's secret is kept. Hard links are not everywhere.
    make_directory(path.parent, private=True)
    with locked(path.parent):
        if path.exists():
            return
        draft = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
        copy_synced(io.BytesIO(secrets.token_bytes(SECRET_BYTES)), draft)
        os.replace(draft, path)
        sync_directory(path.parent)
