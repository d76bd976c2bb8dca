"""The trainer with robots of one's own: it learns with any, and goes on when the physics does not."""

import numpy as np
import pytest
import torch

from helpers.paths import ROOT
from helpers.small_world import FRAMES, small_config
from onedemo.app.annotation.phases import told
from onedemo.robots import registry
from onedemo.robots.library import add_robot
from onedemo.storage.rating_records import RatedSegment
from onedemo.training.learner import Learner
from onedemo.types import Status

RACING = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="wheel">
      <joint name="spin" axis="0 1 0" armature="0.001"/>
      <geom type="capsule" fromto="-0.1 0 0 0.1 0 0" size="0.01" mass="0.001"/>
    </body>
  </worldbody>
  <actuator><motor joint="spin" gear="150"/></actuator>
</mujoco>
"""
"""Its motor is far too strong: after a second of noise every third lane turns at more than any robot does."""


@pytest.mark.parametrize("name", [pytest.param("arm", marks=pytest.mark.slow), "racing"])
def test_an_iteration_of_any_robot(name, tmp_path):
    torch.set_num_threads(1)
    registry.use(tmp_path)
    try:
        text = RACING if name == "racing" else (ROOT / "tests/data/robots/arm.xml").read_text()
        (tmp_path / "model.xml").write_text(text)
        add_robot(tmp_path / "model.xml", tmp_path, name=name)
        config = small_config(
            env=name,
            method="onedemo",
            predictor__appearance=False,
            predictor__members=1,
            practice__give_up=0.0,
            practice__bank_share=0.0,
        )
        learner = Learner(config, FRAMES, 30.0)
        learner.look_at(np.random.default_rng(0).normal(size=(FRAMES, 20)).cumsum(axis=0).astype(np.float32))
        rollouts = learner.random_rollouts()
        questions = learner.choose(rollouts, None, 20, np.random.default_rng(0))
        ratings = []
        for event, q in enumerate(questions):
            segment = rollouts.segment(q.lane, q.start, learner.clip_steps)
            value = int(np.clip(round(3 + 2 * segment.obs[:, 0].mean()), 1, 5))
            ratings.append(RatedSegment(event=event, demo_step=q.demo_step, segment=segment, value=value))
        snapshot, _ = learner.fit(ratings, 1)
        batch, stats = learner.iterate(snapshot)
        assert batch.obs.shape[2] == learner.robot.obs_size and np.isfinite(batch.obs).all()
        assert np.isfinite(batch.next_obs).all() and np.isfinite(batch.rewards).all()
        assert all(np.isfinite(value) for value in stats.values())
        lost = stats.get("unstable", 0)
        assert (lost > 0) == (name == "racing") and lost <= batch.terminated.sum()
    finally:
        registry.use(None)


def test_a_researcher_is_told_of_episodes_that_the_physics_lost():
    assert "3 episodes ended early as the physics became unstable" in told(Status(phase="online", unstable=3))
    assert "1 episode ended early" in told(Status(phase="done", unstable=1))
    assert "unstable" not in told(Status(phase="online"))
