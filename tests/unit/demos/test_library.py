"""Real video files in every container, whole, broken and odd."""

import json
import logging
import re
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from helpers.paths import PERSON, ROOT
from onedemo.demos import library as demos
from onedemo.demos import preparing
from onedemo.demos.decoder_child import shaped_frames
from onedemo.demos.library import find_demo, import_video, list_demos, read_frames, render_demo, show
from onedemo.demos.resampling import resample
from onedemo.demos.video import VideoReader, count_frames, write_webm
from onedemo.errors import UserError

WIDTH, HEIGHT = 160, 96

CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".avi": "MJPG", ".mkv": "VP80"}


def numbered(number, width=WIDTH, height=HEIGHT):
    """A picture that carries its number: ten black or white columns below a colour wash."""
    image = np.empty((height, width, 3), np.uint8)
    image[:] = (200, 120, 40)
    for bit in range(10):
        left, right = bit * width // 10, (bit + 1) * width // 10
        image[height // 2 :, left:right] = 255 if number >> bit & 1 else 0
    return image


def number_of(image):
    """The number a picture carries, after any compression and scaling."""
    height, width = image.shape[:2]
    row = image[height * 3 // 4].mean(1)
    return sum(int(row[(2 * bit + 1) * width // 20] > 127) << bit for bit in range(10))


def numbers(demo):
    return [number_of(frame) for frame in read_frames(demo)]


def make_video(path, count=30, fps=30.0, size=(WIDTH, HEIGHT), picture=numbered):
    if path.suffix == ".gif":
        images = [Image.fromarray(picture(i, *size)) for i in range(count)]
        images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps))
    elif path.suffix == ".webm":
        write_webm(path, (picture(i, *size) for i in range(count)), fps=fps)
    else:
        code = cv2.VideoWriter.fourcc(*CODECS[path.suffix])
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, size)
        assert writer.isOpened()
        for i in range(count):
            writer.write(picture(i, *size)[..., ::-1])
        writer.release()
    return path


@pytest.fixture(autouse=True)
def quickly(request, monkeypatch):
    """Decodes in this process, but for tests that are marked ``seam``: the child has tests of its own."""
    if request.node.get_closest_marker("seam") is None:
        monkeypatch.setattr(
            preparing, "decode", lambda path, options, _, warn: in_process(path, options, warn)
        )


def in_process(path, options, warn):
    with path.open("rb") as file:
        yield from shaped_frames(file, str(path), options, warn)


@pytest.fixture
def library(tmp_path):
    return tmp_path / "demos"


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """30 numbered frames in one second."""
    return make_video(tmp_path_factory.mktemp("video") / "move.mp4")


def refused(path, library, **options):
    """The sentence with which a video is refused; checks that nothing is left of it."""
    before = sorted(library.rglob("*")) if library.exists() else []
    with pytest.raises(UserError) as caught:
        import_video(path, name=options.pop("name", "move"), demos_dir=library, **options)
    assert (sorted(library.rglob("*")) if library.exists() else []) == before
    sentence = str(caught.value)
    assert "\n" not in sentence and not sentence.endswith(".")
    return sentence


# --- what comes in --------------------------------------------------------------------------------


@pytest.mark.seam
@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".avi", ".mkv", ".webm"])
def test_every_container_keeps_every_frame(tmp_path, library, suffix):
    path = make_video(tmp_path / f"move{suffix}")
    demo = import_video(path, name="move", demos_dir=library, task="hop")
    assert (demo.frames, demo.fps, demo.width, demo.height) == (30, 30.0, WIDTH, HEIGHT)
    assert numbers(demo) == list(range(30))
    assert (demo.task, demo.source, demo.seconds) == ("hop", f"move{suffix}", 1.0)
    assert demo.path == library / demo.sha256 / "video.webm"


