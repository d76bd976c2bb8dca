"""The tables of trainings: their plans, their verdicts, and their quick forms for real."""

import cv2
import numpy as np
import pytest

from onedemo.config import METHODS, load_config
from onedemo.experiments.jobs.method import run_config
from onedemo.experiments.report import document
from onedemo.experiments.runner import Job, Outcome, by_label, run_jobs
from onedemo.experiments.tables import ablation, backflip, ratings
from onedemo.experiments.tables.summary import Goal, figure, median_outcome, table

TABLES = (backflip, ratings, ablation)
SEED = 101  # not one of those that are reported


# Plans


@pytest.mark.parametrize("table_module", TABLES)
@pytest.mark.parametrize("quick", [True, False])
def test_a_plan_has_different_jobs_of_settings_that_exist(table_module, quick):
    jobs = table_module.plan((0, 1), quick=quick)
    assert len({job.key for job in jobs}) == len({str(job) for job in jobs}) == len(jobs)
    for job in jobs:
        if job.kind == "method":
            config = run_config(job.settings, job.seed)
            assert config.rollouts.threads == 1 and config.seed == job.seed
            assert config.ratings.pretrain + config.ratings.online == job.settings["ratings"]


def test_nothing_gets_fewer_steps_than_onedemo():
    jobs = backflip.plan((0,), quick=False)
    ours = next(job.settings["steps"] for job in jobs if job.label == "onedemo")
    assert min(job.settings["steps"] for job in jobs) == ours


def test_tables_share_their_runs():
    whole = {job.key for job in backflip.plan((0,), quick=False)}
    shared = [job for job in ratings.plan((0,), quick=False) if job.key in whole]
    assert [job.label for job in shared] == [
        "onedemo, 100 ratings",
        "onedemo, 350 ratings",
        "paper, 350 ratings",
    ]


def test_every_switch_between_the_methods_is_in_the_ablation():
    # A learned distance makes nothing of principal components, so onedemo has no row without them.
    of_network = "predictor.visual_dims"
    for switches, left_out in ((ablation.SWITCHES, {of_network}), (ablation.ON, set())):
        assert {key for keys in switches.values() for key in keys} == set(METHODS["paper"]) - left_out
    everything = [key for keys in ablation.SWITCHES.values() for key in keys] + [of_network]
    paper = load_config(None, {"method": "paper"})
    assert load_config(None, {"method": "onedemo"} | ablation.off(everything)) == load_config(
        None, {"method": "onedemo"} | METHODS["paper"]
    )
    assert run_config(_settings("paper", ablation.on(everything)), 0).practice != paper.practice
    assert run_config(_settings("paper", ablation.on(everything)), 0).practice == load_config().practice


def _settings(method, changes):
    return {"method": method, "ratings": 350, "steps": 1000, "set": changes}


# What is made of results


def outcomes(*turns):
    """Of seeds 0, 1, ...; None has no result."""
    found = []
    for seed, value in enumerate(turns):
        job = Job(kind="method", label="onedemo", settings={}, seed=seed)
        figures = {"net_turns": {"mean": value, "best": value, "worst": value}, "state_error": None}
        kept = None if value is None else {"result": {"figures": figures}}
        found.append(Outcome(job=job, kept=kept, reason="not run"))
    return found


@pytest.mark.parametrize(
    ("turns", "of_5", "count", "asked", "verdict"),
    [
        ((4, 4, 5, 4, 4), 5, "5 of 5", "5 of 5", "**met**"),
        ((4, 4, 5, 4, 3.9), 5, "4 of 5", "5 of 5", "missed"),
        ((4, 4, 5, 4, 3.9), 4, "4 of 5", "4 of 5", "**met**"),
        ((4, 4, None, None, 3.9), 4, "2 of 5", "4 of 5", "open"),
        ((4, 3, None, None, 3.9), 4, "1 of 5", "4 of 5", "missed"),
        ((4, 3), 3, "1 of 2", "2 of 2", "missed"),
    ],
)
def test_a_goal_counts_seeds(turns, of_5, count, asked, verdict):
    turned = figure("net_turns")
    goal = Goal(label="onedemo", what="4 turns", met=lambda r: turned(r) >= 4, shown=turned, of_5=of_5)
    assert goal.row(outcomes(*turns))[3:] == (count, asked, verdict)


def test_the_hand_coded_goal_is_about_one_episode():
    """The turns of the episode with the best reward count, not those of another."""
    rewards = {"best": 16_000.0, "each": [16_000.0, 9_000.0]}
    met = backflip.GOALS[0].met
    assert met({"figures": {"backflip_reward": rewards, "net_turns": {"each": [2.0, 0.0]}}})
    assert not met({"figures": {"backflip_reward": rewards, "net_turns": {"each": [1.0, 9.0]}}})


