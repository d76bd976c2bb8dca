"""Backup, restore and doctor, on data that real runs made, with files that are really damaged."""

import hashlib
import io
import json
import os
import re
import shutil
import sqlite3
import stat
import subprocess
import sys
import threading
import zipfile
from contextlib import closing
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from helpers import beside_playwright
from helpers.small_world import falling_demo, small_config
from load.annotators import browser_session, open_tab, rating
from load.serving import FEW_STATES, reach, serving
from onedemo.app.admin.backup import back_up
from onedemo.app.admin.doctor import _videos
from onedemo.app.admin.restore import restore
from onedemo.app.cli.main import main
from onedemo.app.http.tokens import read_secret
from onedemo.core.files import archive_fault, jpeg_fault, read_whole, sealed
from onedemo.demos.library import find_demo, import_video
from onedemo.demos.sandboxed_decoder import Limits, decode
from onedemo.errors import UserError
from onedemo.render.clip_image import compose_clip
from onedemo.reward.model import Snapshot
from onedemo.storage.database import FILE_NAME
from onedemo.storage.store import Store
from onedemo.training.rating_queue import Simulated
from unit.demos.test_library import make_video
from unit.training.test_trainer import headless, make_run, wait_for, work

TABLES = ("events", "clips", "runs", "snapshots", "iterations", "segments", "raters")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return falling_demo(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="module")
def made(tmp_path_factory, demo):
    """A data directory after a whole small run, with a video of its own and links."""
    directory = tmp_path_factory.mktemp("care") / "data"
    with closing(Store(directory)) as store:
        headless(store, demo)
    home = directory / "demos" / demo.sha256
    home.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(demo.path, home / "video.webm")
    digest = hashlib.sha256(demo.path.read_bytes()).hexdigest()
    about = asdict(demo) | {"path": "", "video_sha256": digest}
    (home / "demo.json").write_text(json.dumps(about))
    video = make_video(tmp_path_factory.mktemp("video") / "mine.mp4")
    import_video(video, name="mine", demos_dir=directory / "demos", reverse=True)
    read_secret(directory)
    return directory


@pytest.fixture
def data_dir(made, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(made, tmp_path / "data")


def tables(directory):
    with closing(sqlite3.connect(directory / FILE_NAME)) as db:
        return {name: db.execute(f"SELECT * FROM {name}").fetchall() for name in TABLES}


def files(directory):
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in directory.rglob("*")
        if path.is_file() and not path.name.endswith("lock") and not path.name.startswith(FILE_NAME)
    }


@pytest.mark.slow
def test_a_backup_gives_the_same_directory_again(data_dir, tmp_path, demo):
    counts = back_up(data_dir, tmp_path / "all.zip")
    assert stat.S_IMODE((tmp_path / "all.zip").stat().st_mode) == 0o600
    restore(tmp_path / "all.zip", tmp_path / "again")
    assert find_demo("mine", tmp_path / "again" / "demos").edits == "backwards"
    assert tables(tmp_path / "again") == tables(data_dir)
    assert files(tmp_path / "again") == files(data_dir) and len(files(data_dir)) == counts.files - 1
    assert stat.S_IMODE((tmp_path / "again" / "link-secret").stat().st_mode) == 0o600
    # A run goes on from it as it would have from the original.
    ends = []
    for directory in (data_dir, tmp_path / "again"):
        with closing(Store(directory)) as store:
            run = store.runs.all()[0]["id"]
            rate = Simulated(name="rule", rate=lambda segment, step: 3)
            training = make_run(store, demo, rate, small_config(), name=run)
            work(training)
            ends.append((training.snapshot.number, store.runs.iterations(run)[-1]["predicted"]))
    assert ends[0] == ends[1] and ends[0][0] > 0


