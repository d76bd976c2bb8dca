"""The public access: nothing without a session, and what each role gets. Real sockets, no browser."""

from __future__ import annotations

import csv
import io
import re
import time
from contextlib import closing
from pathlib import Path

import aiohttp
import pytest
import viser

from helpers.beside_playwright import run
from helpers.fake_trainer import DEMO_FRAMES
from onedemo.app.annotation.examples import choose
from onedemo.app.dataset import csv_writer
from onedemo.app.http.auth import AccessControl
from onedemo.app.http.server import Front
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.network.bind import Listening, check_port
from onedemo.app.services.demo_images import version_of
from onedemo.errors import UserError
from onedemo.storage.rating_records import RATING_COLUMNS
from onedemo.storage.store import Store

pytestmark = pytest.mark.seam


def fetch(url, path, *, link=None, cookies=None, headers=None, follow=True):
    """Opens ``link`` if given, then fetches a path: (status, headers, body, cookies)."""

    async def go():
        jar = aiohttp.CookieJar(unsafe=True)
        async with aiohttp.ClientSession(cookies=cookies, cookie_jar=jar) as session:
            if link:
                await (await session.get(link)).read()
            async with session.get(url + path, headers=headers, allow_redirects=follow) as response:
                body = await response.read()
                return response.status, response.headers, body, [c for c in jar]

    return run(go())


def connect(url, *, link=None, headers=None, path=None):
    """Opens the WebSocket as a browser would and returns the status, 101 if it was let in."""

    async def go():
        jar = aiohttp.CookieJar(unsafe=True)
        async with aiohttp.ClientSession(cookie_jar=jar) as session:
            page = f"{url}/r/1"
            if link:
                async with session.get(link) as response:
                    page = str(response.url)
            try:
                async with session.ws_connect(
                    page if path is None else url + path,
                    protocols=[f"viser-v{viser.__version__}"],
                    headers={"Origin": url} if headers is None else headers,
                ) as socket:
                    assert socket.protocol == f"viser-v{viser.__version__}"
                    message = await socket.receive(timeout=60)
                    assert message.type is aiohttp.WSMsgType.BINARY
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    return run(go())


@pytest.mark.parametrize(
    "path",
    ["/", "/clips/1.jpg", "/demo/frames/0.jpg", "/export.csv", "/static/page.css", "/static/page.js", "/x"],
)
def test_nothing_without_a_session(site, path):
    status, headers, body, _ = fetch(site.url, path)
    assert status == 401
    assert b"Please open your link" in body
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert fetch(site.url, path, cookies={f"onedemo-{site.front.port}-1": "guess"})[0] == 401


VENDORED = "/static/vendor/uplot/uPlot.min.css"
VISER = "/static/viser/viser.css"
EXAMPLE = choose(None, DEMO_FRAMES, 9).guide[0].name
EXAMPLES = {
    "rater": "2", "clip": "1", "pair": "1", "index": "3", "name": EXAMPLE, "iteration": "1", "suffix": "jpg",
    "tab": "rate", "upload": "a" * 32, "demo": "b" * 64, "result": "1", "end": "first",
}  # fmt: skip
"""What the places in a route's path may be; the rater is the annotator."""
STRANGERS_MAY = {
    "/login", "/signed-out", "/healthz", "/static/login.css", "/static/icon.svg", "/r/2/login",
    "/r/2/session",
}  # fmt: skip
ANNOTATORS_MAY = {"/", "/r/2", "/r/2/", "/r/2/press", "/r/2/signout", "/r/2/rate"} | {
    place + path
    for path in (
        "/static/page.css", VENDORED, VISER, "/clips/1.jpg", "/pairs/1.jpg", "/demo/frames/3.jpg",
        f"/demo/examples/{EXAMPLE}.jpg", "/demo/video.webm",
    )
    for place in ("", "/r/2")
}  # fmt: skip


def status_of(url, method, path, link):
    async def go():
        jar = aiohttp.CookieJar(unsafe=True)
        async with aiohttp.ClientSession(cookie_jar=jar) as session:
            if link:
                await (await session.get(link)).read()
            async with session.request(
                method, url + path, headers={"Origin": url}, data=b"{}", allow_redirects=False
            ) as response:
                return response.status

    return run(go())


