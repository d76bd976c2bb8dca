"""The pictures of a run: drawn once, drawn again when somebody looks back, deleted in time."""

import os
import re
import sqlite3
import threading
import time
from concurrent.futures import Future
from contextlib import closing
from functools import partial

import numpy as np
import pytest

from helpers.small_world import falling_demo, small_config
from onedemo.app.cli.main import main
from onedemo.core.files import jpeg_fault, replacing
from onedemo.demos.library import find_demo
from onedemo.render.render_thread import Order, RenderThread
from onedemo.render.renderer import Renderer
from onedemo.robots.registry import robot_named
from onedemo.storage.clips import NewClip
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store
from onedemo.training.clip_worker import ClipMaker, Notes
from onedemo.training.learner import Learner
from onedemo.training.pictures import PictureFiles, awaited, pictures_of, spare, tidy
from onedemo.training.rating_queue import RatingQueue
from onedemo.types import Demo, Segment
from unit.training.test_trainer import wait_for

MB = 1_000_000


class Asked:
    """Draws nothing until told to, and notes what it is asked."""

    def __init__(self):
        self.jobs = []

    def submit(self, job, order=Order.AHEAD, robot=None):
        self.jobs.append((job, order, Future()))
        return self.jobs[-1][2]


def demo_of(frames, fps):
    return Demo(name="d", sha256="0" * 64, path=None, fps=fps, frames=frames, width=480, height=360)  # type: ignore[arg-type]


@pytest.mark.parametrize(("frames", "fps"), [(30, 30.0), (241, 24.0), (100, 59.94), (17, 10.0)])
def test_a_clip_stands_beside_the_frames_that_it_is_learned_beside(tmp_path, frames, fps):
    demo, drawing = demo_of(frames, fps), Asked()
    learner = Learner(small_config(), demo.frames, demo.fps)
    pictures = PictureFiles(drawing, demo, robot_named("hopper"))
    for step in (0, 7, learner.demo_steps - 30, learner.demo_steps - 5, learner.demo_steps + 9):
        moving = np.arange(38 * 6, dtype=float).reshape(38, 6)
        segment = Segment(obs=moving, actions=moving, qpos=moving, qvel=moving)
        pictures.clip(tmp_path / f"{step}.jpg", step, lambda segment=segment: [segment])
        told = drawing.jobs[-1][0].keywords
        index, first = np.unique(learner.frames_of(step + np.arange(38)), return_index=True)
        assert np.array_equal(told["frames"], index) and np.array_equal(told["robots"][0], moving[first])


def test_what_is_asked_twice_is_drawn_once_and_what_failed_is_drawn_again(tmp_path):
    drawing = Asked()
    pictures = PictureFiles(drawing, demo_of(30, 30.0), robot_named("hopper"))
    file = tmp_path / "film.webm"
    asked = [pictures.draw(file, lambda: lambda renderer: None, Order.FILM) for _ in range(12)]
    assert len(drawing.jobs) == 1 and not asked[0].done()
    file.write_bytes(b"film")
    drawing.jobs[0][2].set_result(None)
    assert [future.result(0) for future in asked] == [file] * 12
    assert pictures.draw(file, lambda: pytest.fail("it is there")).result(0) == file
    file.unlink()
    again = pictures.draw(file, lambda: lambda renderer: None)
    drawing.jobs[1][2].set_exception(OSError(28, "full"))
    with pytest.raises(OSError, match="full"):
        again.result(0)
    pictures.draw(file, lambda: lambda renderer: None)
    assert len(drawing.jobs) == 3
    drawing.jobs[2][2].cancel()
    drawing.jobs[2][2].set_running_or_notify_cancel()
    assert pictures.draw(file, lambda: lambda renderer: None) is not again and len(drawing.jobs) == 4


