"""Paths of a run, and names that may not become one."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from helpers.small_world import Thumbnail, falling_demo
from onedemo.app.admin.doctor import _files
from onedemo.app.cli.main import main
from onedemo.core.names import check_new_name
from onedemo.errors import UserError
from onedemo.storage.run_directory import CLIP_FORMAT, RunDirectory
from onedemo.storage.store import Store
from onedemo.vision.encoders import demo_features

HOSTILE = ("../../../home/x/.cargo", "..", "", "a/b", "/etc", "a\\b", "nul\0", "x" * 85)


def test_where_files_lie(tmp_path):
    files = RunDirectory(tmp_path, "jump-1")
    assert files.path == tmp_path / "runs" / "jump-1"
    names = [files.config, files.lock, files.log, files.start, files.checkpoint, files.rollouts]
    wanted = "config.toml lock log start.pt checkpoint.pt rollouts"
    assert [path.name for path in names] == wanted.split()
    assert files.snapshot(3) == files.path / "snapshots" / "000003.pt"
    assert files.clip(12) == files.path / "clips" / f"000012.{CLIP_FORMAT}.jpg"
    assert files.pair(7) == files.path / "pairs" / f"000007.{CLIP_FORMAT}.jpg"


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


@pytest.mark.parametrize("sha256", HOSTILE)
def test_no_path_is_made_of_a_demo_that_leads_elsewhere(tmp_path, sha256):
    """What a demo says of itself is a file in the data directory, which may be a stranger's."""
    demo = replace(falling_demo(tmp_path / "demo"), sha256=sha256)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="a name is 1 to 64 letters"):
        demo_features(demo, Thumbnail(), tmp_path / "data" / "demos")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["NA", "None", "nan", "null"])
def test_nobody_and_nothing_new_is_called_like_a_missing_value(tmp_path, name, capsys):
    assert main(["rater", "add", name, "--data-dir", str(tmp_path)]) == 2
    assert "means a missing value to programs that read exports" in capsys.readouterr().err
    with closing(Store(tmp_path)) as store:  # one of before has other links, as before
        store.accounts.ensure(name, "annotator")
    assert main(["rater", "add", name, "--data-dir", str(tmp_path)]) == 0
    with pytest.raises(UserError, match="missing value"):
        check_new_name(name)
    check_new_name("007")
