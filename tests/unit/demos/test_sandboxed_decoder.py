"""Hostile video files, really made: refused in one sentence, by a child that takes no more than it may."""

import os
import re
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from onedemo.demos import sandboxed_decoder
from onedemo.demos.decoder_child import shaped_frames
from onedemo.demos.edits import Options
from onedemo.demos.library import import_video
from onedemo.demos.sandboxed_decoder import Limits, decode, look
from onedemo.demos.source import THREADS
from onedemo.errors import UserError
from unit.demos.test_edits import film, room_with, shaken, walk
from unit.demos.test_library import make_video, number_of, refused

pytestmark = pytest.mark.seam

SMALL = Limits(memory=1 << 30, cpu_seconds=5, wall_seconds=60)


@pytest.fixture
def library(tmp_path):
    return tmp_path / "demos"


def peak_mb():
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


def huge_gif(path):
    """80 bytes that claim 30000 x 30000 pixels."""
    screen = b"GIF89a" + struct.pack("<HHBBB", 30000, 30000, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    image = b"\x21\xf9\x04\0\x0a\0\0\0\x2c" + struct.pack("<HHHHB", 0, 0, 30000, 30000, 0)
    path.write_bytes(screen + (image + b"\x02\x02\x4c\x01\0") * 2 + b"\x3b")


def huge_jpegs(path):
    """Motion JPEG whose pictures claim 30000 x 30000 pixels."""
    picture = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = picture.index(b"\xff\xc0") + 5
    path.write_bytes((picture[:at] + struct.pack(">HH", 30000, 30000) + picture[at + 4 :]) * 30)


def endless_avi(path):
    """Ten frames that claim to be ten million."""
    content = bytearray(make_video(path, count=10).read_bytes())
    content[0x30:0x34] = struct.pack("<I", 10_000_000)
    at = content.index(b"strh") + 8
    content[at + 32 : at + 36] = struct.pack("<I", 10_000_000)
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("make", "suffix", "words"),
    [
        (huge_gif, ".gif", "is not a video|cannot be decoded|may have at most 4096"),
        (huge_jpegs, ".mjpeg", "is not a video|cannot be decoded|may have at most 4096"),
        (endless_avi, ".avi", "longer than 60 s"),
    ],
)
def test_a_bomb_is_refused_without_growing(tmp_path, library, make, suffix, words):
    path = tmp_path / f"bomb{suffix}"
    make(path)
    before = peak_mb()
    assert re.search(words, refused(path, library, limits=SMALL))
    assert peak_mb() - before < 40


def test_more_frames_than_anybody_needs(tmp_path, library, monkeypatch):
    monkeypatch.setattr("onedemo.demos.import_checks.MAX_FRAMES", 20)
    with pytest.raises(UserError, match="more than 20 frames"):
        with make_video(tmp_path / "a.avi", count=30).open("rb") as file:
            list(shaped_frames(file, "a.avi", Options()))


def test_memory_processor_time_and_wall_time_are_limited(tmp_path, library):
    large = make_video(tmp_path / "large.avi", count=40, size=(3000, 2000), picture=lambda i, w, h: BLANK)
    assert "needs more memory" in refused(large, library, limits=Limits(memory=100 << 20))
    assert "longer than 1 s to decode" in refused(large, library, limits=Limits(cpu_seconds=1))
    start = time.monotonic()
    assert "longer than 0.5 s to decode" in refused(large, library, limits=Limits(wall_seconds=0.5))
    assert time.monotonic() - start < 20


BLANK = np.zeros((2000, 3000, 3), np.uint8)


@pytest.mark.parametrize("kind", ["playlist", "list of files"])
def test_a_file_that_names_other_files_is_no_video(tmp_path, library, kind):
    make_video(tmp_path / "other.avi", count=30)
    if kind == "playlist":
        path = tmp_path / "list.m3u8"
        path.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1.0,\nother.avi\n#EXT-X-ENDLIST\n")
    else:
        path = tmp_path / "list.mp4"
        path.write_text("ffconcat version 1.0\nfile other.avi\n")
    assert "is a list of other files" in refused(path, library)
    with pytest.raises(UserError, match="is not a video that can be read"):  # nor by the decoder itself
        list(decode(path, Options()))


def test_the_child_is_gone_when_nobody_wants_more(tmp_path):
    frames = decode(make_video(tmp_path / "a.avi", count=90, size=(640, 480)), Options())
    next(frames)
    assert _children()
    frames.close()
    assert not _children()
    assert not [t for t in threading.enumerate() if isinstance(t, threading.Timer)]


