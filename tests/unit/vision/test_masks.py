"""What moves is found in videos of any look: measured against masks that are known since they were drawn."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import filmed_movers as films
from onedemo.app.cli.demos import add, show
from onedemo.demos.library import find_demo, read_frames
from onedemo.errors import UserError
from onedemo.vision.mask_child import find_in_child, hints_of
from onedemo.vision.mask_file import (
    find_and_keep,
    in_words,
    kept_masks,
    mask_file,
    plain,
    read_masks,
    shrunk,
    write_masks,
)  # fmt: skip
from onedemo.vision.mask_hints import Box, Click, Hints, check_hints, read_box
from onedemo.vision.masks import SURE, Masks, find_masks

FIGURE = Box(frame=10, x=105, y=70, width=110, height=140)
"""Around the drawn person, who stands in the first frames."""


def speeds(way: np.ndarray) -> np.ndarray:
    """Metres a second, of metres in each frame."""
    return np.gradient(way) * films.FPS


@pytest.fixture(scope="module")
def hopping():
    """A few hops as gymnasium draws them."""
    return films.by_gymnasium(films.positions("hopper-hop", 46)[16:])


@pytest.fixture(scope="module")
def person():
    film = films.figure(noise=4.0)
    return films.Film(film.frames[:45], film.masks[:45])


def test_gymnasiums_look_is_read_without_help(hopping):
    found = find_masks(hopping.frames)
    assert found.method == "following" and films.overlap(found.masks, hopping.masks).mean() > 0.83
    assert np.sqrt(np.square(speeds(found.way) - speeds(hopping.way)).mean()) < 0.35  # of 2.5 m/s
    assert found.scale == pytest.approx(96.6, rel=0.2)  # a metre at three metres, 240 pixels high
    assert np.abs(found.floor - hopping.floor).mean() < 25  # the floor shines: part of what it shows is taken
    coded = find_masks(films.compressed(hopping.frames, 30))
    assert films.overlap(coded.masks, hopping.masks).mean() > 0.72
    assert (coded.doubt < SURE).mean() > 0.6


def test_the_programs_own_pictures_are_known(tmp_path):
    demo = find_demo("hopper-hop", tmp_path)
    frames = shrunk(read_frames(demo)[:40], 40, (demo.width, demo.height))
    qpos = films.positions("hopper-hop", 40)
    found = find_masks(frames)
    assert found.method == "studio"
    few = np.array([0, 20, 39])
    true = films.in_the_studio(qpos[few], frames.shape[2:0:-1])
    assert films.overlap(found.masks[few], true).min() > 0.9
    # The camera keeps beside the middle of the body, whose place is nearly that of its root.
    assert np.abs(found.way - (qpos[:, 0] - qpos[0, 0])).max() < 0.4
    assert found.of_length(3.0).scale == found.scale  # known, and not by the robot's length


def test_before_a_background_that_stands_still(person):
    found = find_masks(person.frames)
    assert found.method == "still" and films.overlap(found.masks, person.masks).mean() > 0.8
    assert not found.way.any() and np.abs(found.floor - 208).max() < 8
    middle = person.masks.sum(1) @ (np.arange(320) + 0.5) / person.masks.sum((1, 2))
    assert found.place == pytest.approx((middle - 160) / found.scale, abs=0.06)
    twice = found.of_length(3.1)
    assert twice.scale == pytest.approx(found.scale / 2)


def test_a_camera_that_goes_along_a_wall_is_followed():
    film = films.panned()
    film = films.Film(film.frames[:40], film.masks[:40], film.way[:40])
    found = find_masks(film.frames)
    assert found.method == "following" and films.overlap(found.masks, film.masks).mean() > 0.9
    assert found.way * found.scale == pytest.approx(film.way - film.way[0], abs=3)  # pixels, of a hundred


def test_doubt_is_honest(person):
    """Two movers, one that is cut off, and one that is not there are worse than one that is seen whole."""
    alone = find_masks(person.frames)
    sure = np.median(alone.doubt)
    assert sure < 0.4
    two = np.concatenate([person.frames[:, :, 60:], person.frames[::-1, :, 60:]], axis=2)
    assert np.median(find_masks(two).doubt) > sure + 0.2
    low = person.frames[:, :190]  # the feet are below the picture
    cut_off = find_masks(low)
    assert np.median(cut_off.doubt) > sure + 0.2
    empty = find_masks(np.repeat(person.frames[:1], 20, axis=0))
    assert empty.doubt.min() > 0.3


def test_a_box_says_which_of_two_and_a_place_says_what_is_not(person):
    other = person.frames[::-1][:, :, ::-1]
    two = np.concatenate([person.frames, other], axis=2)
    box = Box(frame=10, x=320 + 105, y=70, width=110, height=140)
    found = find_masks(two, hints=Hints(box=box))
    true = np.concatenate([np.zeros_like(person.masks), person.masks[::-1][:, :, ::-1]], axis=2)
    assert found.method == "chosen"
    overlap = films.overlap(found.masks, true)
    assert overlap[:25].mean() > 0.45 and found.masks[:25, :, :300].mean() < 0.002
    # A place on the head that is not it takes at least that place away.
    y, x = np.argwhere(found.masks[10])[0]
    less = find_masks(two, hints=Hints(box=box, clicks=(Click(frame=10, x=x, y=y + 2, inside=False),)))
    assert found.masks[10, y + 2, x] and not less.masks[10, y + 2, x]


def test_masks_are_kept_small_and_whole(person, tmp_path):
    masks = np.zeros((40, 30, 41), bool)
    masks[:, 5:20, 7:9] = True
    floor = np.full(40, 20.0)
    floor[3] = np.nan
    kept = Masks(masks=masks, floor=floor, scale=12.5, way=None, doubt=np.full(40, 0.2), method="chosen")
    hints = Hints(box=FIGURE, clicks=(Click(frame=1, x=3.5, y=4, inside=False),))
    write_masks(tmp_path / "masks.npz", kept, hints)
    read = read_masks(tmp_path / "masks.npz")
    assert (read.masks == masks).all() and read.way is None and read.scale == 12.5 and read.method == "chosen"
    assert np.isnan(read.floor[3]) and read.floor[4] == 20
    assert hints_of(plain(hints)) == hints
    assert (tmp_path / "masks.npz").stat().st_size < 4000
    assert in_words(read) == "found from what was marked in the picture; sure in 40 of 40 frames"
    (tmp_path / "masks.npz").write_bytes(b"half")
    assert read_masks(tmp_path / "masks.npz") is None and read_masks(tmp_path / "none.npz") is None


def test_a_demo_says_how_its_mover_was_found(person, tmp_path, capsys):
    video = films.written(tmp_path / "v.mp4", person.frames)
    add(video, name="flip", data_dir=tmp_path)
    assert "what moves: found against a background that stands still; sure in" in capsys.readouterr().out
    demo = find_demo("flip", tmp_path / "demos")
    assert kept_masks(demo).method == "still" and mask_file(demo).parent == demo.path.parent
    # The same video again, with a box: now it is that.
    add(video, name="flip", box="105,70,110,140@0.3", data_dir=tmp_path)
    assert kept_masks(demo).method == "chosen" == find_and_keep(demo).method
    show("flip", data_dir=tmp_path)
    assert "moves   found from what was marked" in capsys.readouterr().out
    for wrong, sentence in (
        ("1,2,3", "argument --box: must be X,Y,W,H"),
        ("1,2,30,nan", "argument --box: must be X,Y,W,H"),
        ("1,2,3,4", "is too small"),
        ("300,10,50,50", "reaches outside the picture, which is 320 x 240 pixels"),
        ("0,0,320,240", "is all of the picture"),
        ("105,70,110,140@9", "9 s is past the end of the demo, which lasts 1.50 s"),
    ):
        with pytest.raises(UserError, match=sentence):
            add(video, name="flip", box=wrong, data_dir=tmp_path)
    # In a process of its own it is the same, and what has no time says so.
    find_in_child(demo, Hints(box=FIGURE), tmp_path / "out.npz")
    assert read_masks(tmp_path / "out.npz").method == "chosen"
    with pytest.raises(UserError, match=r"within 0\.01 s"):
        find_in_child(demo, Hints(), tmp_path / "late.npz", seconds=0.01)
    assert not (tmp_path / "late.npz").exists()


def test_marks_are_checked():
    assert read_box("10,20,30.5,40") == ((10, 20, 30.5, 40), 0.0)
    assert read_box("10,20,30,40@1.5") == ((10, 20, 30, 40), 1.5)
    for text in ("", "1,2,3,4,5", "-1,2,3,4", "1,2,3,4@", "a,b,c,d", "1,2,0,4"):
        with pytest.raises(ValueError, match=r"X,Y,W,H|width and a height"):
            read_box(text)
    many = Hints(clicks=(Click(frame=0, x=1, y=1, inside=True),) * 65)
    outside = Hints(clicks=(Click(frame=9, x=1, y=1, inside=True),))
    for hints, sentence in ((many, "at most 64"), (outside, "lies outside the video, which has 9 frames")):
        with pytest.raises(ValueError, match=sentence):
            check_hints(hints, 9, (64, 48))
    for told in (
        {"box": [1, 2, 3]},
        {"clicks": [[1, 2, 3, float("nan")]]},
        {"clicks": "x"},
        {"box": [True] * 5},
    ):
        with pytest.raises(ValueError, match="numbers"):
            hints_of(told)