def test_gif_comes_in_at_its_own_pace(tmp_path, library):
    path = make_video(tmp_path / "move.gif", count=10, fps=10)
    demo = import_video(path, name="move", demos_dir=library)
    assert numbers(demo) == [i // 3 for i in range(30)]


def test_variable_frame_rate_is_resampled_by_time_stamps(tmp_path, library):
    images = [Image.fromarray(numbered(i)) for i in range(4)]
    path = tmp_path / "uneven.gif"
    images[0].save(path, save_all=True, append_images=images[1:], duration=[100, 400, 200, 100])
    demo = import_video(path, name="uneven", demos_dir=library, fps=10)
    # On screen: 0 in 0..0.1 s, 1 in 0.1..0.5, 2 in 0.5..0.7, 3 from 0.7 on.
    assert numbers(demo)[:8] == [0, 1, 1, 1, 1, 2, 2, 3]


def test_streams_without_time_stamps_fall_back_to_the_nominal_rate(tmp_path, library):
    path = tmp_path / "raw.mjpeg"
    pictures = [cv2.imencode(".jpg", numbered(i))[1].tobytes() for i in range(20)]
    path.write_bytes(b"".join(pictures))
    demo = import_video(path, name="raw", demos_dir=library, fps=25)
    assert numbers(demo) == list(range(20))


@pytest.mark.parametrize(("fps", "wanted"), [(15.0, 15), (60.0, 60), (24.0, 24), (10.0, 10)])
def test_any_rate_becomes_any_other(video, library, fps, wanted):
    demo = import_video(video, name="move", demos_dir=library, fps=fps)
    assert demo.frames == wanted and demo.fps == fps
    shown = numbers(demo)
    assert shown == [int(k / fps * 30 + 1e-6) for k in range(wanted)]


def test_trim_crop_and_mirror(video, library):
    demo = import_video(video, name="part", demos_dir=library, start=0.5, end=0.8)
    assert numbers(demo) == list(range(15, 24))
    half = import_video(video, name="left", demos_dir=library, crop=(0, 48, 80, 48))
    assert (half.width, half.height) == (80, 48)
    mirrored = import_video(video, name="mirror", demos_dir=library, mirror=True)
    assert numbers(mirrored)[5] == int(f"{5:010b}"[::-1], 2)


def test_large_odd_pictures_are_scaled_to_even_sides(tmp_path, library):
    path = make_video(tmp_path / "big.avi", count=9, size=(500, 800))
    demo = import_video(path, name="big", demos_dir=library)
    assert (demo.width, demo.height) == (400, 640)
    odd = import_video(path, name="odd", demos_dir=library, crop=(150, 300, 333, 333))
    assert (odd.width, odd.height) == (332, 332)


def test_stored_colours_are_rgb(video, library):
    frame = read_frames(import_video(video, name="move", demos_dir=library))[0]
    assert np.abs(frame[10, 80].astype(int) - (200, 120, 40)).max() < 12


# --- the same video, the same name ----------------------------------------------------------------


def test_the_same_video_twice_is_the_same_demo(video, library, tmp_path):
    first = import_video(video, name="move", demos_dir=library)
    copy = tmp_path / "copy.mp4"
    copy.write_bytes(video.read_bytes())
    assert import_video(copy, name="move", demos_dir=library) == first
    assert import_video(copy, name="other", demos_dir=library) == first
    assert len(list(library.iterdir())) == 1


def test_a_taken_name_is_refused(video, library, tmp_path):
    import_video(video, name="move", demos_dir=library)
    other = make_video(tmp_path / "other.avi", count=12)
    assert "the name move is taken" in refused(other, library)
    built_in = [demo.name for demo in list_demos(tmp_path / "none")]
    for name in built_in[:1]:
        assert "taken" in refused(other, library, name=name)


@pytest.mark.parametrize("name", ["", "a b", "../up", "a/b", "é", "x" * 65, "a.b", "a\n"])
def test_bad_names_are_refused(video, library, name):
    assert "letters, digits, '-' or '_'" in refused(video, library, name=name)


# --- bad input ------------------------------------------------------------------------------------


def test_files_that_are_no_video(tmp_path, library):
    assert "no video file at" in refused(tmp_path / "none.mp4", library)
    for name, content in (("noise.mp4", bytes(range(256)) * 9), ("a.webm", b"\0" * 5000)):
        (tmp_path / name).write_bytes(content)
        assert "is not a video that can be read" in refused(tmp_path / name, library)


@pytest.mark.seam
def test_files_that_are_no_video_print_nothing(tmp_path, library, capfd):
    (tmp_path / "text.mp4").write_bytes(b"hello " * 999)
    refused(tmp_path / "text.mp4", library)
    assert capfd.readouterr() == ("", "")


def test_an_mp4_cut_in_the_middle(video, tmp_path, library):
    path = tmp_path / "cut.mp4"
    path.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    assert "cut off before its index" in refused(path, library)


@pytest.mark.parametrize("suffix", [".avi", ".webm"])
def test_a_video_that_breaks_off_says_how_much_can_be_read(tmp_path, library, suffix):
    whole = make_video(tmp_path / f"whole{suffix}", count=60)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    sentence = refused(path, library)
    assert "breaks off: only" in sentence and "of 60 frames" in sentence
    end = float(sentence.split("--end ")[1].split()[0])
    rescued = import_video(path, name="rescued", demos_dir=library, end=end)
    assert numbers(rescued) == list(range(round(end * 30)))


def test_one_frame_is_no_move(tmp_path, library):
    assert "at least 2 frames" in refused(make_video(tmp_path / "a.avi", count=1), library)
    Image.fromarray(numbered(1)).save(tmp_path / "still.jpg")
    assert "at least 2 frames" in refused(tmp_path / "still.jpg", library)


def test_one_frame_between_start_and_end(video, library):
    assert "at least 2 frames" in refused(video, library, start=0.5, end=0.51)


def test_longer_than_a_minute(tmp_path, library):
    path = make_video(tmp_path / "long.avi", count=640, fps=10, size=(32, 32))
    assert "longer than 60 s" in refused(path, library)
    demo = import_video(path, name="end", demos_dir=library, start=60.0, fps=10)
    assert demo.frames == 40
    assert import_video(path, name="most", demos_dir=library, start=4, fps=10).frames == 600


def test_a_wrong_header_does_not_let_a_long_video_in(tmp_path, library):
    path = tmp_path / "long.gif"  # gif headers name no length
    images = [Image.fromarray(numbered(i, 32, 32)) for i in range(4)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=[100, 99000, 100, 100])
    assert "longer than 60 s" in refused(path, library)


def test_too_large_and_too_small(tmp_path, library):
    wide = make_video(tmp_path / "wide.avi", count=2, size=(4112, 32))
    assert "4112 x 32 pixels; a side may have at most 4096" in refused(wide, library)
    tiny = make_video(tmp_path / "tiny.avi", count=2, size=(12, 12))
    assert "at least 16 x 16" in refused(tiny, library)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"start": 1.2}, "--start 1.2 is past the end"),
        ({"start": 99.0}, "--start 99 is past the end"),
        ({"start": -1.0}, "--start must be 0"),
        ({"start": float("nan")}, "--start must be 0"),
        ({"start": 0.5, "end": 0.5}, "--end must be later than --start"),
        ({"end": 0.0}, "--end must be later"),
        ({"end": float("nan")}, "--end must be later"),
        ({"crop": (100, 0, 61, 20)}, "outside the picture, which is 160 x 96 pixels"),
        ({"crop": (-1, 0, 60, 20)}, "--crop is x,y,width,height"),
        ({"crop": (0, 0, 0, 20)}, "--crop is x,y,width,height"),
        ({"fps": 0.5}, "--fps must be from 1 to 120"),
        ({"fps": 121.0}, "--fps must be from 1 to 120"),
        ({"fps": float("nan")}, "--fps must be from 1 to 120"),
    ],
)
def test_bad_options_are_refused(video, library, options, words):
    assert words in refused(video, library, **options)


