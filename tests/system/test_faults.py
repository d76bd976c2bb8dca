"""What goes wrong around a training, for real: it says so plainly, loses nothing, goes on by itself."""

import errno
import os
import re
import resource
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, contextmanager, suppress

import pytest

from helpers.paths import ROOT
from helpers.small_disk import small_disk
from helpers.small_world import falling_demo, small_config
from load.serving import FEW_STATES, serving
from onedemo.errors import UserError, in_words
from onedemo.storage.store import Store
from unit.training.test_trainer import make_trainer, rate_all, wait_for

pytestmark = pytest.mark.seam

HOLD = """
import sqlite3, sys
db = sqlite3.connect(sys.argv[1], isolation_level=None)
db.execute("BEGIN IMMEDIATE")
print("held", flush=True)
sys.stdin.readline()
"""


@contextmanager
def locked(file):
    """Another process holds the database's write lock."""
    command = [sys.executable, "-c", HOLD, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        yield
        other.communicate("\n")


@contextmanager
def no_room(file):
    """No file may grow beyond 64 KiB: a checkpoint is larger, and so may the database be."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def full(file):
    """The small disk that the data is on has no block left."""
    ballast = file.with_name("ballast")
    with ballast.open("wb", buffering=0) as out:
        with suppress(OSError):
            while out.write(b"x" * 4096):
                pass
    try:
        yield
    finally:
        ballast.unlink()


@contextmanager
def no_right(file):
    """This process is somebody who may not write to the data directory."""
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def small_data_disk(tmp_path):
    with small_disk(tmp_path / "data", "24m"):
        yield


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (locked, "Another program holds the database"),
        (no_room, "ulimit -f"),  # whether it is a file of ours or the database that may not grow
        (full, "The disk is full"),
        (no_right, "may not be written to"),
    ],
)
def test_a_training_says_what_is_wrong_and_goes_on_once_it_is_not(tmp_path, request, fault, words):
    if fault is full:
        request.getfixturevalue("small_data_disk")
    if fault is no_right:
        if os.geteuid() != 0:
            pytest.skip("only root can become somebody without the right and come back")
        for place in (tmp_path, *tmp_path.parents):  # it may be read, as before
            with suppress(OSError):
                place.chmod(place.stat().st_mode | 0o055)
    demo = falling_demo(tmp_path / "demo")
    config = small_config(rollouts__total_steps=10**6, ratings__online=200)
    with closing(Store(tmp_path / "data")) as store:
        ann = store.accounts.ensure("Ann", "annotator")
        trainer = make_trainer(store, demo, config=config, rest_s=(0.5, 1.0))
        trainer.start()
        try:
            wait_for(lambda: rate_all(store, "r", ann) or trainer.status().iteration >= 1)
            given = trainer.status().ratings
            with fault(store.path):
                wait_for(lambda: words in trainer.status().error)
                assert trainer.status().phase == "failed" and trainer.status().ratings == given
            done = trainer.status().iteration
            wait_for(lambda: trainer.status().iteration > done and not trainer.status().error)
            assert trainer.status().phase == "online" and trainer.status().ratings == given
        finally:
            trainer.stop()
        numbers = [row["number"] for row in store.runs.iterations("r")]
        assert numbers == list(range(1, len(numbers) + 1))
        with closing(sqlite3.connect(store.path)) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_what_fails_again_and_again_is_one_steady_state(tmp_path, monkeypatch):
    """The page does not flicker between "starting", "online" and "failed" with every try."""
    tries = []

    def break_down(self, snapshot):
        tries.append(snapshot)
        time.sleep(0.1)  # of trying
        raise FloatingPointError("the policy has exploded")

    demo = falling_demo(tmp_path / "demo")
    config = small_config(rollouts__total_steps=10**6, ratings__online=200)
    with closing(Store(tmp_path / "data")) as store:
        ann = store.accounts.ensure("Ann", "annotator")
        trainer = make_trainer(store, demo, config=config, rest_s=(0.1, 0.1))
        trainer.start()
        try:
            wait_for(lambda: rate_all(store, "r", ann) or trainer.status().iteration >= 1)
            with monkeypatch.context() as broken:
                broken.setattr("onedemo.training.learner.Learner.iterate", break_down)
                wait_for(lambda: trainer.status().error)
                seen, end = set(), time.monotonic() + 60
                while len(tries) < 4:
                    assert time.monotonic() < end
                    seen.add((trainer.status().phase, bool(trainer.status().error)))
                    time.sleep(0.002)
                assert seen == {("failed", True)}
            wait_for(lambda: not trainer.status().error)
            assert trainer.status().phase == "online"
        finally:
            trainer.stop()


def test_without_opengl_the_page_says_so_and_what_was_drawn_is_rated(tmp_path, monkeypatch, chromium, looked):
    shutil.copytree(looked, tmp_path / "data")
    settings = ["predictor.appearance=false", *FEW_STATES]
    with serving(tmp_path / "data", settings) as server, closing(Store(tmp_path / "data")) as store:
        (run,) = (row["id"] for row in store.runs.all())
        wait_for(lambda: len(store.clips.waiting(run)) == 4, 600)
        drawn = {clip.id for clip in store.clips.waiting(run)}
        server.kill()
        monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", str(tmp_path))  # no driver is there
        with serving(tmp_path / "data") as server:
            page = chromium.new_page()
            page.set_default_timeout(180_000)
            page.goto(server.links["annotator"])
            for _ in range(3):
                clip = page.wait_for_selector(".od-clip > [data-clip][data-frame]")
                number = clip.get_attribute("data-clip")
                page.wait_for_timeout(600)
                page.keyboard.press("4")
                page.wait_for_selector(f".od-clip > [data-clip]:not([data-clip='{number}'])")
            banner = page.wait_for_selector(".od-banner")
            assert "no OpenGL driver" in banner.inner_text() and "apt-get install" in banner.inner_text()
            assert "go on rating" in banner.inner_text()
            page.close()
            rated = {row[0] for row in server.rows("SELECT clip_id FROM events")}
            assert len(rated) == 3 and rated <= drawn


def test_errors_are_told_in_plain_words():
    assert in_words(UserError("wrong")) == "wrong"
    assert in_words(OSError(errno.ENOSPC, "No space")).startswith("The disk is full")
    assert in_words(MemoryError()) == "There is not enough memory: end other programs. (MemoryError)"
    said = in_words(RuntimeError("OpenCV: (-4:Insufficient memory) Failed to allocate 10497600 bytes"))
    assert said.startswith("There is not enough memory: end other programs. (RuntimeError: OpenCV")
    assert in_words(FloatingPointError("exploded")) == "FloatingPointError: exploded"
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        db.execute("PRAGMA max_page_count = 1")
        with pytest.raises(sqlite3.OperationalError) as full:
            db.execute("CREATE TABLE t (x)")
        assert in_words(full.value).startswith("The disk is full")


def test_nothing_goes_by_the_clock_on_the_wall():
    """A clock that is set back changes no order and no waiting: those go by numbers and by monotonic time.

    The time of day is written down, as text, and ends links; nothing else is done with it.
    """
    stamps = {"database.py", "accounts.py", "card.py", "csv_writer.py", "backup.py", "machine.py"}
    files = [*ROOT.glob("app/**/*.py"), *ROOT.glob("trainer/**/*.py")]
    assert stamps <= {path.name for path in files}
    for path in files:
        text = path.read_text()
        assert not re.search(r"\btime\.time\(", text), path
        assert path.name in stamps or not re.search(r"datetime\.(now|today)\(", text), path
        for order in re.findall(r"(?:ORDER BY|MAX\()[^\"'\n]*", text):
            assert "_at" not in order, f"{path}: {order}"
