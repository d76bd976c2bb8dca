"""Table 1: its scores against known answers, and its report from made-up results."""

import json

import numpy as np
import pytest

from onedemo.config import load_config
from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS, STANDING, WILD
from onedemo.experiments.jobs.predictor_trial import VARIANTS, run
from onedemo.experiments.predictor_scores import (
    calibration_error,
    confusion,
    f1,
    interval,
    macro_f1,
    reliability,
    spearman,
)
from onedemo.experiments.report import document
from onedemo.experiments.report.blocks import Bars, Bullets, Chart, Table
from onedemo.experiments.runner import Outcome, kind_of
from onedemo.experiments.tables import predictor
from onedemo.experiments.tables.predictor_figures import (
    COUNTED,
    PAPER,
    PAPERS_CHOICE,
    by_variant,
    findings,
    paired,
)
from onedemo.experiments.worker import find_function

# Scores

GIVEN = np.array([1, 1, 2, 3, 4, 5])
PREDICTED = np.array([1, 3, 2, 3, 3, 1])


def test_f1_by_hand():
    # 3 or more: 3, 4, 5 given; the 3 and the 4 found, the 5 missed, a 1 taken for a 3.
    assert f1(GIVEN, PREDICTED, 3) == pytest.approx(2 * 2 / (2 * 2 + 1 + 1))
    assert f1(GIVEN, PREDICTED, 4) == 0.0  # 4 and 5 given, none found
    assert f1(GIVEN[:3], PREDICTED[:1].repeat(3), 4) is None  # nothing to find, nothing said
    # Of 3: one found, two taken for it. Of 4 and 5: none found.
    assert macro_f1(GIVEN, PREDICTED, 3) == pytest.approx((2 / (2 + 2) + 0 + 0) / 3)
    assert macro_f1(np.array([1, 3]), np.array([1, 3]), 3) == 1.0  # classes that no clip has are left out
    assert macro_f1(np.array([1]), np.array([2]), 3) is None


def test_confusion_by_hand():
    counts = confusion(GIVEN, PREDICTED)
    assert counts.sum() == 6 and counts[0].tolist() == [1, 0, 1, 0, 0]
    assert counts[3, 2] == 1 and counts[4, 0] == 1 and np.trace(counts) == 3


def test_calibration_by_hand():
    chances = np.array([0.05, 0.05, 0.62, 0.68, 1.0])
    happened = np.array([False, True, True, True, True])
    bins = reliability(chances, happened)
    assert bins[0].tolist() == [2, 0, 0, 0, 0, 0, 2, 0, 0, 1]
    # |0.05 - 0.5| of two, |0.65 - 1| of two, |1 - 1| of one.
    assert calibration_error(bins) == pytest.approx((2 * 0.45 + 2 * 0.35) / 5)
    assert calibration_error(bins + bins) == pytest.approx(calibration_error(bins))


def test_spearman_against_known_answers():
    a = np.array([3.0, 1.0, 4.0, 1.5, 5.0])
    assert spearman(a, np.exp(a)) == pytest.approx(1.0)
    assert spearman(a, -(a**3)) == pytest.approx(-1.0)
    # Without ties 1 - 6 sum d^2 / (n (n^2 - 1)); ranks 1..5 against 2 1 4 3 5: d^2 sum to 4.
    assert spearman(np.arange(5), np.array([2, 1, 4, 3, 5])) == pytest.approx(1 - 6 * 4 / (5 * 24))
    # Ties share 1.5: Pearson of (1.5, 1.5, 3) and (1, 2, 3) is 1.5 / sqrt(1.5 * 2).
    assert spearman(np.array([0, 0, 9]), np.arange(3)) == pytest.approx(1.5 / np.sqrt(3.0))
    assert spearman(np.ones(3), np.arange(3)) is None


def test_interval_of_a_mean():
    low, high = interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert (low, high) == pytest.approx((3 - 2.776 * np.sqrt(2.5 / 5), 3 + 2.776 * np.sqrt(2.5 / 5)))
    assert interval([1.0]) == (-np.inf, np.inf)
    rng = np.random.default_rng(0)
    held = [low < 0 < high for low, high in (interval(rng.normal(size=5).tolist()) for _ in range(2000))]
    assert 0.93 < np.mean(held) < 0.97


# Plan and report


def part(**changes):
    """What a trial says of one predictor."""
    ranks = dict.fromkeys((STANDING, WILD, OTHERS, ATTEMPTS), 0.5)
    return {
        "validation": 0.6, "test": 0.6, "f1_3": 0.5, "f1_4": None, "macro_3": 0.4, "macro_4": None,
        "error_3": 0.01, "error_4": 0.0, "confusion": np.eye(5, dtype=int) * 40, "calibration": 0.1,
        "reliability": np.ones((3, 10)) * [[20], [10], [10]], "own": 2.0, "shuffled": 1.5, "picked": 2.0,
        "ranks": ranks, "fit_s": 1.0,
    } | changes  # fmt: skip


