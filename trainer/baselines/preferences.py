"""The paper's second baseline: learning from preferences (Christiano et al. 2017).

``onedemo baseline preferences --out PREFIX`` writes ``PREFIX.hidden.npz`` (the best episode
of the final policy), ``PREFIX.policy.pt`` and ``PREFIX.json`` (settings and the learning curve).

Somebody is shown pairs of short segments of what the robot does and says which is more of a backflip;
``reward_model`` learns a reward from the answers, TRPO improves the policy on it, and new pairs come
from what the policy does next. No demo is used. The somebody is simulated (``comparer``) and goes by
the hand-coded reward, which nothing else sees but the evaluation.

Shapes: W control steps a segment.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from onedemo.baselines.preference_reward import (
    Comparison,
    Pair,
    RewardConfig,
    RewardEnsemble,
    RewardFit,
    fit_reward,
    most_disputed,
)
from onedemo.baselines.scores import Score, measure, save_training
from onedemo.baselines.synthetic_comparer import Comparer, agreement
from onedemo.config import split_ratings
from onedemo.core.cpu import cores
from onedemo.demos.ground_truth import HiddenStates
from onedemo.errors import UserError
from onedemo.rl.policy import Policy, PolicyConfig
from onedemo.rl.rollouts import Collector, Transitions, evaluate
from onedemo.rl.trpo import Trpo, TrpoConfig
from onedemo.robots.registry import robot_named
from onedemo.sim import vector_env
from onedemo.storage.comparisons import COMPARISON_COLUMNS
from onedemo.storage.store import Store


@dataclass(frozen=True, kw_only=True, slots=True)
class PreferencesConfig:
    """One training from comparisons. Sources: [C] Christiano et al. 2017, appendix A.1."""

    pretrain: int = 200
    """Comparisons of segments of the untrained policy: as many as the method of this project gets
    ratings there. ([C] takes a quarter of all.)"""
    online: int = 150
    """Comparisons of what the policy does while it learns."""
    round: int = 50
    """Comparisons before the policy is trained come in rounds of so many, each but the first chosen by
    the reward that the ones before it gave (ours; [C] does not say how these pairs are chosen)."""
    candidates: int = 10
    """Pairs drawn for each one that is asked about; those with the most disagreement are (section 2.2.4)."""
    segment_seconds: float = 1.5
    """Length of a segment, seconds ([C]): 188 control steps here. (15 to 60 longer ones there; 25 frames
    for a person.)"""
    annealing: int = 2_000_000
    """Online comparisons come at a rate proportional to a / (a + t) after t control steps ([C])."""
    steps: int = 3_000_000
    """Control steps to collect, all lanes together; those before the policy is trained are not counted."""
    seed: int = 0
    """Of everything random."""
    lanes: int = 64
    """Episodes side by side."""
    batch: int = 500
    """Control steps of each lane in an iteration."""
    horizon: int = 1000
    """Control steps in an episode: 8 s."""
    evaluate_every: int = 10
    """Iterations between evaluations (16 deterministic episodes)."""
    threads: int = field(default_factory=cores)
    """Of the physics and of the learning. Any number gives the same numbers."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """The learned reward."""
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(kind="raw"))
    """As in the hand-coded baseline: the observation alone."""
    trpo: TrpoConfig = field(default_factory=lambda: TrpoConfig(gamma=0.995, lam=0.97, entropy_bonus=0.01))
    """The step; discount, lambda and entropy bonus as in [C]."""

    def __post_init__(self) -> None:
        for name in (
            "pretrain", "round", "candidates", "annealing", "steps", "lanes", "batch", "horizon",
            "evaluate_every", "threads",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.online < 0:
            raise UserError(f"online must be 0 or more, got {self.online}")
        shortest = min(self.batch, self.horizon)
        if not 2 <= self.segment_steps <= shortest:
            raise UserError(
                f"segments of {self.segment_seconds} s are {self.segment_steps} control steps; "
                f"they must be 2 to {shortest}, the shorter of batch and horizon"
            )

    @property
    def segment_steps(self) -> int:
        """W."""
        return int(self.segment_seconds / robot_named("hopper").dt + 0.5)


@dataclass(frozen=True, kw_only=True, slots=True)
class PreferencesScore(Score):
    """An evaluation, and how good the learned reward was by then."""

    comparisons: int
    """Answers given so far."""
    correlation: float
    """Between learned and hand-coded reward, both summed over segments of the last batch."""
    unseen_accuracy: float
    """``RewardFit.unseen_accuracy`` of the last fit."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PreferencesResult:
    """What a training gave."""

    config: PreferencesConfig
    curve: tuple[PreferencesScore, ...]
    """Evaluations, the last one of the final policy."""
    final: Policy
    reward: RewardEnsemble
    """The last learned reward."""
    episode: HiddenStates
    """The final policy's evaluated episode of the highest hand-coded reward."""


