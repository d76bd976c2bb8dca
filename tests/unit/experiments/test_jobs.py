"""The jobs for real: one table from its plan to its files, and each other kind of job in its smallest form.

What whole runs achieve is tested on the finished ones, in ``test_finished_runs``.
"""

import os
from dataclasses import replace

import cv2
import numpy as np
import pytest

from onedemo.errors import UserError
from onedemo.experiments.jobs import controls, method, person, predictor_trial, transfer
from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS
from onedemo.experiments.report import document
from onedemo.experiments.report.account import complete
from onedemo.experiments.runner import by_label, run_jobs
from onedemo.experiments.tables import ablation, backflip
from onedemo.experiments.tables import person as person_table

SEED = 101  # not one of those that are reported
FEW = {"predictor.updates": 200, "ratings.rounds": 4, "practice.random_lanes": 24, "practice.bank_tries": 500}
"""Of a quick form that is quicker."""
FEW_STEPS = 16_000
"""One iteration: what a predictor knows after its ratings does not depend on more."""
TINY = {
    "rollouts.lanes": 16, "rollouts.steps": 125, "predictor.updates": 20, "ratings.rounds": 2,
    "practice.random_lanes": 8, "practice.bank_tries": 500,
}  # fmt: skip

LONG = pytest.mark.skipif(
    not os.environ.get("ONEDEMO_LONG"), reason="whole trainings: ONEDEMO_LONG=1 (make chaos)"
)


