"""Nothing that a person sees in the two clips is invisible to the predictor, nor is what the motors do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from onedemo.reward.learned_distance import PARTS, MetricSnapshot, restore
from onedemo.reward.model import PredictorConfig, Snapshot, View, fit
from onedemo.rl.random_states import wild_rollouts
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.storage.rating_records import RatedSegment
from onedemo.vision.pose_estimator import Track

ROBOTS = ("hopper", "walker2d", "half-cheetah", "swimmer", "ant", "humanoid")
CONFIG = PredictorConfig(members=1)
STEPS, FRAMES = 38, 20


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """As in a run: more would wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def rollouts_of(name, lanes=12):
    return wild_rollouts(name, lanes=lanes, steps=120, every=60, seed=0, nthread=0)


def view_of(name, obs, **left_out):
    """A demo of states, (F, o), seen by a perfect eye."""
    seen = body_of(robot_named(name)).seen(obs)
    track = Track(**{field: x.astype(np.float32) for field, x in seen._asdict().items()})
    nothing = np.zeros((len(obs), 1), np.float32)
    return View(visual=nothing, track=replace(track, **left_out), basis=nothing + 1, fps=30.0, robot=name)


def rated(rollouts, values):
    """Clips from the middle of each lane, and frames beside them that stand still."""
    clips = [rollouts.segment(lane, 20, STEPS) for lane in range(len(values))]
    ratings = [
        RatedSegment(event=i, demo_step=0, segment=clip, value=int(value))
        for i, (clip, value) in enumerate(zip(clips, values, strict=True))
    ]
    return ratings, np.zeros((len(values), STEPS), int) + FRAMES // 2


def fitted_of(name, **left_out):
    rollouts = rollouts_of(name)
    view = view_of(name, rollouts.obs[0, :FRAMES], **left_out)
    ratings, frames = rated(rollouts, 1 + np.arange(12) % 5)
    return fit(ratings, frames, view, CONFIG, number=1, seed=0)[0], rollouts


def moved(snapshot, obs, actions, changed_obs=None, changed_actions=None):
    """How far the prediction moves if a state or an action is another."""
    frames = np.full(len(obs), 3)
    one = snapshot.ratings(frames, obs, actions)
    other = snapshot.ratings(
        frames,
        obs if changed_obs is None else changed_obs,
        actions if changed_actions is None else changed_actions,
    )
    return np.abs(one - other).max()


@pytest.mark.parametrize("name", ROBOTS)
def test_whatever_can_be_seen_moves_the_prediction(name):
    """Each position and velocity that observations hold is changed in turn, and the actions.

    A joint shows itself by directions or ends, its velocity by their rates, the floor by travel.
    """
    snapshot, rollouts = fitted_of(name)
    robot = robot_named(name)
    obs, actions = rollouts.obs[1:7, 30].copy(), rollouts.actions[1:7, 30]
    obs[:, -robot.velocities :] = np.clip(obs[:, -robot.velocities :], -1, 1)  # rates are limited
    # A dozen ratings can be told apart for sure: beside certainty nothing moves.
    snapshot.steepness[:], snapshot.thresholds[:] = 1.0, np.array([0.5, 1.5, 2.5, 3.5])
    unmoved = []
    for number in range(robot.obs_size):
        changed = obs.copy()
        changed[:, number] = np.clip(changed[:, number], -2, 2) + 0.4
        if moved(snapshot, obs, actions, changed) < 1e-6:
            unmoved.append(number)
    # A swimmer seen from above is followed up the picture, too; all else is seen. In space what turns about
    # its own axis, or goes towards the camera, cannot be told in its plane.
    names = [f"{kind} {at}" for kind, at in _numbers(robot)]
    unseen = {"swimmer": {"v 1"}, "ant": {"v 1"}, "humanoid": {"v 1"}}.get(name, set())
    assert {names[number] for number in unmoved} <= unseen
    assert moved(snapshot, obs, actions, changed_actions=np.zeros_like(actions)) > 1e-6


def _numbers(robot):
    return [("q", at) for at in range(robot.unseen, robot.positions)] + [
        ("v", at) for at in range(robot.velocities)
    ]


