"""The commands ``baseline trpo`` and ``baseline preferences``: what the method is compared with."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from onedemo.app.cli.data import DATA, DataDir, Whole, open_store
from onedemo.core.outputs import check_prefix

baseline = App(name="baseline", help="What the method is compared with.")
Prefix = Annotated[Path, Parameter(help="Where to write PREFIX.json, .policy.pt and .hidden.npz.")]


@baseline.command
def trpo(
    *, out: Prefix, task: Literal["backflip", "hop"] = "backflip", steps: Whole = 3_000_000, seed: Whole = 0,
    lanes: Whole = 64, physics: Literal["mujoco", "warp"] = "mujoco", device: str = "cpu",
) -> None:  # fmt: skip
    """TRPO on a hand-coded reward.

    Args:
        task: What is rewarded.
        steps: Control steps.
        seed: Of all random numbers.
        lanes: Episodes side by side.
        physics: Where the robot is simulated.
        device: Where the policy computes: cpu or cuda.
    """
    from onedemo.baselines.handcoded_trpo import HandcodedConfig, save_result, train_handcoded
    from onedemo.baselines.scores import SAVED

    check_prefix(out, SAVED)
    config = HandcodedConfig(
        task=task,
        steps=steps,
        seed=seed,
        lanes=lanes,
        batch=max(1, 32_000 // max(1, lanes)),  # an iteration is as long however many lanes share it
        physics=physics,
        device=device,
    )
    result = train_handcoded(config)
    save_result(out, result)
    for key, value in asdict(result.best_score).items():
        print(f"{key:18} {value:g}")


@baseline.command
def preferences(
    *, out: Prefix, comparisons: Whole = 350, from_run: str | None = None, data_dir: DataDir = DATA,
    steps: Whole = 3_000_000, seed: Whole = 0,
) -> None:  # fmt: skip
    """Learning from comparisons of two segments.

    Args:
        comparisons: In all, 4 of 7 before practice.
        from_run: Learn from what people compared in this run, and ask nobody.
        steps: Control steps.
        seed: Of all random numbers.
    """
    from onedemo.baselines.preferences import (
        PreferencesConfig,
        save_preferences,
        split_comparisons,
        stored_comparisons,
        train_preferences,
    )
    from onedemo.baselines.scores import SAVED

    check_prefix(out, SAVED)
    pretrain, online = split_comparisons(comparisons)
    config = PreferencesConfig(pretrain=pretrain, online=online, steps=steps, seed=seed)
    given = []
    if from_run is not None:
        with open_store(data_dir, must_exist=True) as store:
            given = stored_comparisons(store, from_run)
    result = train_preferences(config, given=given)
    save_preferences(out, result)
    for key, value in asdict(result.curve[-1]).items():
        print(f"{key:18} {value:g}")