def test_a_figure_that_a_method_has_not_is_not_a_run_that_is_missing():
    columns = {"turns": figure("net_turns"), "error": figure("state_error")}
    assert table(columns, {"onedemo": outcomes(1, 2)}).rows == [("onedemo", "1.5 ± 0.707", "–")]
    assert table(columns, {"onedemo": outcomes(None)}).rows == [("onedemo", "not run", "not run")]


def test_the_median_seed_is_one_that_was_run():
    turned = figure("net_turns")
    assert median_outcome(outcomes(5, None, 1, 3), turned).job.seed == 3
    assert median_outcome(outcomes(5, None, 1), turned).job.seed == 2, "the lower of two"
    assert median_outcome(outcomes(None), turned) is None


@pytest.mark.parametrize("table_module", TABLES)
def test_there_is_a_report_before_anything_was_run(table_module):
    planned = table_module.plan((0,), quick=False)
    report = table_module.report([Outcome(job=job, reason="not run") for job in planned], quick=False)
    assert "not run" in document.as_text(report)


# The quick forms


def run(table_module, results, out):
    found = run_jobs(table_module.plan((SEED,), quick=True), results, workers=1, tell=print)
    assert [outcome.reason for outcome in found if outcome.failed] == []
    report = table_module.report(found, quick=True)
    document.write(report, out)
    return {label: group[0].result for label, group in by_label(found).items()}, document.as_text(report)


@pytest.mark.seam
def test_backflip(results, tmp_path):
    found, text = run(backflip, results, tmp_path)
    ours, paper = found["onedemo"], found["paper"]
    for label, result in found.items():
        assert all(len(f["each"]) == 16 for f in result["figures"].values() if f), label
        assert len(result["episode"]["qpos"]) == 240 and len(result["errors"]["best"]) == 100, label
        assert result["curve"]["env_steps"][-1] == result["env_steps"], label
        assert result["figures"]["aligned_similarity"]["mean"] > result["figures"]["true_similarity"]["mean"]
    assert ours["ratings"] == paper["ratings"] == found["preferences"]["ratings"] == 60
    # With a sixth of the ratings, the distance that was learned knows the demo, the paper's network hardly.
    assert ours["demo_rated"] > ours["demo_shuffled"] + 1.5
    assert abs(paper["demo_rated"] - paper["demo_shuffled"]) < 1
    # Questions about chosen moments of random states: fewer ones, more fours and fives.
    assert ours["ratings_by_class"][0] < paper["ratings_by_class"][0]
    assert sum(ours["ratings_by_class"][3:]) > sum(paper["ratings_by_class"][3:])
    # Practice of a few seconds: it moves like the demo more than it did, if by little.
    assert ours["figures"]["aligned_similarity"]["mean"] > 1.7
    assert text.count("missed") + text.count("met") >= 3 and "not run" not in text
    moving = cv2.imreadanimation(str(tmp_path / "backflip.webp"))[1]
    assert len(moving.frames) == 120 and (tmp_path / "backflip.webp").stat().st_size < 400_000
    assert np.ptp([frame[:, 250:].mean() for frame in moving.frames]) > 0, "the robot's side moves"
    for chart in ("turns", "reward", "state_error"):
        assert (tmp_path / f"{chart}.svg").exists()


@pytest.mark.seam
def test_ratings(results, tmp_path):
    found, text = run(ratings, results, tmp_path)
    assert [result["ratings"] for result in found.values()] == [25, 60, 60]
    assert all(found[f"onedemo, {n} ratings"]["demo_rated"] > 3.5 for n in (25, 60))
    assert "Fewest ratings" in text
    assert "the paper, 350 ratings of a person" in (tmp_path / "ratings.svg").read_text()


@pytest.mark.seam
def test_ablation(results, tmp_path):
    found, text = run(ablation, results, tmp_path)
    assert list(found) == [
        "onedemo", "paper", "onedemo without an elastic clock", "onedemo without giving up",
        "paper with an elastic clock",
    ]  # fmt: skip
    curves = [result["curve"]["backflip_reward"] for result in found.values()]
    assert len({tuple(curve) for curve in curves}) == len(curves), "every switch changes something"
    assert "1 seed and 32,000 control steps" in text
    assert (tmp_path / "ablation_onedemo.svg").exists() and (tmp_path / "ablation_paper.svg").exists()