def train_preferences(
    config: PreferencesConfig, *, given: Sequence[Comparison] = (), progress: bool = True
) -> PreferencesResult:
    """Trains a policy from comparisons of what it does.

    Args:
        config: The training.
        given: Answers that people gave before: then nobody is asked, and these are all.
        progress: Show a progress bar on standard error.

    Returns:
        Final policy, learned reward and learning curve. The same config gives the same ones.
    """
    torch.set_num_threads(1)  # these networks are too small to gain from more
    started = time.monotonic()
    policy = _untrained(config)
    trpo = Trpo(policy, config.trpo, seed=config.seed, threads=config.threads)
    collector = Collector(_make_env(config), seed=config.seed)
    rng = np.random.default_rng(np.random.SeedSequence(config.seed).spawn(2)[1])
    comparer = Comparer(budget=config.pretrain + config.online)
    comparisons = list(given)
    if given:
        reward, fit = fit_reward(comparisons, config.reward, seed=config.seed)
    else:
        reward, fit = _pretrain(config, comparer, comparisons, rng)
    per_iteration = config.lanes * config.batch
    iterations = -(-config.steps // per_iteration)
    curve: list[PreferencesScore] = []
    episode: HiddenStates | None = None
    with tqdm(total=iterations * per_iteration, unit="step", disable=not progress) as bar:
        for iteration in range(1, iterations + 1):
            rollouts = collector.collect(policy.snapshot(), config.batch)
            rewards = reward.rewards(rollouts.obs, rollouts.actions)  # one reward for the whole batch
            stats = trpo.update(replace(rollouts, rewards=rewards))
            bar.update(per_iteration)
            steps = iteration * per_iteration
            correlation = agreement(rollouts, rewards, config.segment_steps)
            due = comparisons_due(config, steps, last=(iterations - 1) * per_iteration) - comparer.given
            due = 0 if given else due
            asked = _ask(config, comparer, reward, rollouts, due, rng)
            if asked:
                comparisons += asked
                reward, fit = fit_reward(comparisons, config.reward, seed=config.seed)
            if iteration % config.evaluate_every == 0 or iteration == iterations:
                episodes = evaluate(
                    policy.snapshot(), "hopper", seed=config.seed + 1, horizon=config.horizon,
                    nthread=config.threads,
                )  # fmt: skip
                score, episode = measure(
                    "backflip", episodes, steps=steps, seconds=time.monotonic() - started
                )
                curve.append(
                    PreferencesScore(
                        **asdict(score),
                        comparisons=len(comparisons),
                        correlation=correlation,
                        unseen_accuracy=fit.unseen_accuracy,
                    )
                )
                bar.set_postfix(
                    reward=round(score.reward_mean),
                    turns=round(score.net_turns_mean, 1),
                    comparisons=len(comparisons),
                    correlation=round(correlation, 2),
                    std=round(stats.std, 2),
                )
    collector.env.close()
    assert episode is not None
    return PreferencesResult(config=config, curve=tuple(curve), final=policy, reward=reward, episode=episode)


def stored_comparisons(store: Store, run: str) -> list[Comparison]:
    """What people said of the pairs of a run, for ``train_preferences``.

    Raises:
        UserError: If there is no such run, or nothing was compared in it.
    """
    runs = [entry["id"] for entry in store.runs.all()]
    if run not in runs:
        raise UserError(f"no run {run!r}; there are: {', '.join(runs) or 'none'}")
    preference = {"left": 1.0, "right": 0.0, "equal": 0.5}
    rows = [dict(zip(COMPARISON_COLUMNS, row, strict=True)) for row in store.comparisons.stream(run)]
    if not rows:
        raise UserError(f"nobody has compared anything in run {run!r}; do so on the page's Compare tab")
    return [
        Comparison(pair=store.comparisons.pair_segments(row["pair_id"]), preference=preference[row["answer"]])
        for row in rows
    ]


def save_preferences(prefix: Path, result: PreferencesResult) -> None:
    """Writes ``<prefix>.hidden.npz``, ``<prefix>.policy.pt`` and ``<prefix>.json``."""
    save_training(
        prefix,
        config=result.config,
        curve=result.curve,
        policy=result.final,
        episode=result.episode,
        final=result.curve[-1],
    )


def split_comparisons(total: int) -> tuple[int, int]:
    """``pretrain`` and ``online`` comparisons of a budget, in the paper's proportion of 200 to 150.

    Raises:
        UserError: If there are fewer than 2.
    """
    if total < 2:
        raise UserError(f"comparisons must be at least 2, got {total}")
    return split_ratings(total)


def comparisons_due(config: PreferencesConfig, steps: int, *, last: int) -> int:
    """How many comparisons should have been made after some control steps.

    Args:
        config: Budget and annealing.
        steps: Control steps so far.
        last: Control steps by which all are to be made: a later answer would change nothing.
    """
    # The integral of the rate a / (a + t), as a share of that over the whole time.
    share = math.log1p(steps / config.annealing) / math.log1p(last / config.annealing) if last else 1.0
    return config.pretrain + math.floor(config.online * min(share, 1.0) + 1e-9)


def draw_pairs(rollouts: Transitions, count: int, length: int, rng: np.random.Generator) -> list[Pair]:
    """Pairs of segments from anywhere in a batch, none of them across the end of an episode.

    Args:
        rollouts: The batch.
        count: How many pairs.
        length: W.
        rng: Draws lanes and starts.

    Returns:
        The pairs; none at all if no lane holds W steps of one episode.
    """
    clock = rollouts.clock
    whole = clock[:, length - 1 :] - clock[:, : clock.shape[1] - length + 1] == length - 1
    lanes, starts = np.nonzero(whole)
    if not len(lanes):
        return []
    cuts = rng.integers(len(lanes), size=(count, 2))
    segment = [[rollouts.segment(int(lanes[i]), int(starts[i]), length) for i in pair] for pair in cuts]
    return [(first, second) for first, second in segment]


def _make_env(config: PreferencesConfig) -> vector_env.RobotVectorEnv:
    return vector_env.make("hopper", config.lanes, horizon=config.horizon, nthread=config.threads)


def _untrained(config: PreferencesConfig) -> Policy:
    spec = robot_named("hopper")
    return Policy(
        config.policy,
        obs_size=spec.obs_size,
        action_size=spec.action_size,
        horizon=config.horizon,
        seed=config.seed,
    )


def _pretrain(
    config: PreferencesConfig, comparer: Comparer, comparisons: list[Comparison], rng: np.random.Generator
) -> tuple[RewardEnsemble, RewardFit]:
    """Comparisons of whole episodes of the untrained policy, and the first reward."""
    collector = Collector(_make_env(config), seed=config.seed + 1, stagger=False)
    rollouts = collector.collect(_untrained(config).snapshot(), config.horizon)
    collector.env.close()
    reward, fit = None, None
    while len(comparisons) < config.pretrain:
        count = min(config.round, config.pretrain - len(comparisons))
        comparisons += _ask(config, comparer, reward, rollouts, count, rng)
        reward, fit = fit_reward(comparisons, config.reward, seed=config.seed)
    assert reward is not None and fit is not None
    return reward, fit


def _ask(
    config: PreferencesConfig,
    comparer: Comparer,
    reward: RewardEnsemble | None,
    rollouts: Transitions,
    count: int,
    rng: np.random.Generator,
) -> list[Comparison]:
    """Answers about the most disputed pairs of a batch, or about any while there is no reward yet."""
    if count <= 0:
        return []
    candidates = config.candidates if reward else 1
    pairs = draw_pairs(rollouts, candidates * count, config.segment_steps, rng)
    if reward:
        pairs = most_disputed(reward, pairs, count)
    return [Comparison(pair=pair, preference=comparer.compare(*pair)) for pair in pairs]
