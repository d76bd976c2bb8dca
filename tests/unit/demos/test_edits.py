"""What is done to a video on its way in, with real files: the right pictures, in the right order."""

import json
import re
from itertools import pairwise

import cv2
import numpy as np
import pytest
from data.videos import corners_of, encode, number_of
from data.videos import numbered as with_corners
from PIL import Image

from onedemo.demos import decoder_child, preparing
from onedemo.demos.decoder_child import shaped_frames
from onedemo.demos.edits import Options, check_options, in_words, read_loop, read_rotation, read_speed
from onedemo.demos.library import find_demo, import_video, list_demos, read_frames, show
from onedemo.demos.resampling import arranged
from onedemo.demos.source import Source
from onedemo.errors import UserError

LOSSLESS = {"crf": "1", "preset": "ultrafast"}


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """40 numbered pictures with coloured corners at 30 a second."""
    path = tmp_path_factory.mktemp("video") / "counted.mp4"
    encode(path, "libx264", frames=40, size=(192, 128), options=LOSSLESS)
    return path


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A GIF of a simulator: one picture a control step of 0.008 s, played at 3 hundredths each."""
    path = tmp_path_factory.mktemp("video") / "walker.gif"
    images = [Image.fromarray(with_corners(number, 160, 120)) for number in range(250)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=30)
    return path


def shaped(path, warn=lambda _: None, **options):
    wanted = Options(**options)
    check_options(wanted)
    with path.open("rb") as file:
        return list(shaped_frames(file, path.name, wanted, warn))


def numbers(path, **options):
    return [number_of(frame) for frame in shaped(path, **options)]


# --- time -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"speed": 2}, range(0, 40, 2)),
        ({"speed": 4}, range(0, 40, 4)),
        ({"speed": 0.5}, [n for n in range(40) for _ in range(2)]),
        ({"reverse": True}, range(39, -1, -1)),
        ({"loop": 3}, [*range(40)] * 3),
        ({"loop": 0}, [*range(40)] * 6),  # 1.33 s: six times is 8 s
        ({"loop": 0, "speed": 0.2}, [n for n in range(40) for _ in range(5)]),  # 6.7 s fit once
        ({"start": 0.5, "end": 1.1, "reverse": True}, range(32, 14, -1)),
        ({"start": 0.5, "end": 1.1, "speed": 2}, range(15, 33, 2)),
        ({"start": 0.5, "end": 1.1, "speed": 2, "reverse": True, "loop": 2}, [*range(31, 14, -2)] * 2),
        ({"speed": 2, "fps": 15.0}, range(0, 40, 4)),
    ],
)
def test_each_picture_in_its_turn(counted, options, expected):
    assert numbers(counted, **options) == list(expected)


def test_a_simulator_s_gif_gets_its_true_speed(simulated):
    """Reversed and repeated, too: frame k shows the control step at k / 30 s."""
    steps = numbers(simulated, speed=3.75)
    assert len(steps) == 60  # 250 steps of 0.008 s are 2 s
    assert steps == [pytest.approx(k / 30 / 0.008, abs=1.01) for k in range(60)]
    assert numbers(simulated, speed=3.75, reverse=True, loop=2) == steps[::-1] * 2


def test_what_does_not_fit_into_memory_is_gone_through_again():
    """A picture of one number each; 3 fit at a time."""
    passes = []

    def play(first, last):
        passes.append((first, last))
        yield from [np.full(8, number, np.uint8) for number in range(10)][first:last]

    def out(reverse, times, room=3 * 8):
        return [
            int(picture[0]) for picture in arranged(play, lambda count: times, reverse=reverse, room=room)
        ]

    assert out(True, 2) == [*range(9, -1, -1)] * 2
    assert passes[1:5] == [(7, 10), (4, 7), (1, 4), (0, 1)]
    assert out(False, 3) == [*range(10)] * 3
    passes.clear()
    assert out(True, 3, room=80) == [*range(9, -1, -1)] * 3 and passes == [(0, None)]


def test_a_long_video_backwards_is_decoded_part_by_part(counted, monkeypatch):
    opened = []

    def source(*given):
        opened.append(given)
        return Source(*given)

    monkeypatch.setattr(decoder_child, "Source", source)
    monkeypatch.setattr(decoder_child, "_ROOM", 11 * 192 * 128 * 3)
    assert numbers(counted, reverse=True, loop=2) == [*range(39, -1, -1)] * 2
    assert len(opened) == 1 + 2 * 4  # 40 pictures, 11 at a time
    assert numbers(counted, loop=2) == [*range(40)] * 2


def test_of_a_picture_that_stays_one_is_kept():
    one = np.zeros(8, np.uint8)
    passes = []

    def play(first, last):
        passes.append(first)
        yield from [one] * 50

    assert sum(1 for _ in arranged(play, lambda count: 2, reverse=False, room=8)) == 100 and passes == [0]


# --- the picture ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degrees", "corners", "size"),
    [
        (0, "RG/BY", (192, 128)),
        (90, "BR/YG", (128, 192)),
        (180, "YB/GR", (192, 128)),
        (270, "GY/RB", (128, 192)),
    ],
)
def test_a_quarter_turn_is_clockwise(counted, degrees, corners, size):
    frames = shaped(counted, rotate=degrees)
    assert {corners_of(frame) for frame in frames} == {corners} and frames[0].shape[1::-1] == size


def test_a_turn_comes_after_that_of_the_file_and_before_crop_and_mirror(tmp_path):
    from data.videos import KINDS

    (kind,) = [kind for kind in KINDS if kind.file == "turned-90.mp4"]
    kind.make(tmp_path / kind.file)
    assert corners_of(shaped(tmp_path / kind.file, rotate=270)[0]) == "RG/BY"  # once around
    turned = shaped(tmp_path / kind.file)[0]
    part = shaped(tmp_path / kind.file, rotate=90, crop=(0, 0, 48, 32), mirror=True)[0]
    wanted = np.rot90(turned, -1)[:32, :48][:, ::-1]
    assert part.shape == (32, 48, 3) and np.abs(part.astype(int) - wanted).max() < 3


def room_with(figure, *, size=(320, 240), seed=0):
    """A picture of a room: patches of many colours, and a red figure at (x, y), 24 x 60 pixels."""
    rng = np.random.default_rng(seed)
    width, height = size
    patches = rng.integers(40, 215, (height // 8, width // 8, 3), dtype=np.uint8)
    patches[..., 0] = np.minimum(patches[..., 0], patches[..., 1])  # none is red
    picture = cv2.resize(patches, size, interpolation=cv2.INTER_CUBIC)
    if figure is not None:
        x, y = (round(place) for place in figure)
        picture[y - 30 : y + 30, x - 12 : x + 12] = 230, 20, 20
    return picture


def centre_of(frame):
    """Where the red figure is, as shares of the picture."""
    red = (frame[..., 0] > 170) & (frame[..., 1] < 80) & (frame[..., 2] < 80)
    rows, columns = np.nonzero(red)
    return columns.mean() / frame.shape[1], rows.mean() / frame.shape[0]


def film(path, pictures, size=(320, 240)):
    encode(path, "libx264", frames=pictures, size=size, options=LOSSLESS)
    return path


def walk(count=60):
    """Places of a figure that goes to the right and hops."""
    t = np.arange(count) / (count - 1)
    return [(40 + 240 * at, 150 - 20 * abs(np.sin(4 * np.pi * at))) for at in t]


def test_a_crop_follows_what_moves_and_never_leaves_the_picture(tmp_path):
    path = film(tmp_path / "walk.mp4", [room_with(place) for place in walk()])
    frames = shaped(path, track=True)
    height, width = frames[0].shape[:2]
    assert {frame.shape for frame in frames} == {(height, width, 3)} and width < 140 and height < 140
    places = np.array([centre_of(frame) for frame in frames])
    assert np.abs(places[6:-6, 0] - 0.5).max() < 0.06  # at the ends the picture is at its end
    assert np.ptp(places[:, 1]) * height > 14  # its hops can be seen: the crop does not hop along
    still = np.array([centre_of(frame) for frame in shaped(path)])
    assert np.ptp(still[:, 0]) > 0.7


def test_a_rectangle_follows_what_moves_in_it_and_nobody_else(tmp_path):
    """A passer-by in black goes the other way, and behind the figure."""
    pictures = []
    for n, (x, y) in enumerate(walk(60)):
        picture = room_with(None)
        at = round(300 - 280 * n / 59)
        picture[130:200, at - 10 : at + 10] = 10
        picture[round(y) - 30 : round(y) + 30, round(x) - 12 : round(x) + 12] = 230, 20, 20
        pictures.append(picture)
    path = film(tmp_path / "two.mp4", pictures)
    frames = shaped(path, track=True, crop=(5, 90, 80, 110))
    assert frames[0].shape == (110, 80, 3)
    places = np.array([centre_of(frame)[0] for frame in frames])
    assert np.abs(places[8:-8] - 0.5).max() < 0.16  # a little drawn along where both meet
    assert np.abs(places[[10, 15, 45, 50]] - 0.5).max() < 0.06
    assert "in the rectangle of --crop at the beginning of two.mp4" in refused(
        path, track=True, crop=(130, 0, 60, 60)
    )


def test_a_following_crop_has_the_size_of_the_rectangle_and_calm(tmp_path):
    """It is as large as asked; a place that is told a little wrong each time does not shake it."""
    rng = np.random.default_rng(1)
    places = [(x + rng.uniform(-3, 3), y) for x, y in walk(90)]
    path = film(tmp_path / "walk.mp4", [room_with(place) for place in places])
    frames = shaped(path, track=True, crop=(0, 100, 100, 90))
    assert frames[0].shape == (90, 100, 3)
    at = np.array([centre_of(frame)[0] * 100 for frame in frames]) - [x for x, _ in places]
    assert np.abs(np.diff(at, 2))[8:-8].max() < 3  # of the crop's left edge; the figure itself shakes by 12


def test_a_figure_that_climbs_is_followed_upwards(tmp_path):
    places = [(160, 205 - 170 * n / 59) for n in range(60)]
    frames = shaped(film(tmp_path / "climb.mp4", [room_with(place) for place in places]), track=True)
    centres = np.array([centre_of(frame) for frame in frames])
    assert np.abs(centres[12:-12] - 0.5).max() < 0.1


def shaken(pictures, *, by=7.0, turn=0.02, seed=3):
    """The same from a hand that is not calm: moved by pixels, turned by radians."""
    rng = np.random.default_rng(seed)
    for picture in pictures:
        height, width = picture.shape[:2]
        matrix = cv2.getRotationMatrix2D((width / 2, height / 2), np.degrees(rng.uniform(-turn, turn)), 1.0)
        matrix[:, 2] += rng.uniform(-by, by, 2)
        yield cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)


def unrest(frames):
    """Mean change of the background from frame to frame, of 255; the strip above the figure is looked at."""
    grey = [frame[: frame.shape[0] // 3].astype(float).mean(2) for frame in frames]
    return float(np.mean([np.abs(b - a).mean() for a, b in pairwise(grey)]))


def test_the_background_of_a_shaken_video_is_held_still(tmp_path):
    path = film(tmp_path / "shaken.mp4", shaken([room_with(place) for place in walk(45)]))
    before, frames = unrest(shaped(path)), shaped(path, stabilise=True)
    assert unrest(frames) < 0.12 * before, (unrest(frames), before)
    height, width = frames[0].shape[:2]
    assert 0.5 * 320 < width < 320 and 0.5 * 240 < height < 240  # without the edges that are not always seen
    edges = [edge for frame in frames for edge in (frame[0], frame[-1], frame[:, 0], frame[:, -1])]
    assert min(edge.max(axis=1).min() for edge in edges) > 25  # and none is filled in with black
    places = np.array([centre_of(frame)[0] for frame in frames])
    assert np.all(np.diff(places) > 0)  # the figure goes on


def test_a_crop_follows_in_a_shaken_video_once_it_is_held_still(tmp_path):
    path = film(tmp_path / "shaken.mp4", shaken([room_with(place) for place in walk(60)]))
    frames = shaped(path, stabilise=True, track=True, speed=2, reverse=True, mirror=True, loop=2)
    assert len(frames) == 60
    places = np.array([centre_of(frame) for frame in frames[:30]])
    assert np.abs(places[5:-5, 0] - 0.5).max() < 0.1
    assert all((a == b).all() for a, b in zip(frames[:30], frames[30:], strict=True))


def test_a_background_that_stands_still_is_left_alone(tmp_path):
    said = []
    path = film(tmp_path / "walk.mp4", [room_with(place) for place in walk(30)])
    frames = shaped(path, stabilise=True, warn=said.append)
    assert any("stands still as it is" in sentence for sentence in said)
    assert all((a == b).all() for a, b in zip(frames, shaped(path), strict=True))


def test_a_crop_of_a_video_that_is_held_still_stays_where_it_was_drawn(tmp_path):
    path = film(tmp_path / "shaken.mp4", shaken([room_with(place) for place in walk(30)]))
    part = shaped(path, stabilise=True, crop=(100, 40, 120, 100))
    first = shaped(path)[0][40:140, 100:220]
    assert part[0].shape == (100, 120, 3)
    assert all(np.abs(frame.astype(int) - first)[:30].mean() < 8 for frame in part)


# --- what cannot be done --------------------------------------------------------------------------


def refused(path, **options):
    with pytest.raises(UserError) as caught:
        shaped(path, **options)
    sentence = str(caught.value)
    assert "\n" not in sentence and not sentence.endswith(".")
    return sentence


def test_what_cannot_be_followed_or_held_still_is_said(tmp_path):
    rng = np.random.default_rng(0)
    noise = film(
        tmp_path / "noise.mp4", [rng.integers(0, 255, (240, 320, 3), dtype=np.uint8) for _ in range(12)]
    )
    assert re.search(
        r"^--track finds nothing in noise.mp4 that moves .*--stabilise", refused(noise, track=True)
    )
    assert "--stabilise finds no background in noise.mp4 at 0.03 s" in refused(noise, stabilise=True)
    plain = [
        cv2.circle(np.full((240, 320, 3), 200, np.uint8), (20 * n, 120), 9, (0, 0, 0), -1) for n in range(12)
    ]
    assert "--stabilise finds no background" in refused(film(tmp_path / "wall.mp4", plain), stabilise=True)
    wide = room_with(None, size=(960, 240))
    pan = film(tmp_path / "pan.mp4", [wide[:, 12 * n : 12 * n + 320] for n in range(45)])
    assert re.search(r"--stabilise would leave \d+ x 2\d\d of 320 x 240 pixels", refused(pan, stabilise=True))
    cut = [room_with(None, seed=n // 10) for n in range(20)]
    assert "at 0.33 s that is that of before (a cut" in refused(
        film(tmp_path / "cut.mp4", cut), stabilise=True
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"speed": 0}, "--speed must be a number from 0.1 to 20, .*, got 0$"),
        ({"speed": -1}, "--speed must be a number from 0.1 to 20, .*, got -1$"),
        ({"speed": float("nan")}, "--speed must be a number .* got nan$"),
        ({"speed": 20}, r"gives 0.07 s between --start and --end at --speed 20"),
        ({"loop": -1}, "--loop must be a whole number, 1 or more, or stand alone .*, got -1$"),
        ({"loop": 50}, r"--loop 50 of 1.33 s is 67 s, and a demo lasts at most 60 s: --loop 45 is the most"),
        ({"rotate": 45}, "--rotate must be 90, 180 or 270 degrees clockwise, got 45"),
        ({"start": 0.2, "end": 1.2, "speed": 0.1, "loop": 7}, r"--loop 7 of 10.00 s is 70 s.* --loop 6 is"),
        ({"rotate": 90, "crop": (0, 0, 192, 100)}, "outside the picture, which is 128 x 192 pixels"),
    ],
)
def test_bad_options_are_named_with_what_would_be_right(counted, options, words):
    assert re.search(words, refused(counted, **options))


@pytest.mark.parametrize(
    ("read", "given", "words"),
    [
        (read_speed, "fast", "--speed must be a number .*, got fast"),
        (read_speed, "", "--speed must be a number"),
        (read_speed, True, "--speed must be a number"),
        (read_speed, [1], "--speed must be a number"),
        (read_speed, "9" * 999, "--speed must be a number"),
        (read_loop, "0", "--loop must be a whole number, 1 or more, or stand alone .*, got 0"),
        (read_loop, "2.5", "--loop must be a whole number"),
        (read_loop, "x.mp4", "--loop must be a whole number.*, got x.mp4"),
        (read_loop, None, "--loop must be a whole number"),
        (read_rotation, "45", "--rotate must be 90, 180 or 270 degrees clockwise, got 45"),
        (read_rotation, "left\x1b", "--rotate must be 90, 180 or 270"),
        (read_rotation, 1.5, "--rotate must be"),
    ],
)
def test_what_somebody_has_typed_is_read(read, given, words):
    with pytest.raises(UserError, match=words) as told:
        read(given)
    assert str(told.value).isprintable() and len(str(told.value)) < 200
    assert (read_speed("3.75"), read_loop("3"), read_loop(True), read_loop(False)) == (3.75, 3, 0, 1)
    assert read_rotation("270") == 270


# --- what is stored -------------------------------------------------------------------------------


def test_what_was_done_is_stored_with_the_demo_and_makes_it_the_same_again(counted, tmp_path, monkeypatch):
    how = {"speed": 2.0, "reverse": True, "loop": 2, "rotate": 90}
    library = tmp_path / "demos"
    demo = import_video(counted, name="back", demos_dir=library, **how)
    assert [number_of(np.rot90(frame)) for frame in read_frames(demo)] == [*range(38, -1, -2)] * 2
    assert demo.edits == "turned by 90°, 2 times as fast, backwards, repeated 2 times"
    assert demo.edits in show(demo) and find_demo("back", library) == demo
    about = json.loads((demo.path.parent / "demo.json").read_bytes())
    assert {name: about["options"][name] for name in how} == how
    elsewhere = import_video(counted, name="there", demos_dir=tmp_path / "other", **how)
    assert elsewhere.sha256 == demo.sha256
    monkeypatch.setattr(preparing, "decode", None)  # the same again is not even decoded
    assert import_video(counted, name="again", demos_dir=library, **how) == demo


def test_demos_of_before_stay_readable(counted, tmp_path):
    """They name five options, or none; somebody may have edited them."""
    library = tmp_path / "demos"
    demo = import_video(counted, name="plain", demos_dir=library, start=0.2, end=1.0)
    file = demo.path.parent / "demo.json"
    about = json.loads(file.read_bytes())
    assert set(about["options"]) == {"start", "end", "crop", "mirror", "fps"}
    assert demo.edits == "from 0.2 to 1 s"
    for options in ({}, None, [1], {"start": "x"}, {"speed": None, "start": 1}, {"loop": "a"}):
        file.write_text(json.dumps(about | {"options": options}))
        assert [d.edits for d in list_demos(library) if d.name == "plain"] == [""]
    file.write_text(json.dumps({name: value for name, value in about.items() if name != "options"}))
    assert find_demo("plain", library).edits == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ""),
        ({"end": 9}, "from 0 to 9 s"),
        ({"start": 1.5}, "from 1.5 s on"),
        ({"crop": [1, 2, 30, 40], "mirror": True}, "cropped, mirrored"),
        (
            {"crop": [1, 2, 30, 40], "track": True, "stabilise": True},
            "background held still, follows the mover",
        ),
        ({"speed": 0.5, "loop": 0}, "0.5 times as fast, repeated to fill 8 s"),
    ],
)
def test_what_was_done_in_words(options, words):
    assert in_words(options) == words
