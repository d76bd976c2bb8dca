"""Videos over HTTP, through the real access: who may, what is refused, what stays behind."""

import asyncio
import re
import zipfile

import aiohttp
import cv2
import numpy as np
import pytest
from aiohttp import web

from helpers.beside_playwright import run
from onedemo.app.admin.backup import back_up
from onedemo.app.http import uploads
from onedemo.app.http.auth import PAGE_HEADER, AccessControl, Route
from onedemo.app.http.tokens import issue_link, read_secret
from onedemo.app.http.uploads import Uploads
from onedemo.app.network.bind import Listening
from onedemo.core.directories import Workshop
from onedemo.demos.library import find_demo, list_demos, read_frames
from onedemo.storage.store import Store
from unit.demos.test_library import make_video, number_of

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
    """Opens a access with the addresses of uploads, logs somebody in, and does ``what(session, url)``."""

    async def go():
        port = 0
        access = AccessControl(store, Listening(port=0), lambda: port, lambda *_: True)
        taken = Uploads(store.path.parent, **limits)
        routes = [
            Route("GET", "/login", "stranger", access.log_in),
            Route("GET", r"/demos/{demo:[0-9a-f]{64}}.jpg", "researcher", taken.picture),
            Route("POST", "/demos", "researcher", taken.add),
            Route("GET", "/demos/{upload}/poster.jpg", "researcher", taken.poster),
            Route("POST", "/demos/{upload}/result", "researcher", taken.bring_in),
            Route("GET", "/demos/{upload}/result-{result}.webm", "researcher", taken.result),
            Route("GET", "/demos/{upload}/result-{result}-{end}.jpg", "researcher", taken.still),
            Route("POST", "/demos/{upload}/keep", "researcher", taken.keep),
            Route("POST", "/demos/{upload}/discard", "researcher", taken.discard),
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
            taken.close()
            await runner.cleanup()

    return run(go())


class Refused(Exception):
    """An answer that is not 200."""


class Sender:
    """What static/demos.js does."""

    def __init__(self, session, url, origin=None):
        self.session, self.url = session, url
        self.headers = {"Origin": origin or url, PAGE_HEADER: "a"}

    async def post(self, path, **what):
        async with self.session.post(self.url + path, headers=self.headers, **what) as answer:
            if answer.status not in (200, 204):
                raise Refused(answer.status, await answer.text())
            return await answer.json() if answer.status == 200 else None

    async def get(self, path):
        async with self.session.get(self.url + path) as answer:
            return answer.status, await answer.read()

    async def add(self, content, field="video", filename="../../evil.mp4"):
        form = aiohttp.FormData()
        form.add_field(field, content, filename=filename, content_type="video/mp4")
        return await self.post("/demos", data=form)

    async def keep(self, upload, name="kick"):
        return await self.post(f"/demos/{upload}/keep", params={"name": name})


def send(store, content, *, origin=None, role="researcher", limits=None, name="kick", field="video", **part):
    """All steps: the last answer, or the status and sentence of the one that was refused."""

    async def go(session, url):
        sender = Sender(session, url, origin)
        try:
            there = await sender.add(content, field)
            facts = await sender.post(f"/demos/{there['upload']}/result", json=part)
            return 200, facts | await sender.keep(there["upload"], name)
        except Refused as refused:
            return refused.args

    return visit(store, go, role=role, **(limits or {}))


def left(store):
    here = store.path.parent
    return [p.name for p in [*(here / "uploads").glob("*"), *(here / "demos").glob("*")]]


def test_a_video_becomes_a_demo(store, video):
    status, said = send(store, video, start=0.2, end=0.8, crop=[8, 40, 48, 40], mirror=True)
    assert status == 200 and (said["name"], said["known"]) == ("kick", False)
    assert (said["frames"], said["fps"], said["width"], said["height"]) == (18, 30.0, 48, 40)
    demo = find_demo("kick", store.path.parent / "demos")
    assert (demo.frames, demo.source) == (18, "uploaded")
    assert read_frames(demo).shape[1:] == (40, 48, 3)
    assert left(store) == [demo.sha256]  # nothing named by the client, nothing temporary


def test_a_video_that_is_known_keeps_its_name(store, video):
    """The page offers the name that is told, not the one that was typed."""
    assert send(store, video)[1]["name"] == "kick"
    status, said = send(store, video, name="punch", end=9)
    assert (status, said["name"], said["known"]) == (200, "kick", True)


def test_a_part_is_looked_at_and_chosen_anew_without_sending_the_video_again(store, video):
    """What is looked at is what is kept, and is in no library before."""
    here = store.path.parent

    async def what(session, url):
        sender = Sender(session, url)
        there = await sender.add(video)
        assert (there["width"], there["height"], there["fps"]) == (160, 96, 30.0)
        assert there["seconds"] == pytest.approx(1, abs=0.05)
        at = f"/demos/{there['upload']}"
        pictures = [await sender.get(f"{at}/poster.jpg?at={second}") for second in ("0", "0.5", "99")]
        decoded = [cv2.imdecode(np.frombuffer(data, np.uint8), 1) for _, data in pictures]
        assert [number_of(image) for image in decoded] == [0, 15, 29]
        with pytest.raises(Refused, match="look at the result first"):
            await sender.keep(there["upload"])
        await sender.post(f"{at}/result", json={})
        facts = await sender.post(f"{at}/result", json={"start": 0.5, "end": None, "crop": None})
        assert (facts["frames"], facts["known"]) == (15, None)
        assert facts["warnings"] == ["The picture is only 160 x 96 pixels; details will be hard to see."]
        assert (await sender.get(f"{at}/result-1.webm"))[0] == 404  # of before
        status, film = await sender.get(f"{at}/result-{facts['result']}.webm")
        assert status == 200 and film[:4] == b"\x1aE\xdf\xa3"
        assert list_own(here) == []
        with pytest.raises(Refused, match="A name is 1 to 64"):
            await sender.keep(there["upload"], "no/slash")
        kept = await sender.keep(there["upload"], "half")
        demo = find_demo("half", here / "demos")
        assert demo.path.read_bytes() == film and kept == {"name": "half", "known": False}
        picture = await sender.get(f"/demos/{demo.sha256}.jpg")
        assert picture[0] == 200 and picture[1][:2] == b"\xff\xd8"
        assert (await sender.get(f"/demos/{'0' * 64}.jpg"))[0] == 404
        with pytest.raises(Refused, match="not here any more"):
            await sender.keep(there["upload"], "again")

    visit(store, what)
    assert list_own(here) == ["half"] and list((here / "uploads").iterdir()) == []


def test_a_result_stays_where_the_next_cannot_be_made(store, video):
    """It is what is seen, and what is kept, with its first and its last frame."""
    here = store.path.parent

    async def what(session, url):
        sender = Sender(session, url)
        at = f"/demos/{(await sender.add(video))['upload']}"
        assert (await sender.get(f"{at}/result-0-first.jpg"))[0] == 404
        part = {"start": 0.2, "speed": 2, "reverse": True, "loop": True}
        facts = await sender.post(f"{at}/result", json=part)
        done = "from 0.2 s on, 2 times as fast, backwards, repeated to fill 8 s"
        assert (facts["seconds"], facts["edits"]) == (8.0, done)
        for _ in range(2):
            with pytest.raises(Refused, match="“Hold the background still” finds no background"):
                await sender.post(f"{at}/result", json=part | {"stabilise": True})
        ends = [await sender.get(f"{at}/result-{facts['result']}-{end}.jpg") for end in ("first", "last")]
        decoded = [cv2.imdecode(np.frombuffer(data, np.uint8), 1) for _, data in ends]
        assert [number_of(image) for image in decoded] == [28, 6]
        assert (await sender.get(f"{at}/result-{facts['result']}.webm"))[0] == 200
        assert len(list((here / "uploads").glob("*/result-*"))) == 1
        await sender.keep(at.split("/")[-1], "back")

    visit(store, what)
    demo = find_demo("back", here / "demos")
    assert [number_of(frame) for frame in read_frames(demo)[:12]] == list(range(28, 4, -2))


def list_own(here):
    return [demo.name for demo in list_demos(here / "demos") if demo.path.is_relative_to(here)]


def test_what_is_neither_kept_nor_discarded_goes(store, video):
    uploads_dir = store.path.parent / "uploads"

    async def what(session, url):
        sender = Sender(session, url)
        first = (await sender.add(video))["upload"]
        assert len(list(uploads_dir.iterdir())) == 1
        await sender.post(f"/demos/{first}/discard")
        assert list(uploads_dir.iterdir()) == []
        names = [(await sender.add(video))["upload"] for _ in range(uploads.MOST_WAITING + 1)]
        assert len(list(uploads_dir.iterdir())) == uploads.MOST_WAITING
        assert [(await sender.get(f"/demos/{name}/poster.jpg"))[0] for name in names[:2]] == [404, 200]

    visit(store, what)
    assert list(uploads_dir.iterdir()) == []

    async def forgotten(session, url):
        await Sender(session, url).add(video)
        for _ in range(200):
            if not list(uploads_dir.iterdir()):
                return
            await asyncio.sleep(0.05)
        raise AssertionError("it is still there")

    visit(store, forgotten, wait=0.3)


def test_no_backup_saves_what_waits(store, video, tmp_path_factory):
    file = tmp_path_factory.mktemp("backup") / "all.zip"

    async def what(session, url):
        sender = Sender(session, url)
        there = await sender.add(video)
        await sender.post(f"/demos/{there['upload']}/result", json={})
        assert len([path for path in (store.path.parent / "uploads").rglob("*") if path.is_file()]) == 3
        return await asyncio.to_thread(back_up, store.path.parent, file)

    saved = visit(store, what)
    assert saved.left_out == []
    assert not [name for name in zipfile.ZipFile(file).namelist() if "upload" in name or "demos" in name]


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
        (None, {"name": "x" * 5000}, "A name is 1 to 64"),
        (None, {"start": 9}, "Start 9 is past the end of the video"),
        (None, {"start": "nan"}, "Start is a number"),
        (None, {"end": True}, "End is a number"),
        (None, {"crop": [1, 2, 3]}, "The part of the picture is four whole numbers"),
        (None, {"crop": [0, 0, 9999, 9999]}, "[Cc]rop"),
        (None, {"crop": [-5, 0, 64, 64]}, "[Cc]rop"),
        (None, {"owner": "me"}, "A part of a video has crop, end, loop, .* track"),
        (None, {"speed": 0}, "^“Speed” must be a number from 0.1 to 20, .* got 0.$"),
        (None, {"speed": "fast"}, "^“Speed” must be a number"),
        (None, {"loop": 0}, "^“Repeat” must be a whole number, 1 or more"),
        (None, {"loop": 99}, "^“Repeat” 99 of 1.00 s is 99 s.* “Repeat” 60 is the most here"),
        (None, {"rotate": 45}, "^“Turn” must be 90, 180 or 270 degrees clockwise"),
        (None, {"stabilise": True}, "^“Hold the background still” finds no background in the video at"),
        (None, {"field": "name"}, "one field, video"),
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
