"""MuJoCo's profiling: off for us, on for peers, and of no consequence to the physics."""

import mujoco
import numpy as np

from onedemo.robots.registry import robot_named
from onedemo.sim import physics_profiling, vector_env
from onedemo.sim.physics import load_model


def stepped():
    model = load_model(robot_named("hopper").xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5, -0.3, 0.2
    mujoco.mj_step(model, data, 200)
    return data.qpos.copy()


def test_off_unless_asked_for_and_it_changes_no_bit():
    callback, shipped = physics_profiling._global()
    assert callback is not None and shipped, "MuJoCo keeps its clock elsewhere: physics is a fifth slower"
    vector_env.make("hopper", 1).close()
    assert callback.value is None
    quick = stepped()
    with physics_profiling.as_shipped():
        assert callback.value == shipped
        slow = stepped()
    assert callback.value is None
    np.testing.assert_array_equal(quick, slow)


def test_without_the_global_nothing_changes(monkeypatch):
    monkeypatch.setattr(physics_profiling, "_global", lambda: (None, None))
    physics_profiling.switch_off()
    with physics_profiling.as_shipped():
        assert np.isfinite(stepped()).all()