@pytest.mark.parametrize("role", ["stranger", "annotator", "researcher"])
def test_every_route_asks_for_its_role(site, role):
    """Which routes a role gets is written here once more: a new one must be added on purpose."""
    for route in site.front.routes():
        path = route.path.replace("/static/{name}", "/static/page.css")
        path = path.replace("/static/vendor/{package}/{name}", VENDORED)
        path = path.replace("/static/viser/{name}", VISER)
        for name, example in EXAMPLES.items():
            path = re.sub(rf"\{{{name}(:[^/]*?(\{{\d+(,\d+)?\}})?)?\}}(?=[-./]|$)", example, path)
        if role == "researcher":
            path = path.replace("/r/2", "/r/1")
        plain = path.replace("/r/1", "/r/2")
        least = (
            "stranger" if plain in STRANGERS_MAY
            else "annotator" if plain in ANNOTATORS_MAY else "researcher"
        )  # fmt: skip
        assert route.role == least, f"{path} asks for {route.role}"
        status = status_of(site.url, route.method, path, site.links.get(role))
        if least == "stranger" or role == "researcher" or role == least:
            # No form, no token in it, or no open page named; or nobody of whom to say whether they are in.
            refused = (403, 415) if route.method == "POST" else (401,) if plain == "/r/2/session" else ()
            assert status in (200, 204, 303, 400, 404, *refused), f"{path} for a {role}: {status}"
            assert status != 404 or path.endswith(("/pairs/1.jpg", "/rollouts/1.jpg")) or "/demos/" in path
        else:
            assert status == (401 if role == "stranger" else 403), f"{path} for a {role}"


def test_a_route_without_a_role_is_for_nobody(site):
    access = AccessControl(site.trainer.store, Listening(), lambda: 0)
    routes = [route for route in site.front.routes() if route.path == "/healthz"]
    application = access.application(routes)
    application.router.add_get("/forgotten", routes[0].handler.__func__)
    from aiohttp.test_utils import TestClient, TestServer

    async def go():
        async with TestClient(TestServer(application)) as client:
            return (await client.get("/forgotten")).status

    assert run(go()) == 403


def test_login_page_its_style_and_health_are_public_and_tell_nothing(site):
    assert fetch(site.url, "/login")[0] == 200
    assert fetch(site.url, "/static/login.css")[0] == 200
    status, _, body, _ = fetch(site.url, "/healthz")
    assert status == 200
    assert b'"phase": "pretrain"' in body
    site.trainer.set_status(phase="failed", error="disk is full")
    status, _, body, _ = fetch(site.url, "/healthz")
    assert status == 503 and b'"ok": false' in body


def test_no_answer_tells_a_version_in_its_headers(site):
    told = [
        fetch(site.url, path, link=site.links["researcher"])[1]
        for path in ("/login", "/x", "/clips/1.jpg", "/export.csv", "/static/page.css", "/r/1")
    ] + [fetch(site.url, "/x", headers={"Expect": "x"})[1]]
    for headers in told:
        assert headers["Server"] == "onedemo"
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert not any("aiohttp" in value or "Python" in value for value in headers.values())


def test_link_becomes_a_cookie_that_scripts_cannot_read(site):
    status, headers, _, _ = fetch(site.url, site.links["annotator"].removeprefix(site.url), follow=False)
    assert (status, headers["Location"]) == (303, "/r/2/")
    cookies = headers.getall("Set-Cookie")
    assert [re.search("Path=([^;]+)", cookie)[1] for cookie in cookies] == ["/r/2", "/"]
    assert all("HttpOnly" in cookie and "SameSite=Lax" in cookie for cookie in cookies)
    assert headers["Referrer-Policy"] == "no-referrer"
    status, _, body, _ = fetch(site.url, "/", link=site.links["annotator"])
    assert status == 200
    assert b'"static/page.css"' in body and b"<title>onedemo</title>" in body


def test_unknown_and_revoked_links_are_refused_kindly(site):
    status, _, body, _ = fetch(site.url, "/login?token=wrong")
    assert status == 403
    assert b"This link does not work" in body
    rater = next(r for r in site.trainer.store.accounts.raters() if r.name == "bo")
    site.trainer.store.accounts.revoke_tokens(rater.id)
    assert fetch(site.url, site.links["annotator"].removeprefix(site.url))[0] == 403


