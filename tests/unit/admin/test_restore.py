"""Restoring what somebody sent: hostile archives are refused whole, before they can do anything."""

import hashlib
import json
import shutil
import sqlite3
import stat
import zipfile
from contextlib import closing

import numpy as np
import pytest

from helpers.hostile_archives import HOSTILE, good_backup, hot_journal, make, small_study
from onedemo.app.admin.archive import MANIFEST
from onedemo.app.admin.backup import back_up
from onedemo.app.admin.restore import restore
from onedemo.core.directories import Workshop
from onedemo.errors import UserError
from onedemo.storage.database import FILE_NAME
from onedemo.types import Segment

SEGMENT = Segment(**{n: np.zeros((3, w)) for n, w in (("obs", 11), ("actions", 3), ("qpos", 6), ("qvel", 6))})


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return good_backup(tmp_path_factory.mktemp("good"), SEGMENT)


@pytest.mark.parametrize("hostile", HOSTILE, ids=lambda hostile: hostile.what)
def test_a_hostile_archive_is_refused_whole(good, tmp_path, hostile):
    victim = tmp_path / "thesis.tex"
    victim.write_text("years of work")
    file = tmp_path / "sent.zip"
    make(hostile, good, file, victim)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(UserError, match=hostile.refused):
        restore(file, tmp_path / "again")
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert victim.read_text() == "years of work"


def test_the_journal_of_the_attack_is_a_real_one(good, tmp_path):
    """What it would do: SQLite itself deletes the victim when it opens the database beside it."""
    victim = tmp_path / "thesis.tex"
    victim.write_text("years of work")
    with zipfile.ZipFile(good) as archive:
        database = tmp_path / FILE_NAME
        database.write_bytes(archive.read(FILE_NAME))
    pages = database.stat().st_size // 4096
    (tmp_path / f"{FILE_NAME}-journal").write_bytes(hot_journal(victim, pages))
    with closing(sqlite3.connect(database)) as db:
        db.execute("SELECT COUNT(*) FROM runs").fetchone()
    assert not victim.exists()


def test_a_good_one_is_there_afterwards_for_its_owner_alone(good, tmp_path):
    with Workshop(tmp_path, ".again.onedemo-half-") as half:  # of somebody who is still at work
        shutil.copytree(half, tmp_path / ".again.onedemo-half-killed")  # of somebody who is not
        assert restore(good, tmp_path / "again") == {"files": 3, "ratings": 1}
        assert half.exists() and not (tmp_path / ".again.onedemo-half-killed").exists()
    for path in (tmp_path / "again", *(tmp_path / "again").rglob("*")):
        assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path


def test_hidden_files_of_the_user_stay(good, tmp_path):
    """Beside what is made, of nearly its name, and nobody has them open."""
    for name in (".env.local", ".env.d/key", ".a.onedemo-half-of-another/x"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    for name in ("env", "[ab]", "*"):
        restore(good, tmp_path / name)
        shutil.rmtree(tmp_path / name)
    small_study(tmp_path / "data", SEGMENT)
    for name in ("env", "[ab]", "*"):
        back_up(tmp_path / "data", tmp_path / name)
        (tmp_path / name).unlink()
    shutil.rmtree(tmp_path / "data")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_backup_holds_what_onedemo_wrote_and_says_what_it_left_out(tmp_path):
    data_dir = tmp_path / "data"
    small_study(data_dir, SEGMENT)
    for name in ("demos/.import-x/video.webm", "uploads/upload-x", "runs/r/lock", "runs/r/start.pt.damaged",
                 ".data.x/onedemo.sqlite3", "notes.txt"):  # fmt: skip
        (data_dir / name).parent.mkdir(parents=True, exist_ok=True)
        (data_dir / name).write_bytes(b"x")
    first = back_up(data_dir, data_dir / "study.zip")
    second = back_up(data_dir, data_dir / "study2.zip")
    assert first.files == second.files == 3 and second.bytes - first.bytes < 1000
    assert first.left_out == ["notes.txt"] and second.left_out == ["notes.txt", "study.zip"]
    assert not [path.name for path in data_dir.iterdir() if path.name.startswith(".study")]
    restore(data_dir / "study2.zip", tmp_path / "again")


def test_what_earlier_backups_packed_of_killed_processes_is_not_restored(good, tmp_path):
    file = tmp_path / "old.zip"
    with zipfile.ZipFile(good) as archive:
        entries = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    manifest = json.loads(entries.pop(MANIFEST))
    for name in ("uploads/upload-abc", "demos/.import-abc/video.webm"):
        entries[name] = b"x"
        manifest["files"][name] = hashlib.sha256(b"x").hexdigest()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in (*entries.items(), (MANIFEST, json.dumps(manifest))):
            archive.writestr(name, content)
    assert restore(file, tmp_path / "again")["files"] == 3
    assert not list((tmp_path / "again").glob("*/*upload*")) and not (tmp_path / "again" / "demos").exists()
