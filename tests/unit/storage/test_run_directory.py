"""Paths of a run, and names that may not become one."""

import sqlite3
from contextlib import closing

import pytest

from onedemo.app.admin.doctor import _files
from onedemo.errors import UserError
from onedemo.storage.run_directory import RunDirectory
from onedemo.storage.store import Store

HOSTILE = ("../../../home/x/.cargo", "..", "", "a/b", "/etc", "a\\b", "nul\0", "x" * 85)


def test_where_files_lie(tmp_path):
    files = RunDirectory(tmp_path, "jump-1")
    assert files.path == tmp_path / "runs" / "jump-1"
    names = [files.config, files.lock, files.log, files.start, files.checkpoint, files.rollouts]
    wanted = "config.toml lock log start.pt checkpoint.pt rollouts"
    assert [path.name for path in names] == wanted.split()
    assert files.snapshot(3) == files.path / "snapshots" / "000003.pt"
    assert files.clip(12) == files.path / "clips" / "000012.jpg"
    assert files.pair(7) == files.path / "pairs" / "000007.jpg"


@pytest.mark.parametrize("name", HOSTILE)
def test_no_path_is_made_of_a_name_that_leads_elsewhere(tmp_path, name):
    with pytest.raises(UserError, match="a name is 1 to 84 letters"):
        RunDirectory(tmp_path, name)


def test_the_doctor_makes_no_path_of_it_either(tmp_path):
    Store(tmp_path).close()
    with closing(sqlite3.connect(next(tmp_path.glob("*.sqlite3")))) as db, db:
        columns = [row[1] for row in db.execute("PRAGMA table_info(runs)")]
        row = {name: 0 if name == "seed" else "x" for name in columns} | {"id": "../../outside"}
        db.execute(
            f"INSERT INTO runs ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})", [*row.values()]
        )
    (finding,) = _files(tmp_path)
    assert "cannot be a directory" in finding.said
