import csv
import json
import re
import shutil
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

from helpers import warm
from helpers.paths import ROOT
from helpers.server_process import Serving
from load import serving as real
from load.serving import FEW_STATES
from onedemo.app.cli.main import _app, main
from onedemo.config import METHODS, RunConfig, describe, to_toml
from onedemo.storage.database import FILE_NAME
from onedemo.storage.rating_records import RATING_COLUMNS
from onedemo.storage.schema import STEPS as SCHEMA
from onedemo.storage.store import Store


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("serve --demo hoper-backflip", "did you mean hopper-backflip?"),
        ("serve --host [::1] --demo hoper-backflip", "did you mean hopper-backflip?"),  # no other machine
        ("serve --encoder resnet", "no encoder 'resnet'; choose efficientnet-lite0 or vgg16"),
        ("serve --prt 99", "unknown option --prt; did you mean --port?"),
        ("serve --port 99999", "must be a whole number from 0 to 65535"),
        ("serve --set trpo.maxkl=3", "unknown key 'trpo.maxkl'; the nearest valid one is 'trpo.max_kl'"),
        ("train --rater orakel", "unknown rater 'orakel'; choose one of: oracle"),
        ("train --rater oracle+mistak", "unknown error model 'mistak'; choose from: myopic, "),
        ("train --rater no_such:Rater", "there is no module 'no_such', neither in "),
        ("train --rater script", "no table of marks at "),
        ("train --ratings 1", "--ratings must be at least 2, got 1"),
        ("train --ratings x", "--ratings: invalid int value: 'x'"),
        ("train --ratings 1.5", "--ratings: invalid int value: '1.5'"),
        ("train --steps 0x10", "--steps: invalid int value: '0x10'"),
        ("serve --port 80 --port 99999", "must be a whole number from 0 to 65535, got '99999'"),
        ("demo list --x", "unknown option --x"),
        ("demo show nope", "no demo called 'nope'; known demos: half-cheetah-run, hopper-backflip"),
        ("demo add nowhere.mp4 --name x", "no video file at nowhere.mp4"),
        ("demo add nowhere.mp4 --name x --crop 1,2", "four whole numbers X,Y,W,H, got '1,2'"),
        ("demo add a.png b.png --name x", "a demo is made of one video, got 2 files"),
        ("demo remove nope", "no demo called 'nope'"),
        ("demo remove hopper-hop", "comes with the program: it can be neither removed nor renamed"),
        ("demo rename hopper-hop x", "comes with the program"),
        ("robot add nowhere.xml --name x", "there is no model nowhere.xml"),
        ("robot add nowhere.xml --name ant", "ant comes with the program; choose another name"),
        ("robot add nowhere.xml --name x --root loose", "--root: invalid choice: 'loose'"),
        ("robot show nope", "unknown robot 'nope'; choose one of: ant, half-cheetah, hopper"),
        ("robot show gym:CartPole-v1", "does not say which MuJoCo model it has"),
        ("robot render hopper x.gif", "the picture must end in .png or .jpg, got x.gif"),
        ("robot render hopper x.png --count 0", "--count must be 1 to 60, got 0"),
        ("robot remove hopper", "there is no robot hopper of your own"),
        ("serve --robot nope", "unknown robot 'nope'"),
        ("train --robot walker2d", "shows robot 'hopper', but this run's robot is 'walker2d'"),
        ("rater revoke Nobody", "no onedemo.sqlite3 in"),
        ("export", "no onedemo.sqlite3 in"),
        ("rater list", "no onedemo.sqlite3 in"),
        ("rater add  ", "a rater's name is 1 to 64 letters, digits"),
        ("serve --seed -1", "seed must be at least 0 and less than 2**63, got -1"),
        (f"serve --seed {2**70}", "argument --seed: invalid int value"),
        (f"baseline trpo --out x --seed {2**70}", "argument --seed: invalid int value"),
        ("train --set policy.hidden=[1.5]", "policy.hidden must be a list of whole numbers"),
        ("train --set env=walker --quiet", "unknown robot 'walker'"),
        ("train --json /", "/ is a directory"),
        ("train --json /nowhere/out.json", "cannot write /nowhere/out.json"),
        ("serve --host a..b", "--host a..b lets other machines in"),
        ("serve --host a..b --behind-proxy", "cannot be opened"),
        ("serve --tls-cert x", "--tls-cert and --tls-key go together"),
        ("serve --tls-cert x --tls-key y", "cannot use the certificate x with the key y"),
        ("serve --allow-host http://x", "takes a host name such as study.example.org"),
        ("nonsense", "invalid choice: 'nonsense'; choose from audit, backup"),
        ("train --method papre", "--method: invalid choice: 'papre'"),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(arguments, sentence, tmp_path, capsys):
    words = arguments.split() if not arguments.endswith("  ") else [*arguments.split(), ""]
    if words[0] != "nonsense":
        words += ["--data-dir", str(tmp_path / "data")]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.startswith("onedemo: ") and error.count("\n") == 1
    assert not list(tmp_path.glob("data/runs/*"))  # a failed command starts no run