def test_clips_of_the_run_and_nothing_else(site):
    link = site.links["annotator"]
    status, headers, body, _ = fetch(site.url, "/clips/1.jpg", link=link)
    assert (status, headers["Content-Type"], body[:3]) == (200, "image/jpeg", b"\xff\xd8\xff")
    assert headers["Cache-Control"] == "private, max-age=31536000, immutable"
    assert headers["X-Content-Type-Options"] == "nosniff"
    for path in (
        "/clips/999.jpg",
        "/clips/../page.css",
        "/static/..%2fpyproject.toml",
        "/demo/frames/999.jpg",
    ):
        assert fetch(site.url, path, link=link)[0] == 404, path
    assert fetch(site.url, "/demo/frames/3.jpg", link=link)[2][:2] == b"\xff\xd8"
    assert fetch(site.url, f"/demo/examples/{EXAMPLE}.jpg", link=link)[2][:3] == b"\xff\xd8\xff"


def test_export_is_for_researchers(site):
    store = site.trainer.store
    nasty = store.accounts.ensure('=HYPERLINK("http://x")', "annotator")
    store.ratings.rate(2, nasty.id, 5, 1200)
    assert fetch(site.url, "/export.csv", link=site.links["annotator"])[0] == 403
    status, headers, body, _ = fetch(site.url, "/export.csv", link=site.links["researcher"])
    assert status == 200
    assert headers["Content-Disposition"].startswith('attachment; filename="onedemo-ratings-')
    rows = list(csv.reader(io.StringIO(body.decode())))
    assert tuple(rows[0]) == RATING_COLUMNS
    row = dict(zip(rows[0], rows[1], strict=True))
    assert (row["clip_id"], row["value"], row["latency_ms"]) == ("2", "5", "1200")
    assert row["rater"] == '\'=HYPERLINK("http://x")'
    assert row["created_at"].endswith("Z")


def test_csv_cells_that_look_like_formulas_are_defused():
    for text in ("=1", "+1", "-1", "@x", "\tx", "\rx"):
        assert csv_writer.defuse(text) == "'" + text
    assert csv_writer.defuse(-1.5) == -1.5
    assert csv_writer.defuse("a=b") == "a=b"
    blocks = list(csv_writer.csv_blocks([(1,) * 14] * 5, rows_per_block=2))
    assert b"".join(blocks).count(b"\r\n") == 6


def test_websocket_needs_session_and_own_origin(site):
    link = site.links["annotator"]
    assert connect(site.url) == 401
    assert connect(site.url, link=link) == 101
    assert connect(site.url, link=link, headers={"Origin": "http://elsewhere.example"}) == 403
    assert connect(site.url, link=link, headers={}) == 403
    assert connect(site.url, link=link, path="/r/1") == 401  # somebody else's


def test_port_in_use_is_one_clear_sentence(site):
    with pytest.raises(UserError, match=rf"port {site.front.port} .* is in use; choose another with --port"):
        Front(site.page, Listening(port=site.front.port)).start()


def test_viser_is_on_the_loopback_only(site):
    tables = [Path(f"/proc/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    sockets = [line.split() for table in tables for line in table]
    listening = [row[1].split(":") for row in sockets if row[3] == "0A"]
    at = {address for address, port in listening if int(port, 16) == site.page.port}
    assert at == {"0100007F"}  # 127.0.0.1, and nothing else


def test_a_revoked_rater_gets_another_link(site):
    store = site.trainer.store
    bo = next(r for r in store.accounts.raters() if r.name == "bo")
    store.accounts.revoke_tokens(bo.id)
    again = issue_link(store, read_secret(store.path.parent), bo, site.url)
    assert again != site.links["annotator"]
    assert fetch(site.url, "/", link=again)[0] == 200
    assert fetch(site.url, "/", link=site.links["annotator"])[0] == 401


@pytest.mark.parametrize(("host", "port"), [("a..b", 0), ("203.0.113.1", 0)])
def test_a_host_that_cannot_be_listened_on(site, host, port):
    with pytest.raises(UserError, match="cannot be opened"):
        check_port(host, port)
    with pytest.raises(UserError, match="cannot be opened"):
        Front(site.page, Listening(host=host, port=port, behind_proxy=True)).start()


def test_pictures_of_other_data_have_other_addresses(tmp_path):
    """Browsers keep a picture for good, and every data directory has a clip 1."""
    versions = set()
    for name in ("a", "b"):
        with closing(Store(tmp_path / name)) as store:
            for run in ("r", "s"):
                store.runs.add(run=run, demo="d", demo_sha256="0", seed=0, config="", version="0")
            versions |= {version_of(store, "r"), version_of(store, "s")}
            assert version_of(store, "r") == version_of(store, "r")
        time.sleep(0.002)
    assert len(versions) == 4
