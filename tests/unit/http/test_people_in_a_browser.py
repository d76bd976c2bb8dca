"""Cookies, sessions and addresses of the front: no Viser and trainer behind it, no browser before it."""

from __future__ import annotations

import asyncio
import gzip
import re
import sqlite3
import time
from contextlib import asynccontextmanager, closing
from datetime import timedelta
from types import SimpleNamespace

import aiohttp
import pytest
from yarl import URL

from helpers.beside_playwright import run
from helpers.paths import ROOT
from onedemo.app.annotation.presses import PageGone
from onedemo.app.cli.main import main
from onedemo.app.http import assets, auth, viser_proxy
from onedemo.app.http.auth import PAGE_HEADER
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, passing_link, read_address, read_secret, write_address
from onedemo.app.network import refusals
from onedemo.app.network.bind import Listening
from onedemo.app.network.rate_limit import STRANGERS_AT_ONCE
from onedemo.errors import UserError
from onedemo.storage import accounts
from onedemo.storage.accounts import MOST_SESSIONS
from onedemo.storage.database import now
from onedemo.storage.store import Store


class Behind:
    """Stands for the page behind the front: whoever is asked for has a page named "open"."""

    port, secret, study = 0, "", None

    def __init__(self, store):
        self.trainer = SimpleNamespace(store=store, run="r", paused=0)
        self.trainer.status = lambda: SimpleNamespace(phase="online")
        self.trainer.pause = lambda: setattr(self.trainer, "paused", self.trainer.paused + 1)
        self.pictures = None

    def is_open(self, rater_id, token):
        return token == "open"

    def tabs(self, role):
        return ["watch", "runs", "rate", "data"] if role == "researcher" else ["rate", "guide"]

    def press(self, rater_id, press):
        assert not self.is_open(rater_id, press.page)
        raise PageGone("gone")


@pytest.fixture
def store(tmp_path):
    with closing(Store(tmp_path)) as store:
        store.database._db.execute("PRAGMA synchronous = OFF")
        yield store


def write(store, sql, values=()):
    """What only time or another program does."""
    with store.database.transaction() as db:
        db.execute(sql, values)


class Browser:
    """A browser at a front: its cookies, as a browser keeps them."""

    def __init__(self, session, url):
        self.session, self.url = session, url

    async def get(self, path, method="GET", follow=False, body=None, **headers):
        address = path if path.startswith("http") else self.url + path
        async with self.session.request(
            method, address, headers=headers, allow_redirects=follow, json=body or {"do": "pause run"}
        ) as answer:
            return SimpleNamespace(
                status=answer.status,
                headers=answer.headers,
                text=await answer.text(errors="replace"),
                at=answer.url.path_qs,
            )

    async def post(self, path, page="open", **headers):
        return await self.get(path, method="POST", Origin=re.match(r"http://[^/]+", self.url)[0],
                              **{PAGE_HEADER: page}, **headers)  # fmt: skip

    def sends(self, path):
        """The cookies that go with a request."""
        return dict(self.session.cookie_jar.filter_cookies(URL(self.url + path)))


@asynccontextmanager
async def front(store, **options):
    behind = Behind(store)
    front = Front(behind, Listening(port=0, **options))
    front.url = front.start()
    front.behind = behind
    try:
        yield front
    finally:
        front.close()


@asynccontextmanager
async def browser(front):
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
        yield Browser(session, front.url)


def link_of(store, url, name, role="annotator"):
    return issue_link(store, read_secret(store.path.parent), store.accounts.ensure(name, role), url)


