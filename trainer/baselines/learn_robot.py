"""Learns the looks of a robot for everybody: the files that come with the program.

``python -m onedemo.baselines learn_robot hopper``
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from onedemo.vision import learned_robots, silhouette


def main(arguments: list[str] | None = None) -> None:
    """Learns from the robot's model alone, and writes ``<out>/<robot>-<model>-silhouette-v<version>.npz``."""
    parser = argparse.ArgumentParser(prog="python -m onedemo.baselines learn_robot", description=main.__doc__)
    parser.add_argument("robot", help="its name")
    parser.add_argument("--out", type=Path, default=learned_robots.SHIPPED, help="where to")
    asked = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        learned = silhouette.learn(asked.robot, Path(scratch), shipped=False)
    name = silhouette.file_name(asked.robot)
    print(learned_robots.keep(name, asked.out, learned.tensors, half=True))
