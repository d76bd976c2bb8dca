"""Pictures over HTTP: whoever waits for one takes nothing away from those who do not."""

import asyncio
from concurrent.futures import Future
from contextlib import closing
from types import SimpleNamespace

import pytest
from aiohttp import ClientSession, web

from helpers.fake_trainer import StandIn
from onedemo.app.http.media import Files
from onedemo.app.services.demo_images import Pictures
from onedemo.errors import UserError

FILMS = 40
"""More than there are threads."""


class Filming(StandIn):
    """Its films are never done."""

    def __init__(self, data_dir):
        super().__init__(data_dir, clips=1)
        self.films = []

    def rollout_picture(self, iteration, suffix):
        if iteration == 0:
            raise UserError("nothing can be drawn here")
        self.films.append(Future())
        return self.films[-1]


@pytest.fixture
def trainer(tmp_path):
    trainer = Filming(tmp_path)
    with closing(trainer.store):
        yield trainer


def serve(trainer, visit, pictures=None):
    """Runs ``visit(get)`` against the handlers on a port of their own."""

    async def run():
        files = Files(SimpleNamespace(trainer=trainer, pictures=pictures))
        app = web.Application()
        app.router.add_get(r"/clips/{clip:\d+}.jpg", files.clip)
        app.router.add_get(r"/pairs/{pair:\d+}.jpg", files.pair)
        app.router.add_get(r"/rollouts/{iteration:\d+}.{suffix:jpg|webm}", files.rollout)
        app.router.add_get(r"/demo/frames/{index:\d+}.jpg", files.demo_frame)
        runner = web.AppRunner(app, shutdown_timeout=0)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        base = f"http://127.0.0.1:{runner.addresses[0][1]}"
        async with ClientSession() as session:

            async def get(path, **headers):
                async with session.get(base + path, headers=headers) as answer:
                    return answer.status, answer.headers["Content-Type"], await answer.read()

            try:
                return await asyncio.wait_for(visit(get), 60)
            finally:
                await runner.cleanup()

    return asyncio.run(run())


async def reach(condition):
    while not condition():
        await asyncio.sleep(0.005)


def test_a_clip_comes_although_forty_films_are_waited_for(trainer, tmp_path):
    (clip,) = trainer.store.clips.waiting(trainer.run)
    film = tmp_path / "film.webm"
    film.write_bytes(b"a film")

    async def visit(get):
        waiting = [asyncio.create_task(get(f"/rollouts/{k}.webm")) for k in range(1, FILMS + 1)]
        await reach(lambda: len(trainer.films) == FILMS)
        clips = await asyncio.gather(*(get(f"/clips/{clip.id}.jpg") for _ in range(FILMS)))
        waiting[0].cancel()  # somebody closes the film before it is there; others wait for it still
        await asyncio.gather(waiting[0], return_exceptions=True)
        assert not trainer.films[0].cancelled()
        for made in trainer.films:
            made.set_result(film)
        return clips, await asyncio.gather(*waiting[1:])

    clips, films = serve(trainer, visit)
    assert {status for status, *_ in clips} == {200} and clips[0][2].startswith(b"\xff\xd8")
    assert set(films) == {(200, "video/webm", b"a film")}


@pytest.mark.parametrize(("times", "status"), [(1, 200), (2, 200), (99, 503)])
def test_a_picture_that_is_deleted_before_it_is_sent_is_drawn_again(trainer, monkeypatch, times, status):
    """`onedemo tidy` in another process; before, a 404."""
    (clip,) = trainer.store.clips.waiting(trainer.run)
    there, file = trainer.clip_picture, trainer.clip_file(clip.id)
    picture, asked = file.read_bytes(), []

    def draw(clip):
        file.write_bytes(picture)
        coming = there(clip)
        asked.append(clip.id)
        if len(asked) <= times:
            file.unlink()
        return coming

    monkeypatch.setattr(trainer, "clip_picture", draw)
    answer = serve(trainer, lambda get: get(f"/clips/{clip.id}.jpg"))
    assert answer[0] == status and (status == 503 or answer[1:] == ("image/jpeg", picture))


def test_a_film_comes_in_parts(trainer, tmp_path, monkeypatch):
    """As browsers ask for it."""
    film = tmp_path / "film.webm"
    film.write_bytes(bytes(range(100)))
    made = Future()
    made.set_result(film)
    monkeypatch.setattr(trainer, "rollout_picture", lambda *_: made)

    async def visit(get):
        asked = (
            "bytes=0-",
            "bytes=10-19",
            "bytes=-5",
            "bytes=90-1000",
            "bytes=100-",
            "bytes=7-3",
            "lines=1-2",
        )
        return [await get("/rollouts/1.webm", Range=part) for part in asked]

    *parts, late, backwards, other = serve(trainer, visit)
    whole = bytes(range(100))
    assert [body for *_, body in parts] == [whole, whole[10:20], whole[-5:], whole[90:]]
    assert {status for status, *_ in parts} == {206} and late[0] == backwards[0] == other[0] == 416


def test_what_is_not_there_and_what_cannot_be_drawn_say_so(trainer):
    async def visit(get):
        return [(await get(path))[0] for path in ("/clips/999.jpg", "/pairs/9.jpg", "/rollouts/0.webm")]

    assert serve(trainer, visit) == [404, 404, 503]


def test_the_video_is_prepared_once_and_clips_do_not_wait_for_it(trainer):
    began, go_on = [], Future()

    def read(demo):
        began.append(demo)
        go_on.result(60)
        return trainer.frames[:10]

    (clip,) = trainer.store.clips.waiting(trainer.run)

    async def visit(get):
        waiting = [asyncio.create_task(get(f"/demo/frames/{k % 10}.jpg")) for k in range(FILMS)]
        await reach(lambda: began)
        status, *_ = await get(f"/clips/{clip.id}.jpg")
        go_on.set_result(None)
        return status, {answer[0] for answer in await asyncio.gather(*waiting)}

    assert serve(trainer, visit, Pictures(trainer.demo, read)) == (200, {200})
    assert len(began) == 1