def outcomes(seeds, figures=lambda name, seed: {}, missing=()):
    """Made-up results of all jobs."""
    made = []
    for job in predictor.plan(seeds, quick=False):
        result = {
            "classes": {
                "fitted": [150, 40, 10, 0, 0], "validation": [70, 30, 0, 0, 0], "test": [75, 25, 0, 0, 0]
            },
            "truth": {"own": 5.0, "shuffled": 1.7, "clips": part()["ranks"]},
            "variants": {name: part(**figures(name, job.seed)) for name in VARIANTS},
        }  # fmt: skip
        there = job.seed not in missing
        made.append(Outcome(job=job, kept={"result": result} if there else None, reason="not run"))
    return made


def test_the_plan_fits_all_predictors_on_the_same_ratings():
    jobs = predictor.plan((3, 4), quick=False)
    assert [(job.seed, job.settings["data"]) for job in jobs] == [
        (3, "paper"), (3, "onedemo"), (4, "paper"), (4, "onedemo")
    ]  # fmt: skip
    assert len({job.key for job in jobs}) == 4
    assert all(job.settings["split"] == [200, 100, 100] for job in jobs)
    assert find_function(kind_of(jobs[0]).function) is run
    quick = predictor.plan((3,), quick=True)
    assert not {job.key for job in quick} & {job.key for job in jobs}


def test_the_variants_are_the_papers_and_ours():
    configs = {name: load_config(None, variant).predictor for name, variant in VARIANTS.items()}
    assert list(configs)[:5] == list(PAPER)
    for name, sampling, weights, layer in (
        ("random sampling", "random", False, False),
        ("sampling equally", "equal", False, False),
        ("class weights", "random", True, False),
        ("equal + weights", "equal", True, False),
        ("additional layer", "equal", False, True),
    ):
        config = configs[name]
        assert (config.sampling, config.class_weights, config.additional_layer) == (sampling, weights, layer)
        assert (config.kind, config.members, config.appearance) == ("network", 1, False)
    assert configs["metric"] == load_config().predictor


def test_what_cannot_be_told_apart_is_said_loudly():
    noise = np.random.default_rng(1).normal(0, 0.05, (len(VARIANTS), 5))

    def noisy(name, seed):
        return {"test": 0.6 + noise[list(VARIANTS).index(name), seed]}

    group = by_variant([o for o in outcomes(range(5), noisy) if o.job.settings["data"] == "paper"])
    first, _, high, *_ = findings("x", group)
    assert "**less than the spread of one variant over seeds" in first
    assert "**Seed by seed, none can be told from the additional layer.**" in first
    assert high == "**x, F1 of 4-5**: no clip has such a rating, given or predicted."

    def worse(name, seed):
        return {"test": 0.3 + seed / 10 - 0.2 * (name == "class weights") + noise[0, seed] / 100}

    made = [o for o in outcomes(range(5), worse) if o.job.settings["data"] == "paper"]
    group = by_variant(made)
    assert findings("x", group)[0].endswith("told from the additional layer: class weights.")
    assert paired(COUNTED["test"], group["class weights"], group[PAPERS_CHOICE]) == pytest.approx([-20] * 5)
    assert "nothing can be said" in findings("x", by_variant(made[:1]))[0]


def test_the_report_shows_every_seed_and_every_predictor():
    made = outcomes((0, 1, 2), lambda name, seed: {"test": 0.5 + seed / 10}, missing=(1,))
    report = predictor.TABLE.report(made, quick=False)
    tables = [block for block in report.blocks if isinstance(block, Table)]
    each = [table for table in tables if table.title == "Each seed, in the order 0, 1, 2"]
    assert each[0].rows[0][:2] == ("random sampling", "50, –, 70")
    accuracy = next(table for table in tables if table.title == "Clips not fitted, %")
    assert [row[0] for row in accuracy.rows] == [*VARIANTS, "always the same"]
    assert (
        accuracy.rows[0][2] == "60 ± 14.1 (2 of 3 seeds)" and accuracy.rows[-1][2] == "75 ± 0 (2 of 3 seeds)"
    )
    bars = next(block for block in report.blocks if isinstance(block, Bars))
    assert bars.each[0] == pytest.approx([50, 70]) and bars.values[0] == pytest.approx(60)
    charts = [block for block in report.blocks if isinstance(block, Chart)]
    assert len(charts) == 2 and charts[0].lines[1].x == pytest.approx([50] * 10)
    confused = next(table for table in tables if table.title.startswith("additional layer; "))
    assert confused.rows[1][1:] == ["0", "80", "0", "0", "0"]  # two seeds of 40
    assert len({document.file_name(b) for b in report.blocks if isinstance(b, Bars | Chart)}) == 10
    figures = report.data["figures"]["random policy"]["metric"]["test"]
    assert figures["each"] == pytest.approx((50, None, 70))
    json.dumps(document.plain(report.data), allow_nan=False)


def test_the_report_of_nothing():
    report = predictor.TABLE.report(outcomes((0, 1), missing=(0, 1)), quick=True)
    assert next(block for block in report.blocks if isinstance(block, Bullets)).items == []
    assert "not run" not in document.as_text(report)
