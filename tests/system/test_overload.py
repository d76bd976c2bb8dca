"""A real front while somebody asks too much of it, or something behind it is stuck."""

from __future__ import annotations

import asyncio
import json
import sqlite3
import threading
import time
from contextlib import closing, contextmanager

import aiohttp
import pytest

from helpers.beside_playwright import run
from load.annotators import browser_session, open_tab
from onedemo.app.http import server
from onedemo.app.network.rate_limit import ACTIONS_WAITING, MESSAGES_AT_ONCE, PRESSES_AT_ONCE

pytestmark = pytest.mark.seam

UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


async def ask(session, url, method="GET", **options):
    """(Status, text) of one request."""
    async with session.request(method, url, allow_redirects=False, **options) as answer:
        return answer.status, await answer.text()


@contextmanager
def stuck(owner, name):
    """A method that does not return as long as this lasts."""
    go_on = threading.Event()
    before = getattr(owner, name)

    def wait(*args, **options):
        go_on.wait(60)
        return before(*args, **options)

    setattr(owner, name, wait)
    try:
        yield
    finally:
        go_on.set()
        setattr(owner, name, before)


def test_the_health_check_waits_for_nothing_that_is_stuck(site, monkeypatch):
    monkeypatch.setattr(server, "_HEALTH_S", 0.3)

    async def go():
        async with aiohttp.ClientSession() as session:
            asked = [asyncio.ensure_future(ask(session, f"{site.url}/healthz")) for _ in range(30)]
            await asyncio.sleep(0.1)
            began = time.monotonic()
            assert (await ask(session, f"{site.url}/login"))[0] == 200
            assert time.monotonic() - began < 30  # what is stuck is so for 60
            return await asyncio.gather(*asked)

    with stuck(site.trainer, "status"):
        said = run(go())
    assert {status for status, _ in said} == {503} and '"phase": "busy"' in said[0][1]


def test_actions_that_take_long_are_few_and_hinder_nobody_who_rates(site):
    async def go():
        async with browser_session() as session:
            ada = await open_tab(session, site.links["researcher"])
            bo = await open_tab(session, site.links["annotator"])
            await bo.until(lambda: bo.clip, "a clip")
            await ada.until(lambda: ada.token, "a page")
            asked = [asyncio.ensure_future(ada.do(do="pause run")) for _ in range(ACTIONS_WAITING + 8)]
            done, _ = await asyncio.wait(asked, timeout=20, return_when=asyncio.FIRST_COMPLETED)
            await bo.rate(3)
            go_on.__exit__(None, None, None)
            said = await asyncio.gather(*asked)
            for tab in (ada, bo):
                await tab.close()
            assert done
            return said

    go_on = stuck(site.front._actions, "do")
    go_on.__enter__()
    said = run(go())
    assert said.count(204) == ACTIONS_WAITING and said.count(503) == 8


def test_presses_faster_than_anybody_are_refused(site):
    async def go():
        async with browser_session() as session:
            tab = await open_tab(session, site.links["annotator"])
            await tab.until(lambda: tab.clip and tab.token, "a clip")
            said = []
            while 429 not in said and len(said) < 10 * PRESSES_AT_ONCE:
                said.append((await tab.post(press="undo", clip=99))[0])
            await asyncio.sleep(1)
            await tab.rate(4)  # a second later it goes on
            await tab.close()
            return said

    said = run(go())
    assert said[-1] == 429 and said.count(200) >= PRESSES_AT_ONCE


@pytest.mark.parametrize("flood", ["pings", "pongs", "fragments"])
def test_frames_that_are_no_messages_end_the_connection_too(site, flood):
    mask = b"\x80\0\0\0\0"
    frames = {"pings": b"\x89" + mask, "pongs": b"\x8a" + mask, "fragments": b"\x00" + mask}[flood]

    async def go():
        async with browser_session() as session:
            tab = await open_tab(session, site.links["annotator"])
            await tab.until(lambda: tab.clip, "a clip")
            await tab.socket.ping(b"one")
            await tab.rate(4)  # one is fine
            wire = tab.socket._response.connection.transport
            wire.write(b"\x02" + mask if flood == "fragments" else b"")
            for _ in range(1000):
                wire.write(frames * (MESSAGES_AT_ONCE if flood == "fragments" else 10))
                await asyncio.sleep(0)
                if wire.is_closing():
                    break
            done, _ = await asyncio.wait([tab._reader], timeout=30)
            assert done, "the connection goes on"
            await tab.close()

    run(go())


