"""Inviting and revoking from a page: over a real front, without Viser; and what the links are."""

from __future__ import annotations

import html
import re
from contextlib import closing
from datetime import UTC, datetime, timedelta

import pytest

from helpers.beside_playwright import run
from onedemo.app.cli.main import main
from onedemo.app.http.invitations import check_address, invite, page_address
from onedemo.app.network.bind import Listening
from onedemo.app.tabs.start import ago, people_of
from onedemo.errors import UserError
from onedemo.storage.accounts import Presence
from onedemo.storage.store import Store
from onedemo.types import Rater
from unit.http.test_people_in_a_browser import browser, front, link_of

INVITE = {"do": "invite", "names": "Ann", "role": "annotator", "expires": "", "once": False, "address": ""}


@pytest.fixture
def store(tmp_path):
    with closing(Store(tmp_path)) as store:
        store.database._db.execute("PRAGMA synchronous = OFF")
        yield store


def names(store):
    return [rater.name for rater in store.accounts.raters()]


def audit(store):
    return [(who, what, detail) for _, who, what, detail in store.audit.lines() if what != "signed in"]


def links_in(text):
    return [html.unescape(link) for link in re.findall(r'value="(http[^"]*)"', text)]


def as_researcher(store, steps, **options):
    """Runs ``steps(door, ada)`` with Ada's browser at a front."""

    async def go():
        async with front(store, **options) as door, browser(door) as ada:
            await ada.get(link_of(store, door.url, "ada", "researcher"))
            await steps(door, ada)

    run(go())


def test_twenty_are_invited_at_once_and_each_link_lets_its_owner_in(store):
    async def steps(door, ada):
        wanted = [f"Rater {k}" for k in range(20)]
        answer = await ada.post("/r/1/do", body=INVITE | {"names": "\n".join([*wanted, "", " Rater 3 "])})
        assert answer.status == 200 and answer.headers["Content-Type"].startswith("text/html")
        links = links_in(answer.text)
        assert len(links) == len(set(links)) == 20 and answer.text.count("<svg") == 20
        assert all(link.startswith(f"{door.url}/login?token=") for link in links)
        assert "on this computer only" in answer.text  # the front listens on the loopback
        async with browser(door) as new:
            assert (await new.get(links[7])).headers["Location"] == "/r/9/"
            assert (await new.get("/r/9/session")).status == 204
        again = await ada.post("/r/1/do", body=INVITE | {"names": "Rater 7"})
        assert links_in(again.text) == [links[7]] and "It opens on this computer only" in again.text
        assert names(store) == ["ada", *wanted]
        assert audit(store)[:1] == [("ada", "made a link", "for Rater 0, annotator (standing)")]
        assert len(audit(store)) == 21

    as_researcher(store, steps)


