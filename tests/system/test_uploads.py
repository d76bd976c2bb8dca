"""Videos over HTTP, through the real access: who may, what is refused, what stays behind."""

import asyncio
import re

import aiohttp
import pytest
from aiohttp import web

from helpers.beside_playwright import run
from onedemo.app.http import uploads
from onedemo.app.http.auth import PAGE_HEADER, AccessControl, Route
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.http.uploads import Uploads
from onedemo.app.network.bind import Listening
from onedemo.core.directories import Workshop
from onedemo.demos.library import find_demo, read_frames
from onedemo.storage.store import Store
from unit.demos.test_library import make_video

pytestmark = pytest.mark.seam


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return make_video(tmp_path_factory.mktemp("video") / "move.mp4").read_bytes()


@pytest.fixture
def store(tmp_path):
    with_people = Store(tmp_path)
    yield with_people
    with_people.close()


def visit(store, what, *, role="researcher", **limits):
    """Opens a access with this one address, logs somebody in, and does ``what(session, url)``."""

    async def go():
        port = 0
        access = AccessControl(store, Listening(port=0), lambda: port, lambda *_: True)
        taken = Uploads(store.path.parent, **limits)
        routes = [
            Route("GET", "/login", "stranger", access.log_in),
            Route("POST", "/demos", "researcher", taken.add),
        ]
        runner = web.AppRunner(access.application(routes), shutdown_timeout=1)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        port = runner.addresses[0][1]
        url = f"http://127.0.0.1:{port}"
        try:
            async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
                if role != "stranger":
                    rater = store.accounts.ensure("a-" + role, role)
                    link = issue_link(store, read_secret(store.path.parent), rater, url)
                    await session.get(link, allow_redirects=False)
                return await what(session, url)
        finally:
            await runner.cleanup()

    return run(go())


told = []
"""The names of demos that were told beside the answers."""


def send(store, content, *, origin=None, filename="../../evil.mp4", role="researcher", limits=None, **fields):
    async def post(session, url):
        form = aiohttp.FormData()
        for name, value in ({"name": "kick"} | fields).items():
            form.add_field(name, value)
        form.add_field("video", content, filename=filename, content_type="video/mp4")
        headers = {"Origin": origin or url, PAGE_HEADER: "a"}
        async with session.post(url + "/demos", data=form, headers=headers) as answer:
            told.append(answer.headers.get("X-Demo"))
            return answer.status, await answer.text()

    return visit(store, post, role=role, **(limits or {}))


def left(store):
    here = store.path.parent
    return [p.name for p in [*(here / "uploads").glob("*"), *(here / "demos").glob("*")]]


def test_a_video_becomes_a_demo(store, video):
    status, said = send(store, video, start="0.2", end="0.8", crop="8, 40, 48, 40", mirror="on")
    assert (status, said) == (200, "kick is a demo now: 0.6 s, 18 frames.")
    demo = find_demo("kick", store.path.parent / "demos")
    assert (demo.frames, demo.source) == (18, "uploaded")
    assert read_frames(demo).shape[1:] == (40, 48, 3)
    assert left(store) == [demo.sha256]  # nothing named by the client, nothing temporary


def test_a_video_that_is_known_keeps_its_name(store, video):
    """The page offers the name that is told, not the one that was typed."""
    assert send(store, video)[1] == "kick is a demo now: 1.0 s, 30 frames."
    status, said = send(store, video, name="punch", end="9")
    assert (status, said) == (200, "This video is known already, as kick: 1.0 s, 30 frames.")
    assert told[-2:] == ["kick", "kick"]


def test_a_video_may_be_larger_than_other_requests(store, video):
    assert send(store, video + b"\0" * 300_000)[0] == 200


@pytest.mark.parametrize(("role", "status"), [("stranger", 401), ("annotator", 403)])
def test_only_researchers_may(store, video, role, status):
    assert send(store, video, role=role)[0] == status
    assert left(store) == []


