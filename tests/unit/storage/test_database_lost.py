"""The database's files are deleted under a process that has them open; and other programs hold it."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing

import pytest

from helpers.small_world import falling_demo, small_config
from onedemo.app.templates import render
from onedemo.errors import DatabaseLost, UserError
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store
from unit.training.test_trainer import make_trainer


def wait_for(condition, seconds=30):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def say(store, count):
    for number in range(count):
        store.audit.add("Ann", "rated", str(number))


def delete(*suffixes):
    def harm(path):
        for suffix in suffixes:
            os.unlink(f"{path}{suffix}")

    return harm


def replace(suffix):
    def harm(path):
        shutil.copy(f"{path}{suffix}", f"{path}.other")
        os.replace(f"{path}.other", f"{path}{suffix}")

    return harm


@pytest.mark.parametrize(
    "harm",
    [delete("-wal"), delete(""), delete("-shm"), delete("", "-wal", "-shm"), replace(""), replace("-wal")],
    ids=["wal", "database", "index", "all three", "database replaced", "log replaced"],
)
def test_lost_files_are_noticed_and_everything_that_was_acknowledged_is_saved(tmp_path, harm):
    """Nobody writes meanwhile: a watch notices it. Then nothing is acknowledged any more."""
    with closing(Store(tmp_path)) as store:
        say(store, 37)
        harm(store.path)
        began = time.monotonic()
        wait_for(lambda: store.database.fault)
        assert time.monotonic() - began < 60  # half a second, on a machine with time
        assert "deleted or replaced. Nothing more is saved. Every rating until then" in store.database.fault
        with pytest.raises(DatabaseLost, match="deleted or replaced"):
            say(store, 1)
        with pytest.raises(DatabaseLost):
            list(store.audit.lines())
        assert store.database.rows("SELECT COUNT(*) FROM audit") == [(37,)]  # the page goes on showing
    # As it says.
    os.replace(tmp_path / f"{FILE_NAME}.rescued-1", tmp_path / FILE_NAME)
    for suffix in ("-wal", "-shm"):
        (tmp_path / f"{FILE_NAME}{suffix}").unlink(missing_ok=True)
    with closing(Store(tmp_path)) as store:
        assert [int(line[3]) for line in store.audit.lines()] == list(range(37))


KILLED = """
import os, sys, time
from pathlib import Path
from onedemo.storage.store import Store
store = Store(Path(sys.argv[1]))
for number in range(37):
    store.audit.add("Ann", "rated", str(number))
os.unlink(f"{store.path}-wal")
while not store.database.fault:
    time.sleep(0.02)
print(store.database.fault, flush=True)
time.sleep(600)
"""


def test_a_log_that_was_deleted_loses_nothing_even_if_the_process_is_killed(tmp_path):
    """Before: 36 of 37."""
    with subprocess.Popen([sys.executable, "-c", KILLED, tmp_path], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert b"deleted or replaced" in process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    with closing(Store(tmp_path)) as store:  # as it is: nobody has put anything anywhere
        assert len(list(store.audit.lines())) == 37


def test_a_press_after_the_files_are_gone_is_not_acknowledged(tmp_path):
    with closing(Store(tmp_path)) as store:
        say(store, 1)
        os.unlink(f"{store.path}-wal")
        with pytest.raises(sqlite3.OperationalError):  # as the page expects of what cannot be saved
            say(store, 1)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody without the right")
def test_files_that_one_may_not_look_at_are_not_lost(tmp_path):
    with closing(Store(tmp_path / "data")) as store:
        say(store, 1)
        os.seteuid(65534)
        try:
            assert store.database._there() is None
            time.sleep(1.2)  # the watch has looked twice
        finally:
            os.seteuid(0)
        assert not store.database.fault
        say(store, 1)


def test_a_database_that_is_lost_while_there_are_runs_is_not_made_anew(tmp_path):
    config = tmp_path / "runs" / "jump-1" / "config.toml"
    config.parent.mkdir(parents=True)
    config.write_text("")
    with pytest.raises(UserError, match=r"sqlite3 is missing, but .*jump-1 is there.*restore a backup"):
        Store(tmp_path)
    assert not (tmp_path / FILE_NAME).exists()


def test_who_reads_does_not_wait_for_another_program_that_writes(tmp_path):
    with (
        closing(Store(tmp_path)) as store,
        closing(sqlite3.connect(store.path, isolation_level=None)) as other,
    ):
        say(store, 3)
        other.execute("BEGIN IMMEDIATE")
        done = threading.Event()

        def write():
            say(store, 1)
            done.set()

        writer = threading.Thread(target=write)
        writer.start()
        wait_for(
            lambda: store.database._lock.acquire(blocking=False) is False or store.database._lock.release()
        )
        for _ in range(20):
            assert store.database.rows("SELECT COUNT(*) FROM audit") == [(3,)]
        assert not done.is_set()  # the write waits for ten seconds
        other.execute("ROLLBACK")
        writer.join(30)
        assert store.database.rows("SELECT COUNT(*) FROM audit") == [(4,)]


def test_inside_a_transaction_it_is_read_what_was_written(tmp_path):
    with closing(Store(tmp_path)) as store:
        with pytest.raises(ZeroDivisionError), store.database.transaction():
            say(store, 2)
            assert store.database.rows("SELECT COUNT(*) FROM audit") == [(2,)]
            elsewhere = []
            thread = threading.Thread(
                target=lambda: elsewhere.append(store.database.rows("SELECT COUNT(*) FROM audit"))
            )
            thread.start()
            thread.join(30)
            assert elsewhere == [[(0,)]]
            raise ZeroDivisionError
        assert store.database.rows("SELECT COUNT(*) FROM audit") == [(0,)]


def test_the_database_is_for_its_owner_alone(tmp_path):
    with closing(Store(tmp_path / "a" / "data")) as store:
        say(store, 1)
        for path in (store.path.parent, *store.path.parent.iterdir()):
            assert not path.stat().st_mode & 0o077, path


def test_the_page_says_so(tmp_path):
    """In the banner that shows whatever goes wrong, which then does not say that ratings are kept."""
    with closing(Store(tmp_path / "data")) as store:
        trainer = make_trainer(store, falling_demo(tmp_path / "demo"), config=small_config())
        assert trainer.status().saved
        os.unlink(f"{store.path}-wal")
        wait_for(lambda: not trainer.status().saved)
        status = trainer.status()
        assert status.phase == "failed" and "deleted or replaced" in status.error
        banner = str(render("session.html:banner", status=status))
        assert "Please stop rating" in banner and "every rating is kept" not in banner
