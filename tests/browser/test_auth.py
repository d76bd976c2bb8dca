"""Who may come in and what they may say. Each thing that Viser by itself leaves open is a test here."""

from __future__ import annotations

import asyncio
import math
import re
import sqlite3
import ssl
import subprocess
import time
from contextlib import closing
from pathlib import Path

import aiohttp
import msgspec
import pytest

from helpers.beside_playwright import run
from helpers.paths import ROOT
from load.annotators import browser_session, open_tab
from onedemo.app.cli.main import main
from onedemo.app.http import viser_proxy
from onedemo.app.http.tokens import hash_token, passing_link, read_span
from onedemo.app.http.viser_protocol import known
from onedemo.app.network.bind import Listening
from onedemo.app.network.rate_limit import MESSAGES_AT_ONCE, WRONG_LINKS_AT_ONCE, Bucket, Buckets, Places
from onedemo.core.names import check_name, check_person
from onedemo.errors import UserError
from onedemo.storage.store import Store

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, -3.0, 1.0], "fov": 0.8,
    "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640, "look_at": [0.0, 0.0, 1.0],
    "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 3}}
TRIGGER = {"type": "CommandTriggerMessage", "uuid": "a"}


# Where it listens


def test_other_machines_are_let_in_only_with_tls_or_behind_a_proxy():
    for host in ("127.0.0.1", "::1", "localhost", "127.8.8.8"):
        Listening(host=host)
    for host in ("0.0.0.0", "::", "", "192.168.1.4", "example.org"):
        with pytest.raises(UserError, match="lets other machines in, and without TLS"):
            Listening(host=host)
        Listening(host=host, behind_proxy=True)
        Listening(host=host, tls_cert=Path("c"), tls_key=Path("k"))


@pytest.mark.parametrize(
    ("host", "fine"),
    [
        ("127.0.0.1:8080", True), ("[::1]:8080", True), ("localhost", True), ("LOCALHOST:1", True),
        ("192.168.1.4", True), ("study.example.org", True), ("study.example.org:443", True),
        ("Study.Example.org.", True), ("evil.example.org", False), ("example.org", False), ("", False),
        ("study.example.org.evil.org", False), ("127.0.0.1.evil.org", False), ("a b", False),
        ("study.example.org:x", False), ("[::1", False), ("127.0.0.1@evil.org", False),
    ],
)  # fmt: skip
def test_hosts_that_may_be_named(host, fine):
    assert Listening(names=("study.example.org",)).knows(host) == fine


def ask(url, path="/login", *, follow=False, **options):
    async def go():
        async with aiohttp.ClientSession() as session:
            method = options.pop("method", "GET")
            async with session.request(method, url + path, allow_redirects=follow, **options) as response:
                return response.status, response.headers, await response.text()

    return run(go())


@pytest.mark.seam
def test_a_strangers_name_for_this_machine_gets_nothing(site):
    """DNS rebinding: the browser believes evil.example to be this machine and says so in Host."""
    for path in ("/login", "/healthz", "/", "/static/login.css"):
        status, headers, text = ask(site.url, path, headers={"Host": "evil.example:8080"})
        assert status == 421 and "--allow-host" in text, path
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


@pytest.mark.seam
def test_the_page_can_be_served_encrypted(site, tmp_path):
    from onedemo.app.http.server import Front

    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost", "-keyout", tmp_path / "k.pem",
         "-out", tmp_path / "c.pem"],
        check=True, capture_output=True,
    )  # fmt: skip
    listening = Listening(host="127.0.0.1", port=0, tls_cert=tmp_path / "c.pem", tls_key=tmp_path / "k.pem")
    front = Front(site.page, listening)
    url = front.start().replace("127.0.0.1", "localhost")
    try:
        assert url.startswith("https://")
        trusted = ssl.create_default_context(cafile=tmp_path / "c.pem")
        link = site.links["annotator"].removeprefix(site.url)
        status, headers, _ = ask(url, link, ssl=trusted)
        assert status == 303 and "Secure" in headers["Set-Cookie"]
        assert headers["Strict-Transport-Security"] == "max-age=31536000"
        with pytest.raises(aiohttp.ClientError):
            ask(url.replace("https", "http"))
    finally:
        front.close()


