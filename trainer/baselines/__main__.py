"""``python -m onedemo.baselines NAME ...``: the programs that made what is built in."""

import importlib
import sys

from onedemo.core.process import prepare_process

PROGRAMS = ("handcoded_trpo", "learn_robot", "make_demo", "trajectory_search")

if len(sys.argv) < 2 or sys.argv[1] not in PROGRAMS:
    sys.exit(f"usage: python -m onedemo.baselines {{{','.join(PROGRAMS)}}} [--help]")
prepare_process()
importlib.import_module(f"onedemo.baselines.{sys.argv[1]}").main(sys.argv[2:])
