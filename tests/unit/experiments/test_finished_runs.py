"""The reports of the finished runs in ``docs/results/runs``, and what these runs show."""

import json
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.paths import ROOT
from onedemo.experiments.jobs import person
from onedemo.experiments.jobs.predictor_exam import ATTEMPTS, OTHERS
from onedemo.experiments.registry import TABLES, find_table
from onedemo.experiments.report import document
from onedemo.experiments.report.account import complete
from onedemo.experiments.runner import by_label, peek
from onedemo.experiments.statistics import spread
from onedemo.experiments.tables.parts import figure
from onedemo.experiments.tables.transfer import BACK, THERE

RESULTS = ROOT / "docs" / "results"
SEEDS = {"ratings": 3}
"""Reported, where they are not as many as the table usually takes."""
MOVING = {"backflip": ("backflip", "flip_clean", "paper"), "transfer": ("hop_transferred",)}
STRIPS = {"transfer": ("hop_fine_tuned", "hop_scratch")}


@cache
def finished(name):
    """Outcomes of all reported seeds."""
    table = find_table(name)
    with pytest.MonkeyPatch.context() as patch:
        if name == "person" and not has_video():  # its plan asks for a file; its finished runs do not
            patch.setenv(person.VARIABLE, __file__)
        jobs = table.plan(tuple(range(SEEDS.get(name, table.seeds))), quick=False)
    return peek(jobs, RESULTS / "runs")


def results(name):
    """Label to the results of all seeds."""
    return {label: [o.result for o in group] for label, group in by_label(finished(name)).items()}


def has_video():
    return Path(os.environ.get(person.VARIABLE, "")).is_file()


@dataclass
class Made:
    """A report that was made anew, and the one in the repository."""

    name: str
    out: Path

    def texts(self):
        """Paragraphs of both, without what was typed and where."""
        for directory in (self.out, RESULTS / self.name):
            title, _, *blocks = (directory / "report.md").read_text().split("\n\n")
            yield [title, *blocks]


@pytest.fixture(scope="module", params=[name for name in TABLES if (RESULTS / name).exists()])
def made(request, tmp_path_factory):
    name, out = request.param, tmp_path_factory.mktemp(request.param)
    outcomes = finished(name)
    report = complete(find_table(name).report(outcomes, quick=False), outcomes, command="x", quick=False)
    document.write(report, out)
    return Made(name, out)


@pytest.mark.seam
def test_the_reports_in_the_repository_are_those_of_the_finished_runs(made):
    pytest.importorskip("matplotlib")
    new, old = made.texts()
    if made.name == "person":  # whose pictures are not in the repository
        at = [blocks.index("## What it looks like") for blocks in (new, old)]
        assert new[at[0] :][-3:] == old[at[1] :][-3:]
        new, old = new[: at[0]], old[: at[1]]
    assert new == old
    written = {file.name for file in made.out.iterdir()}
    assert {file.name for file in (RESULTS / made.name).iterdir()} <= written
    for chart in made.out.glob("*.svg"):
        assert chart.stat().st_size > 5_000
    record = json.loads((made.out / "results.json").read_text(), parse_constant=pytest.fail)
    kept = json.loads((RESULTS / made.name / "results.json").read_text())
    assert record["runs"] == kept["runs"]
    for name in {"goals", "ratios", "figures", "paper"} & record.keys():
        assert record[name] == kept[name]
    for name in MOVING.get(made.name, ()):
        moving = cv2.imreadanimation(str(made.out / f"{name}.webp"))[1]
        assert len(moving.frames) == 120 and (made.out / f"{name}.webp").stat().st_size < 400_000
        assert np.ptp([frame[:, 250:].mean() for frame in moving.frames]) > 0, "the robot's side moves"
    for name in STRIPS.get(made.name, ()):
        assert cv2.imread(str(made.out / f"{name}.webp")).shape == (274, 8 * 184 - 4, 3)
    if made.name == "person":
        pictures = ["person_onedemo.webp", "person_onedemo_strip.webp", "person_paper_strip.webp"]
        text = (made.out / "report.md").read_text()
        if has_video():
            assert all((made.out / name).stat().st_size > 10_000 for name in pictures)
        else:
            assert text.count("No picture of") == len(pictures)