def test_ratings_may_come_while_a_backup_is_made(data_dir, tmp_path):
    with closing(Store(data_dir)) as store:
        clips = [clip.id for clip, _ in store.clips.answered()]
        before = store.ratings.last_event()
        stop = threading.Event()

        def keep_rating():
            number = 0
            while not stop.is_set():
                rater = store.accounts.ensure(f"r{number // len(clips)}", "annotator")
                store.ratings.rate(clips[number % len(clips)], rater.id, 4, latency_ms=5)
                number += 1

        thread = threading.Thread(target=keep_rating)
        thread.start()
        try:
            for number in range(5):
                acknowledged = store.ratings.last_event()
                back_up(data_dir, tmp_path / f"{number}.zip")
                later = store.ratings.last_event()
                restore(tmp_path / f"{number}.zip", tmp_path / f"again-{number}")
                with closing(sqlite3.connect(tmp_path / f"again-{number}" / FILE_NAME)) as db:
                    (last,) = db.execute("SELECT MAX(id) FROM events").fetchone()
                    (count,) = db.execute("SELECT COUNT(*) FROM events").fetchone()
                assert acknowledged <= last <= later and count == last
        finally:
            stop.set()
            thread.join()
        assert store.ratings.last_event() > before + 10


@pytest.mark.slow
def test_damaged_files_are_set_aside_and_what_was_in_them_is_made_again(data_dir, demo, caplog):
    """A run that has lost its last checkpoint and its last predictor makes both again, to the bit."""
    snapshot = newest(data_dir)
    checkpoint = snapshot.parents[1] / "checkpoint.pt"
    with closing(Store(data_dir)) as store:
        run = store.runs.all()[0]["id"]

        def go_on():
            rate = Simulated(name="rule", rate=lambda segment, step: 3)
            work(make_run(store, demo, rate, small_config(), name=run))
            rows = store.runs.iterations(run)
            return [{key: row[key] for key in row.keys() - {"steps_per_s", "seconds"}} for row in rows]

        before, fitted = go_on(), Snapshot.load(snapshot).tensors()
        for file in (snapshot, checkpoint):
            flip(file)
        assert go_on() == before
        again = Snapshot.load(snapshot).tensors()
        for file in (snapshot, checkpoint):
            assert file.with_name(f"{file.name}.damaged").exists() and not archive_fault(file.read_bytes())
            assert f"{file} is damaged" in caplog.text
        for name, tensor in fitted.items():
            if isinstance(tensor, str):
                assert again[name] == tensor
            else:
                torch.testing.assert_close(again[name], tensor, rtol=0, atol=0)


@pytest.mark.parametrize("at", [None, 0.001, 0.003, 0.99])  # cut off, or turned: in the seal, the rest
def test_a_damaged_picture_is_set_aside(tmp_path, at):
    frames = np.random.default_rng(0).integers(0, 255, (2, 3, 360, 480, 3), np.uint8)
    plain, file = compose_clip(*frames), tmp_path / "000001.jpg"
    file.write_bytes(sealed(plain))
    assert read_whole(file, jpeg_fault) == sealed(plain) and jpeg_fault(plain) == ""
    with Image.open(io.BytesIO(plain)) as one, Image.open(file) as other:
        assert one.tobytes() == other.tobytes()  # nobody else sees the seal
    if at is None:
        file.write_bytes(sealed(plain)[:-40])
    else:
        flip(file, at)
    assert read_whole(file, jpeg_fault) is None
    assert not file.exists() and (tmp_path / "000001.jpg.damaged").exists()


def test_a_predictor_that_the_copied_database_does_not_know_is_left_out(data_dir, tmp_path):
    newest = max(data_dir.glob("runs/*/snapshots/*.pt"))
    shutil.copy(newest, newest.with_name("000099.pt"))
    (newest.parent / ".000100.pt.abc").write_bytes(b"half")
    back_up(data_dir, tmp_path / "all.zip")
    names = zipfile.ZipFile(tmp_path / "all.zip").namelist()
    assert any(name.endswith(newest.name) for name in names)
    assert not any("000099" in name or "000100" in name or name.endswith("lock") for name in names)


def test_cut_off_or_strange_files_are_no_backups(data_dir, tmp_path):
    file = tmp_path / "all.zip"
    back_up(data_dir, file)
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"hello"):
        file.write_bytes(content)
        with pytest.raises(UserError, match=r"all\.zip is (damaged, or )?no backup|damaged, or no backup"):
            restore(file, tmp_path / "again")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    file.write_bytes(flipped)
    with pytest.raises(UserError, match="damaged"):
        restore(file, tmp_path / "again")
    assert not (tmp_path / "again").exists()
    with pytest.raises(UserError, match=r"cannot restore .*No such file"):
        restore(tmp_path / "none.zip", tmp_path / "again")


