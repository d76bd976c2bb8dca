"""Learning curves of two programs, or of two versions of one, in one chart.

Each run is a JSON file of ``python -m onedemo.baselines handcoded_trpo --evaluate-every 4 --seed N --out
PREFIX``. ``python tests/load/learning_curves.py before "before/*.json" after "after/*.json" --out curves``
writes
``curves.svg`` and ``curves.json`` and prints the mean and the deviation over the seeds at each evaluation.
"""

import argparse
import glob
import json
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("svg")
from matplotlib import pyplot

COLOURS = ("#8a94a3", "#2f5dc4")


def read(pattern):
    """Steps (E,) and rewards (seeds, E) of all runs that a pattern names."""
    curves = [json.loads(Path(file).read_text())["curve"] for file in sorted(glob.glob(pattern))]
    if not curves:
        raise SystemExit(f"no file is named {pattern}")
    steps = [score["steps"] for score in curves[0]]
    return steps, [[round(score["reward_mean"], 1) for score in curve] for curve in curves]


def main():
    """Draws the chart and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sides", nargs=4, metavar="NAME PATTERN", help="two names, each with its files")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    pyplot.rcParams["svg.hashsalt"] = "curves"
    figure, axes = pyplot.subplots(figsize=(5.6, 3.4), layout="constrained")
    kept = {}
    for name, pattern, colour in zip(args.sides[::2], args.sides[1::2], COLOURS, strict=True):
        steps, rewards = read(pattern)
        kept[name] = {"steps": steps, "reward_mean": rewards}
        million = np.array(steps) / 1e6
        for curve in rewards:
            axes.plot(million, curve, color=colour, linewidth=0.7, alpha=0.45)
        mean, spread = np.mean(rewards, axis=0), np.std(rewards, axis=0, ddof=1)
        axes.plot(million, mean, color=colour, linewidth=2.4, label=f"{name}, mean of {len(rewards)} seeds")
        for at, m, s in zip(steps, mean, spread, strict=True):
            print(f"{name:12} {at:>9,} steps  {m:7,.0f} +- {s:,.0f}")
    axes.set(xlabel="million control steps", ylabel="backflip reward of an episode")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(args.out.with_suffix(".svg"), metadata={"Date": None})
    args.out.with_suffix(".json").write_text(json.dumps(kept) + "\n")


if __name__ == "__main__":
    main()
