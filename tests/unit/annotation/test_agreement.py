"""How good ratings are: figures against known answers, and who is warned of."""

import krippendorff
import numpy as np
import pytest

from onedemo.app.annotation.agreement import (
    RatingRow,
    agreement,
    differences,
    disputed,
    quality,
    quality_by_rater,
    trends,
    verdict,
    warnings,
)


def row(clip, rater="Ann", value=3, *, repeat=False, latency_ms=2000, predicted=None):
    return RatingRow(clip, rater, value, repeat, latency_ms, predicted, 304.0)


def test_alpha_is_that_of_the_reliability_matrix():
    rng = np.random.default_rng(0)
    matrix = rng.integers(1, 6, size=(3, 40)).astype(float)
    matrix[1] = np.clip(matrix[0] + rng.integers(-1, 2, size=40), 1, 5)
    matrix[rng.random(matrix.shape) < 0.3] = np.nan
    rows = [
        row(clip, f"rater {rater}", int(matrix[rater, clip]))
        for clip in range(40) for rater in range(3) if np.isfinite(matrix[rater, clip])
    ]  # fmt: skip
    found = agreement(rows)
    assert found.alpha == pytest.approx(krippendorff.alpha(matrix, level_of_measurement="ordinal"))
    assert found.clips == (np.isfinite(matrix).sum(axis=0) > 1).sum()
    assert found.low < found.alpha < found.high and found.high - found.low < 0.9


def test_perfect_opposite_and_untold_agreement():
    same = [row(clip, rater, clip % 5 + 1) for clip in range(20) for rater in ("Ann", "Bob")]
    assert agreement(same).alpha == pytest.approx(1.0)
    opposite = [
        row(c, r, (c % 5 + 1) if r == "Ann" else 5 - c % 5) for c in range(20) for r in ("Ann", "Bob")
    ]
    assert agreement(opposite).alpha < 0
    assert agreement([row(1), row(2)]) == agreement([])
    habit = agreement([row(clip, rater, 3) for clip in range(9) for rater in ("Ann", "Bob")])
    assert habit.alpha is None and habit.clips == 9


def test_second_opinions_tell_of_steadiness_alone():
    rows = [row(clip, value=value) for clip, value in enumerate((1, 2, 3, 4))]
    rows += [row(0, value=1, repeat=True), row(1, value=4, repeat=True)]
    found = quality(rows)
    assert (found.repeats, found.same, found.apart) == (2, 0.5, 1.0)
    assert found.agreement.clips == 0  # the same person twice is no agreement
    assert found.shares == [2 / 6, 1 / 6, 1 / 6, 2 / 6, 0]


def test_pace_and_drift():
    rows = [row(c, value=3, latency_ms=1000 + c, predicted=3.0 - 0.5 * (c >= 60)) for c in range(90)]
    found = quality(rows)
    assert found.seconds == pytest.approx(1.0445) and found.drift == pytest.approx(0.5)
    assert quality(rows[:30]).drift is None and quality([]).seconds is None


def test_each_rater_is_compared_on_the_clips_that_others_rated_too():
    rows = [row(c, "Ann", c % 5 + 1) for c in range(30)] + [row(c, "Bob", c % 5 + 1) for c in range(10)]
    rows += [row(c, "Cy", 5 - c % 5) for c in range(10, 30)]
    each = quality_by_rater(rows)
    assert list(each) == ["Ann", "Bob", "Cy"]
    assert each["Bob"].agreement.alpha == pytest.approx(1.0) and each["Bob"].agreement.clips == 10
    assert each["Cy"].agreement.alpha < 0 and each["Ann"].agreement.clips == 30


@pytest.mark.parametrize(
    ("rows", "warned"),
    [
        ([row(c, value=c % 5 + 1) for c in range(40)], []),
        ([row(c, value=3) for c in range(19)], []),  # too few to tell
        ([row(c, value=3) for c in range(20)], ["nearly always says 3"]),
        ([row(c, value=1 if c < 20 else 4) for c in range(40)], ["the last 20 were all 4"]),
        (
            [row(c, value=c % 5 + 1, latency_ms=350 if c % 2 else 900) for c in range(40)],
            ["50 % of the answers came before the clip had played once"],
        ),
        ([row(c, value=c % 5 + 1, latency_ms=420) for c in range(40)], []),
    ],
)
def test_who_should_be_looked_at(rows, warned):
    assert warnings(rows) == warned


def test_agreement_has_a_verdict_in_a_word():
    said = [verdict(alpha) for alpha in (None, -0.2, 0.66, 0.667, 0.79, 0.8, 1.0)]
    assert said == ["", "poor", "poor", "fair", "fair", "good", "good"]


def test_figures_of_raters_need_no_interval():
    rows = [row(clip, rater, clip % 5 + 1) for clip in range(20) for rater in ("Ann", "Bob")]
    (ann, _) = quality_by_rater(rows, intervals=False).values()
    assert ann.agreement.alpha == pytest.approx(1.0) and ann.agreement.low is None


def test_who_disagrees_and_on_which_clips():
    rows = [row(clip, "Ann", 5 if clip < 4 else 3) for clip in range(8)]
    rows += [row(clip, "Bob", 2 if clip < 4 else 3) for clip in range(8)]
    rows += [row(clip, "Cy", 4) for clip in range(2)] + [row(7, "Ann", 1, repeat=True)]
    clips = disputed(rows, most=3)
    assert [(one.clip, one.apart) for one in clips] == [(3, 3), (2, 3), (1, 3)]
    assert clips[2].opinions == [("Ann", 5), ("Cy", 4), ("Bob", 2)]
    assert disputed([row(1, "Ann", 3), row(1, "Bob", 4)]) == []  # a point apart is no dispute
    (pair,) = differences(rows)  # Cy shares two clips with the others: too few
    assert (pair.higher, pair.lower, pair.clips) == ("Ann", "Bob", 8)
    assert pair.apart == pytest.approx(1.5) and pair.above == pytest.approx(1.5)
    assert differences([row(c, r, 3) for c in range(5) for r in ("Ann", "Bob")]) == []


def test_trends_tell_how_figures_went():
    rows = [row(c, "Ann", 2 if c < 40 else 4, latency_ms=3000 if c < 40 else 1000) for c in range(80)]
    rows += [row(c, "Bob", 1 + c % 2, latency_ms=2000) for c in range(16)]
    found = trends(rows)
    assert list(found) == ["", "Ann", "Bob"]
    assert len(found["Ann"].means) == 10 and len(found["Bob"].means) == 2
    assert (found["Ann"].means[0], found["Ann"].means[-1]) == (2.0, 4.0)
    assert (found["Ann"].seconds[0], found["Ann"].seconds[-1]) == (3.0, 1.0)
    assert found["Ann"].alphas[-1] is None and found["Bob"].alphas[0] is not None
    assert trends([row(c, "Ann") for c in range(15)]) == {}
