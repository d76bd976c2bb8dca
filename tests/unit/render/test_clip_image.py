"""Clips are decoded again with another library and looked at."""

import io
import time

import numpy as np
import pytest
from PIL import Image

from onedemo.core.files import jpeg_fault, sealed
from onedemo.render.backdrop import Viewpoint, backdrop
from onedemo.render.clip_image import (
    GAP,
    SIDE_HEIGHT,
    SIDE_WIDTH,
    Side,
    compose_clip,
    fit,
    frame_durations,
    read_about,
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
    """Of each side its frames (k, H, W, 3), in the order in which the page plays them."""
    picture, about = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")), read_about(data)
    (width, height), sides = about["cell"], []
    for side in about["sides"]:
        wide, tall = side["size"]
        places = [divmod(i, about["columns"]) for i in range(about["frames"])]
        corners = [(row * height, column * width + side["at"]) for row, column in places]
        sides.append(np.stack([picture[y : y + tall, x : x + wide] for y, x in corners]))
    return sides


def test_demo_left_agent_right_white_between():
    data = compose_clip(plain(RED), plain(BLUE, size=(100, 200)))
    demo, agent = (side[0].astype(int) for side in decode(data))
    assert demo.shape == (SIDE_HEIGHT, SIDE_WIDTH, 3) and agent.shape == (100, 200, 3)
    assert np.abs(demo[180, 200] - RED).max() < 8 and np.abs(agent[50, 100] - BLUE).max() < 8
    picture = np.asarray(Image.open(io.BytesIO(data)))
    assert picture[180, SIDE_WIDTH + GAP // 2].min() > 245


@pytest.mark.slow
@pytest.mark.parametrize(("count", "columns"), [(10, 1), (44, 1), (45, 2), (151, 4)])
def test_both_sides_show_the_same_moment_and_no_picture_is_too_high(count, columns):
    def bars(colour):
        frames = np.full((count, 360, 480, 3), 240, np.uint8)
        for i, frame in enumerate(frames):
            frame[:, i % 10 * 40 + 30 : i % 10 * 40 + 70] = colour
        return frames

    data = compose_clip(bars(RED), bars(BLUE))
    for i, (demo, agent) in enumerate(zip(*decode(data), strict=True)):
        red = np.nonzero(demo[180, :, 0].astype(int) - demo[180, :, 2] > 80)[0].mean()
        blue = np.nonzero(agent[180, :, 2].astype(int) - agent[180, :, 0] > 80)[0].mean()
        assert abs(red - (50 + 40 * (i % 10))) < 6 and abs(blue - red) < 4
    assert read_about(data)["columns"] == columns
    assert Image.open(io.BytesIO(data)).size[1] < 16_384


def test_what_is_known_of_a_side_is_read_again_however_much_it_is():
    known = {"left": [k / 1000 for k in range(40_000)], "bottom": -0.15}  # more than one comment holds
    data = compose_clip(Side(pictures=plain(RED, 2), known=known), plain(BLUE, 2))
    demo, agent = read_about(data)["sides"]
    assert {name: demo[name] for name in known} == known and "left" not in agent
    assert jpeg_fault(sealed(data)) == "" and read_about(sealed(data)) == read_about(data)
    with pytest.raises(ValueError, match=r"."):
        read_about(data[:2] + data[-2:])


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
        limbs = [np.array([[v - 0.2, v + 0.2, 0.1, 0.05, 0.0]]) for v in x]
        cameras = [Viewpoint(x=float(v), z=0.9, distance=3.0, fovy=40.0) for v in x]
        return np.stack([backdrop(480, 360, c, limb) for c, limb in zip(cameras, limbs, strict=True)])

    demo, agent = drive(2.0), drive(-1.0)
    begin = time.process_time()  # of the processor: others may want it, too
    data = compose_clip(demo, agent)
    assert time.process_time() - begin < 1.0  # it takes 0.03
    assert len(data) < 200_000
