"""The tables of trainings: their plans, and what is made of results."""

import pytest

from onedemo.config import METHODS, load_config
from onedemo.experiments.jobs.method import run_config, whole_config
from onedemo.experiments.registry import TABLES, find_table
from onedemo.experiments.report import document
from onedemo.experiments.report.account import complete
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.tables import ablation, backflip, ratings
from onedemo.experiments.tables.episode import median_outcome
from onedemo.experiments.tables.parts import Figures, Goal, figure, reach

# Plans


@pytest.mark.parametrize("table_module", [backflip, ratings, ablation])
@pytest.mark.parametrize("quick", [True, False])
def test_a_plan_has_different_jobs_of_settings_that_exist(table_module, quick):
    jobs = table_module.plan((0, 1), quick=quick)
    assert len({job.key for job in jobs}) == len({str(job) for job in jobs}) == len(jobs)
    for job in jobs:
        if job.kind == "method":
            config = run_config(job.settings, job.seed)
            assert config.rollouts.threads == 1 and config.seed == job.seed
            assert config.ratings.pretrain + config.ratings.online == job.settings["ratings"]


def test_settings_that_were_constants_change_no_reported_job():
    """A finished run of before there were such settings is found; one with other values is another."""

    def digest(**changes):
        return whole_config({"demo": "hopper-backflip", "method": "onedemo", "steps": 1000, "set": changes})

    as_ever = {"practice.random_lanes": 64, "practice.bank_tries": 8000}
    assert digest() == digest(**as_ever)
    assert len({str(digest(**as_ever | {key: 7})) for key in as_ever} | {str(digest())}) == 3


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


def test_a_goal_of_two_figures_needs_both():
    goal = reach("onedemo", "2 turns and 3 reward", net_turns=2, backflip_reward=3, of_5=5)
    for turns, reward, met in ((2, 3, True), (1, 3, False), (2, 2, False), (2, None, False)):
        result = {"figures": {"net_turns": {"mean": turns}, "backflip_reward": {"mean": reward}}}
        assert goal.met(result) == met and goal.shown(result) == turns


def test_the_hand_coded_goal_is_about_one_episode():
    """The turns of the episode with the best reward count, not those of another."""
    rewards = {"best": 16_000.0, "each": [16_000.0, 9_000.0]}
    met = backflip.GOALS[0].met
    assert met({"figures": {"backflip_reward": rewards, "net_turns": {"each": [2.0, 0.0]}}})
    assert not met({"figures": {"backflip_reward": rewards, "net_turns": {"each": [1.0, 9.0]}}})


def test_a_figure_that_a_method_has_not_is_not_a_run_that_is_missing():
    figures = Figures({"turns": figure("net_turns"), "error": figure("state_error")})
    for turns, row in (((1, 2), ("1.5 ± 0.707", "–")), ((None,), ("not run", "not run"))):
        (table,) = figures({"onedemo": outcomes(*turns)})
        assert table.rows == [("onedemo", *row)]


def test_the_median_seed_is_one_that_was_run():
    turned = figure("net_turns")
    assert median_outcome(outcomes(5, None, 1, 3), turned).job.seed == 3
    assert median_outcome(outcomes(5, None, 1), turned).job.seed == 2, "the lower of two"
    assert median_outcome(outcomes(None), turned) is None


@pytest.mark.parametrize("name", TABLES)
def test_there_is_a_report_before_anything_was_run(name, monkeypatch):
    monkeypatch.setenv("ONEDEMO_PERSON_VIDEO", __file__)  # without it there is nothing to run
    table = find_table(name)
    outcomes = [Outcome(job=job, reason="not run") for job in table.plan((0,), quick=False)]
    report = complete(table.report(outcomes, quick=False), outcomes, command="x", quick=False)
    assert "seed 0 not run" in document.as_text(report)