def test_twenty_people_use_one_browser(store):
    async def go():
        async with front(store) as door, browser(door) as people:
            researcher = await people.get(link_of(store, door.url, "ada", "researcher"))
            for number in range(20):
                answer = await people.get(link_of(store, door.url, f"P{number}"))
                assert answer.headers["Location"] == f"/r/{number + 2}/"
            for rater in range(1, 22):
                assert (await people.get(f"/r/{rater}/")).status == 200
                assert (await people.get(f"/r/{rater}/static/page.css")).status == 200
                assert (await people.get(f"/r/{rater}/session")).status == 204
                assert (await people.get(f"/r/{rater}/export.csv")).status == (200 if rater == 1 else 403)
                sent = people.sends(f"/r/{rater}/clips/1.jpg")  # two cookies, however many people
                assert len(sent) == 2 and sum(map(len, sent)) < 50
            # Elsewhere it is whoever opened a link last.
            assert (await people.get("/")).headers["Location"] == "/r/21/"
            assert (await people.get("/export.csv")).status == 403
            await people.get(link_of(store, door.url, "ada", "researcher"))
            assert (await people.get("/export.csv")).status == 200
            return researcher

    assert run(go()).status == 303


def test_somebody_else_s_cookie_does_not_open_a_page(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            bob = store.accounts.ensure("bob", "annotator").id
            for path in (f"/r/{bob}/", f"/r/{bob}/clips/1.jpg", f"/r/{bob}/session"):
                assert (await one.get(path)).status == 401
            token = one.sends("/r/1/")[f"onedemo-{door.port}-1"].value
            stolen = {"Cookie": f"onedemo-{door.port}-{bob}={token}; onedemo-{door.port}={token}"}
            assert (await one.get(f"/r/{bob}/", **stolen)).status == 401

    run(go())


def test_a_cookie_of_before_does_not_shut_out_the_one_of_now(store):
    """Earlier ones were for all paths: a browser sends both, the new one first."""

    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            name = f"onedemo-{door.port}-1"
            new = one.sends("/r/1/")[name].value
            async with aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as session:
                bare = Browser(session, door.url)
                assert (await bare.get("/r/1/", Cookie=f"{name}={new}; {name}=old")).status == 200
                assert (await bare.get("/r/1/", Cookie=f"a=b; {name}=old; {name}={new}")).status == 200
                many = "; ".join(f"{name}={number}" for number in range(50))
                assert (await bare.get("/r/1/", Cookie=many)).status == 401

    run(go())


def test_signing_out_ends_the_session_here_and_in_the_browser(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            for name in ("ann", "bob"):
                await one.get(link_of(store, door.url, name))
            bob, token = one.sends("/r/2/"), one.sends("/")[f"onedemo-{door.port}"].value
            assert (await one.post("/r/2/signout", page="another")).status == 409
            assert (await one.get("/r/2/session")).status == 204
            answer = await one.post("/r/2/signout")
            assert (answer.status, answer.headers["Location"]) == (303, "/signed-out")
            assert "You are signed out" in (await one.get("/signed-out")).text
            assert not one.sends("/") and list(one.sends("/r/2/")) == []
            assert (await one.get("/r/2/")).status == 401
            kept = "; ".join(f"{name}={cookie.value}" for name, cookie in bob.items())
            for path in ("/r/2/", "/r/2/session", "/"):  # who kept the cookie has nothing by it
                assert (await one.get(path, Cookie=kept)).status == 401
            assert (await one.get("/r/1/")).status == 200
            assert store.accounts.session_state(token) is None

    run(go())
    assert [line[1:3] for line in store.audit.lines()] == [
        ("ann", "signed in"), ("bob", "signed in"), ("bob", "signed out"),
    ]  # fmt: skip


def test_signing_out_ends_every_session_that_the_browser_has_of_that_person(store):
    """An older cookie, for all paths, comes beside that of now."""

    async def go():
        async with front(store) as door, browser(door) as one, browser(door) as another:
            name = f"onedemo-{door.port}-1"
            tokens = []
            for each in (one, another):
                await each.get(link_of(store, door.url, "ann"))
                tokens.append(each.sends("/r/1/")[name].value)
            async with aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as session:
                bare = Browser(session, door.url)
                both = "; ".join(f"{name}={token}" for token in tokens)
                assert (await bare.post("/r/1/signout", Cookie=both)).status == 303
                for token in tokens:
                    assert (await bare.get("/r/1/session", Cookie=f"{name}={token}")).status == 401

    run(go())


def fill_audit_log(store):
    """Of all tables this one alone cannot be written."""
    write(store, "CREATE TRIGGER full BEFORE INSERT ON audit BEGIN SELECT RAISE(ABORT, 'full'); END")


def test_a_link_that_was_used_lets_in_although_the_audit_log_cannot_be_written(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            link = passing_link(store, store.accounts.ensure("ann", "annotator"), door.url, once=True)
            fill_audit_log(store)
            async with one.session.post(
                door.url + "/login",
                data={"token": link.split("token=")[1]},
                headers={"Origin": door.url},
            ) as answer:
                assert (answer.status, answer.url.path) == (200, "/r/1/")
            assert (await one.get("/r/1/session")).status == 204

    run(go())
    assert list(store.audit.lines()) == []


def test_a_revoked_page_is_closed_although_the_audit_log_cannot_be_written(store, monkeypatch):
    monkeypatch.setattr(viser_proxy, "_LOOK_S", 0.01)
    ann = store.accounts.ensure("ann", "annotator").id
    store.accounts.add_token("session", ann, "session", lasts=timedelta(days=1))
    for _ in range(2):
        store.audit.note("ann", "signed in")
    store.audit._clock = lambda: time.monotonic() + 3600  # the second one is to be written now
    fill_audit_log(store)

    class Socket:
        closed = asyncio.Event()

        async def close(self, **why):
            self.closed.set()

    async def go():
        proxy, page = viser_proxy.Proxy(Behind(store), store), Socket()
        await proxy.open()
        try:
            proxy._sockets[page] = "session"
            store.accounts.revoke_tokens(ann)
            await asyncio.wait_for(page.closed.wait(), 20)
        finally:
            await proxy.close()

    run(go())
    with pytest.raises(sqlite3.IntegrityError, match="full"):
        store.audit.finish()


@pytest.mark.parametrize(
    ("ending", "why"),
    [
        ("UPDATE tokens SET revoked_at = '2026-01-01T00:00:00.000Z'", "Your link was revoked."),
        ("UPDATE tokens SET expires_at = '2026-01-01T00:00:00.000Z'", "You opened your link 30 days ago."),
        ("DELETE FROM tokens WHERE kind = 'session'", "You are signed out."),
    ],
)
def test_a_page_is_told_why_its_session_ended(store, ending, why):
    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            alive = await one.get("/r/1/session")
            write(store, ending)
            return alive, await one.get("/r/1/session")

    alive, ended = run(go())
    assert (alive.status, alive.text) == (204, "")
    assert ended.status == 401 and ended.text.startswith(why)
    assert ended.headers["Content-Type"].startswith("text/plain")


def test_a_link_that_opened_once_leads_back_to_the_page_it_opened(store):
    """Also in a browser in which others have opened theirs since."""

    async def go():
        async with front(store) as door, browser(door) as one, browser(door) as another:
            ann = store.accounts.ensure("ann", "annotator")
            link = passing_link(store, ann, door.url, once=True)
            token = link.split("token=")[1]
            async with one.session.post(door.url + "/login", data={"token": token},
                                        headers={"Origin": door.url}) as answer:  # fmt: skip
                assert answer.status == 200
            await one.get(link_of(store, door.url, "bob"))
            back = await one.get(link, follow=True)
            assert (back.status, back.at) == (200, "/r/1/")
            strange = await another.get(link, follow=True)
            assert strange.status == 403 and "was used already" in strange.text

    run(go())


def test_the_button_may_be_pressed_again_if_its_answer_was_lost(store):
    """Before, the link was used up and its owner stood outside."""
    ann = store.accounts.ensure("ann", "annotator")

    async def lost(door, one, link):
        """Presses the button, and the answer never comes: the browser keeps no cookie of it."""
        page = await one.get(link)
        assert page.status == 200 and "works only once" in page.text
        before = {cookie.key: cookie.value for cookie in one.session.cookie_jar}
        assert await press_the_button(door, one, link[-43:]) == 303
        for cookie in list(one.session.cookie_jar):
            if before.get(cookie.key) != cookie.value:
                one.session.cookie_jar.clear(lambda morsel, key=cookie.key: morsel.key == key)

    async def go():
        async with front(store) as door, browser(door) as one, browser(door) as another:
            first, second = (passing_link(store, ann, door.url, once=True) for _ in range(2))
            await lost(door, one, first)
            assert (await one.get("/r/1/session")).status == 401
            assert await press_the_button(door, one, first[-43:]) == 303
            assert (await one.get("/r/1/session")).status == 204
            await lost(door, one, second)  # and by the link itself
            assert (await one.get(second, follow=True)).at == "/r/1/"
            assert (await one.get("/r/1/session")).status == 204
            # The number alone opens nothing, nor does the link in another browser, nor after signing out.
            assert await press_the_button(door, another, first[-43:]) == 403
            await another.get(passing_link(store, ann, door.url, once=True))
            assert await press_the_button(door, another, first[-43:]) == 403
            assert (await one.post("/r/1/signout")).status == 303
            assert await press_the_button(door, one, second[-43:]) == 403

    run(go())
    assert sum(presence.browsers for presence in store.accounts.presence().values()) == 1


async def press_the_button(door, one, token):
    """Opens a link that opens once; the status of the answer."""
    async with one.session.post(
        door.url + "/login", data={"token": token}, headers={"Origin": door.url}, allow_redirects=False
    ) as answer:
        return answer.status


def test_a_link_is_not_used_up_for_somebody_who_was_sent_away(store, monkeypatch):
    """The database was held for longer than anybody is kept waiting: before, the link was gone afterwards."""
    monkeypatch.setattr(refusals, "LOGIN_S", 0.3)
    token = passing_link(store, store.accounts.ensure("ann", "annotator"), "http://x", once=True)[-43:]

    async def go():
        async with front(store) as door, browser(door) as one:
            with closing(sqlite3.connect(store.path, isolation_level=None)) as other:
                other.execute("BEGIN IMMEDIATE")
                assert await press_the_button(door, one, token) == 503
                other.execute("ROLLBACK")
            await asyncio.to_thread(store.audit.add, "ann", "came after")  # what waited has had its turn
            state = store.accounts.links()[0].state
            monkeypatch.setattr(refusals, "LOGIN_S", 60.0)
            return state, await press_the_button(door, one, token)

    assert run(go()) == ("open", 303)


def test_who_would_be_sent_away_while_the_session_is_committed_gets_it(store, monkeypatch):
    monkeypatch.setattr(refusals, "LOGIN_S", 0.3)
    token = passing_link(store, store.accounts.ensure("ann", "annotator"), "http://x", once=True)[-43:]
    opened = store.accounts.open_link

    def slowly(*about):
        link = opened(*about)
        time.sleep(1)
        return link

    monkeypatch.setattr(store.accounts, "open_link", slowly)

    async def go():
        async with front(store) as door, browser(door) as one:
            assert await press_the_button(door, one, token) == 303
            return (await one.get("/r/1/session")).status

    assert run(go()) == 204


def test_strangers_are_slowed_down_and_nobody_else(store, monkeypatch):
    """Before, one address got as many answers as it could ask for."""
    monkeypatch.setattr(auth, "_SLOWED_S", 0.01)

    async def go():
        async with front(store) as door, browser(door) as one, browser(door) as other:
            await one.get(link_of(store, door.url, "ann"))
            said = [await other.get(("/login", "/healthz", "/", "/x?token=1")[n % 4]) for n in range(400)]
            refused = [answer for answer in said if answer.status == 429]
            assert len(refused) > 20 and all(a.headers["Connection"] == "close" for a in refused)
            assert {answer.status for answer in said[:STRANGERS_AT_ONCE]} == {200, 401}
            # From the same address: somebody with a session, and somebody who opens a link.
            assert [(await one.get("/r/1/session")).status for _ in range(400)] == [204] * 400
            return (await other.get(link_of(store, door.url, "bob"))).status

    assert run(go()) == 303


def test_what_is_remembered_of_sessions_is_bounded(store, monkeypatch):
    monkeypatch.setattr(accounts, "_MOST_USED", 50)
    monkeypatch.setattr(viser_proxy, "_MOST_FOLLOWED", 50)
    proxy = viser_proxy.Proxy(Behind(store), store)
    for number in range(1000):
        store.accounts.note_use([f"s{number}", "always"])
        proxy._note_socket(f"s{number}")
        proxy._note_socket("always")
    assert len(store.accounts._used) == 50 and {"always", "s999"} <= set(store.accounts._used)
    assert len(proxy._followed) == 50 and {"always", "s999"} <= set(proxy._followed)


def test_opening_a_link_again_keeps_the_session(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            link = link_of(store, door.url, "ann")
            for _ in range(5):
                await one.get(link)
                assert (await one.get("/r/1/session")).status == 204

    run(go())
    assert store.database.rows("SELECT COUNT(*) FROM tokens WHERE kind = 'session'") == [(1,)]
    assert len(list(store.audit.lines())) == 1


def test_sessions_of_a_link_are_bounded_and_those_in_use_stay(store):
    from onedemo.app.http.tokens import hash_token

    token = hash_token(link_of(store, "http://x", "ann").split("token=")[1])
    store.accounts.open_link(token, "in use")
    store.accounts.open_link(token, "not in use")
    for number in range(MOST_SESSIONS + 50):
        if number % 50 == 49:
            store.accounts.note_use(["in use"])
        store.accounts.open_link(token, f"s{number}")
    sessions = {row[0] for row in store.database.rows("SELECT hash FROM tokens WHERE kind = 'session'")}
    assert len(sessions) == MOST_SESSIONS
    assert "in use" in sessions and "not in use" not in sessions and f"s{MOST_SESSIONS + 49}" in sessions
    # What ended a week ago goes; until then a page can be told why.
    write(store, "UPDATE tokens SET expires_at = '2020-01-01T00:00:00.000Z' WHERE hash = 's90'")
    write(store, "UPDATE tokens SET revoked_at = '2020-01-01T00:00:00.000Z' WHERE hash = 's91'")
    write(store, "UPDATE tokens SET revoked_at = ? WHERE hash = 's92'", (now(),))
    store.accounts.open_link(token, "new")
    assert [store.accounts.session_state(name) for name in ("s90", "s91", "s92", "new")] == [
        None, None, "revoked", "open",
    ]  # fmt: skip


def parameters_of_the_client():
    """Every name by which Viser's client may ask its query for something, and some more."""
    client = gzip.decompress(assets.viser_files()["viser.js"].body).decode()
    assert "URLSearchParams" in client
    names = set(re.findall(r"\.(?:get|getAll|has)\(`([A-Za-z_]\w{2,40})`\)", client))
    variables = set(re.findall(r"\.(?:get|getAll|has)\((\w{1,5})\)", client))
    constants = re.findall(r"\b(\w{1,5})=`([A-Za-z_]\w{2,40})`", client)
    return names | {name for variable, name in constants if variable in variables}


def test_no_parameter_reaches_viser_s_client(store):
    names = parameters_of_the_client()
    assert {"playbackPath", "websocket", "darkMode", "initialCameraPosition", "dummyWindowTitle"} - names <= {
        "initialCameraPosition"  # asked for by a function of the client's own
    }

    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            for name in sorted(names | {"initialCameraPosition", "", "x"}):
                answer = await one.get(f"/r/1/?{name}=data:,x")
                assert (answer.status, answer.headers["Location"]) == (303, "/r/1/"), name
                assert "<script" not in answer.text
            page = await one.get("/r/1/?playbackPath=data:,x", follow=True)
            assert (page.status, page.at) == (200, "/r/1/")
            for path in ("/", "/login", "/signed-out"):  # no other address gives the client
                assert "viser.js" not in (await one.get(path + "?playbackPath=x", follow=path != "/")).text

    run(go())


def test_viser_s_client_comes_as_files_that_a_browser_keeps(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            page = await one.get("/r/1/")
            names = re.findall(r'"(static/viser/[^"]+)"', page.text)
            wasm = names[-1].replace("viser.js", "zstd.wasm")
            return page, [await one.get(f"/r/1/{name}") for name in (*names, wasm, "static/viser/x.js")]

    page, (style, script, wasm, other) = run(go())
    assert len(page.text) < 4000 and other.status == 404
    assert style.headers["Content-Type"] == "text/css" and ".mantine-" in style.text
    assert script.headers["Content-Type"] == "text/javascript" and len(script.text) > 2_000_000
    assert wasm.headers["Content-Type"] == "application/wasm"  # else it is not compiled as it comes
    for file in (style, script, wasm):
        assert "immutable" in file.headers["Cache-Control"]
        assert int(file.headers["Content-Length"]) < 800_000  # what is packed is sent packed


def test_nothing_inline_runs(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            return [await one.get(path) for path in ("/r/1/", "/login", "/r/2/", "/export.csv", "/nothing")]

    page, *others = run(go())
    policy = dict(part.strip().split(" ", 1) for part in page.headers["Content-Security-Policy"].split(";"))
    assert "'unsafe-inline'" not in policy["script-src"] and "'unsafe-eval'" not in policy["script-src"]
    assert policy["script-src-attr"] == policy["object-src"] == policy["base-uri"] == "'none'"
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    for kind in ("script", "connect", "img", "media", "font", "worker", "style"):
        assert not re.search(r"https?:|wss?:|\*", policy[f"{kind}-src"])
    assert policy["script-src"] == "'self' 'wasm-unsafe-eval'"
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", page.text, re.DOTALL)
    assert len(scripts) > 10 and all(' src="static/' in tag and not body for tag, body in scripts)
    for answer in others:
        assert answer.headers["Content-Security-Policy"] == assets.POLICY
    assert "script-src 's" not in assets.POLICY


def test_what_changes_something_is_done_from_an_open_page_alone(store):
    """Each POST there is: a cookie, even with the right origin, is not enough."""

    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ada", "researcher"))
            paths = [route.path for route in door.routes() if route.method == "POST"]
            assert len(paths) == 14
            for path in paths:
                path = path.replace(r"{rater:\d{1,9}}", "1").replace("{upload:[0-9a-f]{32}}", "a" * 32)
                refused = [
                    await one.post(path, page=""),
                    await one.post(path, page="another"),
                    await one.get(path, method="POST"),
                    *[
                        await one.get(path, method="POST", Origin=origin, **{PAGE_HEADER: "open"})
                        for origin in ("http://elsewhere.example", "null")
                    ],
                ]
                assert {answer.status for answer in refused} <= {400, 403, 409, 415}, path
            press = {"press": "skip", "clip": 1, "id": "a", "page": "another"}
            assert (await one.post("/r/1/press", body=press)).status == 410
            assert door.behind.trainer.paused == 0
            assert (await one.post("/r/1/do")).status == 204
            assert door.behind.trainer.paused == 1

    run(go())


def test_a_tab_has_an_address(store):
    """Reload, and a link to a colleague or to somebody with fewer tabs."""

    async def go():
        async with front(store) as door, browser(door) as ada, browser(door) as bob:
            await ada.get(link_of(store, door.url, "ada", "researcher"))
            await bob.get(link_of(store, door.url, "bob"))
            page = await ada.get("/r/1/data")
            assert page.status == 200 and "viser.js" in page.text
            for query in ("?playbackPath=data:,x", "?"):
                answer = await ada.get(f"/r/1/data{query}")
                assert query == "?" or (answer.status, answer.headers["Location"]) == (303, "/r/1/data")
            assert (await bob.get("/r/2/guide")).status == 200
            answer = await bob.get("/r/2/data")
            assert (answer.status, answer.headers["Location"]) == (303, "/r/2/")
            # Sent by ada: bob is somebody else, and may go to the like of his own.
            sent = await bob.get("/r/1/data")
            assert sent.status == 401 and "You are signed in as bob" in sent.text
            assert 'href="/r/2/data"' in sent.text
            assert (await bob.get("/r/1/clips/1.jpg")).status == 401

    run(go())


def test_who_is_sent_a_tab_and_opens_a_link_comes_to_that_tab(store):
    async def go():
        async with front(store, base_path="/study1") as door, browser(door) as one:
            link = link_of(store, door.url, "ada", "researcher")
            asked = await one.get("/r/1/data")
            assert asked.status == 401 and "Please open your link" in asked.text
            (cookie,) = asked.headers.getall("Set-Cookie")
            assert "HttpOnly" in cookie and "Path=/study1/" in cookie and "Max-Age=600" in cookie
            assert (await one.get(link)).headers["Location"] == "/study1/r/1/data"
            assert (await one.get(link)).headers["Location"] == "/study1/r/1/"  # once
            name = f"onedemo-{door.port}-tab"
            for hostile in ("//evil.example", "..%2f", "a" * 21, "DATA"):
                answer = await one.get(link, Cookie=f"{name}={hostile}")
                assert answer.headers["Location"] == "/study1/r/1/", hostile

    run(go())


def test_an_address_without_anything_is_a_page_that_says_so(store):
    async def go():
        async with front(store, base_path="/study1") as door, browser(door) as one:
            assert (await one.get("/nothing", Accept="text/html")).status == 401
            await one.get(link_of(store, door.url, "ann"))
            for path in ("/nothing", "/r/1/nothing", "/r/1/press", "/r/1/clips/99.jpg/x"):
                answer = await one.get(path, Accept="text/html,*/*")
                assert answer.status == 404 and "There is nothing at this address" in answer.text, path
                assert 'href="/study1/r/1/"' in answer.text
                assert answer.headers["Content-Security-Policy"] == assets.POLICY
            assert (await one.get("/nothing", Accept="*/*")).headers["Content-Type"].startswith("text/plain")

    run(go())


def test_everything_lies_below_the_base_path(store):
    async def go():
        async with front(store, base_path="/study1") as door, browser(door) as one:
            assert door.url.endswith(f":{door.port}/study1")
            root = door.url.removesuffix("/study1")
            answer = await one.get(link_of(store, door.url, "ada", "researcher"))
            assert answer.headers["Location"] == "/study1/r/1/"
            paths = [re.search("Path=([^;]+)", cookie)[1] for cookie in answer.headers.getall("Set-Cookie")]
            assert paths == ["/study1/r/1", "/study1/"]
            for path in ("/r/1", "/"):
                answer = await one.get(path)
                assert (answer.status, answer.headers["Location"]) == (303, "/study1/r/1/")
            page = await one.get("/r/1/")
            for address in re.findall(r'(?:src|href)="([^"]+)"', page.text.partition("<script data-p")[0]):
                assert not address.startswith("/"), address
                assert (await one.get("/r/1/" + address)).status == 200
            login = await one.get("/r/7/")
            assert login.status == 401
            for address in re.findall(r'(?:src|href)="([^"]+)"', login.text):
                assert (await one.get(root + address)).status == 200, address
            assert (await one.get("/export.csv")).status == 200
            answer = await one.post("/r/1/signout")
            assert answer.headers["Location"] == "/study1/signed-out"
            assert (await one.get(root + "/healthz")).status == 200

    run(go())


def test_a_nearly_right_proxy_is_named_in_the_log_once(store, monkeypatch, caplog):
    monkeypatch.setattr(viser_proxy, "_FOLLOWED_S", 0.05)

    async def go():
        async with front(store) as door, browser(door) as one:
            await one.get(link_of(store, door.url, "ann"))
            for number in range(60):  # Host was changed, so the origin is another
                origin = f"https://study{number % 40}.example.org"
                headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Origin": origin}
                assert (await one.get("/r/1/", **headers)).status == 403
            for _ in range(3):  # Upgrade was not passed on
                await one.get("/r/1/")
            for _ in range(200):
                if "did not come within" in caplog.text:
                    break
                await asyncio.sleep(0.05)
            await asyncio.sleep(0.2)

    run(go())
    said = [record.getMessage() for record in caplog.records]
    origins = [line for line in said if "study0.example.org" in line]
    assert len(origins) == 1 and "must pass on WebSockets and the Host header" in origins[0]
    assert len([line for line in said if "was refused its connection" in line]) == 20
    followed = [line for line in said if "did not come within" in line]
    assert len(followed) == 1 and "the page of ann was opened" in followed[0]


def test_the_pictures_that_others_may_embed_are_none(store):
    async def go():
        async with front(store) as door, browser(door) as one:
            return await one.get("/login")

    headers = run(go()).headers
    assert headers["Cross-Origin-Resource-Policy"] == headers["Cross-Origin-Opener-Policy"] == "same-origin"


def test_the_audit_log_cannot_be_flooded(store):
    async def go():
        async with front(store, behind_proxy=True) as door:
            link = link_of(store, door.url, "ada", "researcher")
            async with aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as session:
                one = Browser(session, door.url)
                for _ in range(50):
                    await one.get(link)
                for number in range(60):
                    await one.get("/login?token=x", **{"X-Forwarded-For": f"10.0.0.{number}"})

    run(go())
    lines = [(who, what) for _, who, what, _ in store.audit.lines()]
    assert lines.count(("ada", "signed in")) == 1
    assert len(lines) <= 1 + 20 + 1 and ("other addresses", "sign-in refused") in lines
    store.audit.finish(everything=True)
    told = [line[1:] for line in store.audit.lines()]
    assert ("ada", "signed in", "link 1, 49 more in ten minutes") in told
    assert ("other addresses", "sign-in refused", "in other ways, 39 more in ten minutes") in told
    with closing(sqlite3.connect(store.path)) as db:
        assert db.execute("SELECT COUNT(*) FROM tokens WHERE kind = 'session'").fetchone()[0] == 50


def test_links_of_another_process_carry_the_server_s_address(store, capsys):
    directory = store.path.parent
    where = ["--data-dir", str(directory)]
    assert read_address(directory) == "http://127.0.0.1:8080"
    write_address(directory, "https://study.example.org/study1")
    assert main(["rater", "add", "Ann", *where]) == 0
    assert capsys.readouterr().out.startswith("https://study.example.org/study1/login?token=")
    assert main(["rater", "add", "Ann", "--once", "--url", "http://x:1", *where]) == 0
    assert capsys.readouterr().out.startswith("http://x:1/login?token=")


@pytest.mark.parametrize(
    ("options", "address"),
    [
        ({}, "http://127.0.0.1:8081"),
        ({"base_path": "/study1"}, "http://127.0.0.1:8081/study1"),
        ({"host": "::1"}, "http://[::1]:8081"),
        ({"host": "0.0.0.0", "tls_cert": "c", "tls_key": "k"}, "https://127.0.0.1:8081"),
        ({"tls_cert": "c", "tls_key": "k", "names": ("a.example.org", "b")}, "https://a.example.org:8081"),
        ({"behind_proxy": True}, "http://127.0.0.1:8081"),
        ({"behind_proxy": True, "names": ("a.org",), "base_path": "/b/c"}, "https://a.org/b/c"),
    ],
)
def test_the_address_that_links_carry(options, address):
    assert Listening(**options).address(8081) == address


@pytest.mark.parametrize("path", ["study1", "/study1/", "//", "/a b", "/../x", "/ä", "/" + "x" * 100, "/a?b"])
def test_a_base_path_is_a_plain_path(path):
    with pytest.raises(UserError, match="--base-path takes a path such as /study1"):
        Listening(base_path=path)


def test_no_script_of_ours_makes_markup_of_text():
    scripts, templates = [*ROOT.glob("static/*.js")], [*ROOT.glob("app/templates/*.html")]
    assert len(scripts) >= 2 and len(templates) >= 10
    for path in scripts:
        makes = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|Function\("
        assert not re.search(makes, path.read_text()), path
    for path in templates:
        assert not re.search(r"\|\s*safe\b|autoescape|\son[a-z]+=|javascript:", path.read_text()), path
