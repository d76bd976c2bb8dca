"""Renders the built-in demos again.

``python -m onedemo.baselines make_demo hopper-hop --task hop --source "..."``

This is the maker of a simulated demo, so it may look at the states behind it; nothing that learns
imports this module.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from onedemo.config import load_config
from onedemo.core.names import check_name
from onedemo.core.outputs import check_outputs
from onedemo.demos.ground_truth import SUFFIX, load_hidden
from onedemo.demos.library import BUILT_IN, read_frames, render_demo, show
from onedemo.vision.encoders import demo_features, make_encoder
from onedemo.vision.pose_estimator import keep_track, learn, with_ground


def main(arguments: list[str] | None = None) -> None:
    """Reads ``<out>/<name>.hidden.npz``, writes the video and its description beside it."""
    parser = argparse.ArgumentParser(prog="python -m onedemo.baselines make_demo", description=main.__doc__)
    parser.add_argument("name", help="the demo's name")
    parser.add_argument("--task", required=True, help="the hand-coded reward that describes it")
    parser.add_argument("--source", required=True, help="what made the motion")
    parser.add_argument("--out", type=Path, default=BUILT_IN, help="where the states lie")
    parser.add_argument(
        "--cache", type=Path, help="also look at it, and keep here what is learned of the robot meanwhile"
    )
    asked = parser.parse_args(arguments)
    check_outputs(asked.out / f"{check_name(asked.name)}.webm", asked.out / f"{asked.name}.json")
    qpos = load_hidden(asked.out / f"{asked.name}{SUFFIX}").qpos
    demo = render_demo(qpos, name=asked.name, task=asked.task, source=asked.source, out_dir=asked.out)
    print(show(demo))
    if asked.cache is not None:
        encoder = make_encoder(load_config().encoder)
        look = learn(load_config().env, encoder, asked.cache / "robots")
        track = look.track(demo_features(demo, encoder, asked.cache / "demos"), demo.fps)
        keep_track(demo, with_ground(track, read_frames(demo), demo.fps))
