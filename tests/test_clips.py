"""Clips are decoded again with another library and looked at."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from trainer.backdrop import Camera, backdrop
from trainer.clips import (
    CLIP_HEIGHT,
    CLIP_WIDTH,
    GAP,
    HOLD_SECONDS,
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


def decode(data):
    """Frames (k, H, W, 3), durations in milliseconds and loop count."""
    image = Image.open(io.BytesIO(data))
    frames, durations = [], []
    for i in range(image.n_frames):
        image.seek(i)
        image.load()
        frames.append(np.asarray(image.convert("RGB")))
        durations.append(image.info["duration"])
    return np.stack(frames), durations, image.info["loop"]


def test_demo_left_agent_right_white_between():
    frames, _, _ = decode(compose_clip(plain(RED), plain(BLUE), fps=30))
    frame = frames[0].astype(int)
    assert frame.shape == (CLIP_HEIGHT, CLIP_WIDTH, 3)
    assert np.abs(frame[180, 200] - RED).max() < 8
    assert np.abs(frame[180, SIDE_WIDTH + GAP + 200] - BLUE).max() < 8
    assert frame[180, SIDE_WIDTH + GAP // 2].min() > 245


def test_both_sides_show_the_same_moment():
    frames, _, _ = decode(compose_clip(stepping(RED), stepping(BLUE), fps=30))
    assert len(frames) == 10
    for i, frame in enumerate(frames.astype(int)):
        red = np.nonzero(frame[180, :, 0] - frame[180, :, 2] > 80)[0].mean()
        blue = np.nonzero(frame[180, :, 2] - frame[180, :, 0] > 80)[0].mean() - SIDE_WIDTH - GAP
        assert abs(red - (50 + 40 * i)) < 4 and abs(blue - red) < 4


def test_the_last_frame_is_held_and_the_clip_loops():
    _, durations, loop = decode(compose_clip(stepping(RED), stepping(BLUE), fps=30))
    assert sum(durations[:9]) == 300 and set(durations[:9]) == {33, 34}
    assert durations[9] == HOLD_SECONDS * 1000
    assert loop == 0


def test_slow_motion_takes_four_times_as_long():
    _, durations, _ = decode(compose_clip(stepping(RED), stepping(BLUE), fps=30, speed=0.25))
    assert sum(durations[:9]) == 1200 and durations[9] == 500


def test_durations_do_not_drift():
    # 30 fps: 33.3 ms a frame, so two of 33 and one of 34.
    assert frame_durations(4, 30).tolist() == [33, 34, 33, 500]
    assert frame_durations(301, 30)[:300].sum() == 10_000
    assert frame_durations(2, 1).tolist() == [1000, 1000]  # a slow frame is not cut to half a second


def test_equal_frames_in_a_row_keep_their_time():
    frames = np.concatenate([plain(RED, 5), plain(BLUE, 5)])
    _, durations, _ = decode(compose_clip(frames, frames, fps=30))
    assert sum(durations) == 300 + 500  # WebP may merge equal frames, not shorten them


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
    frames, _, _ = decode(compose_clip(plain(RED, 3, (640, 360)), plain(BLUE, 3, (64, 64)), fps=30))
    assert frames.shape == (3, CLIP_HEIGHT, CLIP_WIDTH, 3) or len(frames) == 1


@pytest.mark.parametrize(
    ("demo", "agent", "options", "words"),
    [
        (plain(RED, 3), plain(RED, 4), {}, "3 demo frames, but 4 agent frames"),
        (plain(RED, 0), plain(RED, 0), {}, "k > 0"),
        (plain(RED, 2)[..., 0], plain(RED, 2), {}, r"demo frames must be \(k, H, W, 3\)"),
        (plain(RED, 2), plain(RED, 2).astype(float), {}, "agent frames .* float64"),
        (plain(RED, 2), plain(RED, 2), {"fps": 0}, "must be positive"),
        (plain(RED, 2), plain(RED, 2), {"speed": -1}, "must be positive"),
    ],
)
def test_bad_frames_are_refused(demo, agent, options, words):
    with pytest.raises(ValueError, match=words):
        compose_clip(demo, agent, **{"fps": 30, **options})


def test_a_clip_of_the_studio_is_small_and_quick():
    def drive(speed):
        x = np.arange(10) / 30 * speed
        limbs = [np.array([[v - 0.2, v + 0.2, 0.1, 0.05]]) for v in x]
        cameras = [Camera(x=float(v), z=0.9, distance=3.0, fovy=40.0) for v in x]
        return np.stack([backdrop(480, 360, c, limb) for c, limb in zip(cameras, limbs, strict=True)])

    demo, agent = drive(2.0), drive(-1.0)
    begin = time.perf_counter()
    data = compose_clip(demo, agent, fps=30)
    assert time.perf_counter() - begin < 3.0  # 0.2 s on an idle core
    assert len(data) < 100_000
