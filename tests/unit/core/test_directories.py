"""Directories: who may look into them, and what processes leave in them that are killed."""

import os
import signal
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from onedemo.core.directories import Workshop, clear_left_over, make_directory
from onedemo.core.files import hold, write_atomic


def modes(root):
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in root.rglob("*")}


@pytest.fixture
def usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


def test_what_is_made_is_as_open_as_what_it_lies_in(tmp_path, usual_umask):
    tmp_path.chmod(0o755)
    make_directory(tmp_path / "data", private=True)
    write_atomic(tmp_path / "data" / "runs" / "config.toml", b"x")
    write_atomic(tmp_path / "out" / "ratings.csv", b"x")
    with hold(tmp_path / "data" / "runs" / "lock"):
        pass
    assert modes(tmp_path) == {
        "data": 0o700, "runs": 0o700, "config.toml": 0o600, "lock": 0o600, "out": 0o755,
        "ratings.csv": 0o644,
    }  # fmt: skip


KILLED = """
import sys, time
from pathlib import Path
from onedemo.core.directories import Workshop
place = Workshop(Path(sys.argv[1]), ".import-")
(place.path / "video.webm").write_bytes(b"half")
print(place.path, flush=True)
time.sleep(600)
"""


def test_what_a_killed_process_left_is_cleared_and_what_a_living_one_has_is_not(tmp_path):
    (tmp_path / ".import-old").mkdir()  # of a version that locked nothing
    (tmp_path / ".import-file").write_bytes(b"x")
    with subprocess.Popen([sys.executable, "-c", KILLED, tmp_path], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        theirs = tmp_path / os.path.basename(process.stdout.readline().decode().strip())
        with Workshop(tmp_path, ".import-") as ours:
            assert {path.name for path in tmp_path.iterdir()} == {theirs.name, ours.name}
            clear_left_over(tmp_path, ".import-")
            assert ours.exists() and (theirs / "video.webm").exists()
        assert not ours.exists()
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert theirs.exists()
    clear_left_over(tmp_path, ".import-")
    assert not list(tmp_path.iterdir())


def test_what_was_renamed_stays(tmp_path):
    with Workshop(tmp_path, ".half.") as half:
        (half / "file").write_bytes(b"x")
        half.rename(tmp_path / "whole")
    assert (tmp_path / "whole" / "file").exists()
    clear_left_over(tmp_path, ".half.")
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


def test_one_that_nobody_has_any_more_is_gone(tmp_path):
    place = Workshop(tmp_path, "upload-")
    assert place.path.exists()
    del place
    assert not list(tmp_path.iterdir())


def test_many_that_begin_at_once_clear_nothing_of_one_another_away(tmp_path):
    def make(_):
        for _ in range(60):
            with Workshop(tmp_path, ".half.") as ours:
                assert ours.is_dir()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(make, range(8)))
    assert list(tmp_path.iterdir()) == []
