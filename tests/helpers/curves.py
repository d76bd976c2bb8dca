"""A run that has been trained for a while, as far as the page can tell."""

from __future__ import annotations

import math
from typing import Any


def iteration_stats(number: int, of: int = 400) -> dict[str, Any]:
    """Figures of an iteration of a training that goes well."""
    along = number / of
    wave = math.sin(number / 3) + 0.4 * math.sin(1.7 * number)
    return {
        "predicted": 2.4 + 1.1 * math.sqrt(along) + 0.06 * wave,
        "reference": 4.3 + 0.1 * math.sin(number / 40),
        "true_reward": 900 + 10_500 * along**1.3 + 320 * wave,
        "best": 2.6 + 1.3 * math.sqrt(along) + 0.1 * wave,
        "kl": 0.0095 + 0.0004 * wave,
        "std": 0.9 - 0.5 * along,
        "disagreement": 0.35 - 0.2 * along + 0.01 * wave,
        "episode_seconds": 2.0 + 4 * along + 0.1 * wave,
        "seconds": {
            "rollouts": 2.1 + 0.05 * wave, "policy": 1.2 - 0.03 * wave,
            "refit": 0.7 if number % 7 == 0 else 0.0, "other": 0.2,
        },
        "timeline": [None if k > 30 + 10 * along else round(2 + math.sin(k / 6), 2) for k in range(40)],
    }  # fmt: skip


def train(store: Any, run: str, first: int, last: int, of: int = 400) -> None:
    """Records iterations, with a refit every seventh."""
    for number in range(first, last + 1):
        store.runs.add_iteration(
            run,
            number,
            snapshot=1 + number // 7,
            env_steps=16_000 * number,
            stats=iteration_stats(number, of),
        )