@pytest.mark.seam
def test_a_proxy_is_believed_only_where_there_is_one(site):
    from onedemo.app.http.server import Front

    asked = {"X-Forwarded-For": "6.6.6.6, 10.0.0.9", "X-Forwarded-Proto": "https"}
    link = site.links["annotator"].removeprefix(site.url)
    plain = ask(site.url, link, headers=asked)[1]
    assert "Secure" not in plain["Set-Cookie"] and "Strict-Transport-Security" not in plain
    front = Front(site.page, Listening(port=0, behind_proxy=True))
    url = front.start()
    try:
        assert "Secure" in ask(url, link, headers=asked)[1]["Set-Cookie"]
        assert "Strict-Transport-Security" in ask(url, "/login?token=wrong", headers=asked)[1]
    finally:
        front.close()
    ask(site.url, "/login?token=wrong", headers=asked)
    who = [line[1] for line in site.trainer.store.audit.lines() if line[2] == "sign-in refused"]
    assert who == ["10.0.0.9", "127.0.0.1"]


# Links


@pytest.mark.seam
def test_a_link_that_opens_once_opens_once_and_for_nobody_who_only_looks(site):
    store = site.trainer.store
    bo = next(rater for rater in store.accounts.raters() if rater.name == "bo")
    link = passing_link(store, bo, site.url, once=True).removeprefix(site.url)
    token = link.split("token=")[1]
    for _ in range(3):  # mail scanners and previews
        status, headers, text = ask(site.url, link)
        assert status == 200 and "Your link works only once" in text
        assert re.match(r"onedemo-\d+-nonce=.*; Path=/login;", headers["Set-Cookie"])  # that lets nobody in
        assert ask(site.url, link, method="HEAD")[0] == 405
    elsewhere = {"Origin": "http://elsewhere.example"}
    assert ask(site.url, "/login", method="POST", data={"token": token}, headers=elsewhere)[0] == 403
    own = {"Origin": site.url}
    status, headers, _ = ask(site.url, "/login", method="POST", data={"token": token}, headers=own)
    assert status == 303 and "HttpOnly" in headers["Set-Cookie"]
    status, headers, text = ask(site.url, "/login", method="POST", data={"token": token}, headers=own)
    assert status == 403 and "was used already" in text and "Set-Cookie" not in headers
    assert "was used already" in ask(site.url, link, follow=True)[2]


@pytest.mark.seam
def test_a_link_ends_when_its_time_is_over(site):
    store = site.trainer.store
    bo = next(rater for rater in store.accounts.raters() if rater.name == "bo")
    link = passing_link(store, bo, site.url, lasts=read_span("1m")).removeprefix(site.url)
    assert ask(site.url, link)[0] == 303
    with closing(sqlite3.connect(store.path)) as db:  # the minute has gone by
        db.execute("UPDATE tokens SET expires_at = '2020-01-01T00:00:00.000Z' WHERE kind = 'link'")
        db.commit()
    status, _, text = ask(site.url, link, follow=True)
    assert status == 403 and "time of this link is over" in text
    state = {link.rater.name: link.state for link in store.accounts.links()}
    assert state["bo"] == "expired"


def test_only_hashes_of_tokens_are_kept(tmp_path):
    with closing(Store(tmp_path)) as store:
        bo = store.accounts.ensure("bo", "annotator")
        links = [passing_link(store, bo, "http://x", once=once) for once in (True, False)]
        store.accounts.open_link(hash_token(links[1].split("token=")[1]), hash_token("session"))
    kept = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    for link in links:
        token = link.split("token=")[1]
        assert len(token) >= 43 and token.encode() not in kept and hash_token(token).encode() in kept


def test_times_of_links():
    assert read_span("30m").total_seconds() == 1800 and read_span("7d").days == 7
    for wrong in ("", "7", "d", "0h", "-1d", "1.5h", "9999999d", "4000d", "1y", "٣d"):
        with pytest.raises(UserError, match="a time is a number with m, h or d"):
            read_span(wrong)


