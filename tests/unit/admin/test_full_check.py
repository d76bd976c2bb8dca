"""Bytes that somebody or a dying disk wrote over the database are found, wherever they matter."""

import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from helpers.hostile_archives import small_study
from helpers.segments import noise
from onedemo.app.admin.doctor import _database, _files, _privacy
from onedemo.storage.clips import NewClip
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A study of fifty clips, all in the one file; and where the motion of the clips lies in it."""
    directory = tmp_path_factory.mktemp("made") / "data"
    rng = np.random.default_rng(0)
    small_study(directory, noise(rng, 38))
    with closing(Store(directory)) as store:
        ann = store.accounts.ensure("Ann", "annotator").id
        for _ in range(49):
            new = NewClip(demo_step=0, segment=noise(rng, 38), stage="online", iteration=1)
            (clip,) = store.clips.add("r", [new])
            store.ratings.rate(clip.id, ann, 3, 900)
        places = [row.obs.tobytes()[:64] for _, row in store.clips.answered()]
    return directory, places


def said(data_dir, *, full):
    return [(finding.ok, finding.said) for finding in _database(data_dir, full)]


def test_256_random_bytes_in_the_motion_are_found_by_the_full_check(made, tmp_path):
    directory, _ = made
    whole = (directory / FILE_NAME).read_bytes()
    with closing(sqlite3.connect(directory / FILE_NAME)) as db:
        blobs = [data for (data,) in db.execute("SELECT data FROM segments")]
    assert said(directory, full=True)[-1][0]
    # In the middle of what is nothing but motion, page by page.
    body = [blob[200:] for blob in blobs]
    rng = np.random.default_rng(1)
    tried = 0
    for place in range(4096, len(whole) - 4096, 4096):
        page = whole[place + 1024 : place + 1024 + 256]
        if not any(page in blob for blob in body):
            continue
        tried += 1
        if tried % 10:  # every tenth will do
            continue
        copy = tmp_path / f"{place}"
        copy.mkdir()
        changed = bytearray(whole)
        changed[place + 1024 : place + 1024 + 256] = rng.bytes(256)
        (copy / FILE_NAME).write_bytes(changed)
        assert said(copy, full=False)[-1][0]  # SQLite keeps no checksums
        ((ok, what),) = said(copy, full=True)
        assert not ok and "the motion of segments" in what and "restore a backup" in what
    assert tried > 50


@pytest.mark.parametrize(
    ("statement", "what"),
    [
        ("UPDATE runs SET created_at = 'x'", "1 times in runs are not times"),
        ("UPDATE runs SET config = '\x01 ='", "the settings of run r are damaged"),
        ("UPDATE snapshots SET stats = '{'", "what snapshots 1 of run r says is damaged"),
        ("UPDATE tallies SET ratings = 7 WHERE value = 3", "counts of ratings are not those of the events"),
        ("UPDATE segments SET data = zeroblob(100) WHERE clip_id = 3", "the motion of segments 3 is damaged"),
    ],
)
def test_what_else_is_found(made, tmp_path, statement, what):
    shutil.copytree(made[0], tmp_path / "data")
    with closing(sqlite3.connect(tmp_path / "data" / FILE_NAME)) as db, db:
        db.execute(statement)
    ((ok, sentence),) = said(tmp_path / "data", full=True)
    assert not ok and what in sentence


def test_a_database_that_another_program_changed_is_named_and_not_run(made, tmp_path):
    shutil.copytree(made[0], tmp_path / "data")
    with closing(sqlite3.connect(tmp_path / "data" / FILE_NAME)) as db:
        db.execute("DROP VIEW ratings")
        db.execute("CREATE VIEW ratings AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n)"
                   " SELECT i AS id FROM n WHERE i < 0")  # fmt: skip
    ((ok, sentence),) = said(tmp_path / "data", full=False)
    assert not ok and "changed by another program: view 'ratings' was changed" in sentence


def test_an_open_data_directory_is_named(made, tmp_path):
    shutil.copytree(made[0], tmp_path / "data")
    assert all(finding.ok for finding in _privacy(tmp_path / "data"))
    (tmp_path / "data").chmod(0o755)
    wrong = [finding.said for finding in _privacy(tmp_path / "data") if not finding.ok]
    assert len(wrong) == 1 and "chmod -R go-rwx" in wrong[0]


def test_a_lost_picture_is_named_although_somebody_was_left_out(tmp_path):
    data_dir, motion = tmp_path / "data", noise(np.random.default_rng(0), 10)
    small_study(data_dir, motion)
    with closing(Store(data_dir)) as store:
        new = NewClip(demo_step=0, segment=motion, stage="online", iteration=1)
        store.clips.set_state([clip.id for clip in store.clips.add("r", [new])], "ready")
        ann = store.accounts.ensure("Ann", "annotator").id
        store.ratings.leave_out("r", ann, by=ann)  # an event of no clip
    lost = [finding.said for finding in _files(data_dir) if "the picture of a clip" in finding.said]
    assert len(lost) == 1 and "lacks" in lost[0] and "000002." in lost[0]