def test_a_demo_that_runs_is_told_from_one_that_hops_in_place():
    """The robot moves as the demo does but for its way along the floor."""
    snapshot, rollouts = fitted_of("hopper")
    own, actions = rollouts.obs[0, :FRAMES].copy(), rollouts.actions[0, :FRAMES]
    slower = own.copy()
    slower[:, 5] -= 2.5
    frames = np.arange(FRAMES)
    assert (
        snapshot.ratings(frames, own, actions).mean() > snapshot.ratings(frames, slower, actions).mean() + 0.1
    )


@pytest.mark.parametrize("left_out", [{"travel": None}, {"contact": None}, {"travel": None, "contact": None}])
def test_what_a_track_does_not_know_is_left_out(left_out):
    snapshot, rollouts = fitted_of("hopper", **left_out)
    assert snapshot.parts == tuple(part for part in PARTS if part not in left_out)
    assert snapshot.log_weights.shape[1] == 18 + len(snapshot.parts)
    obs, actions = rollouts.obs[1:7, 30], rollouts.actions[1:7, 30]
    faster = obs + 2.0 * np.eye(11)[5]
    assert (moved(snapshot, obs, actions, faster) > 1e-6) == ("travel" in snapshot.parts)


def test_a_rater_who_minds_effort_is_understood():
    """Same states, and motors that strain more and more: before any rating they do not matter."""
    rollouts = rollouts_of("hopper", lanes=1)
    view = view_of("hopper", rollouts.obs[0, 20 : 20 + FRAMES])
    values = 1 + np.arange(40) % 5
    clip = rollouts.segment(0, 20, STEPS)
    ratings = [
        RatedSegment(
            event=i, demo_step=0, value=int(value),
            segment=replace(clip, actions=np.full_like(clip.actions, (5 - value) / 4)),
        )
        for i, value in enumerate(values)
    ]  # fmt: skip
    frames = np.tile(np.arange(STEPS) // 4, (40, 1))
    snapshot, _ = fit(ratings, frames, view, CONFIG, number=1, seed=0)
    assert snapshot.effort[0] > 0.2
    still, straining = (
        snapshot.ratings(frames[0], clip.obs, np.full_like(clip.actions, level)).mean() for level in (0, 1)
    )
    assert still > straining + 0.5


def test_a_snapshot_of_before_is_read_as_it_was(tmp_path):
    """Legacy snapshots hold pose and motion of a hopper and know neither parts nor effort."""
    snapshot, rollouts = fitted_of("hopper", travel=None, contact=None)
    old = {key: x for key, x in snapshot.tensors().items() if key not in ("parts", "effort", "robot")}
    again = restore({"number": 1, **old}, CONFIG, "cpu")
    assert again.parts == () and not again.effort.any()
    obs, frames = rollouts.obs[1:7, 30], np.full(6, 3)
    exact = MetricSnapshot(
        number=1, config=CONFIG, tracks=snapshot._tracks, log_weights=snapshot.log_weights,
        thresholds=snapshot.thresholds, steepness=snapshot.steepness, effort=np.zeros(1, np.float32),
        parts=(), robot="hopper",
    )  # fmt: skip
    np.testing.assert_array_equal(
        again.ratings(frames, obs, np.zeros((6, 3))), exact.ratings(frames, obs, np.zeros((6, 3)))
    )
    whole, _ = fitted_of("walker2d")
    whole.save(tmp_path / "new.pt")
    loaded = Snapshot.load(tmp_path / "new.pt")
    assert isinstance(loaded, MetricSnapshot)
    assert loaded.parts == PARTS and loaded.log_weights.shape == whole.log_weights.shape


def test_a_start_that_never_saw_travel_begins_there_with_the_prior():
    start, rollouts = fitted_of("hopper", travel=None)
    view = view_of("hopper", rollouts.obs[2, :FRAMES])
    rows = start.weights_for(view)
    assert rows.shape == (1, 20)
    np.testing.assert_array_equal(rows[:, :18], start.log_weights[:, :18])
    assert rows[0, 18] == -1.0 and rows[0, 19] == start.log_weights[0, 18]
    beside = start.beside(view)
    assert beside is not None and beside.parts == PARTS
    blind = view_of("hopper", rollouts.obs[2, :FRAMES], travel=None, contact=None)
    ratings, frames = rated(rollouts, 1 + np.arange(12) % 5)
    tuned, _ = fit(ratings, frames, blind, CONFIG, number=1, seed=0, start=start)
    assert tuned.parts == () and tuned.log_weights.shape == (1, 18)