def _children():
    listing = [p.read_text() for p in Path("/proc").glob("[0-9]*/cmdline") if _mine(p.parent)]
    return [line for line in listing if "onedemo.demos.decoder_child" in line]


def _mine(process):
    try:
        return f"PPid:\t{os.getpid()}\n" in (process / "status").read_text()
    except OSError:
        return False


@pytest.mark.parametrize(
    "code",
    [
        "import os; os.abort()",
        "print('S', end='')",
        "import os; os.write(1, b'S' + bytes([255, 255, 255, 255]) + b'F' * 99)",
        "import os; os.write(1, b'S' + bytes([16, 0, 16, 0]) + b'F' + b'x' * 700)",
        "import os; os.write(1, b'D')",
        "import os\nos.write(1, b'S' + bytes([2, 0, 2, 0]))\nwhile True: os.write(1, b'F' + b'x' * 12)",
        "import os; os.write(1, b'garbage' * 1000)",
    ],
)
def test_whatever_the_child_says_is_checked(tmp_path, library, monkeypatch, code):
    """As if a decoder had been taken over: its process says what it likes, and dies as it likes."""
    child = subprocess.Popen
    monkeypatch.setattr(
        sandboxed_decoder.subprocess,
        "Popen",
        lambda command, **how: child([sys.executable, "-c", code], **how),
    )
    assert "cannot be decoded" in refused(make_video(tmp_path / "a.avi", count=3), library)


def test_the_child_knows_nothing_of_its_parent(tmp_path, monkeypatch):
    """Neither the environment nor open files."""
    seen = {}
    child = subprocess.Popen
    monkeypatch.setattr(
        sandboxed_decoder.subprocess,
        "Popen",
        lambda command, **how: seen.update(how) or child(command, **how),
    )
    monkeypatch.setenv("SECRET", "x")
    list(decode(make_video(tmp_path / "a.avi", count=12), Options()))
    assert "SECRET" not in seen["env"] and seen.get("close_fds", True) and not seen.get("shell")


def run_child_after(monkeypatch, code, **surroundings):
    """The real child, but for what ``code`` changes before it begins."""
    child = subprocess.Popen
    start = f"import sys; {code}; from onedemo.demos import decoder_child; decoder_child._main(sys.argv[1])"

    def popen(command, **how):
        how["env"] = how["env"] | surroundings
        return child([sys.executable, "-P", "-B", "-c", start, command[-1]], **how)

    monkeypatch.setattr(sandboxed_decoder.subprocess, "Popen", popen)


NO_ADDRESS_LIMIT = """import resource as r; real = r.setrlimit
def setrlimit(what, limits):
    if what == r.RLIMIT_AS: raise ValueError('current limit exceeds maximum limit')
    real(what, limits)
r.setrlimit = setrlimit"""


def as_expression(code):
    return f"exec({code!r})"


def test_where_address_space_cannot_be_limited_memory_is_watched(tmp_path, monkeypatch):
    """As on macOS, whose processes have more mapped than any such limit."""
    run_child_after(monkeypatch, as_expression(NO_ADDRESS_LIMIT))
    path = make_video(tmp_path / "a.avi", count=12)
    assert len(list(decode(path, Options()))) == 12
    longer = make_video(tmp_path / "b.avi", count=900)  # longer than it takes to look, on any machine
    with pytest.raises(UserError, match="needs more memory than a video may"):
        list(decode(longer, Options(), Limits(memory=40 << 20)))


def test_without_limits_nothing_is_decoded(tmp_path, monkeypatch):
    """As on Windows."""
    monkeypatch.setattr(sandboxed_decoder.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="on Windows: in WSL 2"):
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))


def test_the_last_that_a_child_says_is_told_and_logged(tmp_path, monkeypatch, caplog):
    run_child_after(monkeypatch, "raise ImportError('libpython3.11.so.1.0: cannot open shared object file')")
    with pytest.raises(UserError, match=r"ended with: ImportError: libpython3.*; .*ffmpeg -i x -c:v libx264"):
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))
    assert "ended with status 1: ImportError: libpython3" in caplog.text


def test_a_child_that_complains_without_end_is_not_waited_for(tmp_path, monkeypatch):
    run_child_after(monkeypatch, "[sys.stderr.write('x' * 9999 + chr(10)) for _ in range(99)]")
    start = time.monotonic()
    with pytest.raises(UserError):
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))
    assert time.monotonic() - start < 20


