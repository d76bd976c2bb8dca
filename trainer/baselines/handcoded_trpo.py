"""The paper's first baseline: TRPO on a hand-coded reward. It also makes two of the demos.

``python -m onedemo.baselines handcoded_trpo --task backflip --steps 3000000 --seed 2 --out PREFIX``
writes ``PREFIX.hidden.npz`` (the best episode of the best policy), ``PREFIX.policy.pt`` and
``PREFIX.json`` (settings and the learning curve). ``--robot walker2d --task forward`` trains another
robot on gymnasium's own reward.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from tqdm import tqdm

from onedemo.baselines.scores import (
    FORWARD,
    SAVED,
    TASKS,
    UNTIL_FALL,
    Score,
    check_task,
    measure,
    save_training,
)
from onedemo.core.cpu import cores
from onedemo.core.outputs import check_prefix
from onedemo.demos.ground_truth import HiddenStates
from onedemo.errors import UserError
from onedemo.rl.policy import Policy, PolicyConfig, check_device
from onedemo.rl.rollouts import Collector, evaluate
from onedemo.rl.trpo import Trpo, TrpoConfig
from onedemo.sim import vector_env
from onedemo.sim.task_rewards import TASK_REWARDS


@dataclass(frozen=True, kw_only=True, slots=True)
class HandcodedConfig:
    """One training on a hand-coded reward."""

    robot: str = "hopper"
    """Its name."""
    task: str = "backflip"
    """One of ``TASKS``."""
    steps: int = 3_000_000
    """Control steps to collect, all lanes together."""
    seed: int = 0
    """Of everything random."""
    lanes: int = 64
    """Episodes side by side."""
    batch: int = 500
    """Control steps of each lane in an iteration."""
    horizon: int = 1000
    """Control steps in an episode: 8 s of a hopper."""
    evaluate_every: int = 10
    """Iterations between evaluations (16 deterministic episodes)."""
    threads: int = field(default_factory=cores)
    """Of the physics and of the learning. Any number gives the same numbers."""
    physics: str = "mujoco"
    """"mujoco" or "warp" (``rollouts.physics``)."""
    device: str = "cpu"
    """Where the policy is trained: "cpu", "cuda" or "cuda:N"."""
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(kind="raw"))
    """Sees the observation alone: the rewards say nothing about time."""
    trpo: TrpoConfig = field(default_factory=TrpoConfig)
    """The step."""

    def __post_init__(self) -> None:
        check_task(self.robot, self.task)
        for name in ("steps", "lanes", "batch", "horizon", "evaluate_every", "threads"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True, slots=True)
class HandcodedResult:
    """What a training gave."""

    config: HandcodedConfig
    curve: tuple[Score, ...]
    """Evaluations, the last one of the final policy."""
    final: Policy
    best: Policy
    """The one with the highest mean reward in an evaluation."""
    best_score: Score
    episode: HiddenStates
    """Its episode of the highest reward."""


def train_handcoded(config: HandcodedConfig, *, progress: bool = True) -> HandcodedResult:
    """Trains a policy on a hand-coded reward.

    Args:
        config: The training.
        progress: Show a progress bar on standard error.

    Returns:
        Policies, learning curve and the best episode.

    Raises:
        UserError: If the device cannot be used or the physics is not installed.
    """
    check_device(config.device)
    torch.set_num_threads(1)  # these networks are too small to gain from more
    # Going ahead is learned as in gymnasium, where a fall ends the episode; a flip is no fall.
    env = vector_env.make(
        config.robot,
        config.lanes,
        horizon=config.horizon,
        nthread=config.threads,
        physics=config.physics,
        terminate_when_unhealthy=config.task in UNTIL_FALL,
    )
    policy = Policy(
        config.policy,
        obs_size=env.robot.obs_size,
        action_size=env.robot.action_size,
        horizon=config.horizon,
        seed=config.seed,
        angles=env.robot.angles,
    ).to(config.device)
    trpo = Trpo(policy, config.trpo, seed=config.seed, threads=config.threads)
    collector = Collector(env, seed=config.seed)
    per_iteration = config.lanes * config.batch
    iterations = -(-config.steps // per_iteration)
    started = time.monotonic()
    curve: list[Score] = []
    best: tuple[Score, dict, HiddenStates] | None = None
    with tqdm(total=iterations * per_iteration, unit="step", disable=not progress) as bar:
        for iteration in range(1, iterations + 1):
            acting = policy.snapshot(on_device=config.device != "cpu")
            batch = collector.collect(acting, config.batch)
            if config.task != FORWARD:  # which is what the environment gives
                of = TASK_REWARDS[config.task]
                rewards = of(batch.next_obs, batch.actions, batch.qpos, batch.next_qpos, batch.next_qvel)
                batch = replace(batch, rewards=rewards)
            stats = trpo.update(batch)
            bar.update(per_iteration)
            if iteration % config.evaluate_every == 0 or iteration == iterations:
                episodes = evaluate(
                    policy.snapshot(), config.robot, seed=config.seed + 1, horizon=config.horizon
                )
                steps, seconds = iteration * per_iteration, time.monotonic() - started
                score, episode = measure(config.task, episodes, steps=steps, seconds=seconds, of=env.robot)
                curve.append(score)
                if best is None or score.reward_mean > best[0].reward_mean:
                    best = score, policy.to_dict(), episode
                bar.set_postfix(
                    reward=round(score.reward_mean),
                    best=round(score.reward_max),
                    turns=round(score.net_turns_mean, 1),
                    travel=round(score.travel, 1),
                    upright=round(score.upright_seconds, 1),
                    kl=round(stats.kl, 3),
                    explained=round(stats.explained_variance, 2),
                    std=round(stats.std, 2),
                )
    env.close()
    assert best is not None
    return HandcodedResult(
        config=config,
        curve=tuple(curve),
        final=policy,
        best=Policy.from_dict(best[1]),
        best_score=best[0],
        episode=best[2],
    )


def save_result(prefix: Path, result: HandcodedResult) -> None:
    """Writes ``<prefix>.hidden.npz``, ``<prefix>.policy.pt`` and ``<prefix>.json``."""
    save_training(
        prefix,
        config=result.config,
        curve=result.curve,
        policy=result.best,
        episode=result.episode,
        best=result.best_score,
    )


def main(argv: list[str] | None = None) -> None:
    """Command line; ``--help`` lists the options."""
    parser = argparse.ArgumentParser(
        prog="python -m onedemo.baselines handcoded_trpo", description="TRPO on a hand-coded reward."
    )
    parser.add_argument("--task", choices=sorted(TASKS), default="backflip")
    parser.add_argument("--robot", default="hopper")
    parser.add_argument("--steps", type=int, default=3_000_000, help="control steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--horizon", type=int, default=1000, help="control steps in an episode")
    parser.add_argument("--out", type=Path, required=True, help="prefix of the files to write")
    parser.add_argument("--max-kl", type=float, default=TrpoConfig().max_kl, help="nats")
    parser.add_argument("--gamma", type=float, default=TrpoConfig().gamma)
    parser.add_argument("--evaluate-every", type=int, default=10, help="iterations")
    args = parser.parse_args(argv)
    check_prefix(args.out, SAVED)
    config = HandcodedConfig(
        robot=args.robot,
        task=args.task,
        horizon=args.horizon,
        steps=args.steps,
        seed=args.seed,
        evaluate_every=args.evaluate_every,
        trpo=TrpoConfig(max_kl=args.max_kl, gamma=args.gamma),
    )
    result = train_handcoded(config)
    save_result(args.out, result)
    print(json.dumps(asdict(result.best_score)))