def test_only_from_the_page(store, video):
    assert send(store, video, origin="http://evil.example")[0] == 403
    assert left(store) == []


@pytest.mark.parametrize(
    ("content", "fields", "words"),
    [
        (b"\0hello " * 999, {}, "The video is not a video that can be read"),
        (b"hello " * 999, {}, "The video is a text file"),
        (b"", {}, r"^The video is empty \(0 bytes\): copy or download it again\.$"),
        (b"<!doctype html><html>", {}, "^The video is a web page: download the video itself"),
        (None, {"name": "../up"}, "name"),
        (None, {"name": "a\u202eb"}, "name"),
        (None, {"name": "x" * 5000}, "Name is up to 200"),
        (None, {"start": "9"}, "Start 9 is past the end of the video"),
        (None, {"start": "nan"}, "Start is a number"),
        (None, {"crop": "1,2,3"}, "The part of the video must be four whole numbers"),
        (None, {"crop": "0,0,9999,9999"}, "[Cc]rop"),
        (None, {"owner": "me"}, "has the fields"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(store, video, content, fields, words):
    status, said = send(store, video if content is None else content, **fields)
    assert status == 400 and re.search(words, said), said
    assert str(store.path.parent) not in said and "\n" not in said
    assert left(store) == []


def test_too_large(store, video):
    status, said = send(store, video, limits={"largest": 1000})
    assert status == 400 and "larger than" in said
    assert left(store) == []


def slow(video, wait):
    async def body():
        yield video[:500]
        await wait()

    return body


async def begin(session, url, wait, video):
    with aiohttp.MultipartWriter("form-data") as form:
        part = form.append("kick")
        part.set_content_disposition("form-data", name="name")
        part = form.append(slow(video, wait)())
        part.set_content_disposition("form-data", name="video", filename="a.mp4")
    return await session.post(url + "/demos", data=form, headers={"Origin": url, PAGE_HEADER: "a"})


def test_one_that_never_ends_is_given_up(store, video):
    async def what(session, url):
        answer = await begin(session, url, lambda: asyncio.sleep(3), video)
        return answer.status, await answer.text()

    status, said = visit(store, what, longest=0.5)
    assert status == 408 and "did not arrive within 0.5 s" in said
    assert left(store) == []


def test_so_many_at_once_and_nothing_of_those_that_break_off(store, video):
    async def what(session, url):
        never = asyncio.Event()
        tasks = [asyncio.ensure_future(begin(session, url, never.wait, video)) for _ in range(2)]
        for _ in range(100):
            await asyncio.sleep(0.05)
            if len(left(store)) == uploads.MOST_AT_ONCE:
                break
        during = left(store)
        third = await begin(session, url, lambda: asyncio.sleep(0), video)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for _ in range(100):
            if not left(store):
                break
            await asyncio.sleep(0.05)
        after = left(store)
        again = await begin(session, url, lambda: asyncio.sleep(0), video)
        return during, third.status, after, again.status

    during, third, after, again = visit(store, what)
    assert len(during) == 2 and third == 503
    assert after == [] and again == 400  # half a video is no video, but it was taken


def test_what_a_killed_server_left_is_removed(tmp_path):
    (tmp_path / "uploads").mkdir()
    (tmp_path / "uploads" / "upload-x").write_bytes(b"x")
    Uploads(tmp_path)
    assert list((tmp_path / "uploads").iterdir()) == []


def test_a_second_server_leaves_the_uploads_of_the_first_alone(tmp_path):
    (tmp_path / "uploads").mkdir()
    (tmp_path / "demos").mkdir()
    with Workshop(tmp_path / "uploads", "upload-") as one, Workshop(tmp_path / "demos", ".import-") as two:
        (one / "video").write_bytes(b"on its way")
        Uploads(tmp_path)
        assert (one / "video").read_bytes() == b"on its way" and two.exists()
