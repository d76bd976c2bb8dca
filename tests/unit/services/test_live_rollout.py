import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from helpers.fake_trainer import Wobble
from helpers.paths import ROOT
from onedemo.app.services.live_rollout import Live, followed
from onedemo.rl.rollouts import Acting, EpisodeRules
from onedemo.robots.registry import robot_named
from onedemo.robots.robot import build


class Hurrying(EpisodeRules):
    """The demo moves on twice as fast as the robot."""

    def advance(self, step):
        return step.clock + 2


@contextmanager
def watched(acting, seconds):
    """What a watcher sees of a live robot, as it comes."""
    live, moments = Live(acting, seconds), []
    live.watch("me", moments.append)
    try:
        yield moments
    finally:
        live.leave("me")
        live.close()


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_the_demo_is_where_the_rules_put_it_and_each_episode_asks_anew():
    asked = threading.Semaphore(0)

    def acting():
        asked.release()
        return Acting(policy=Wobble(), rules=Hurrying())  # type: ignore[arg-type]

    with watched(acting, seconds=2.0) as moments:
        for _ in range(2):  # an episode ends with the demo, after a second
            assert asked.acquire(timeout=20)
        wait_for(lambda: len(moments) > 20)
    assert all(moment.acting for moment in moments)
    for moment in moments:
        assert moment.demo_seconds == pytest.approx(2 * moment.seconds) and moment.demo_seconds < 2.0
    assert max(moment.demo_seconds for moment in moments) > 1.0


def test_the_demo_plays_alone_until_something_acts():
    found: list[Acting] = []
    with watched(lambda: found[0] if found else None, seconds=60.0) as moments:
        wait_for(lambda: moments and moments[-1].demo_seconds > 0.2)
        assert not moments[-1].acting
        standing = moments[-1].xpos
        np.testing.assert_array_equal(standing, moments[0].xpos)
        found.append(Acting(policy=Wobble(), rules=EpisodeRules()))  # type: ignore[arg-type]
        wait_for(lambda: moments[-1].acting)
        first = next(moment for moment in moments if moment.acting)
        assert first.demo_seconds == first.seconds < 0.3  # both from the start
        wait_for(lambda: np.abs(moments[-1].xpos - standing).max() > 0.01)


def test_a_camera_goes_along_with_what_moves_and_stands_before_what_stays():
    arm = build("arm", ROOT / "tests/data/arm.xml", frame_skip=5)
    names = ("hopper", "walker2d", "ant", "humanoid", "swimmer")
    along = {name: followed(robot_named(name)).tolist() for name in names}
    assert along["hopper"] == along["walker2d"] == [1, 0, 0]
    assert along["ant"] == along["humanoid"] == along["swimmer"] == [1, 1, 0]
    assert followed(arm).tolist() == [0, 0, 0]