def test_a_newer_database_stays_as_it_is(tmp_path, capsys):
    Store(tmp_path).close()
    with sqlite3.connect(tmp_path / FILE_NAME) as db:
        db.execute(f"PRAGMA user_version = {max(SCHEMA) + 1}")
    db.close()
    assert main(["export", "--data-dir", str(tmp_path)]) == 2
    assert "newer onedemo" in capsys.readouterr().err


def test_a_data_directory_that_cannot_be_used(tmp_path, capsys):
    (tmp_path / "data").write_text("a file is in the way")
    assert main(["rater", "add", "Ann", "--data-dir", str(tmp_path / "data")]) == 2
    assert "not writable" in capsys.readouterr().err


def test_raters_get_links_and_lose_them(tmp_path, capsys):
    where = ["--data-dir", str(tmp_path)]
    assert main(["rater", "add", "Ann", *where]) == 0
    link = capsys.readouterr().out.strip()
    assert link.startswith("http://127.0.0.1:8080/login?token=")
    assert main(["rater", "add", "Ann", *where]) == 0
    assert capsys.readouterr().out.strip() == link  # the same person, the same link
    assert main(["rater", "add", "Bob", "--researcher", *where]) == 0
    capsys.readouterr()
    assert main(["rater", "list", *where]) == 0
    assert capsys.readouterr().out.split() == ["Ann", "annotator", "Bob", "researcher"]
    assert main(["rater", "revoke", "Ann", *where]) == 0
    assert "ended 1 links" in capsys.readouterr().out
    assert main(["rater", "add", "Ann", *where]) == 0
    assert capsys.readouterr().out.strip() not in (link, "")  # the old link stays dead
    assert main(["rater", "revoke", "Nobody", *where]) == 2
    assert "no rater 'Nobody'; there are: Ann, Bob" in capsys.readouterr().err
    assert main(["export", "--run", "nope", *where]) == 2
    assert "no run 'nope'; there are: none" in capsys.readouterr().err
    assert main(["export", "--out", str(tmp_path / "onedemo.sqlite3"), *where]) == 2
    assert "is the database" in capsys.readouterr().err


def test_a_rating_is_withdrawn(tmp_path, capsys):
    from onedemo.storage.clips import NewClip
    from onedemo.types import Segment

    sizes = {"obs": 11, "actions": 3, "qpos": 6, "qvel": 6}
    segment = Segment(**{name: np.zeros((4, size)) for name, size in sizes.items()})
    with closing(Store(tmp_path)) as store:
        store.runs.add(run="r", demo="d", demo_sha256="0" * 64, seed=0, config="", version="0")
        new = NewClip(demo_step=0, segment=segment, stage="pretrain", iteration=0)
        (clip,) = store.clips.add("r", [new])
        number = store.ratings.rate(clip.id, store.accounts.ensure("Ann", "annotator").id, 4, 900)
    command = ["rating", "withdraw", str(number), "--reason", "pressed by mistake"]
    command += ["--data-dir", str(tmp_path)]
    assert main(command) == 0
    assert capsys.readouterr().out == f"withdrew rating {number}: Ann gave clip {clip.id} a 4\n"
    assert main(command) == 2
    assert "does not hold any more" in capsys.readouterr().err
    assert main(["audit", "--data-dir", str(tmp_path)]) == 0
    assert f"withdraw: rating {number}, reason pressed by mistake" in capsys.readouterr().out