_IMPORT_WITH_LITTLE_SPACE = """
import resource, sys
from pathlib import Path
from onedemo.demos.library import import_video
from onedemo.errors import UserError
resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
try:
    import_video(sys.argv[1], name="move", demos_dir=Path(sys.argv[2]))
except UserError as error:
    print(error)
"""


@pytest.mark.seam
def test_a_disk_without_space_is_noticed_and_left_clean(video, library):
    done = subprocess.run(
        [sys.executable, "-c", _IMPORT_WITH_LITTLE_SPACE, str(video), str(library)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "was not written whole: is the disk full?" in done.stdout, done.stderr
    assert list(library.iterdir()) == []


def test_a_place_where_nothing_can_be_stored(video, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot store demos in"):
        import_video(video, name="move", demos_dir=tmp_path / "file" / "demos")


# --- the library ----------------------------------------------------------------------------------


def test_list_find_and_show(video, library):
    demo = import_video(video, name="my-hop", demos_dir=library)
    assert demo in list_demos(library)
    assert find_demo("my-hop", library) == demo
    with pytest.raises(UserError, match=r"did you mean my-hop\?\); known demos: .*my-hop"):
        find_demo("my-hopp", library)
    with pytest.raises(UserError, match=r"no demo called 'zzzz'; known demos"):
        find_demo("zzzz", library)
    text = show(demo)
    assert "1.00 s, 30 frames at 30 per second" in text and "160 x 96" in text


def test_a_damaged_demo_is_left_out_and_logged(video, library, caplog):
    demo = import_video(video, name="move", demos_dir=library)
    (library / demo.sha256 / "demo.json").write_text('{"name": "mo')
    with caplog.at_level(logging.WARNING):
        assert "move" not in [d.name for d in list_demos(library)]
    assert demo.sha256 in caplog.text
    again = import_video(video, name="move", demos_dir=library)  # heals it
    assert find_demo("move", library) == again


def test_a_damaged_stored_video_is_noticed(video, library):
    demo = import_video(video, name="move", demos_dir=library)
    demo.path.write_bytes(demo.path.read_bytes()[:-2000])
    with pytest.raises(UserError, match=r"damaged: \d+ of 30 frames"):
        read_frames(demo)
    demo.path.unlink()
    with pytest.raises(UserError, match="missing or damaged: 0 of 30 frames"):
        read_frames(demo)


def test_the_built_in_demos_are_whole():
    for path in sorted(demos.BUILT_IN.glob("*.webm")):
        about = json.loads(path.with_suffix(".json").read_text())
        demo = find_demo(about["name"], Path("nowhere"))
        assert demo.path == path and path.stem == demo.name
        assert read_frames(demo).shape == (demo.frames, 360, 480, 3)
        assert demo.task in ("backflip", "hop", "forward")
        assert preparing.sha256_of(path) == demo.sha256


@pytest.mark.seam
def test_stored_positions_become_a_demo(tmp_path):
    qpos = np.zeros((251, 6))
    qpos[:, 1] = 1.25
    qpos[:, 2] = -np.linspace(0, 6, 251)
    demo = render_demo(qpos, name="spin", task="backflip", source="a test", out_dir=tmp_path)
    assert (demo.frames, demo.width, demo.height, demo.fps) == (60, 480, 360, 30.0)
    frames = read_frames(demo)
    assert np.abs(frames[0].astype(int) - frames[59]).max() > 100
    assert sorted(p.name for p in tmp_path.iterdir()) == ["spin.json", "spin.webm"]


# --- pieces ---------------------------------------------------------------------------------------


def test_resample_shows_what_was_on_screen():
    stamped = [(0.0, np.array(0)), (0.25, np.array(1)), (0.5, np.array(2)), (1.0, np.array(3))]
    out = resample(stamped, fps=4, lasts=lambda: 0.5, start=0.0, end=np.inf)
    assert [int(x) for x in out] == [0, 1, 2, 2, 3, 3]
    # Starting between two frames, the earlier one is on screen.
    out = resample(stamped, fps=4, lasts=lambda: 0.5, start=0.4, end=1.2)
    assert [int(x) for x in out] == [1, 2, 2]


def test_written_files_are_webm(tmp_path):
    path = tmp_path / "a.webm"
    write_webm(path, [numbered(i) for i in range(5)], fps=30)
    head = path.read_bytes()[:64]
    assert b"webm" in head and b"matroska" not in head
    assert count_frames(path) == 5
    with VideoReader(path) as reader:
        assert reader.fps == 30
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not PERSON.is_file(), reason="ONEDEMO_PERSON_VIDEO names no video")
def test_a_real_person(library):
    demo = import_video(PERSON, name="person", demos_dir=library, end=1.0)
    assert (demo.frames, demo.width, demo.height) == (30, 480, 480)
    assert read_frames(demo).std() > 20


# --- what a demo is, and its name -----------------------------------------------------------------


def test_the_same_video_is_the_same_demo_everywhere(video, tmp_path):
    """The container holds a random number; exported ratings meet the same demo elsewhere, or added again."""
    one, two = (import_video(video, name="move", demos_dir=tmp_path / each) for each in "ab")
    assert one.sha256 == two.sha256
    demos.remove_demo(one, tmp_path / "a")
    assert import_video(video, name="again", demos_dir=tmp_path / "a").sha256 == one.sha256
    assert demos.is_whole(two)


@pytest.mark.parametrize(
    "options",
    [{"end": 10.0}, {"end": np.inf}, {"crop": (0, 0, WIDTH, HEIGHT)}, {"start": -0.0}, {"start": 1e-9}],
)
def test_other_options_that_give_the_same_pictures_are_the_same_demo(video, library, options):
    first = import_video(video, name="move", demos_dir=library)
    assert import_video(video, name="other", demos_dir=library, **options) == first


def test_a_demo_of_before_stays_readable_and_is_found_again(video, library):
    """Its sha256 was that of the file, which named the directory."""
    demo = import_video(video, name="move", demos_dir=library)
    about = json.loads((demo.path.parent / "demo.json").read_text())
    of_file = about.pop("video_sha256")
    old = library / of_file
    demo.path.parent.rename(old)
    (old / "demo.json").write_text(json.dumps(about | {"sha256": of_file}))
    kept = find_demo("move", library)
    assert kept.sha256 == of_file and demos.is_whole(kept) and numbers(kept) == list(range(30))
    assert import_video(video, name="other", demos_dir=library) == kept
    kept.path.write_bytes(kept.path.read_bytes()[:-1] + b"x")
    assert not demos.is_whole(kept)


def test_of_two_that_are_added_under_one_name_at_once_one_wins(video, tmp_path, library):
    other = make_video(tmp_path / "other.avi", count=12)
    outcomes = []

    def add(path):
        try:
            outcomes.append(import_video(path, name="move", demos_dir=library).name)
        except UserError as error:
            outcomes.append(str(error))

    threads = [threading.Thread(target=add, args=(path,)) for path in (video, other)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["move", "the name move is taken by another demo; choose another --name"]
    assert len(list(library.iterdir())) == 1


def test_rename_and_remove(video, library, tmp_path):
    demo = import_video(video, name="move", demos_dir=library)
    renamed = demos.rename_demo(demo, "better", library)
    assert find_demo("better", library) == renamed and renamed.sha256 == demo.sha256
    with pytest.raises(UserError, match="no demo called 'move'"):
        find_demo("move", library)
    with pytest.raises(UserError, match="taken"):
        demos.rename_demo(renamed, "hopper-hop", library)
    with pytest.raises(UserError, match="letters"):
        demos.rename_demo(renamed, "../up", library)
    for change in (demos.remove_demo, lambda demo, place: demos.rename_demo(demo, "x", place)):
        with pytest.raises(UserError, match="comes with the program"):
            change(find_demo("hopper-hop", library), library)
    demos.remove_demo(renamed, library)
    assert list(library.iterdir()) == []


def test_what_was_stored_is_compared_with_what_came_in(video, library, monkeypatch):
    """As if the encoder stored black, as OpenCV decoded interlaced video."""
    monkeypatch.setattr(preparing, "write_webm", lambda path, frames, fps: write_webm(
        path, (frame * (number < 20) for number, frame in enumerate(frames)), fps=fps))  # fmt: skip
    assert "frame 20 was not stored as it came in" in refused(video, library)


# --- what people give by mistake ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            "https://www.youtube.com/watch?v=x",
            "https://www.youtube.com/watch.v=x is a web address: download the video",
        ),
        ("/dev/video0", "is a camera"),
        ("0", "is a camera"),
        ("/dev/null", "is a device"),
        ("frames/%04d.png", "stands for several files; .* ffmpeg -framerate 30"),
        ("frames/*.png", "stands for several files"),
        ("nowhere.mp4", "no video file at nowhere.mp4"),
        ("x" * 300, "no video file at"),
        ("a\0b", "no video file at"),
    ],
)
def test_what_is_no_file_is_named(library, given, words):
    assert re.search(words, refused(given, library))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"\n<html lang=en>", "is a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        (b"PK\x03\x04" + b"x" * 99, "is an archive: unpack it"),
        (b"%PDF-1.7", "is a PDF"),
        (b"\0\0\0\x18ftypheic", "is a single picture"),
        (b"ID3" + b"x" * 99, "is sound without a picture"),
        (b"Thank you for your order. " * 9, "is a text file"),
    ],
)
def test_what_is_no_video_is_named_before_anything_is_decoded(tmp_path, library, monkeypatch, content, words):
    monkeypatch.setattr(preparing, "decode", None)
    (tmp_path / "x.mp4").write_bytes(content)
    assert re.search(words, refused(tmp_path / "x.mp4", library))
    with pytest.raises(UserError, match="is a folder: give one video file"):
        import_video(tmp_path, name="x", demos_dir=library)


