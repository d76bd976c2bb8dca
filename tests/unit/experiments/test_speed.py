"""The benchmark's arithmetic, its report, and a quick run of the parts that need no server."""

import itertools
import json
import os
import sys

import numpy as np
import pytest

from onedemo.app.cli.main import main
from onedemo.experiments.speed import parts as speed
from onedemo.experiments.speed import report
from onedemo.experiments.speed.figures import Figure, Growth, Skipped, by_turns, ratio, single


def made_up():
    return [
        ratio(
            "a_vs_b", "a", ours=[2.0, 9.0, 4.0], theirs=[1.0, 3.0, 4.0], against="b", reach=1.5,
            unit="steps/s", equal="made up",
        ),
        single("wait_s", "waiting", [0.2, 0.9, 0.4], unit="s", reach=0.3),
        Growth(name="cost", title="Cost", x_label="n", y_label="s", x=[1, 10], y={"ours": [0.1, 1.0]}),
        Skipped(name="c_vs_d", reason="d is not installed"),
    ]  # fmt: skip


def test_sides_are_measured_by_turns():
    order = []
    clock = itertools.count()

    def side(name):
        return lambda: order.append(name) or float(next(clock))

    taken = by_turns({"a": side("a"), "b": side("b")}, 3)
    assert order == ["a", "b"] * 4  # the first turn warms up
    assert taken == {"a": [2, 4, 6], "b": [3, 5, 7]}


def test_ratio_is_taken_within_each_turn():
    faster = ratio(
        "x", "x", ours=[2.0, 9, 4], theirs=[1.0, 3, 4], against="", reach=2, equal="", unit="steps/s"
    )
    assert (faster.value, faster.low, faster.high, faster.met) == (2, 1, 3, True)
    with pytest.raises(ValueError, match="2 turns of ours, 1 of theirs"):
        ratio("x", "x", ours=[1.0, 2], theirs=[1.0], against="", reach=None, equal="", unit="s")


def test_a_single_figure_is_bounded_from_above():
    assert single("x", "x", [1.0, 2, 9], unit="s", reach=2).met
    assert not single("x", "x", [1.0, 3, 9], unit="s", reach=2).met
    assert single("x", "x", [1.0], unit="s").met is None
    with pytest.raises(ValueError, match="no repetition"):
        single("x", "x", [], unit="s")


def test_json_holds_every_repetition():
    about = report.as_json(made_up(), command="onedemo bench speed", seconds=1.0)
    assert about["ratios"] == {"a_vs_b": 2.0}
    assert about["figures"]["a_vs_b"]["sides"]["onedemo, steps/s"] == [2.0, 9.0, 4.0]
    assert about["figures"]["wait_s"]["met"] is False
    assert about["skipped"] == {"c_vs_d": "d is not installed"}
    assert about["machine"]["cores"] >= 1 and "mujoco" in about["machine"]["packages"]
    json.dumps(about)


def test_table_names_what_was_missed_and_what_was_not_run():
    lines = report.table(made_up()).splitlines()
    assert [line.split()[-1] for line in lines[1:3]] == ["met", "missed"]
    assert lines[3] == "c_vs_d: not run, d is not installed"


def test_report(tmp_path):
    pytest.importorskip("matplotlib")
    results = made_up()
    about = report.as_json(results, command="onedemo bench speed", seconds=1.0)
    report.write_report(tmp_path / "out", "Speed", results, about)
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert names == {"report.md", "results.json", "cost.svg"}
    assert "| a | b | 2 x | 1 - 3 | >= 1.5 | met |" in (tmp_path / "out/report.md").read_text()
    assert "cost.svg" in (tmp_path / "out/report.md").read_text()


def test_a_part_that_fails_does_not_lose_the_others(monkeypatch):
    from onedemo.experiments.speed import fitting, physics

    def broken(quick):
        raise RuntimeError("no luck")

    monkeypatch.setattr(physics, "measure", broken)
    monkeypatch.setattr(fitting, "measure", lambda quick: made_up()[:1])
    results = speed.measure(quick=True, parts=["physics", "fitting"])
    assert results[0] == Skipped(name="physics", reason="RuntimeError: no luck", failed=True)
    assert isinstance(results[1], Figure) and results[1].name == "a_vs_b"


def test_a_failed_part_fails_the_command(monkeypatch, capsys):
    from onedemo.experiments.speed import fitting

    monkeypatch.setattr(fitting, "measure", lambda quick: 1 / 0)
    assert main(["bench", "speed", "--part", "fitting"]) == 1
    assert "fitting: failed, ZeroDivisionError" in capsys.readouterr().out
    monkeypatch.setattr(fitting, "measure", lambda quick: made_up()[:1])
    assert main(["bench", "speed", "--part", "fitting"]) == 0


def test_bad_options(tmp_path, capsys):
    assert main(["bench", "speed", "--part", "fiziks"]) == 2
    assert "unknown part 'fiziks'; choose from: physics, training" in capsys.readouterr().err
    file = tmp_path / "file"
    file.write_text("")
    assert main(["bench", "speed", "--part", "physics", "--out", str(file)]) == 2
    assert main(["bench", "speed", "--part", "physics", "--json", str(tmp_path)]) == 2
    assert "is a directory" in capsys.readouterr().err


@pytest.fixture
def one_core():
    """Both sides on one core: threads that meet wait for each other where others compute, too."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.seam
def test_quick_run_of_physics_and_training(tmp_path, capsys, one_core):
    """Loose bounds, as the machine may be busy: what fails here is wrong by more than noise."""
    file = tmp_path / "speed.json"
    parts = [word for part in ("physics", "training", "sb3") for word in ("--part", part)]
    assert main(["bench", "speed", "--quick", *parts, "--json", str(file)]) == 0
    about = json.loads(file.read_text())
    assert about["ratios"]["physics_vs_bare"] > 0.25
    assert about["ratios"]["physics_vs_gymnasium"] > 1
    assert about["ratios"]["train_vs_physics"] > 0.3
    assert 0 < about["figures"]["reward_share"]["value"] < 10
    rates = about["growth"]["physics_lanes"]["y"]["onedemo"]
    assert rates[-1] > 0.5 * rates[0], "many lanes are not slower than one"
    for part, name in (("physics_vs_envpool", "physics_vs_envpool"), ("sb3", "train_vs_sb3_best")):
        assert name in about["ratios"] or "not installed" in about["skipped"][part]
    assert "physics_vs_bare" in capsys.readouterr().out


def test_made_up_ratings_are_skewed_like_those_of_a_random_policy():
    from onedemo.config import load_config
    from onedemo.experiments.speed.training import made_up_ratings
    from onedemo.training.learner import Learner

    learner = Learner(load_config(None, {"method": "paper"}), 240, 30.0)
    ratings = made_up_ratings(learner.random_rollouts(), 200, learner.clip_steps)
    counts = np.bincount([r.value for r in ratings], minlength=6)[1:]
    assert counts[0] > counts[1] > counts[4] > 0