def test_a_film_that_took_long_is_there_for_whoever_waited(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("onedemo.training.pictures.time.monotonic", lambda: now[0])
    drawing = Asked()
    pictures = PictureFiles(drawing, demo_of(30, 30.0), robot_named("hopper"))
    film, ahead = tmp_path / "film.webm", tmp_path / "ahead.jpg"
    pictures.draw(film, lambda: lambda renderer: None, Order.FILM)
    pictures.draw(ahead, lambda: lambda renderer: None, Order.AHEAD)
    for now[0] in (1.0, 300.0):
        assert pictures.recent() == {film}
    drawing.jobs[0][2].set_result(None)
    now[0] = 350.0
    assert pictures.recent() == {film}
    now[0] = 361.0
    assert pictures.recent() == set()


def test_the_oldest_that_nobody_waits_for_go_first(tmp_path):
    files = [(tmp_path / str(k), 10, 100.0 * k) for k in range(10)]
    keep = {tmp_path / "0", tmp_path / "2"}
    named = [int(path.name) for path in spare(files, keep, 70)]
    assert named == [1, 3, 4]
    assert [int(path.name) for path in spare(files, keep, 0)] == [1, 3, 4, 5, 6, 7, 8, 9]
    assert spare(files, keep, 100) == []


def thousand(store):
    """A run with a thousand clips, cut."""
    store.runs.add(run="r", demo="falling", demo_sha256="0" * 64, seed=0, config="", version="0")
    rng = np.random.default_rng(0)
    new = []
    for k in range(1000):
        qpos = np.tile([0.0, 1.2, 0.0, 0.0, 0.0, 0.0], (38, 1)) + 0.3 * rng.standard_normal(6)
        segment = Segment(obs=np.zeros((38, 11)), actions=np.zeros((38, 3)), qpos=qpos, qvel=qpos)
        new.append(NewClip(demo_step=k % 80, segment=segment, stage="online", iteration=k // 10))
    return store.clips.add("r", new)


@pytest.mark.seam
def test_a_thousand_ratings_leave_twenty_megabytes_and_can_be_looked_back_at(tmp_path, capsys):
    """One picture in a hundred is drawn for real; the others are copies under their numbers."""
    demo = falling_demo(tmp_path / "demo")
    with closing(Store(tmp_path)) as store, RenderThread(exact=False) as drawing:
        files = RunDirectory(tmp_path, "r")
        clips = thousand(store)
        pictures = PictureFiles(drawing, demo, robot_named("hopper"))
        maker = ClipMaker(store, file=files.clip, pictures=pictures)
        maker.submit(clips[::100])
        drawing.submit(lambda renderer: None).result(120)
        drawn = [files.clip(clip.id).read_bytes() for clip in clips[::100]]
        ann = store.accounts.ensure("Ann", "annotator").id
        for number, clip in enumerate(clips):
            files.clip(clip.id).write_bytes(drawn[number // 100])
            os.utime(files.clip(clip.id), (1e9 + number, 1e9 + number))
        store.clips.set_state([clip.id for clip in clips], "ready")
        rated = clips[12:]
        with store.database.transaction():
            for clip in rated:
                store.ratings.rate(clip.id, ann, 3, latency_ms=900)
        before = sum(size for _, size, _ in pictures_of(files))
        freed = tidy(store, files, small_config().storage.pictures_gb * 1e9)
        left = sum(size for _, size, _ in pictures_of(files))
        assert before > 60 * MB and left == before - freed and left <= 20 * MB
        assert all(path.exists() for path in awaited(store, files)) and len(awaited(store, files)) == 12
        assert files.clip(rated[-1].id).exists() and not files.clip(rated[0].id).exists()  # the newest stay

        assert main(["tidy", "--show", "--data-dir", str(tmp_path)]) == 0
        said = capsys.readouterr().out
        held, could = map(float, re.findall(r"([0-9.]+) MB", said)[:2])
        needed = sum(path.stat().st_size for path in awaited(store, files))
        assert held == pytest.approx(left / MB, abs=0.06)
        assert could == pytest.approx((left - needed) / MB, abs=0.06) and "without --show" in said
        assert sum(size for _, size, _ in pictures_of(files)) == left

        # Somebody takes back what was rated first: its picture is the same again.
        looked = clips[100]
        assert not files.clip(looked.id).exists()
        again = maker.picture(looked).result(60)
        assert again == files.clip(looked.id) and again.read_bytes() == drawn[1]
        assert jpeg_fault(drawn[1]) == ""
        tidy(store, files, 0, pictures.recent())
        assert again.exists()  # it was asked for just now
        tidy(store, files, 0)
        assert {path for path, _, _ in pictures_of(files)} == awaited(store, files)
        assert main(["tidy", "--data-dir", str(tmp_path)]) == 0
        assert "0.0 MB freed" in capsys.readouterr().out


def test_whoever_draws_waits_for_no_lock_of_another_program(tmp_path):
    """Before, each picture came ten seconds after the one before it."""
    drawing = Asked()
    with closing(Store(tmp_path)) as store:
        clips = thousand(store)[:4]
        files = RunDirectory(tmp_path, "r")
        maker = ClipMaker(
            store, file=files.clip, pictures=PictureFiles(drawing, demo_of(30, 30.0), robot_named("hopper"))
        )
        with closing(sqlite3.connect(store.path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            began = time.monotonic()
            maker.submit(clips[:3])
            looked = maker.picture(clips[3])
            for *_, drawn in drawing.jobs:  # what draws tells of one after another
                drawn.set_result(None)
            assert looked.result(0) == files.clip(clips[3].id)
            assert time.monotonic() - began < 5 and store.clips.waiting("r") == []
            other.execute("ROLLBACK")
        wait_for(lambda: store.clips.waiting("r") == clips[:3])


def test_what_was_drawn_is_noted_when_the_database_can_be_written(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("onedemo.training.clip_worker._AGAIN_S", 0.01)
    notes, wrote = Notes(), []

    def write(number, failing):
        def one():
            if failing:
                raise failing.pop()
            wrote.append(number)

        return one

    locked = sqlite3.OperationalError("database is locked")
    notes.add(write(1, [locked, locked]))
    notes.add(write(2, [ValueError("no clip")]))
    notes.add(write(3, []))
    wait_for(lambda: wrote == [1, 3])  # in their order; one that cannot be is not tried for ever
    assert "no clip" in caplog.text
    wait_for(lambda: not notes._writing)  # no thread is left
    notes.add(write(4, []))
    wait_for(lambda: wrote == [1, 3, 4])


def test_a_clip_that_fails_again_and_again_is_drawn_once_with_each_try(tmp_path, monkeypatch):
    monkeypatch.setattr("onedemo.training.clip_worker._RETRY_S", -1.0)
    drawing = Asked()
    with closing(Store(tmp_path)) as store:
        store.clips.set_state([clip.id for clip in thousand(store)[3:]], "withdrawn")
        files = RunDirectory(tmp_path, "r")
        maker = ClipMaker(
            store, file=files.clip, pictures=PictureFiles(drawing, demo_of(30, 30.0), robot_named("hopper"))
        )
        for _ in range(3):  # the training fails, too, and takes the run up again
            maker.recover("r")
            for *_, drawn in drawing.jobs:
                if not drawn.done():
                    drawn.set_exception(OSError(28, "full"))
        assert len(maker._failed) == 3 and "disk is full" in maker.error
        drawing.jobs.clear()
        maker.retry()
        assert len(drawing.jobs) == 3


def test_what_is_being_written_is_neither_counted_nor_deleted(tmp_path):
    with closing(Store(tmp_path)) as store:
        files = RunDirectory(tmp_path, "r")
        film, clip = files.path / "rollouts/000001.webm", files.clip(1)
        with replacing(film, ".webm", sync=False) as half, replacing(clip, ".jpg", sync=False) as other:
            half.write_bytes(b"half")
            other.write_bytes(b"half")
            assert pictures_of(files) == [] and tidy(store, files, 0) == 0
        assert sorted(path for path, _, _ in pictures_of(files)) == [clip, film]
        assert tidy(store, files, 0) == 8 and not film.exists()


@pytest.mark.seam
def test_a_film_lets_clips_go_first_and_ends_when_told_to(tmp_path, monkeypatch):
    demo = falling_demo(tmp_path / "demo")
    from onedemo.training.best_rollouts import Gallery

    order = []
    with RenderThread(exact=False) as drawing:
        gallery = Gallery(tmp_path / "rollouts", PictureFiles(drawing, demo, robot_named("hopper")))
        for iteration in (1, 2, 3):
            gallery.keep(iteration, np.zeros((125, 6)), np.arange(125) * 30 // 125)
        begun, go_on = threading.Event(), threading.Event()

        def wait(renderer):
            begun.set()
            assert go_on.wait(60)

        drawing.submit(wait, Order.AWAITED)
        assert begun.wait(60)
        films = [gallery.picture(iteration, "webm") for iteration in (1, 2, 1, 2)]
        assert films[0] is films[2] and films[1] is films[3]
        for name, film in (("film 1", films[0]), ("film 2", films[1])):
            film.add_done_callback(lambda _, name=name: order.append(name))

        def in_between(renderer):  # one clip after another
            order.append("clip")
            if len(order) < 5:
                drawing.submit(in_between)

        drawing.submit(lambda renderer: order.append("awaited"), Order.AWAITED)
        render, begun_films = Renderer.render, []

        def rendered(renderer, qpos):
            if not begun_films:
                begun_films.append(drawing.submit(in_between))  # while the first film is being drawn
            return render(renderer, qpos)

        monkeypatch.setattr(Renderer, "render", rendered)
        go_on.set()
        assert films[0].result(120).stat().st_size > 1000
        assert order[:2] == ["awaited", "clip"] and order.index("film 1") == 5
        films[1].result(120)
        last = gallery.picture(3, "webm")
    with pytest.raises(BaseException, match=r"closed|^$"):
        last.result(60)
    assert sorted(path.name for path in (tmp_path / "rollouts").iterdir()) == [
        "000001.npz", "000001.webm", "000002.npz", "000002.webm", "000003.npz",
    ]  # fmt: skip


def test_the_built_in_demo_is_read_once_for_all_clips(tmp_path):
    from onedemo.training import pictures

    demo = find_demo("hopper-backflip", tmp_path)
    pictures._filmed.cache_clear()
    filmed = partial(pictures._filmed, robot=robot_named("hopper"))
    assert filmed(demo)[0] is filmed(find_demo("hopper-backflip", tmp_path))[0]
    pictures._filmed.cache_clear()


def test_as_many_clips_wait_as_people_rate_while_the_robot_practises_once():
    queue = RatingQueue(None, "r", small_config(), None)  # type: ignore[arg-type]
    paces = [
        queue._ratings_an_iteration(*seen) for seen in ((0, 0), (0, 30), (1, 40), (1, 90), (2, 100), (3, 100))
    ]
    assert paces == [0, 0, 10, 10, 10, 0]  # not those given before, or while it was paused
    assert queue._ratings_an_iteration(9, 500) == 0  # a run that was resumed
