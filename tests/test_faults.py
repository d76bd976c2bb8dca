"""What goes wrong around a training, for real: it says so plainly, loses nothing, goes on by itself."""

import errno
import resource
import sqlite3
import subprocess
import sys
from contextlib import closing, contextmanager

import pytest
from test_loop import make_trainer, rate_all, wait_for
from worlds import falling_demo, small_config

from trainer.errors import UserError, in_words
from trainer.store import Store

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
    """No file may grow beyond 64 KiB: a checkpoint is larger. The database is left alone by then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    ("fault", "words"),
    [(locked, "Another program holds the database"), (no_room, "A file has grown")],
)
def test_a_training_says_what_is_wrong_and_goes_on_once_it_is_not(tmp_path, monkeypatch, fault, words):
    monkeypatch.setattr("trainer.loop._REST_S", (0.5, 1.0))
    demo = falling_demo(tmp_path / "demo")
    config = small_config(rollouts__total_steps=10**6, ratings__online=200)
    with closing(Store(tmp_path / "data")) as store:
        ann = store.ensure_rater("Ann", "annotator")
        trainer = make_trainer(store, demo, config=config)
        trainer.start()
        try:
            wait_for(lambda: rate_all(store, "r", ann) or trainer.status().iteration >= 1, 60)
            given = trainer.status().ratings
            with fault(store.path):
                wait_for(lambda: words in trainer.status().error, 60)
                assert trainer.status().phase == "failed" and trainer.status().ratings == given
            done = trainer.status().iteration
            wait_for(lambda: trainer.status().iteration > done and not trainer.status().error, 60)
            assert trainer.status().phase == "online" and trainer.status().ratings == given
        finally:
            trainer.stop()
        numbers = [row["number"] for row in store.iterations("r")]
        assert numbers == list(range(1, len(numbers) + 1))
        with closing(sqlite3.connect(store.path)) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_errors_are_told_in_plain_words():
    assert in_words(UserError("wrong")) == "wrong"
    assert in_words(OSError(errno.ENOSPC, "No space")).startswith("The disk is full")
    assert in_words(MemoryError()) == "There is not enough memory: end other programs. (MemoryError)"
    assert in_words(FloatingPointError("exploded")) == "FloatingPointError: exploded"
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as db:
        db.execute("PRAGMA max_page_count = 1")
        with pytest.raises(sqlite3.OperationalError) as full:
            db.execute("CREATE TABLE t (x)")
        assert in_words(full.value).startswith("The disk is full")
