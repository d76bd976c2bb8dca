"""Travel and contact of the shipped demos, read from their pictures, against the states behind them."""

import numpy as np
import pytest

from onedemo.demos.frame_clock import steps_of_frames
from onedemo.demos.ground_truth import hidden_path, load_hidden
from onedemo.demos.library import BUILT_IN, find_demo, read_frames
from onedemo.robots.registry import robot_named
from onedemo.sim.kinematics import body_of
from onedemo.vision.pose_estimator import shipped_track, with_ground

HOPPER = robot_named("hopper")
DEMOS = ("hopper-hop", "hopper-backflip", "hopper-flip-clean")


def truth(demo):
    hidden = load_hidden(hidden_path(demo.path))
    steps = np.minimum(steps_of_frames(demo.frames, HOPPER.dt, demo.fps), len(hidden.qpos) - 1)
    return body_of(HOPPER).seen(hidden.obs[steps])


def explained(found, wanted):
    return 1 - np.square(found - wanted).mean() / wanted.var()


@pytest.mark.parametrize("name", DEMOS)
def test_shipped_tracks_know_travel_and_contact(name):
    demo = find_demo(name, BUILT_IN / "none")
    track, seen = shipped_track(demo), truth(demo)
    assert track is not None and track.travel is not None and track.contact is not None
    assert explained(track.travel, seen.travel) > 0.9
    assert explained(track.contact, seen.contact) > 0.95
    assert track.travel.mean() == pytest.approx(seen.travel.mean(), abs=0.05)


def test_they_are_what_the_pictures_show():
    demo = find_demo("hopper-hop", BUILT_IN / "none")
    kept = shipped_track(demo)
    assert kept is not None
    again = with_ground(kept, read_frames(demo), demo.fps, HOPPER)
    assert again.travel is not None and again.contact is not None
    np.testing.assert_allclose(again.travel, kept.travel, atol=0.1)
    np.testing.assert_allclose(again.contact, kept.contact, atol=0.25)
    assert 2.2 < again.travel.mean() < 2.5  # it runs, and does not hop in place


def test_pictures_of_anything_else_leave_a_track_as_it_is():
    kept = shipped_track(find_demo("hopper-hop", BUILT_IN / "none"))
    assert kept is not None
    grey = np.full((5, 90, 120, 3), 128, np.uint8)
    assert with_ground(kept, grey, 30.0, HOPPER) is kept
