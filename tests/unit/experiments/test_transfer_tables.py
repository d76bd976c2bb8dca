"""The tables of transfer and of the person: plans, ratios, strips."""

import cv2
import numpy as np
import pytest

from onedemo.app.cli.main import main
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import find_demo
from onedemo.evaluation.metrics import farthest_turn, net_turns, turned
from onedemo.experiments.jobs import person
from onedemo.experiments.jobs.method import run_config
from onedemo.experiments.report import document
from onedemo.experiments.report.strip import moments, strip
from onedemo.experiments.runner import Job, Outcome
from onedemo.experiments.tables import transfer
from onedemo.experiments.tables.transfer import BACK, THERE


@pytest.fixture
def no_video(monkeypatch, tmp_path):
    monkeypatch.setenv(person.VARIABLE, str(tmp_path / "nowhere.mp4"))


def test_rotation_is_counted_with_its_sign():
    lean, flip = np.linspace(0, 1.4, 20), np.linspace(1.4, -6.2, 80)  # forward, then all the way back
    angle = np.concatenate([lean, flip, np.linspace(-6.2, -4.7, 20)])  # and down on the face
    wrapped = np.angle(np.exp(1j * angle))
    assert turned(wrapped) == pytest.approx(4.7 / (2 * np.pi))
    assert farthest_turn(wrapped) == pytest.approx(7.6 / (2 * np.pi))
    assert net_turns(wrapped) == 0
    assert turned(-wrapped) == pytest.approx(-4.7 / (2 * np.pi))
    assert farthest_turn(np.stack([np.zeros(9), np.linspace(0, 3, 9)])).tolist() == [0, 0]


@pytest.mark.parametrize("quick", [True, False])
def test_fine_tuned_and_scratch_get_the_same_ratings_and_steps(quick):
    jobs = {str(job): job for job in transfer.plan((0, 1), quick=quick)}
    assert len({job.key for job in jobs.values()}) == len(jobs) == (4 if quick else 18)
    tuned = [job for job in jobs.values() if job.kind == "transfer"]
    for job in tuned:
        scratch = jobs[str(job).replace("fine-tuned", "from scratch")]
        assert job.settings["target"] == scratch.settings and job.seed == scratch.seed
        source, target = (run_config(job.settings[name], job.seed) for name in ("source", "target"))
        assert source.method == target.method and job.settings["source"]["demo"] != scratch.settings["demo"]
        if not quick:
            assert (target.ratings.pretrain, target.ratings.online) == (30, 25)
            assert source.ratings.pretrain + source.ratings.online == 350
    assert len(tuned) * 2 == sum(job.kind in ("method", "transfer") for job in jobs.values())


def outcome(label, seed, **figures):
    job = Job(kind="method", label=label, settings={}, seed=seed)
    names = {"hop_return": 1.0, "hop_reward": 1.0, "backflip_reward": 1.0, "net_turns": 0.0} | figures
    result = {
        "figures": {name: {"mean": x, "best": 2 * x, "worst": x} for name, x in names.items()},
        "ratings": 55, "seconds": {"training": 60.0}, "curve": {},
    }  # fmt: skip
    return Outcome(job=job, kept={"result": result})


def goals(groups):
    """Rows of the table of goals."""
    (table,) = transfer.goals(groups)
    return table.rows


def test_the_ratio_is_that_of_the_same_seeds():
    tuned, scratch = (THERE.label("onedemo", t) for t in (True, False))
    found = [
        outcome(tuned, 0, hop_return=300.0), outcome(tuned, 1, hop_return=600.0),
        outcome(scratch, 1, hop_return=200.0), outcome(scratch, 0, hop_return=300.0),
    ]  # fmt: skip
    groups = {label: [o for o in found if o.job.label == label] for label in (tuned, scratch)}
    rows = {row[:2]: row for row in goals(groups)}
    name = "backflip to hop, onedemo, hop_return"
    assert rows[name, "1.5 x scratch"][4:] == ("1.8", "1, 3", "**met**")
    assert rows[name, "beyond: 767"][-1] == "**met**"  # 900: best of 16, mean over seeds
    assert rows["backflip to hop, onedemo, hop_reward", "1.5 x scratch"][-1] == "missed"
    for tuned_mean, scratch_mean in ((300.0, -100.0), (300.0, 0.0)):  # no ratio to nothing, or to less
        pair = {
            label: [outcome(label, 0, hop_return=mean)]
            for label, mean in ((tuned, tuned_mean), (scratch, scratch_mean))
        }
        assert goals(pair)[0][4:] == ("–", "–", "missed")
    missing = Outcome(job=Job(kind="method", label=tuned, settings={}, seed=2), reason="not run")
    groups[tuned].append(missing)
    assert goals(groups)[0][-1] == "open"
    back = outcome(BACK.label("paper", True), 0)
    assert goals({back.job.label: [back]}) == []  # nothing to compare it with


def test_the_papers_figures_stand_beside_ours():
    planned = transfer.plan((0,), quick=False)
    report = transfer.TABLE.report([Outcome(job=job, reason="not run") for job in planned], quick=False)
    text = document.as_text(report)
    assert "767" in text and "1,007" in text and "433" in text and "not run" in text


def test_without_the_video_the_table_says_why_and_succeeds(no_video, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["bench", "person", "--results", str(tmp_path / "results"), "--out", str(out)]
    assert main(words) == 0
    assert "Skipped" in capsys.readouterr().out
    assert "ONEDEMO_PERSON_VIDEO" in (out / "report.md").read_text()


@pytest.mark.slow
def test_a_strip_shows_the_same_moments_of_both(tmp_path):
    demo = find_demo("hopper-hop", tmp_path)
    hidden = load_hidden(hidden_path(demo.path))
    steps = np.minimum(np.floor(np.arange(demo.frames) / demo.fps / 0.008 + 0.5).astype(int), 1000)
    picture = cv2.imdecode(np.frombuffer(strip(demo, hidden.qpos[steps]), np.uint8), cv2.IMREAD_COLOR)
    upper, lower = picture[:135].astype(float), picture[139:274].astype(float)
    assert picture.shape == (274, 8 * 184 - 4, 3)
    # The demo is this very episode, so both rows are alike, column by column, and unlike their neighbours.
    assert np.abs(upper - lower).mean() < 4
    one, two = moments(240, 0.25, 0.75)[[0, -1]]
    assert (one, two) == (60, 179)
    with pytest.raises(ValueError, match="3 positions do not go with the 240 frames"):
        strip(demo, hidden.qpos[:3])