def test_nothing_is_overwritten(data_dir, tmp_path, capsys):
    file, directory = tmp_path / "all.zip", str(data_dir)
    assert main(["backup", str(file), "--data-dir", directory]) == 0
    assert "18 ratings" in capsys.readouterr().out
    saved = file.read_bytes()
    assert main(["backup", str(file), "--data-dir", directory]) == 2
    assert "is there already; choose another name" in capsys.readouterr().err and file.read_bytes() == saved
    assert main(["backup", str(file), "--data-dir", directory, "--force"]) == 0
    assert main(["backup", str(data_dir / FILE_NAME), "--data-dir", directory, "--force"]) == 2
    assert main(["backup", str(tmp_path / "b.zip"), "--data-dir", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "b.zip").exists()
    assert main(["restore", str(file), "--data-dir", directory]) == 2
    assert "is not empty; restore into a new directory" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main(["restore", str(file), "--data-dir", str(tmp_path / "empty")]) == 0
    assert tables(tmp_path / "empty") == tables(data_dir)


def doctor(directory, capsys):
    code = main(["doctor", "--data-dir", str(directory)])
    lines = capsys.readouterr().out.splitlines()
    assert code == int(any(line.startswith("BAD") for line in lines))
    return [line for line in lines if line.startswith("BAD")], lines


def test_the_doctor_finds_nothing_wrong_with_what_a_run_leaves(data_dir, capsys):
    wrong, lines = doctor(data_dir, capsys)
    assert not wrong, wrong
    text = "\n".join(lines)
    for said in ("Python 3.", "the robot can be drawn", "18 ratings; schema", "2 videos of your own"):
        assert said in text


def newest(data_dir):
    return max(data_dir.glob("runs/*/snapshots/*.pt"))


def flip(path, at=0.5):
    content = bytearray(path.read_bytes())
    content[int(len(content) * at)] ^= 0xFF
    path.write_bytes(content)


def spoil_database(data_dir):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path = data_dir / FILE_NAME
    with path.open("r+b") as file:
        for page in range(3, 40, 3):
            file.seek(page * 4096)
            file.write(os.urandom(4096))


def newer(data_dir):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        db.execute("PRAGMA user_version = 999")


def orphan_rows(data_dir):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        db.execute("DELETE FROM raters")
        db.commit()


def lose_demo(data_dir):
    with closing(sqlite3.connect(data_dir / FILE_NAME)) as db:
        (sha256,) = db.execute("SELECT demo_sha256 FROM runs").fetchone()
    shutil.rmtree(data_dir / "demos" / sha256)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda d: flip(newest(d)), r"holds a damaged .*\.pt: it will be set aside"),
        (lambda d: newest(d).unlink(), r"lacks .*\.pt: a predictor; the newest there is used"),
        (lambda d: flip(next(d.glob("runs/*/checkpoint.pt"))), r"holds a damaged .*checkpoint\.pt"),
        (lambda d: (d / "runs" / "stranger").mkdir(), "does not know .*stranger: a directory of no run"),
        (lambda d: (newest(d).parent / ".000003.pt.x").write_bytes(b"h"), "left half written"),
        (lambda d: newest(d).rename(f"{newest(d)}.damaged"), r"set aside .*\.damaged"),
        (lambda d: flip(next(d.glob("demos/*/video.webm"))), "demos/.* damaged: delete it and add the video"),
        (lambda d: next(d.glob("demos/*/video.webm")).unlink(), "demos/.* damaged: delete it"),
        (lose_demo, "run falling-1 cannot go on, its demo .* is gone: put demos/"),
        (lambda d: (d / "link-secret").chmod(0o644), "others may read .*chmod 600"),
        (lambda d: next(iter(d.glob("demos/*"))).joinpath("features-x.npz").write_bytes(b"PK"), "made anew"),
        (spoil_database, r"onedemo\.sqlite3 is damaged|malformed|not a database"),
        (newer, "newer onedemo .*version 999"),
        (orphan_rows, "belong to nothing: restore a backup"),
    ],
)
def test_the_doctor_names_what_is_wrong(data_dir, capsys, harm, said):
    harm(data_dir)
    wrong, _ = doctor(data_dir, capsys)
    assert wrong
    assert any(re.search(said, line) for line in wrong), wrong


