"""What a clip shows: movers found in real videos and never cut off, one scale, floors at one height."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.paths import ROOT
from onedemo.demos.library import find_demo, read_frames
from onedemo.render.clip_image import compose_clip, read_about
from onedemo.render.framing import Extent, clip_sides, film_sides, views_of
from onedemo.render.mover import BODY, is_studio, locate
from onedemo.render.renderer import CLOSE_HEIGHT, CLOSE_WIDTH, Renderer, studio
from onedemo.robots.hopper import joint_points
from onedemo.robots.registry import robot_named

CAMERA = robot_named("hopper").camera
STANDING = Extent(left=-0.2, right=0.3, low=0.0, high=1.5)
FLYING = Extent(left=-0.6, right=0.5, low=0.7, high=1.6)


@pytest.fixture(scope="module", params=["hopper-backflip", "hopper-hop"])
def demo(request, tmp_path_factory):
    """Pictures of a demo, what is found in them, and what was true: for this test alone."""
    name = request.param
    frames = read_frames(find_demo(name, tmp_path_factory.mktemp("demos")))
    with np.load(ROOT / "static/demos" / f"{name}.hidden.npz") as truth:
        qpos = truth["qpos"][np.round(np.arange(120) / 30 / 0.008).astype(int)]
    return frames[:120], locate(frames[:120]), qpos


@pytest.mark.seam
def test_the_robot_is_found_in_its_videos(demo):
    frames, mover, qpos = demo
    assert is_studio(frames) and mover is not None
    points = joint_points(qpos)
    every = np.stack(list(points.values()))

    def height(row):
        return (mover.floor - row) / mover.scale

    # The camera follows the centre of mass; how far it has gone is read from the floor.
    seen = mover.way + (mover.head[:, 0] - frames.shape[2] / 2) / mover.scale
    apart = seen - points["top"][:, 0]
    assert np.abs(apart - np.median(apart)).max() < 0.12
    head, foot = height(mover.head[:, 1]), height(mover.foot[:, 1])
    assert np.abs(head - points["top"][:, 1]).max() < 0.12
    assert np.abs(foot - (points["heel"] + points["toe"])[:, 1] / 2).max() < 0.08
    assert np.abs(height(mover.box[:, 1]) - every[..., 1].max(axis=0) - 0.05).max() < 0.06
    assert np.abs(height(mover.box[:, 3]) - every[..., 1].min(axis=0) + 0.05).max() < 0.06


def test_one_size_for_all_with_the_floor_where_somebody_is_near_it():
    left, right = views_of([FLYING, STANDING])
    assert (left.width, left.height, left.bottom) == (right.width, right.height, right.bottom)
    assert left.bottom < -0.1 and left.bottom + left.height > 1.7
    assert left.width / left.height == pytest.approx(CLOSE_WIDTH / CLOSE_HEIGHT)
    alone = views_of([FLYING])[0]
    assert 0.4 < alone.bottom < 0.7 and alone.height < left.height  # closer: nobody is near the floor


def test_one_that_leaps_from_the_floor_and_one_that_stays_there_have_one_height():
    leaps = Extent(left=-0.5, right=0.5, low=0.1, high=2.6)
    left, right = views_of([leaps, STANDING])
    assert left.bottom == right.bottom and left.height == right.height


def test_movers_at_very_different_heights_keep_their_size_but_not_one_height():
    high = replace(FLYING, low=4.0, high=4.9)
    left, right = views_of([high, STANDING])
    assert left.height == right.height < 2.2 and left.bottom > 3.5 and right.bottom < 0


@pytest.mark.parametrize("seed", range(20))
def test_nobody_is_cut_off(seed):
    rng = np.random.default_rng(seed)
    extents = []
    for _ in range(2):
        low, left = rng.uniform(0, 3), rng.uniform(-1, 0.2)
        extents.append(
            Extent(left=left, right=left + rng.uniform(0.3, 3), low=low, high=low + rng.uniform(0.3, 3))
        )
    views = views_of(extents)
    assert views[0].height == views[1].height
    for view, extent in zip(views, extents, strict=True):
        assert view.shift - view.width / 2 < extent.left and extent.right < view.shift + view.width / 2
        assert view.bottom < extent.low and extent.high < view.bottom + view.height


def limbs(picture):
    """Where a picture shows the robot: its colours are strong, all else is grey."""
    return np.nonzero(picture.max(axis=2).astype(int) - picture.min(axis=2) > 60)


@pytest.mark.seam
def test_both_sides_of_a_clip_show_the_robot_whole_at_one_scale(demo):
    frames, mover, qpos = demo
    with Renderer(exact=False) as renderer:
        for start in (0, 55, 95):
            k = np.arange(start, start + 10)
            film, robot = clip_sides(renderer, frames[k], mover.at(k), [qpos[k]])  # the very same movement
            assert robot.pictures.shape[1:] == (CLOSE_HEIGHT, CLOSE_WIDTH, 3)
            assert film.known["width"] == robot.known["width"]
            wide, tall = film.known["seen"]
            offsets = np.round(film.known["offsets"]).astype(int)
            for i in range(10):
                x, y = offsets[i]
                seen = film.pictures[i][y : y + round(tall), x : x + round(wide)]
                boxes = []
                for picture in (seen, robot.pictures[i]):
                    rows, columns = limbs(picture)
                    boxes.append(
                        np.array([columns.min(), columns.max() + 1, rows.min(), rows.max() + 1])
                        / np.repeat(picture.shape[1::-1], 2)
                    )
                    assert 0.01 < boxes[-1].min() and boxes[-1].max() < 0.99  # whole
                assert np.abs(boxes[0] - boxes[1])[2:].max() < 0.035  # as high, and as large


@pytest.mark.seam
def test_a_close_up_is_a_part_of_the_whole_picture():
    whole = studio()
    pose = np.array([[0.4, 1.2, 0.3, -0.4, -0.5, 0.2]])
    with Renderer() as exact, Renderer(exact=False) as quick:
        picture = exact.render(pose)[0]
        middle = exact._data.subtree_com[0, :1].copy()  # which the camera looks at
        assert np.abs(quick.close_ups(pose, middle, whole)[0].astype(int) - picture).mean() < 1.5
        part = replace(whole, width=240, height=180, bottom=0.5)
        cut = quick.close_ups(pose, np.array([0.4]), part)[0].astype(int)
        full = quick.close_ups(pose, np.array([0.4]), whole)[0].astype(int)
        top = round(360 - (0.5 - whole.bottom) * whole.scale) - 180
        assert min(np.abs(full[top + d : top + d + 180, 120:360] - cut).mean() for d in (-1, 0, 1)) < 2.5


@functools.cache
def person(frames=60, size=(240, 320)):
    """A block that crosses a textured room with a camera that stands still, (F, H, W, 3)."""
    rng = np.random.default_rng(0)
    room = rng.integers(80, 160, (*size, 3), np.uint8)
    film = np.stack([room] * frames)
    for i, frame in enumerate(film):
        x = 20 + 4 * i
        frame[90:210, x : x + 40] = (240, 30, 30)
    noise = rng.integers(-6, 7, film.shape)
    return np.clip(film + noise, 0, 255).astype(np.uint8)


def test_what_moves_before_a_background_is_followed_and_as_large_as_the_robot():
    film = person()
    mover = locate(film)
    assert mover is not None and mover.head is None and mover.way is None
    assert mover.scale == pytest.approx(120 / BODY, rel=0.06) and abs(mover.floor - 210) < 4
    for i in (5, 30, 50):
        assert np.abs(mover.box[i] - [20 + 4 * i, 90, 60 + 4 * i, 210]).max() < 5
    k = np.arange(20, 30)
    side = film_sides([film[k], film[k]], [mover.at(k), mover.at(k)], CAMERA)[0]
    wide, tall = side.known["seen"]
    assert wide < 0.8 * film.shape[2] and len(side.known["ghost"]) >= 4
    for picture, (x, y) in zip(side.pictures, side.known["offsets"], strict=True):
        seen = picture[int(y) : int(y + tall), int(x) : int(x + wide)].astype(int)
        red = (seen[..., 0] > 200) & (seen[..., 1] < 90)
        assert 0.9 * 4800 < red.sum() and not red[:, 0].any() and not red[:, -1].any()


def test_where_all_moves_or_nothing_does_the_picture_is_shown_whole():
    rng = np.random.default_rng(1)
    shaking = rng.integers(0, 255, (30, 120, 160, 3), np.uint8)
    still = np.full((30, 120, 160, 3), 128, np.uint8)
    for film in (shaking, still):
        assert locate(film) is None
        side = film_sides([film[:5]], [None], CAMERA)[0]
        assert side.pictures.shape == (5, CLOSE_HEIGHT, CLOSE_WIDTH, 3) and not side.known


def test_a_view_that_would_be_larger_than_the_video_is_not_taken():
    film, k = person(), np.arange(5)
    mover = locate(film)
    assert mover is not None
    large = replace(mover.at(k), box=np.tile([1.0, 5.0, 315.0, 235.0], (5, 1)))
    side = film_sides([film[k]], [large], CAMERA)[0]
    assert side.pictures.shape[1:3] == (CLOSE_HEIGHT, CLOSE_WIDTH) and not side.known


def test_a_clip_notes_what_the_page_draws(tmp_path):
    film = person()
    k = np.arange(10)
    mover = locate(film)
    about = read_about(compose_clip(*film_sides([film[k], film[k]], [mover.at(k), mover.at(k)], CAMERA)))
    assert about["frames"] == 10 and len(about["sides"]) == 2
    for side in about["sides"]:
        assert len(side["left"]) == len(side["offsets"]) == 10 and not math.isnan(side["bottom"])
        assert "eye" not in side  # where the floor is guessed, no scale is drawn
