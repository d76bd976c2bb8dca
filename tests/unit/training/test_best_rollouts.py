"""What is kept of an iteration, and what is drawn of it when somebody asks."""

import numpy as np
import pytest

from helpers.small_world import falling_demo, falling_states
from onedemo.app.tabs.progress import timeline_html
from onedemo.demos.video import VideoReader, count_frames
from onedemo.render.render_thread import RenderThread
from onedemo.rl.rollouts import Transitions
from onedemo.robots.registry import robot_named
from onedemo.training.best_rollouts import PARTS, Episode, Gallery
from onedemo.training.pictures import PictureFiles, captioned
from onedemo.types import Rollouts
from unit.queries.test_selection import rollouts as empty_rollouts


def rated(clock, moved=1, **changes):
    """Rollouts of which lane k is rated 1 + k, a point less in the second half of the demo."""
    plain = empty_rollouts(clock)
    next_clock = clock + moved
    ratings = 1.0 + np.arange(len(clock))[:, None] - (next_clock >= 500)
    none = np.zeros((*clock.shape, 0))
    fields = {name: getattr(plain, name) for name in Rollouts.__slots__}
    fields |= {"rewards": (ratings - 1) / 4 * moved, "next_clock": next_clock} | changes
    return Transitions(**fields, next_obs=none, next_qpos=none, next_qvel=none)


def test_each_part_of_the_demo_has_the_mean_of_what_was_done_there(tmp_path):
    gallery = Gallery(tmp_path, None)
    for moved, reached in ((1, 700), (2, 1000)):
        clock = np.tile(np.arange(200, reached, moved), (3, 1)).astype(np.int32)
        told = gallery.note(1, rated(clock, moved), lambda steps: steps * 240 // 1000, 1000)
        parts = told["timeline"]
        assert len(parts) == PARTS and "best" not in told  # no episode ended
        assert [k for k, part in enumerate(parts) if part is not None] in (
            list(range(8, 29)), list(range(8, 40)),
        )  # fmt: skip
        assert parts[8:20] == [2.0] * 12 and parts[20:28] == [1.0] * 8


def test_the_best_of_an_iteration_is_a_whole_episode_although_an_iteration_is_a_quarter_of_one(tmp_path):
    """Two lanes, episodes of 1000 steps in iterations of 250; the second lane is 100 steps behind."""
    clocks = (np.arange(2000)[None] - np.array([[0], [100]])) % 1000
    gallery = Gallery(tmp_path, None)
    kept = []
    for k in range(8):
        clock = clocks[:, 250 * k : 250 * (k + 1)].astype(np.int32)
        qpos = np.repeat(clock[..., None], 6, axis=2).astype(float)
        part = rated(clock, qpos=qpos, truncated=clock == 999)
        told = gallery.note(k + 1, part, lambda steps: steps * 240 // 1000, 1000)
        kept.append(told.get("best"))
    # The episodes under way when it began to look are not whole; nor is the second lane's of 100 steps.
    assert [k for k, best in enumerate(kept) if best is not None] == [4, 7]
    assert kept[4] == pytest.approx(1.5, abs=0.01) and kept[7] == pytest.approx(0.5, abs=0.01)
    for iteration in (5, 8):
        with np.load(tmp_path / f"{iteration:06d}.npz") as data:
            assert data["qpos"][:, 0].tolist() == list(range(1000))
            assert data["frames"].tolist() == [t * 240 // 1000 for t in range(1000)]


def test_a_long_attempt_is_better_than_a_good_moment():
    short, long = (
        Episode(np.zeros((steps, 6)), np.arange(steps), np.full(steps, reward), np.ones(steps, int))
        for steps, reward in ((10, 0.75), (1000, 0.5))
    )
    assert long.worth > short.worth


def test_a_film_says_which_side_is_the_robot():
    plain = np.full((360, 972, 3), 128, np.uint8)
    named = captioned(plain, "Demonstration", "Robot, iteration 7")
    changed = (named != plain).any(axis=2)
    assert changed[320:, :486].any() and changed[320:, 486:].any() and not changed[:310].any()
    assert not (plain != 128).any()


@pytest.mark.seam
def test_the_best_rollout_is_drawn_when_asked_for_and_once(tmp_path):
    import cv2

    demo = falling_demo(tmp_path / "demo")
    states = falling_states()
    with RenderThread() as drawing:
        gallery = Gallery(tmp_path / "rollouts", PictureFiles(drawing, demo, robot_named("hopper")))
        gallery.keep(7, states.qpos[:125], np.arange(125) * 30 * 8 // 1000)
        strip = gallery.picture(7, "jpg").result(60)
        picture = cv2.imread(str(strip))
        assert picture.shape == (120, 960, 3)
        assert np.abs(picture[:, :160].astype(int) - picture[:, -160:]).max() > 60  # it falls
        video = gallery.picture(7, "webm").result(60)
        assert count_frames(video) == 30  # a second
        with VideoReader(video) as reader:
            frame = next(iter(reader.frames()))
            assert frame.shape == (360, 972, 3)
        written = video.stat().st_mtime_ns
        assert gallery.picture(7, "webm").result(60).stat().st_mtime_ns == written
        with pytest.raises(FileNotFoundError):
            gallery.picture(8, "jpg")
    assert sorted(f.suffix for f in (tmp_path / "rollouts").iterdir()) == [".jpg", ".npz", ".webm"]


def test_the_strip_names_the_weakest_part_and_what_was_not_reached():
    html = timeline_html({"number": 1, "timeline": [1.0, 3.0, 2.0, None]}, 8.0)
    assert "iteration 1; between 1.0 and 3.0; weakest at 1.0 s; 2.0 s not reached (dashed)" in html
    assert html.count("<i style=") == 3 and "6.0 to 8.0 s: not reached" in html and "--od-rated:50%" in html
    assert "no part was reached" in timeline_html({"number": 1, "timeline": [None]}, 8.0)
    assert "iteration" not in timeline_html(None, 8.0)