def test_help_is_quick_and_loads_nothing_heavy():
    code = "import sys; from onedemo.app.cli.main import main\n"
    code += "for words in (['--help'], ['train', '--help'], ['serve', '--help']): assert main(words) == 0\n"
    code += "print(sorted({'torch', 'mujoco', 'viser', 'cv2', 'numpy'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.rstrip().endswith("[]")


@pytest.mark.parametrize("command", ["serve", "train"])
def test_the_help_shows_every_setting_with_its_default_and_meaning(command, capsys):
    assert main([command, "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    settings = list(describe())
    assert len(settings) == to_toml(RunConfig()).count(" = ") > 50
    for key, default, meaning in settings:
        assert f" {key} = {default} {meaning}" in shown
        assert len(meaning) > 5


def test_the_table_of_the_docs_is_of_settings_that_there_are():
    table = (ROOT / "docs" / "options.md").read_text().split("## Settings")[1].split("## Limits")[0]
    named = set(re.findall(r"`([a-z_]+[.][a-z_]+)`", table))
    assert named and named <= {key for key, _, _ in describe()}


@pytest.mark.parametrize("words", [[], ["demo"], ["rater"], ["bench"], ["baseline"]])
def test_a_command_that_is_missing(words, capsys):
    assert main(words) == 2
    assert "a command is missing" in capsys.readouterr().err


def test_every_method_can_be_asked_for():
    for method in METHODS:
        for command in ("serve", "train"):
            _, bound, _ = _app().parse_args([command, "--method", method], exit_on_error=False)
            assert bound.arguments["options"].overrides() == {"method": method}


FEW = [word for setting in FEW_STATES for word in ("--set", setting)]


@pytest.mark.seam
def test_a_headless_run(tmp_path, capsys, looked):
    shutil.copytree(looked, tmp_path, dirs_exist_ok=True)
    out = tmp_path / "summary.json"
    words = "train --demo hopper-backflip --rater oracle --ratings 40 --steps 30001 --seed 0"
    assert (
        main(
            [
                *words.split(),
                *FEW,
                "--set",
                "ratings.rounds=3",
                "--data-dir",
                str(tmp_path),
                "--json",
                str(out),
            ]
        )
        == 0
    )
    shown = capsys.readouterr().out
    summary = json.loads(out.read_text())
    assert summary["ratings"] == sum(summary["ratings_by_class"]) == 40
    assert summary["env_steps"] == 30_016 and summary["seed"] == 0 and summary["version"]
    assert summary["wall_s"] < 240 and summary["steps_per_s"] > 0
    figures = ("predicted_similarity", "true_similarity", "net_turns", "clean_turns")
    for key in (*figures, "backflip_reward", "backflip_reward_raw_actions"):
        assert set(summary[key]) == {"mean", "best", "worst"} and key in shown
    assert main(["export", "--data-dir", str(tmp_path), "--out", str(tmp_path / "r.csv")]) == 0
    with (tmp_path / "r.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40 and tuple(rows[0]) == RATING_COLUMNS
    assert [row["value"] for row in rows].count("1") == summary["ratings_by_class"][0]
    assert {row["rater"] for row in rows} == {"oracle"}
    assert [row["stage"] for row in rows].count("pretrain") == 23  # 4 of 7, as 200 of 350


@pytest.fixture
def serving(tmp_path, looked):
    shutil.copytree(looked, tmp_path / "data")
    serving = Serving(tmp_path / "data")
    yield serving
    serving.close()


@pytest.mark.seam
def test_serve_prints_both_links_refuses_a_taken_port_and_ends_on_sigterm(serving):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    serving.begin = real.command  # as a person starts it, this once
    child, links, _ = serving.start("--port", str(port), *FEW)
    serving.begin = warm.begin
    assert list(links) == ["researcher", "annotator"]
    assert all(link.startswith(f"http://127.0.0.1:{port}/login?token=") for link in links.values())
    second, none, log = serving.start("--port", str(port))
    assert second.wait(30) == 2 and not none
    assert f"port {port}" in log.read_text() and "--port" in log.read_text()
    other, none, log = serving.start("--port", "0")
    assert other.wait(30) == 2 and not none
    assert "another onedemo is working on" in log.read_text()
    assert len(list(serving.data_dir.glob("runs/*"))) == 1  # a start that failed leaves no run
    child.terminate()
    assert child.wait(60) == 0
