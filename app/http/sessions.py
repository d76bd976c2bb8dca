"""Which session a request has: the cookies, and the addresses that tell of a session or end it.

Everything of one person's page lies under ``/r/N``, and so does the person's cookie: a browser sends it
there and nowhere else, so any number of people may use one browser. A second cookie, the same for
everybody, names the session of the link that was opened last: it is for addresses without a person, such as
``/export.csv``.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from aiohttp import web

from onedemo.app.http.tokens import hash_token, new_session_token
from onedemo.app.network.bind import Listening
from onedemo.storage.accounts import SESSION_DAYS
from onedemo.storage.store import Store
from onedemo.types import Rater

RATER = web.RequestKey("rater", Rater)
SESSION = web.RequestKey("session", str)
"""The hash of the cookie's token."""
PERSON = r"/r/{rater:\d{1,9}}"
"""Where everything of one person's page is."""

_T = TypeVar("_T")
_THREADS = 4
_TAB_KEPT_S = 600
"""Between the address of a tab and the link that opens it."""
_NONCE_KEPT_S = 600
"""Between the page of a link that opens once and the last time its button is pressed."""
_MOST_VALUES = 4
"""Cookies of one name that are looked at; a browser sends those of the longest path first."""
_ENDED = {
    "revoked": "Your link was revoked. Please ask for another if you still take part.",
    "expired": f"You opened your link {SESSION_DAYS} days ago. Please open it again.",
    None: "You are signed out. Please open your link again.",
}
"""Why there is no session, by what has become of it."""


class Sessions:
    """Knows who asks by cookies.

    Args:
        store: Knows the tokens.
        listening: The path before all addresses, and whether the way to the browser is encrypted.
        port: Tells the port of the front, once it is open.
    """

    def __init__(self, store: Store, listening: Listening, port: Callable[[], int]) -> None:
        self._store, self._listening, self._port = store, listening, port
        self.threads = ThreadPoolExecutor(_THREADS, "onedemo-session")
        """Nothing else is done in them, so that nobody waits to be recognised."""

    async def recognise(self, request: web.Request) -> None:
        """Notes who asks; below ``/r/N`` that is N or nobody."""
        for token in self.tokens(request):
            session = hash_token(token)
            rater = await self._ask(self._store.accounts.rater_of, session, "session")
            if rater is not None and rater.id == _person(request, rater.id):
                request[RATER], request[SESSION] = rater, session
                return

    def tokens(self, request: web.Request) -> list[str]:
        """What the cookies say that count here: of the person, or of whoever opened a link last."""
        return list(_values(request, self._name(_person(request))))[:_MOST_VALUES]

    def put(self, request: web.Request, response: web.StreamResponse, rater: int, token: str) -> None:
        """Gives the browser a session of a rater."""
        for name, path in self._both(rater):
            # Lax, not Strict: a link is opened from a mail or a chat, and the redirect must carry it.
            response.set_cookie(
                name,
                token,
                max_age=SESSION_DAYS * 86400,
                httponly=True,
                samesite="Lax",
                secure=self._listening.encrypted(request),
                path=path,
            )
        if self.kept_tab(request):
            response.del_cookie(self._tab_name, path=f"{self._listening.base_path}/")

    async def last(self, request: web.Request) -> Rater | None:
        """Who opened a link here last, whomever the address names."""
        for token in list(_values(request, self._name(None)))[:_MOST_VALUES]:
            rater = await self._ask(self._store.accounts.rater_of, hash_token(token), "session")
            if rater is not None:
                return rater
        return None

    def keep_tab(self, request: web.Request, response: web.StreamResponse, tab: str) -> None:
        """Has the browser remember for a while which tab it was sent to, until a link is opened."""
        response.set_cookie(
            self._tab_name,
            tab,
            max_age=_TAB_KEPT_S,
            httponly=True,
            samesite="Lax",
            secure=self._listening.encrypted(request),
            path=f"{self._listening.base_path}/",
        )

    def put_nonce(self, request: web.Request, response: web.StreamResponse) -> None:
        """Gives the browser a number by which it is known for a while when it opens a link."""
        response.set_cookie(
            self._nonce_name,
            new_session_token(),
            max_age=_NONCE_KEPT_S,
            httponly=True,
            samesite="Lax",
            secure=self._listening.encrypted(request),
            path=f"{self._listening.base_path}/login",
        )

    def nonce(self, request: web.Request) -> str:
        """That number, "" if there is none."""
        kept = next(_values(request, self._nonce_name), "")
        return kept if re.fullmatch(r"[\w-]{43}", kept, re.ASCII) else ""

    def kept_tab(self, request: web.Request) -> str:
        """That tab, "" if there is none."""
        kept = next(_values(request, self._tab_name), "")
        return kept if re.fullmatch(r"[a-z]{1,20}", kept) else ""

    async def state(self, request: web.Request) -> web.Response:
        """Whether the session still holds: 204, or 401 with the reason in a sentence."""
        if RATER in request:
            return web.Response(status=204)
        states = [
            await self._ask(self._store.accounts.session_state, hash_token(token))
            for token in self.tokens(request)
        ]
        known = next((state for state in states if state in _ENDED and state is not None), None)
        return web.Response(status=401, text=_ENDED[known])

    async def sign_out(self, request: web.Request) -> web.StreamResponse:
        """Ends the session: here, and in this browser."""
        rater, session = request[RATER], request[SESSION]
        for token in self.tokens(request):  # an older cookie may hold another session of the same person
            await asyncio.to_thread(self._store.accounts.end_session, hash_token(token))
        await asyncio.to_thread(self._store.audit.note, rater.name, "signed out")
        response = web.HTTPSeeOther(f"{self._listening.base_path}/signed-out")
        (own, path), (last, everywhere) = self._both(rater.id)
        response.del_cookie(own, path=path)
        if any(hash_token(token) == session for token in _values(request, last)):
            response.del_cookie(last, path=everywhere)
        return response

    async def _ask(self, what: Callable[..., _T], *about: str) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self.threads, what, *about)

    def _both(self, rater: int) -> tuple[tuple[str, str], tuple[str, str]]:
        base = self._listening.base_path
        return (self._name(rater), f"{base}/r/{rater}"), (self._name(None), f"{base}/")

    @property
    def _tab_name(self) -> str:
        return f"{self._name(None)}-tab"

    @property
    def _nonce_name(self) -> str:
        return f"{self._name(None)}-nonce"

    def _name(self, rater: int | None) -> str:
        # Browsers share cookies between the ports of a host; two studies on one machine must not.
        return f"onedemo-{self._port()}" + ("" if rater is None else f"-{rater}")


def _person(request: web.Request, otherwise: int | None = None) -> int | None:
    """Whom the address names."""
    return int(request.match_info["rater"]) if "rater" in request.match_info else otherwise


def _values(request: web.Request, name: str) -> Iterator[str]:
    for header in request.headers.getall("Cookie", []):
        for cookie in header.split(";"):
            found, _, value = cookie.strip().partition("=")
            if found == name:
                yield value