def test_what_a_server_saved_is_named_and_taken_in_as_the_doctor_says(data_dir, tmp_path, capsys):
    """The database was deleted under a server; before, the doctor said that there was none, and all well."""
    with closing(Store(data_dir)) as store:
        ratings = len(list(store.ratings.stream()))
        store.audit.add("Ann", "rated")
        store.path.unlink()
        wait_for(lambda: store.database.fault)
        saved = data_dir / f"{FILE_NAME}.rescued-1"
    wrong, _ = doctor(data_dir, capsys)
    assert any(
        re.search(r"database .*sqlite3 is missing, but .*runs/falling-1 is there", line) for line in wrong
    )
    (line,) = [line for line in wrong if "rescued-1 holds" in line]
    assert f"holds {ratings} ratings; a server saved it when its database was deleted" in line
    with pytest.raises(
        UserError, match=r"is missing.*mv .*rescued-1 .*onedemo\.sqlite3, which a server saved"
    ):
        Store(data_dir)
    # A backup of what a server went on with does not hold it, and says so.
    shutil.copy(saved, data_dir / FILE_NAME)
    assert main(["backup", str(tmp_path / "b.zip"), "--data-dir", str(data_dir)]) == 0
    said = capsys.readouterr().out
    assert f"not in it: {saved}, which a server saved" in said and "did not write" not in said
    (data_dir / FILE_NAME).unlink()
    # As the doctor says.
    subprocess.run(re.search(r"run `(.*)`", line)[1], shell=True, check=True)
    with closing(Store(data_dir)) as store:
        assert len(list(store.ratings.stream())) == ratings
    assert doctor(data_dir, capsys)[0] == []
    (data_dir / f"{FILE_NAME}.rescued-2").write_bytes(b"half")
    (line,), _ = doctor(data_dir, capsys)
    assert re.search(r"rescued-2 is no whole database \(.*\): delete it", line)


def test_the_doctor_says_when_no_video_can_be_brought_in(monkeypatch):
    """Before, only bringing one in told."""
    (well,) = _videos()
    assert well.ok, well.said
    monkeypatch.setattr("onedemo.app.admin.doctor.decode", partial(decode, limits=Limits(memory=64 << 20)))
    (ill,) = _videos()
    assert not ill.ok and ill.said.startswith("no video can be brought in here: a small one of onedemo's own")


@pytest.mark.slow
def test_the_doctor_says_when_nothing_can_be_drawn(tmp_path):
    command = [sys.executable, "-m", "onedemo.app.cli", "doctor", "--data-dir", str(tmp_path / "none")]
    child = subprocess.run(command, env=os.environ | {"MUJOCO_GL": "off"}, capture_output=True, text=True)
    assert child.returncode == 1 and "BAD  pictures         cannot draw the robot" in child.stdout
    assert "none in" in child.stdout


@pytest.mark.seam
def test_a_server_goes_on_from_a_backup_of_a_running_one(tmp_path, looked):
    """People rate at a real server while it is saved; the restored one knows them, and all they had said."""
    data_dir, file, again = tmp_path / "data", tmp_path / "all.zip", tmp_path / "again"
    shutil.copytree(looked, data_dir)

    async def rate(link, count, beside=None):
        async with browser_session() as session:
            tab = await open_tab(session, link)
            for number in range(count):
                await reach(lambda: tab.clip, "a clip")
                await tab.rate(rating(tab))
                if beside is not None and number == count // 2:
                    beside()
            await tab.close()
            return [(press.clip, press.value) for press in tab.presses]

    def save():
        command = [
            sys.executable,
            "-m",
            "onedemo.app.cli",
            "backup",
            str(file),
            "--data-dir",
            str(data_dir),
        ]
        subprocess.run(command, check=True, capture_output=True)

    with serving(data_dir, ["ratings.pretrain=100", *FEW_STATES]) as server:
        pressed = beside_playwright.run(rate(server.links["annotator"], 12, save))
        links = server.links
    restore(file, again)
    with closing(sqlite3.connect(again / FILE_NAME)) as db:
        kept = db.execute("SELECT clip_id, value FROM events ORDER BY id").fetchall()
    assert kept == pressed[: len(kept)] and len(kept) == 7
    with serving(again) as server:
        tokens = [
            {role: link.split("token=")[1] for role, link in each.items()} for each in (links, server.links)
        ]
        assert tokens[0] == tokens[1]
        assert len(beside_playwright.run(rate(server.links["annotator"], 2))) == 2