def test_links_are_listed_and_revoked_one_by_one(tmp_path, capsys):
    directory = ["--data-dir", str(tmp_path)]
    assert main(["rater", "add", "Ann", "--once", "--expires", "7d", *directory]) == 0
    assert main(["rater", "add", "Ann", *directory]) == 0
    made = capsys.readouterr().out.split()
    assert main(["rater", "links", *directory]) == 0
    told = capsys.readouterr().out
    assert re.search(r"1\s+Ann\s+annotator\s+open\s+once", told)
    assert not any(link.split("token=")[1] in told for link in made)
    assert main(["rater", "revoke", "--link", "1", *directory]) == 0
    assert main(["rater", "links", *directory]) == 0
    told = capsys.readouterr().out
    assert re.search(r"1\s+Ann\s+annotator\s+revoked", told) and re.search(
        r"2\s+Ann\s+annotator\s+open", told
    )
    assert main(["rater", "revoke", *directory]) == 2
    assert main(["rater", "revoke", "--link", "9", *directory]) == 2
    assert main(["audit", *directory]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and "made a link: for Ann" in lines[0] and "revoked a link: 1 of Ann" in lines[2]
    assert main(["audit", "--csv", str(tmp_path / "audit.csv"), *directory]) == 0
    assert (tmp_path / "audit.csv").read_text().splitlines()[0] == "at,who,what,detail"


@pytest.mark.seam
def test_revoking_ends_open_pages_within_two_seconds(site, monkeypatch):
    """By looks, each a second after the one before: how long that is on a busy machine, nobody knows."""
    store, looks = site.trainer.store, []
    ended = store.accounts.ended_sessions
    monkeypatch.setattr(
        store.accounts, "ended_sessions", lambda sessions: looks.append(ended(sessions)) or looks[-1]
    )

    async def go():
        async with browser_session() as session:
            bo, cy = [await open_tab(session, site.links[who]) for who in ("annotator", "second annotator")]
            for tab in (bo, cy):
                await tab.until(lambda tab=tab: tab.clip, "a clip")
            began = time.monotonic()
            before = len(looks)
            await asyncio.to_thread(
                store.accounts.revoke_tokens, next(r.id for r in store.accounts.raters() if r.name == "bo")
            )
            while not bo.socket.closed:
                assert time.monotonic() < began + 60, "the page stays open"
                await asyncio.sleep(0.05)
            seen = [bool(look) for look in looks[before:]]
            await cy.rate(3)  # nobody else's
            code = bo.socket.close_code
            for tab in (bo, cy):
                await tab.close()
            return seen, code

    seen, code = run(go())
    # One look may have been under way; the next one sees it.
    assert seen.index(True) <= 1 and viser_proxy._LOOK_S <= 1 and code == 1008
    assert len(site.events()) == 1


@pytest.mark.seam
def test_wrong_links_are_tried_only_so_often(site):
    async def go():
        async with aiohttp.ClientSession() as session:
            said = []
            for number in range(WRONG_LINKS_AT_ONCE + 3):
                async with session.get(f"{site.url}/login?token=wrong{number}") as response:
                    said.append(response.status)
            async with session.get(site.links["annotator"], allow_redirects=False) as response:
                said.append(response.status)
            return said

    said = run(go())
    assert said[:WRONG_LINKS_AT_ONCE] == [403] * WRONG_LINKS_AT_ONCE
    assert set(said[WRONG_LINKS_AT_ONCE:-1]) == {429}
    assert said[-1] == 303  # others at that address have links that work
    refused = [line for line in site.trainer.store.audit.lines() if line[2] == "sign-in refused"]
    assert len(refused) == 1  # a flood does not fill the log


# What may be said


def test_messages_of_the_page_are_known():
    for message in (CAMERA, UPDATE, TRIGGER):
        assert known(msgspec.msgpack.encode(message))
    for value in (True, -3, 2.5, "text", ""):
        assert known(msgspec.msgpack.encode(UPDATE | {"updates": {"value": value}})), value


@pytest.mark.parametrize(
    "message",
    [
        {"type": "ShareUrlRequest"},  # Viser's public tunnel
        {"type": "GuiFormDirtyMessage", "uuid": "a"},  # kept by Viser, and repeated to all
        {"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "b",
         "filename": "../x", "mime_type": "", "part_count": 1, "size_bytes": 1},  # into memory, unlimited
        {"type": "RunJavascriptMessage", "source": "1"},
        {"type": "GuiRemoveMessage", "uuid": "a"},
        UPDATE | {"updates": {"disabled": False}},  # any property of any element
        UPDATE | {"updates": {"value": 1, "visible": True}},
        UPDATE | {"updates": {}},
        UPDATE | {"updates": {"value": math.nan}},
        UPDATE | {"updates": {"value": math.inf}},
        UPDATE | {"updates": {"value": None}},
        UPDATE | {"updates": {"value": [1, 2]}},
        UPDATE | {"updates": {"value": "x" * 2001}},
        UPDATE | {"uuid": ""},
        UPDATE | {"uuid": "x" * 65},
        UPDATE | {"uuid": 3},
        UPDATE | {"more": 1},
        TRIGGER | {"more": 1},
        {"type": "CommandTriggerMessage"},
        CAMERA | {"fov": math.nan},
        CAMERA | {"position": [0.0, 0.0]},
        CAMERA | {"image_width": -1},
        CAMERA | {"wxyz": [1.0, 0.0, 0.0, "0"]},
        {},
        [],
        None,
        7,
    ],
)  # fmt: skip
def test_everything_else_is_not(message):
    assert not known(msgspec.msgpack.encode(message))


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\xff" * 50, b"\x91" * 5000, b"\xdf\xff\xff\xff\xff", b"{}"])
def test_bytes_that_are_no_message_are_not_known(data):
    assert not known(data)


@pytest.mark.seam
def test_unknown_messages_do_nothing_and_floods_end_the_connection(site):
    async def go():
        async with browser_session() as session:
            tab = await open_tab(session, site.links["annotator"])
            await tab.until(lambda: tab.clip, "a clip")
            for message in ({"type": "ShareUrlRequest"}, {"type": "GuiFormDirtyMessage", "uuid": "a"}):
                await tab._say(message)
            await tab.socket.send_bytes(b"\xc1")
            await tab.socket.send_str("text")
            await tab.rate(4)  # the page is as before
            assert not tab.socket.closed
            for _ in range(MESSAGES_AT_ONCE + 200):
                await tab._say(CAMERA)
            with pytest.raises(RuntimeError, match="ended its connection"):
                await tab.until(lambda: False, "nothing")
            code = tab.socket.close_code
            await tab.close()
            large = await open_tab(session, site.links["annotator"])
            await large.until(lambda: large.clip, "a clip")
            await large.socket.send_bytes(b"x" * (1 << 17))
            with pytest.raises(RuntimeError, match="ended its connection"):
                await large.until(lambda: False, "nothing")
            codes = (code, large.socket.close_code)
            await large.close()
            return codes

    assert run(go()) == (1008, 1009)
    assert [event[:1] for event in site.events()] == [("rate",)]
    assert site.page._server._websock_server._incoming_handlers == {}


@pytest.mark.seam
def test_one_person_opens_only_so_many_pages(site, monkeypatch):
    site.front._proxy._places = Places(3, 2)

    async def go():
        async with browser_session() as session:
            tabs = [await open_tab(session, site.links["annotator"]) for _ in range(2)]
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await open_tab(session, site.links["annotator"])
            tabs.append(await open_tab(session, site.links["researcher"]))
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await open_tab(session, site.links["second annotator"])
            await tabs.pop(0).close()
            await asyncio.sleep(0.3)
            tabs.append(await open_tab(session, site.links["second annotator"]))
            for tab in tabs:
                await tab.close()
            return refused.value.status

    assert run(go()) == 503


@pytest.mark.seam
def test_a_clip_that_somebody_else_holds_cannot_be_rated(site):
    """Each page answers only what is its own: neither another's clip nor another's page."""

    async def go():
        async with browser_session() as session:
            bo, cy = [await open_tab(session, site.links[who]) for who in ("annotator", "second annotator")]
            for tab in (bo, cy):
                await tab.until(lambda tab=tab: tab.clip and tab.token, "a clip")
            assert bo.clip != cy.clip
            before = cy.clip
            await asyncio.sleep(0.7)
            rating = {"press": "rate", "clip": cy.clip, "value": 3}
            assert await bo.post(**rating) == (200, '{"counted": false}')
            assert (await bo.post(**rating, page=cy.token))[0] == 410
            await asyncio.sleep(0.7)
            assert cy.clip == before
            for tab in (bo, cy):
                await tab.close()

    run(go())
    assert site.events() == []


# Limits


def test_a_bucket_gives_so_much_at_once_and_so_much_a_second():
    time_is = [0.0]
    bucket = Bucket(2.0, 3, clock=lambda: time_is[0])
    assert [bucket.take() for _ in range(4)] == [True, True, True, False] and bucket.empty
    time_is[0] = 0.5
    assert not bucket.empty and bucket.take() and not bucket.take()
    time_is[0] = 100.0
    assert not bucket.take(4) and bucket.take(3)


def test_addresses_do_not_fill_the_memory():
    buckets = Buckets(0.0, 1)
    assert buckets["a"].take()
    for number in range(10_000):
        buckets[f"{number}"].take()
    assert len(buckets._buckets) == 10_000 and buckets["a"].take()  # forgotten, so it begins anew
    assert not buckets["9999"].take()


# Names


@pytest.mark.parametrize(
    "name", ["Ann", "Ann B.", "Łukasz O'Neill", "李雷", "annotator-1", "a@b.org", "x" * 64]
)
def test_names_of_people(name):
    assert check_person(name) == name


@pytest.mark.parametrize(
    "name",
    [
        "", " ", "x" * 65, "<b>Ann</b>", "Ann/Bob", "..", "a\\b", "Ann\nBob", "Ann\x00", "Ann\x1b[31m",
        "Ann‮Bob", "‏Ann", "Ann​Bob", "A  B", "-a", "=1+1", 'a"b', "a;b", "a|b", "﻿Ann",
    ],
)  # fmt: skip
def test_names_that_would_mean_something_else_are_refused(name):
    with pytest.raises(UserError, match="a rater's name is 1 to 64 letters"):
        check_person(name)


@pytest.mark.parametrize("name", ["", "..", "a/b", "a b", "a\n", "ä", "x" * 65, ".hidden", "a\x00"])
def test_names_of_runs_and_demos_are_safe_as_files(name):
    with pytest.raises(UserError, match="a name is 1 to 64 letters"):
        check_name(name)


# The log


def test_the_audit_log_cannot_be_changed(tmp_path):
    with closing(Store(tmp_path)) as store:
        store.audit.add("bo", "did", "x\x1b[31m\n‮y" + "z" * 600)
        ((_, who, what, detail),) = store.audit.lines()
        assert (who, what) == ("bo", "did") and detail.isprintable() and len(detail) == 500
    with closing(sqlite3.connect(store.path)) as db:
        for statement in ("DELETE FROM audit", "UPDATE audit SET who = 'cy'"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                db.execute(statement)


@pytest.mark.seam
def test_what_researchers_do_is_in_the_log(site):
    async def go():
        jar = aiohttp.CookieJar(unsafe=True)
        async with aiohttp.ClientSession(cookie_jar=jar, headers={"Origin": site.url}) as session:
            await (await session.get(site.links["researcher"])).read()
            exports = (
                "export.csv?run=backflip-1",
                "segments.parquet",
                "card.md",
                "comparisons.csv",
                "skips.csv",
            )
            for path in exports:
                await (await session.get(f"{site.url}/{path}")).read()
        async with browser_session() as session:
            tab = await open_tab(session, site.links["researcher"])
            await tab.until(lambda: "alt+2" in tab.keys, "the tab Watch")
            await tab.press("alt+2")
            await tab.until(lambda: "alt+P" in tab.keys, "keys")
            for rater in (2, 99):
                await tab.do(do="exclude", rater=rater)
            await tab.press("alt+P")
            await asyncio.sleep(0.5)
            await tab.close()

    run(go())
    lines = [(who, what, detail) for _, who, what, detail in site.trainer.store.audit.lines()]
    assert [line[1] for line in lines] == [
        "signed in", "downloaded ratings", "downloaded segments", "downloaded the data card",
        "downloaded comparisons", "downloaded skips", "exclude", "paused the run",
    ]  # fmt: skip
    assert {line[0] for line in lines} == {"ada"}
    assert lines[1][2] == "run=backflip-1" and lines[6][2] == "rater 2; run backflip-1"


# What is read


def test_nothing_that_is_loaded_can_run_code():
    """No file is a pickle: weights and arrays are read as data alone."""
    runs_code = r"allow_pickle=True|weights_only=False|(?<![.\w])(eval|exec)\("
    loads = 0
    for path in [*ROOT.glob("app/**/*.py"), *ROOT.glob("trainer/**/*.py")]:
        text = path.read_text()
        assert not re.search(r"^\s*(import|from) (shelve|dill|joblib|marshal)\b|from pickle", text, re.M), (
            path
        )
        if path.name != "drawing_process.py":  # what goes through a pipe between two processes of ours
            assert not re.search(r"\bpickle\.(?!UnpicklingError)", text), path  # torch's own error
        assert not re.search(runs_code, text), path
        for found in re.finditer(r"(torch\.load|np\.load)\(((?:[^()]|\([^()]*\))*)\)", text):
            wanted = "weights_only=True" if found[1] == "torch.load" else "allow_pickle=False"
            assert wanted in found[2], f"{path}: {found[0]}"
            loads += 1
    assert loads >= 8