def test_a_link_may_open_once_expire_and_make_a_researcher(store):
    async def steps(door, ada):
        body = INVITE | {"role": "researcher", "expires": "12h", "once": True}
        (link,) = links_in((await ada.post("/r/1/do", body=body)).text)
        (made,) = [link for link in store.accounts.links() if link.rater.name == "Ann"]
        assert made.once and made.state == "open" and made.rater.role == "researcher"
        left = datetime.fromisoformat(made.expires_at) - datetime.now(UTC)
        assert timedelta(hours=11.9) < left <= timedelta(hours=12)
        assert audit(store) == [("ada", "made a link", "for Ann, researcher (once, 12h)")]
        assert links_in((await ada.post("/r/1/do", body=body)).text) != [link]  # nobody can print it again

    as_researcher(store, steps)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"names": "Bob\n<i>"}, "a rater's name is 1 to 64 letters"),
        ({"names": "Bob\nNA"}, "'NA' means a missing value"),
        ({"names": "Bob\nada"}, "rater 'ada' exists already as researcher"),
        ({"names": "Bob\nADA"}, "'ADA' and 'ada' would be two people"),
        ({"names": "bob\nBob"}, "would be two people"),
        ({"names": "\n \n"}, "name 1 to 100 people, one on each line; got 0"),
        ({"names": "\n".join(f"P{k}" for k in range(101))}, "got 101"),
        ({"names": ["Bob"]}, "the action takes names, role"),
        ({"role": "simulated"}, "invited as annotator or researcher"),
        ({"expires": "soon"}, "a time is a number with m, h or d"),
        ({"once": "yes"}, "the action takes role, expires, once, address"),
        ({"address": "javascript:alert(1)"}, "an address is such as https://study.example.org"),
        ({"address": "https://a.example/?x="}, "an address is such as"),
        ({"more": 1}, "the action takes"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_invites_nobody(store, changed, sentence):
    async def steps(door, ada):
        answer = await ada.post("/r/1/do", body=INVITE | {"names": "Bob"} | changed)
        assert answer.status == 400 and sentence in answer.text and answer.text.count("\n") == 0
        assert names(store) == ["ada"] and audit(store) == []

    as_researcher(store, steps)


def test_annotators_and_strangers_may_do_none_of_it(store):
    async def go():
        async with front(store) as door, browser(door) as bo, browser(door) as nobody:
            ada = store.accounts.ensure("ada", "researcher")
            await bo.get(link_of(store, door.url, "bo"))
            link = store.accounts.links()[0].id
            for body in (
                INVITE | {"role": "researcher"}, {"do": "revoke", "rater": ada.id},
                {"do": "revoke", "rater": 2}, {"do": "revoke link", "link": link},
            ):  # fmt: skip
                for path in ("/r/2/do", "/r/1/do"):
                    assert (await bo.post(path, body=body)).status in (401, 403), (path, body)
                assert (await nobody.post("/r/1/do", body=body)).status == 401
            assert (await bo.get("/r/2/session")).status == 204
            assert names(store) == ["ada", "bo"] and audit(store) == []
            # Nor does a researcher whose request names no page, or comes from elsewhere.
            await bo.get(link_of(store, door.url, "ada", "researcher"))
            assert (await bo.post("/r/1/do", page="other", body=INVITE)).status == 409
            other = {"Origin": "http://evil.example", "X-Onedemo-Page": "open"}
            assert (await bo.get("/r/1/do", method="POST", body=INVITE, **other)).status == 403
            assert names(store) == ["ada", "bo"]

    run(go())


def test_revoking_ends_sessions_and_links_and_oneself_only_when_sure(store):
    async def steps(door, ada):
        async with browser(door) as bo, browser(door) as elsewhere:
            await bo.get(link_of(store, door.url, "bo"))
            await elsewhere.get(
                links_in((await ada.post("/r/1/do", body=INVITE | {"names": "bo", "once": True})).text)[0]
            )
            one_off = store.accounts.links()[-1]
            assert (await ada.post("/r/1/do", body={"do": "revoke link", "link": one_off.id})).status == 204
            assert (await bo.get("/r/2/session")).status == 204
            assert (await ada.post("/r/1/do", body={"do": "revoke", "rater": 2})).status == 204
            told = await bo.get("/r/2/session")
            assert told.status == 401 and "Your link was revoked" in told.text
        for body in ({"do": "revoke link", "link": 99}, {"do": "revoke", "rater": 99}, {"do": "revoke"}):
            assert (await ada.post("/r/1/do", body=body)).status == 400
        own = store.accounts.links()[0].id
        for body in ({"do": "revoke", "rater": 1}, {"do": "revoke link", "link": own}):
            for sure in ({}, {"sure": False}, {"sure": 1}):
                answer = await ada.post("/r/1/do", body=body | sure)
                assert answer.status == 400 and "would close your own page" in answer.text
        assert (await ada.get("/r/1/session")).status == 204
        assert (await ada.post("/r/1/do", body={"do": "revoke", "rater": 1, "sure": True})).status == 204
        assert (await ada.get("/r/1/session")).status == 401
        assert [line[1:] for line in audit(store) if line[1].startswith("revoked")] == [
            ("revoked a link", f"{one_off.id} of bo"), ("revoked a rater", "bo"), ("revoked a rater", "ada"),
        ]  # fmt: skip

    as_researcher(store, steps)


@pytest.mark.parametrize(
    ("options", "origin", "address"),
    [
        ({}, "http://127.0.0.1:8080", "http://127.0.0.1:8080"),
        ({}, "http://localhost:9000", "http://localhost:9000"),  # a tunnel
        ({"base_path": "/study1"}, "http://127.0.0.1:8080", "http://127.0.0.1:8080/study1"),
        ({"behind_proxy": True, "base_path": "/a"}, "https://lab.example", "https://lab.example/a"),
        # Opened on the server itself, where nobody else has it.
        (
            {"behind_proxy": True, "names": ("lab.example",), "base_path": "/a"},
            "http://127.0.0.1:8080",
            "https://lab.example/a",
        ),
    ],
)
def test_links_begin_with_the_address_that_people_have(options, origin, address):
    assert page_address(Listening(**options), 8080, origin) == address


def test_an_address_of_one_s_own_is_used_and_its_slash_is_not(store):
    async def steps(door, ada):
        answer = await ada.post("/r/1/do", body=INVITE | {"address": "https://lab.example:8443/a/"})
        assert links_in(answer.text)[0].startswith("https://lab.example:8443/a/login?token=")
        assert "on this computer only" not in answer.text

    as_researcher(store, steps, base_path="/study")
    assert check_address("http://[::1]:8080") == "http://[::1]:8080"


def test_the_command_line_and_the_page_make_the_same_link(store, capsys):
    (made,) = invite(store, ["Ann"], "annotator", "http://127.0.0.1:8080", by="ada")
    assert main(["rater", "add", "Ann", "--data-dir", str(store.path.parent)]) == 0
    assert capsys.readouterr().out.strip() == made.url
    with pytest.raises(UserError, match="exists already as annotator"):
        invite(store, ["Zoe", "Ann"], "researcher", "http://x", by="ada")
    assert names(store) == ["Ann"]


def test_the_list_of_people_says_what_became_of_each_link(store):
    for person in ("Ann", "Bob"):
        invite(store, [person], "annotator", "http://x", by="ada", once=person == "Bob")
    store.accounts.ensure("oracle", "simulated")
    ann, bob, _ = store.accounts.raters()
    store.accounts.add_token("s1", ann.id, "session", lasts=timedelta(days=1))
    store.accounts.note_use(["s1"])
    presence = store.accounts.presence()
    assert presence[ann.id].browsers == 1 and presence[bob.id] == Presence(0, None)
    store.accounts.revoke_tokens(bob.id)
    invite(store, ["Bob"], "annotator", "http://x", by="ada", expires="1d")
    people = people_of(
        store.accounts.raters(), store.accounts.links(), store.accounts.presence(), {"Ann": 7}, {bob.id},
        now=datetime.now(UTC),
    )  # fmt: skip
    assert [person.name for person in people] == ["Ann", "Bob"]
    one, other = people
    assert (one.ratings, one.seen, one.excluded, one.open, one.older) == (7, "now", False, True, 0)
    assert (other.ratings, other.seen, other.excluded, other.older) == (0, "", True, 1)
    assert [link.state for link in other.links] == ["open"]
    store.accounts.revoke_tokens(bob.id)
    (_, other) = people_of([ann, bob], store.accounts.links(), {}, {}, set(), now=datetime.now(UTC))
    assert [link.state for link in other.links] == ["revoked"] and not other.open
    assert people_of([Rater(id=9, name="x", role="annotator")], [], {}, {}, set(), now=datetime.now(UTC))


def test_times_in_words():
    now = datetime(2026, 11, 29, 12, tzinfo=UTC)
    told = [
        ago((now - timedelta(seconds=s)).isoformat(), now) for s in (-2, 59, 61, 3599, 3600, 86400, 200_000)
    ]
    assert told == ["now", "now", "1 min ago", "59 min ago", "1 h ago", "1 day ago", "2 days ago"]
    assert ago(None, now) == ""