def tiny(**changes):
    """Settings of a job of kind "method": one iteration after 8 ratings, with 6 more."""
    return {
        "demo": "hopper-backflip", "method": "onedemo", "rater": "oracle", "ratings": 14, "steps": 2000,
        "set": TINY | changes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def cache(results):
    return results / "cache"


def quicker(job):
    """A job of the quick form that practises less, with a rougher predictor."""
    settings = {**job.settings, "steps": min(FEW_STEPS, job.settings["steps"])}
    if job.kind == "method":
        settings |= {"set": FEW}
        settings |= method.whole_config(settings)
    return replace(job, settings=settings)


@pytest.mark.seam
@LONG
def test_a_table_from_its_plan_to_its_files(results, tmp_path):
    """The backflip's quick form, without preferences, which take longest and have a test of their own."""
    jobs = [quicker(job) for job in backflip.plan((SEED,), quick=True) if job.kind != "preferences"]
    outcomes = run_jobs(jobs, results, workers=1, tell=print)
    assert [outcome.reason for outcome in outcomes if outcome.failed] == []
    report = backflip.TABLE.report(outcomes, quick=True)
    document.write(complete(report, outcomes, command="onedemo bench backflip", quick=True), tmp_path)
    found = {label: group[0].result for label, group in by_label(outcomes).items()}
    ours, paper = found["onedemo"], found["paper"]
    for label, result in found.items():
        assert all(len(f["each"]) == 16 for f in result["figures"].values() if f), label
        assert len(result["episode"]["qpos"]) == 240 and len(result["errors"]["best"]) == 100, label
        assert result["curve"]["env_steps"][-1] == result["env_steps"], label
        assert result["figures"]["aligned_similarity"]["mean"] > result["figures"]["true_similarity"]["mean"]
    assert ours["ratings"] == paper["ratings"] == 60
    # With a sixth of the ratings, the distance that was learned knows the demo, the paper's network hardly.
    assert ours["demo_rated"] > ours["demo_shuffled"] + 1
    assert abs(paper["demo_rated"] - paper["demo_shuffled"]) < 1
    # Questions about chosen moments of random states: fewer ones, more fours and fives.
    assert ours["ratings_by_class"][0] < paper["ratings_by_class"][0]
    assert sum(ours["ratings_by_class"][3:]) > sum(paper["ratings_by_class"][3:])
    text = (tmp_path / "report.md").read_text()
    assert text.count("| missed |") + text.count("| **met** |") >= 3 and "not run" not in text
    assert "The quick form" in text and "Not for reporting" in text
    moving = cv2.imreadanimation(str(tmp_path / "backflip.webp"))[1]
    assert len(moving.frames) == 120 and (tmp_path / "backflip.webp").stat().st_size < 400_000
    assert np.ptp([frame[:, 250:].mean() for frame in moving.frames]) > 0, "the robot's side moves"
    for chart in ("turns", "reward", "state_error"):
        assert (tmp_path / f"{chart}.svg").exists()


@pytest.mark.seam
@LONG
def test_a_switch_of_the_ablation_and_a_predictor_of_another_move_change_something(cache, tmp_path):
    plain = document.plain(method.run(tiny(), SEED, tmp_path / "plain", cache))
    assert plain["ratings"] == sum(plain["ratings_by_class"]) == 14
    switched = tiny(**ablation.off(ablation.SWITCHES["an adaptive phase"]))
    other = document.plain(method.run(switched, SEED, tmp_path / "other", cache))
    assert other["ratings"] == 14 and other["env_steps"] == plain["env_steps"]
    assert other["figures"] != plain["figures"]
    source = {**tiny(), "demo": "hopper-hop", "ratings": 21}
    tuned = document.plain(
        transfer.run({"source": source, "target": tiny()}, SEED, tmp_path / "tuned", cache)
    )
    assert tuned["ratings"] == plain["ratings"] and tuned["source"]["ratings"] == 21
    assert tuned["curve"]["env_steps"] == plain["curve"]["env_steps"]
    assert tuned["demo_rated"] != plain["demo_rated"] and tuned["figures"] != plain["figures"]


@pytest.mark.seam
def test_a_run_on_the_persons_video(cache, tmp_path):
    try:
        person.video()
    except UserError:
        pytest.skip(f"{person.VARIABLE} names no video")
    settings = {k: v for k, v in tiny(**person_table.CHANGES).items() if k != "demo"} | {"rater": "script"}
    result = document.plain(person.run(settings, SEED, tmp_path, cache))
    assert result["ratings"] == sum(result["ratings_by_class"]) == 14
    assert sum(n > 0 for n in result["ratings_by_class"]) >= 3, "the rater tells clips apart"
    assert len(result["episode"]["qpos"]) == 66 and result["demo_rated"] is None
    each = [result["figures"][name]["each"] for name in ("farthest_turn", "turned")]
    assert len(each[0]) == 16 and all(far >= turned for far, turned in zip(*each, strict=True))


@pytest.mark.seam
def test_a_policy_from_comparisons(tmp_path):
    settings = {"demo": "hopper-backflip", "steps": 1, "comparisons": 4}
    result = document.plain(controls.preferences(settings, SEED, tmp_path))
    assert result["ratings"] == 4 and -1 <= result["reward_correlation"] <= 1
    assert len(result["figures"]["net_turns"]["each"]) == 16


@pytest.mark.seam
def test_a_trial_of_every_predictor(cache, tmp_path):
    split = [40, 20, 20]
    settings = {
        "demo": "hopper-backflip", "data": "onedemo", "split": split, "rounds": 2, "clips": 30,
        "config": {
            "rollouts.threads": 1, "predictor.updates": 20, "practice.random_lanes": 16,
            "practice.bank_tries": 500,
        },
    }  # fmt: skip
    result = predictor_trial.run(settings, SEED, tmp_path / "scratch", cache)
    assert [sum(classes) for classes in result["classes"].values()] == split
    assert list(result["variants"]) == list(predictor_trial.VARIANTS)
    for figures in result["variants"].values():
        assert np.sum(figures["confusion"]) == 40 and np.sum(figures["reliability"][0]) == 40
        right = np.trace(figures["confusion"]) / 40
        assert right == pytest.approx((figures["validation"] + figures["test"]) / 2)
        assert 1 <= figures["shuffled"] <= 5 and -1 <= (figures["ranks"][OTHERS] or 0) <= 1
    # Attempts at the move are nearer to it than other moves.
    assert result["truth"]["clips"][ATTEMPTS] > result["truth"]["clips"][OTHERS]
    assert len({figures["own"] for figures in result["variants"].values()}) > 5, "variants differ"
    assert not (tmp_path / "scratch").exists()  # what was learned of demo and robot is in the cache
