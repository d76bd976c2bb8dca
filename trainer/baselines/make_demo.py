"""Renders the built-in demos again.

``python -m onedemo.baselines make_demo hopper-hop --task hop --source "..."``

This is the maker of a simulated demo, so it may look at the states behind it; nothing that learns
imports this module.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from onedemo.core.names import check_name
from onedemo.core.outputs import check_outputs
from onedemo.demos.ground_truth import SUFFIX, HiddenStates, load_hidden, save_hidden
from onedemo.demos.library import BUILT_IN, render_demo, show
from onedemo.robots.registry import DEFAULT, robot_named
from onedemo.vision.mask_file import masks_of
from onedemo.vision.pose_estimator import keep_track
from onedemo.vision.silhouette import learn


def main(arguments: list[str] | None = None) -> None:
    """Reads ``<out>/<name>.hidden.npz``, writes the video and its description beside it."""
    parser = argparse.ArgumentParser(prog="python -m onedemo.baselines make_demo", description=main.__doc__)
    parser.add_argument("name", help="the demo's name")
    parser.add_argument("--task", required=True, help="the hand-coded reward that describes it")
    parser.add_argument("--source", required=True, help="what made the motion")
    parser.add_argument("--robot", default=DEFAULT, help="whose motion it is")
    parser.add_argument("--seconds", type=float, default=8.0, help="from the beginning, at most")
    parser.add_argument("--out", type=Path, default=BUILT_IN, help="where the states lie")
    parser.add_argument(
        "--cache", type=Path, help="also look at it, and keep here what is learned of the robot meanwhile"
    )
    asked = parser.parse_args(arguments)
    check_outputs(asked.out / f"{check_name(asked.name)}.webm", asked.out / f"{asked.name}.json")
    robot = robot_named(asked.robot)
    states = asked.out / f"{asked.name}{SUFFIX}"
    hidden = cut(load_hidden(states), round(asked.seconds / robot.dt))
    save_hidden(states, hidden)
    demo = render_demo(
        hidden.qpos, name=asked.name, task=asked.task, source=asked.source, out_dir=asked.out, robot=robot
    )
    print(show(demo))
    if asked.cache is not None:
        learned = learn(robot.name, asked.cache / "robots")
        track = learned.track(masks_of(demo, learned.reach), demo.fps)
        assert track is not None, "it shows the robot"
        keep_track(demo, track)


def cut(hidden: HiddenStates, steps: int) -> HiddenStates:
    """The first control steps of an episode."""
    return HiddenStates(
        obs=hidden.obs[: steps + 1], actions=hidden.actions[:steps], qpos=hidden.qpos[: steps + 1],
        qvel=hidden.qvel[: steps + 1],
    )  # fmt: skip