def test_opening_a_link_on_a_locked_or_full_database_says_so(site):
    db = site.trainer.store.database._db
    db.execute("PRAGMA busy_timeout = 100")

    async def go(link):
        async with aiohttp.ClientSession() as session:
            return await ask(session, link)

    with closing(sqlite3.connect(site.trainer.store.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        status, text = run(go(site.links["annotator"]))
        assert status == 503 and text.startswith("This could not be saved (database is locked)")
        other.execute("ROLLBACK")
    most = db.execute("PRAGMA max_page_count").fetchone()[0]
    db.execute("CREATE TABLE filler (data)")
    db.execute(f"PRAGMA max_page_count = {db.execute('PRAGMA page_count').fetchone()[0]}")
    with pytest.raises(sqlite3.OperationalError):
        while True:
            db.execute("INSERT INTO filler VALUES (zeroblob(1000))")
    for _ in range(200):  # until the pages that are there are full, too
        status, text = run(go(site.links["annotator"]))
        if status != 303:
            break
    db.execute(f"PRAGMA max_page_count = {most}")
    assert status == 503 and text.startswith("This could not be saved (database or disk is full)")
    assert run(go(site.links["annotator"]))[0] == 303


def test_hostile_values_get_a_short_4xx(site, caplog):
    """From somebody with a session, so that it reaches what is behind."""
    deep, huge = "[" * 4000, 2**70
    long = "a" * 300

    async def go():
        async with browser_session() as session:
            ada = await open_tab(session, site.links["researcher"])
            headers = ada.headers | {"Origin": site.url}

            async def said(path, body=None, **more):
                how = {"data": body, "headers": headers | more}
                return await ask(session, site.url + path, "GET" if body is None else "POST", **how)

            answers = {}
            for body in (
                deep, "9" * 5000, json.dumps({"do": "exclude", "rater": huge}), json.dumps({"do": deep}),
                json.dumps({"do": "new run", "demo": "hopper-backflip", "method": "onedemo", "seed": huge,
                            "name": "", "predictor_from": ""}),
                json.dumps({"do": "open run", "run": "é" * 300}), json.dumps({"press": "rate", "clip": huge}),
            ):  # fmt: skip
                for place in ("do", "press"):
                    answers[place, body[:40]] = await said(f"/r/1/{place}", body)
            for path in (
                "/preview?value=²", "/export.csv?value=²", f"/preview?value={'9' * 30}", "/preview?value=٣",
                f"/static/{long}.css", f"/static/{long * 8}.js", "/static/%00.css", "/static/\ud83d.css",
                f"/preview?rater={long}",
            ):  # fmt: skip
                answers[path[:40]] = await said(path.encode("utf-8", "replace").decode())
            answers["charset"] = await said("/r/1/do", "{}", **{"Content-Type": "a/b; charset=no-such"})
            answers["coding"] = await said("/r/1/do", "{}", **{"Content-Encoding": "no-such"})
            kind = {"Content-Type": "multipart/form-data; boundary=b"}
            part = '--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n1\r\n'
            for body in (
                500 * part,
                "--b\r\n" + "X: y\r\n" * 5000,
                f"--b\r\nX: {long * 100}",
                "--b\r\nX\r\n",
            ):
                answers[f"form {body[:40]!r}"] = await said("/demos", body + "\r\n\r\n--b--\r\n", **kind)
            for protocol in ("viser-v1.1.1, {", "a b", "é", "x" * 500, ",,,", "viser-v9" + "9" * 99):
                answers[f"protocol {protocol[:10]!r}"] = await said(
                    "/r/1", None, **UPGRADE, **{"Sec-WebSocket-Protocol": protocol}
                )
            await ada.close()
            return answers

    answers = run(go())
    wrong = {what: said for what, said in answers.items() if not 400 <= said[0] < 500 or len(said[1]) > 400}
    assert not wrong
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def test_the_port_closes_soon_whatever_is_under_way(site):
    """A film that is being drawn, a download that nobody takes, a page that does not answer."""

    async def go():
        async with browser_session() as session:
            ada = await open_tab(session, site.links["researcher"])
            film = asyncio.ensure_future(ask(session, f"{site.url}/rollouts/1.webm", headers=ada.headers))
            await asyncio.sleep(0.3)
            ada._reader.cancel()  # from now on nobody answers at the page
            began = time.monotonic()
            await asyncio.to_thread(site.front.close)
            taken = time.monotonic() - began
            await asyncio.gather(film, return_exceptions=True)
            await ada.close()
            return taken

    with stuck(site.trainer, "rollout_picture"):
        assert run(go()) < 30  # what is stuck is so for 60
    assert not site.front._thread.is_alive()