def test_every_run_has_what_reports_need():
    for name in ("backflip", "transfer", "ratings", "ablation", "person"):
        for label, found in results(name).items():
            for result in found:
                assert all(len(f["each"]) == 16 for f in result["figures"].values() if f), label
                assert result["curve"]["env_steps"][-1] == result["env_steps"], label
                assert len(result["episode"]["qpos"]) == (66 if name == "person" else 240), label
                assert name == "person" or len(result["errors"]["best"]) == 100, label
                for each in result["figures"].values():
                    if each:
                        assert each["mean"] == pytest.approx(np.mean(each["each"]), rel=1e-3, abs=1e-3)


def test_a_figure_of_the_report_by_hand():
    turns = [result["figures"]["net_turns"]["mean"] for result in results("backflip")["onedemo"]]
    shown = f"{np.mean(turns):.3g} ± {np.std(turns, ddof=1):.3g}"
    assert str(spread(by_label(finished("backflip"))["onedemo"], figure("net_turns"))) == shown
    assert f"| onedemo | {shown} |" in (RESULTS / "backflip" / "report.md").read_text()


def test_the_metric_knows_the_demo_and_the_papers_network_hardly():
    found = results("backflip")
    for ours, paper in zip(found["onedemo"], found["paper"], strict=True):
        assert ours["ratings"] == paper["ratings"] == 350
        assert ours["demo_rated"] > ours["demo_shuffled"] + 2.5
        assert abs(paper["demo_rated"] - paper["demo_shuffled"]) < 0.5
        # Questions about chosen moments of random states: fewer ones, more fours and fives.
        assert ours["ratings_by_class"][0] < paper["ratings_by_class"][0] / 2
        assert sum(ours["ratings_by_class"][3:]) > 10 * sum(paper["ratings_by_class"][3:])
        assert ours["figures"]["aligned_similarity"]["mean"] > 3
    for group in found.values():
        for figures in (result["figures"] for result in group):
            assert figures["aligned_similarity"]["mean"] > figures["true_similarity"]["mean"]


def test_25_ratings_are_enough_to_know_the_demo():
    for label, found in results("ratings").items():
        method, number = label.removesuffix(" ratings").split(", ")
        assert [result["ratings"] for result in found] == [int(number)] * 3
        assert all((result["demo_rated"] > 3.5) == (method == "onedemo") for result in found)


def test_every_switch_of_the_ablation_changes_something():
    groups = results("ablation")
    for seed in range(3):
        curves = {tuple(found[seed]["curve"]["backflip_reward"]) for found in groups.values()}
        assert len(curves) == len(groups)


def test_what_one_move_taught_of_the_rater_holds_for_the_other():
    found = results("transfer")
    for way in (THERE, BACK):
        tuned, scratch = (found[way.label("onedemo", t)] for t in (True, False))
        for one, other in zip(tuned, scratch, strict=True):
            assert one["ratings"] == other["ratings"] == 55 and one["source"]["ratings"] == 350
            assert one["figures"] != other["figures"]
            assert one["demo_rated"] > max(4, one["demo_shuffled"] + 0.1)


def test_the_rater_of_the_persons_video_tells_clips_apart():
    for found in results("person").values():
        for result in found:
            assert result["ratings"] == 350 and all(result["ratings_by_class"])
            assert result["demo_rated"] is None
            each = [result["figures"][name]["each"] for name in ("farthest_turn", "turned")]
            assert all(far >= turned for far, turned in zip(*each, strict=True))


def test_the_metric_is_worth_more_as_a_reward_than_the_papers_network():
    for label, found in results("predictor").items():
        for result in found:
            assert [sum(classes) for classes in result["classes"].values()] == [200, 100, 100]
            metric, network = result["variants"]["metric"], result["variants"]["additional layer"]
            assert metric["own"] - metric["shuffled"] > network["own"] - network["shuffled"] + 1.5
            assert metric["ranks"][ATTEMPTS] > max(0.9, network["ranks"][ATTEMPTS])
            assert metric["picked"] > network["picked"] + 1.5
            # Attempts at the move are nearer to it than other moves.
            assert result["truth"]["clips"][ATTEMPTS] > result["truth"]["clips"][OTHERS] + 0.7
            assert result["truth"]["shuffled"] < 2.5
            # A random policy from standing hardly shows anything that deserves a 3.
            assert (sum(result["classes"]["fitted"][2:]) < 20) == (label == "random policy")