def test_a_video_that_an_older_version_decoded_otherwise_is_decoded_again(video, library, monkeypatch):
    """It would be "known already", with its wrong frames."""
    first = import_video(video, name="move", demos_dir=library)
    about = json.loads((first.path.parent / "demo.json").read_bytes())
    assert import_video(video, name="again", demos_dir=library) == first  # not even decoded
    wrong = list(reversed(range(30)))
    upset = library / ("f" * 64)
    first.path.parent.rename(upset)
    write_webm(upset / "video.webm", (numbered(i) for i in wrong), fps=30.0)
    (upset / "demo.json").write_text(json.dumps(about | {"sha256": "f" * 64, "decoding": 1}))
    again = import_video(video, name="again", demos_dir=library)
    assert again.sha256 == first.sha256 and numbers(again) == list(range(30))
    assert [number_of(frame) for frame in read_frames(find_demo("move", library))] == wrong
    del about["decoding"]  # a version that noted none, but gave the same frames
    (again.path.parent / "demo.json").write_text(json.dumps(about | {"name": "again"}))
    assert import_video(video, name="third", demos_dir=library).name == "again"


def test_what_can_be_used_and_is_not_as_it_should_be_is_said(tmp_path, library):
    said = []
    path = make_video(tmp_path / "slow.gif", count=12, fps=10, size=(64, 48))
    import_video(path, name="slow", demos_dir=library, warn=said.append)
    assert [sentence.split(";")[0] for sentence in said] == [
        "it has 10 frames a second", "the picture is only 64 x 48 pixels",
    ]  # fmt: skip
    said.clear()
    import_video(
        make_video(tmp_path / "fine.mp4", size=(320, 240)), name="fine", demos_dir=library, warn=said.append
    )
    assert said == []
