"""Clips are decoded again with another library and looked at."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from onedemo.render.backdrop import Camera, backdrop
from onedemo.render.clip_image import (
    CLIP_HEIGHT,
    CLIP_WIDTH,
    GAP,
    SIDE_HEIGHT,
    SIDE_WIDTH,
    compose_clip,
    fit,
    frame_durations,
)

RED, BLUE = (200, 40, 40), (40, 60, 200)


def plain(colour, count=10, size=(SIDE_HEIGHT, SIDE_WIDTH)):
    return np.broadcast_to(np.uint8(colour), (count, *size, 3)).copy()


def stepping(colour, count=10):
    """A bar that moves one tenth of the picture a frame."""
    frames = plain((240, 240, 240), count)
    for i, frame in enumerate(frames):
        frame[:, 40 + 40 * i : 60 + 40 * i] = colour
    return frames


def decode(data, count):
    """Frames (k, H, W, 3), in the order in which the page plays them."""
    picture = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    columns = picture.shape[1] // CLIP_WIDTH
    frames = []
    for i in range(count):
        y, x = i // columns * CLIP_HEIGHT, i % columns * CLIP_WIDTH
        frames.append(picture[y : y + CLIP_HEIGHT, x : x + CLIP_WIDTH])
    return np.stack(frames)


def test_demo_left_agent_right_white_between():
    frame = decode(compose_clip(plain(RED), plain(BLUE)), 10)[0].astype(int)
    assert frame.shape == (CLIP_HEIGHT, CLIP_WIDTH, 3)
    assert np.abs(frame[180, 200] - RED).max() < 8
    assert np.abs(frame[180, SIDE_WIDTH + GAP + 200] - BLUE).max() < 8
    assert frame[180, SIDE_WIDTH + GAP // 2].min() > 245


@pytest.mark.slow
@pytest.mark.parametrize(("count", "columns"), [(10, 1), (40, 1), (41, 2), (151, 4)])
def test_both_sides_show_the_same_moment_and_no_picture_is_too_high(count, columns):
    def bars(colour):
        frames = np.full((count, 36, 48, 3), 240, np.uint8)
        for i, frame in enumerate(frames):
            frame[:, i % 10 * 4 + 3 : i % 10 * 4 + 7] = colour
        return frames

    data = compose_clip(bars(RED), bars(BLUE))
    for i, row in enumerate(decode(data, count)[:, 180].astype(int)):
        red = np.nonzero(row[:, 0] - row[:, 2] > 80)[0].mean()
        blue = np.nonzero(row[:, 2] - row[:, 0] > 80)[0].mean() - SIDE_WIDTH - GAP
        assert abs(red - (50 + 40 * (i % 10))) < 6 and abs(blue - red) < 4
    width, height = Image.open(io.BytesIO(data)).size
    assert (width, height) == (columns * CLIP_WIDTH, -(-count // columns) * CLIP_HEIGHT)
    assert height < 16_384


def test_what_is_left_of_the_grid_shows_the_last_frame():
    picture = np.asarray(Image.open(io.BytesIO(compose_clip(plain(RED, 41), plain(BLUE, 41)))))
    assert picture.shape[:2] == (21 * CLIP_HEIGHT, 2 * CLIP_WIDTH)
    assert np.abs(picture[-180, CLIP_WIDTH + 200].astype(int) - RED).max() < 8


def test_durations_do_not_drift():
    # 30 fps: 33.3 ms a frame, so two of 33 and one of 34.
    assert frame_durations(4, 30).tolist() == [33, 34, 33, 500]
    assert frame_durations(301, 30)[:300].sum() == 10_000
    assert frame_durations(2, 1).tolist() == [1000, 1000]  # a slow frame is not cut to half a second


@pytest.mark.parametrize("size", [(640, 360), (360, 640), (480, 480), (97, 1201), (16, 16)])
def test_any_shape_is_fitted_whole_and_centred(size):
    frame = np.full((*size, 3), 20, np.uint8)
    side = fit(frame)
    assert side.shape == (SIDE_HEIGHT, SIDE_WIDTH, 3) and side.dtype == np.uint8
    dark = side.max(2) < 40
    rows, columns = np.nonzero(dark.any(1))[0], np.nonzero(dark.any(0))[0]
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert height == SIDE_HEIGHT or width == SIDE_WIDTH
    assert abs(width / height - size[1] / size[0]) < 0.02 * size[1] / size[0]
    assert abs(rows.mean() - SIDE_HEIGHT / 2) < 2 and abs(columns.mean() - SIDE_WIDTH / 2) < 2
    assert side[~dark].min() > 150  # what surrounds it is light


def test_a_frame_of_the_right_size_is_not_touched():
    frame = stepping(RED)[3]
    assert np.array_equal(fit(frame), frame)


def test_sides_of_different_shapes_share_a_clip():
    frames = decode(compose_clip(plain(RED, 3, (640, 360)), plain(BLUE, 3, (64, 64))), 3)
    assert frames.shape == (3, CLIP_HEIGHT, CLIP_WIDTH, 3)


@pytest.mark.parametrize(
    ("demo", "agent", "words"),
    [
        (plain(RED, 3), plain(RED, 4), "3 demo frames, but 4 agent frames"),
        (plain(RED, 0), plain(RED, 0), "k > 0"),
        (plain(RED, 2)[..., 0], plain(RED, 2), r"demo frames must be \(k, H, W, 3\)"),
        (plain(RED, 2), plain(RED, 2).astype(float), "agent frames .* float64"),
    ],
)
def test_bad_frames_are_refused(demo, agent, words):
    with pytest.raises(ValueError, match=words):
        compose_clip(demo, agent)


def test_a_clip_of_the_studio_is_small_and_quick():
    def drive(speed):
        x = np.arange(10) / 30 * speed
        limbs = [np.array([[v - 0.2, v + 0.2, 0.1, 0.05]]) for v in x]
        cameras = [Camera(x=float(v), z=0.9, distance=3.0, fovy=40.0) for v in x]
        return np.stack([backdrop(480, 360, c, limb) for c, limb in zip(cameras, limbs, strict=True)])

    demo, agent = drive(2.0), drive(-1.0)
    begin = time.perf_counter()
    data = compose_clip(demo, agent)
    assert time.perf_counter() - begin < 1.0  # 0.03 s on an idle core
    assert len(data) < 200_000
