"""Which clip of the agent is asked against which clip of the demo: decided here and nowhere else.

Shapes: N lanes, T control steps, W control steps a clip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.records import Rollouts


@dataclass(frozen=True, kw_only=True, slots=True)
class Question:
    """One clip to be asked about: steps ``start`` .. ``start + W`` of a lane, beside the demo."""

    lane: int
    start: int
    demo_step: int


def choose(
    rollouts: Rollouts, count: int, clip_steps: int, demo_steps: int, rng: np.random.Generator
) -> list[Question]:
    """Chooses clips uniformly, each beside the demo of the same time, as in the paper.

    Args:
        rollouts: What the agent did, (N, T).
        count: How many clips.
        clip_steps: W.
        demo_steps: Control steps of the demo; a clip ends before them.
        rng: Decides.

    Returns:
        ``count`` questions, fewer if the rollouts hold fewer places to cut. No two overlap unless
        there is no other way.
    """
    clock = rollouts.clock
    last = clip_steps - 1
    if clock.shape[1] < clip_steps:
        return []
    whole = clock[:, last:] - clock[:, : clock.shape[1] - last] == last
    lanes, starts = np.nonzero(whole & (clock[:, last:] < demo_steps))
    order = rng.permutation(len(lanes))
    chosen: list[int] = []
    spare: list[int] = []
    taken: dict[int, list[int]] = {}
    for index in order:
        lane, start = int(lanes[index]), int(starts[index])
        if all(abs(start - other) >= clip_steps for other in taken.get(lane, [])):
            taken.setdefault(lane, []).append(start)
            chosen.append(index)
            if len(chosen) == count:
                break
        elif len(spare) < count:
            spare.append(index)
    chosen += spare[: count - len(chosen)]
    return [
        Question(lane=int(lanes[i]), start=int(starts[i]), demo_step=int(clock[lanes[i], starts[i]]))
        for i in chosen
    ]