def test_what_a_child_says_last_is_one_short_printable_line(tmp_path, monkeypatch, caplog):
    run_child_after(monkeypatch, "sys.stderr.write(chr(27) + '[2J' + 'y' * 5000); sys.exit(3)")
    with pytest.raises(UserError, match=r"ended with: .*yyy") as told:
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))
    for said in (str(told.value), caplog.messages[-1]):
        assert said.isprintable() and 200 < said.count("y") < 350


def test_the_place_of_shared_libraries_is_passed_on(tmp_path, monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/python/lib")
    run_child_after(monkeypatch, "import os; raise SystemExit(os.environ['LD_LIBRARY_PATH'])")
    with pytest.raises(UserError, match="ended with: /opt/python/lib"):
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))


def test_a_name_that_is_not_utf_8(tmp_path, library):
    path = make_video(tmp_path / "a.avi", count=12)
    odd = tmp_path / os.fsdecode(b"saut\xe9.avi")
    path.rename(odd)
    demo = import_video(odd, name="saut", demos_dir=library)
    assert demo.frames == 12 and demo.source == "saut\N{REPLACEMENT CHARACTER}.avi"


def test_the_child_can_open_no_file(tmp_path, monkeypatch):
    """A decoder that has been taken over gets at nothing but the video: not even a name is opened."""
    attack = "import onedemo.demos.decoder_child as d; "
    attack += "d.check_size = lambda name, *_: name and open('/etc/passwd')"
    run_child_after(monkeypatch, attack)
    with pytest.raises(UserError, match=r"OSError: \[Errno 24\] Too many open files: '/etc/passwd'"):
        list(decode(make_video(tmp_path / "a.avi", count=12), Options()))


def test_the_child_takes_the_same_on_any_machine(tmp_path, monkeypatch):
    """Threads by cores, and an arena of address space for each, made a phone's video too large on 16."""
    seen = []
    child = subprocess.Popen
    monkeypatch.setattr(
        sandboxed_decoder.subprocess, "Popen",
        lambda command, **how: seen.append((child(command, **how), how["env"])) or seen[-1][0],
    )  # fmt: skip
    frames = decode(make_video(tmp_path / "a.avi", count=90, size=(640, 480)), Options())
    next(frames)
    process, env = seen[0]
    status = Path(f"/proc/{process.pid}/status").read_text()
    frames.close()
    assert int(re.search(r"Threads:\s+(\d+)", status)[1]) <= 1 + THREADS
    assert int(re.search(r"VmPeak:\s+(\d+)", status)[1]) / 1024 < 1024
    assert env["MALLOC_ARENA_MAX"] == "2"


def test_a_look_gives_one_frame_and_what_the_container_says(tmp_path):
    path = make_video(tmp_path / "a.mp4", count=45, size=(1280, 96))
    found = look(path, at=1.0)
    assert (found.width, found.height, found.fps) == (1280, 96, 30.0)
    assert found.seconds == pytest.approx(1.5, abs=0.05)
    assert found.picture.shape == (48, 640, 3) and number_of(found.picture) == 30
    assert number_of(look(path).picture) == 0 and number_of(look(path, at=60).picture) == 44
    (tmp_path / "b.mp4").write_bytes(b"\0hello " * 999)
    with pytest.raises(UserError, match="is not a video that can be read"):
        look(tmp_path / "b.mp4")


def test_warnings_come_through_the_pipe(tmp_path):
    said = []
    frames = list(decode(make_video(tmp_path / "a.gif", count=12, fps=10), Options(), warn=said.append))
    assert len(frames) == 36 and said == [
        "it has 10 frames a second; fast moves can be seen better with 24 or more",
        "the picture is only 160 x 96 pixels; details will be hard to see",
    ]


def test_what_is_held_still_and_followed_is_found_by_the_child_that_opens_no_file(tmp_path):
    """All that this needs, MuJoCo with it, is loaded before the file is looked at."""
    path = film(tmp_path / "walk.mp4", shaken([room_with(place) for place in walk(30)]))
    options = Options(track=True, stabilise=True, reverse=True, speed=2.0, loop=2)
    frames = list(decode(path, options, SMALL))
    assert len(frames) == 30 and frames[0].shape[1] < 200
    with path.open("rb") as file:
        here = list(shaped_frames(file, "walk.mp4", options))
    assert all((a == b).all() for a, b in zip(frames, here, strict=True))
