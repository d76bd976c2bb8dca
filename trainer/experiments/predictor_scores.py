"""How good predicted ratings are: pure functions on arrays.

Shapes: n clips, K = 5 ratings, b bins.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from onedemo.reward.model import CLASSES

BINS = 10
"""Of a reliability chart, equally wide."""
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
"""97.5 % quantiles of Student's t with 1, 2, ... 10 degrees of freedom; the last stands for more, too."""


def f1(given: np.ndarray, predicted: np.ndarray, least: int) -> float | None:
    """F1 of "rated ``least`` or more" as one question, ``2 TP / (2 TP + FP + FN)``.

    Args:
        given: Ratings, (n,), 1..5.
        predicted: Predicted ratings, (n,), 1..5.
        least: 3 asks for the classes 3 to 5, 4 for 4 and 5.

    Returns:
        0..1; None where no clip has such a rating, given or predicted.
    """
    return _f1(given >= least, predicted >= least)


def macro_f1(given: np.ndarray, predicted: np.ndarray, least: int) -> float | None:
    """The mean of the F1 of each class from ``least`` to 5; one that no clip has is left out."""
    each = [_f1(given == k, predicted == k) for k in range(least, CLASSES + 1)]
    there = [value for value in each if value is not None]
    return float(np.mean(there)) if there else None


def confusion(given: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """How many clips of each given rating (rows) got each predicted one (columns), (K, K)."""
    counts = np.zeros((CLASSES, CLASSES), int)
    np.add.at(counts, (np.asarray(given) - 1, np.asarray(predicted) - 1), 1)
    return counts


def reliability(chances: np.ndarray, happened: np.ndarray) -> np.ndarray:
    """Predicted chances beside what happened, in bins; those of several seeds can be added up.

    Args:
        chances: Predicted probability of something, (n,).
        happened: Whether it was so, (n,), bool.

    Returns:
        (3, b): clips in each bin, the sum of their chances, and how many times it was so.
    """
    bins = np.minimum((chances * BINS).astype(int), BINS - 1)
    return np.stack([np.bincount(bins, weights, BINS) for weights in (np.ones(len(bins)), chances, happened)])


def calibration_error(bins: np.ndarray) -> float:
    """Expected calibration error (Naeini et al. 2015): |chance - share|, each bin by its clips.

    Args:
        bins: As ``reliability`` gives them, (3, b).
    """
    clips, chances, happened = bins
    return float(np.abs(chances - happened).sum() / clips.sum())


def spearman(a: np.ndarray, b: np.ndarray) -> float | None:
    """Rank correlation of two figures of n clips, equal ones sharing their mean rank.

    Returns:
        -1..1; None where one of them is the same for all clips.
    """
    ranks = np.stack([_ranks(a), _ranks(b)])
    ranks -= ranks.mean(axis=1, keepdims=True)
    size = np.sqrt(np.square(ranks).sum(axis=1).prod())
    return float(ranks[0] @ ranks[1] / size) if size > 0 else None


def interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % confidence interval of the mean of a few figures, by Student's t; infinite with less than two."""
    if len(values) < 2:
        return -np.inf, np.inf
    half = _T[min(len(values) - 1, len(_T)) - 1] * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values) - half), float(np.mean(values) + half)


def _f1(is_so: np.ndarray, said_so: np.ndarray) -> float | None:
    named = is_so.sum() + said_so.sum()  # 2 TP + FN + FP
    return float(2 * (is_so & said_so).sum() / named) if named else None


def _ranks(values: np.ndarray) -> np.ndarray:
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[which]
