"""Which clips are cut from rollouts, and beside which part of the demo; the page decides who sees which.

Shapes: N lanes, T control steps, W control steps a clip, n candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from onedemo.queries.settings import CHOICES
from onedemo.types import Rollouts

Predict = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(lanes, starts, demo_steps), (n,) each, to predicted ratings and the disagreement on them, (n,) each."""

_CANDIDATES = 3000
_APART = 15
"""Control steps of the demo within which ..."""
_MOST_THERE = 2
"""... so many clips of a round may begin, while others are to be had."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Question:
    """One clip to be asked about: steps ``start`` .. ``start + W`` of a lane, beside the demo."""

    lane: int
    start: int
    demo_step: int
    choice: str = "any"
    """Why: "high", "disagreement" or "any"."""
    score: float | None = None
    """The predicted rating or the disagreement that it was chosen by."""


def choose(
    rollouts: Rollouts,
    count: int,
    clip_steps: int,
    demo_steps: int,
    rng: np.random.Generator,
    *,
    any_time: bool = False,
    how: str = "mix",
    predict: Predict | None = None,
) -> list[Question]:
    """Chooses clips to be rated.

    Uniformly if nothing judges, and in the paper. Else by one or several reasons: high predicted ratings,
    because random motion hardly ever deserves one and the reward is made of them; disagreement between
    the predictor's members, where a rating tells most; and any, so that nothing stays unseen. Within a
    round they spread over the demo.

    Args:
        rollouts: What the agent did, (N, T).
        count: How many clips.
        clip_steps: W.
        demo_steps: Control steps of the demo; a clip ends before them.
        rng: Decides.
        any_time: Pair a clip with any moment of the demo instead of the moment of its own clock.
        how: One of ``CHOICES``.
        predict: What the predictor says of a clip beside the demo, if there is one.

    Returns:
        ``count`` questions, fewer if the rollouts hold fewer places to cut. No two overlap, and they
        spread over the demo, unless there is no other way; they crowd before they overlap.
    """
    lanes, starts = _places(rollouts, clip_steps)
    if not len(lanes):
        return []
    order = rng.permutation(len(lanes))
    lanes, starts = lanes[order], starts[order]
    if any_time:
        demo = rng.integers(demo_steps - clip_steps + 1, size=len(lanes))
    else:
        # Beside the demo of the clip's middle: where the phase adapts, both ends are then about as far off.
        middle = clip_steps // 2
        demo = np.maximum(rollouts.clock[lanes, starts + middle].astype(int) - middle, 0)
    within = np.flatnonzero(demo + clip_steps <= demo_steps)
    shares = CHOICES[how] if predict is not None else CHOICES["uniform"]
    scores: dict[str, np.ndarray] = {}
    if predict is not None and set(shares) != {"any"}:
        within = within[: max(_CANDIDATES, 20 * count)]  # looking at some of them is enough
        scores["high"], scores["disagreement"] = predict(lanes[within], starts[within], demo[within])
    lanes, starts, demo = lanes[within], starts[within], demo[within]
    chosen: list[int] = []
    reasons: list[str] = []
    for reason, share in shares.items():
        rank = np.arange(len(lanes)) if reason == "any" else np.argsort(-scores[reason], kind="stable")
        wanted = count if reason == list(shares)[-1] else len(chosen) + round(share * count)
        _take(chosen, rank, min(wanted, count), lanes, starts, demo, clip_steps, spread=bool(scores))
        reasons += [reason] * (len(chosen) - len(reasons))
    return [
        Question(
            lane=int(lanes[i]), start=int(starts[i]), demo_step=int(demo[i]), choice=reason,
            score=float(scores[reason][i]) if reason in scores else None,
        )
        for i, reason in zip(chosen, reasons, strict=True)
    ]  # fmt: skip


def _places(rollouts: Rollouts, clip_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Lanes and starts of all clips that lie within one episode."""
    ended = rollouts.terminated | rollouts.truncated
    if ended.shape[1] < clip_steps:
        return np.empty(0, int), np.empty(0, int)
    before = np.concatenate([np.zeros_like(ended[:, :1], dtype=int), np.cumsum(ended, axis=1)], axis=1)
    places = ended.shape[1] - clip_steps + 1
    inside = before[:, clip_steps - 1 : clip_steps - 1 + places] - before[:, :places]
    lanes, starts = np.nonzero(inside == 0)
    return lanes, starts


def _take(
    chosen: list[int], rank: np.ndarray, wanted: int, lanes: np.ndarray, starts: np.ndarray,
    demo: np.ndarray, clip_steps: int, *, spread: bool,
) -> None:  # fmt: skip
    """Appends to ``chosen`` from the front of ``rank`` until there are ``wanted``.

    First without clips that overlap others or, if they are to ``spread``, crowd one part of the demo; if
    that is not enough, clips that crowd; then any.
    """
    for separate, loose in ((True, spread), (True, False), (False, False)):
        for index in rank:
            if len(chosen) >= wanted:
                return
            if index in chosen:
                continue
            others = np.array(chosen, int)
            close = np.abs(starts[others] - starts[index]) < clip_steps
            if separate and (close & (lanes[others] == lanes[index])).any():
                continue
            if loose and (np.abs(demo[others] - demo[index]) < _APART).sum() >= _MOST_THERE:
                continue
            chosen.append(int(index))
