"""Error models against what their formulas say, over thousands of ratings."""

import math

import numpy as np
import pytest

from onedemo.annotators.base import DistanceAnnotator, RatingBudgetSpent
from onedemo.annotators.noise import ERRORS, parse_errors
from onedemo.errors import UserError
from onedemo.types import Segment

N = 2000
THRESHOLDS = (1.0, 2.0, 3.0, 4.0)  # classes one wide: 0.5 is the middle of class 5, 2.5 of class 3


class Ruler(DistanceAnnotator):
    """Is told the distance at each step: it stands where x would be."""

    def distance(self, qpos, qvel, demo_step):
        return qpos[:, 0]


def ruler(*parts, budget=N, **more):
    errors, seed = parse_errors(parts, "ruler")
    return Ruler(THRESHOLDS, dt=0.008, budget=budget, errors=errors, seed=seed or 0, **more)


def clip(distance, steps=10):
    """A segment as far away as told, one number or one for each step."""
    qpos = np.zeros((steps, 6))
    qpos[:, 0] = distance
    return Segment(
        obs=np.zeros((steps, 11)), actions=np.zeros((steps, 3)), qpos=qpos, qvel=np.zeros((steps, 6))
    )


def shares(rater, distance, count=N):
    """How often each class is given to one and the same clip, (5,)."""
    ratings = [rater.rate(clip(distance), 0) for _ in range(count)]
    return np.bincount(ratings, minlength=6)[1:] / count


def likely(found, expected, count=N):
    """Within four standard errors of what is expected."""
    expected = np.asarray(expected)
    np.testing.assert_array_less(
        np.abs(found - expected), 4 * np.sqrt(expected * (1 - expected) / count) + 1e-9
    )


def normal_below(x):
    return (1 + math.erf(x / math.sqrt(2))) / 2


def test_without_errors_thresholds_decide():
    found = [ruler().rate(clip(d), 0) for d in (0.0, 1.0, 1.001, 2.5, 3.5, 4.001, 99.0)]
    assert found == [5, 5, 4, 3, 2, 1, 1]


def test_noisy_is_boltzmann():
    for distance, level in ((2.5, 3.0), (2.9, 2.6), (0.2, 5.3), (50.0, 0.5)):
        odds = [math.exp(-2 * (level - k) ** 2) for k in range(1, 6)]
        likely(shares(ruler("noisy"), distance), np.array(odds) / sum(odds))
    assert shares(ruler("noisy"), 2.5)[2] == pytest.approx(0.78, abs=0.04)
    likely(shares(ruler("noisy:0"), 2.5), np.full(5, 0.2))
    assert shares(ruler("noisy:1e5"), 2.6)[2] == 1


def test_a_mistake_is_any_of_the_four_others():
    likely(shares(ruler("mistake"), 1.5), [0.025, 0.025, 0.025, 0.9, 0.025])
    likely(shares(ruler("mistake:0.4"), 9.0), [0.6, 0.1, 0.1, 0.1, 0.1])
    assert shares(ruler("mistake:1"), 9.0)[0] == 0 and shares(ruler("mistake:0"), 9.0)[0] == 1


def test_mistakes_come_on_top_of_noise():
    odds = np.array([math.exp(-2 * (3.0 - k) ** 2) for k in range(1, 6)])
    odds /= odds.sum()
    likely(shares(ruler("mistake:0.2", "noisy"), 2.5), 0.8 * odds + 0.2 * (1 - odds) / 4)


def test_jitter_moves_clips_at_the_boundaries():
    likely(shares(ruler("jitter"), 2.0), [0, 0, 0.5, 0.5, 0])
    beyond = normal_below(-0.5 / 0.25)  # half a class away, two standard deviations
    likely(shares(ruler("jitter"), 2.5), [0, beyond, 1 - 2 * beyond, beyond, 0])
    assert 2 * beyond < 1 / 20 + 1e-2
    # Threshold i lies below 1.8 with the chance that i + 0.5 n < 1.8.
    off = [normal_below((1.8 - t) / 0.5) for t in THRESHOLDS]
    expected = [off[3], off[2] - off[3], off[1] - off[2], off[0] - off[1], 1 - off[0]]
    likely(shares(ruler("jitter:0.5"), 1.8), expected)


def test_harsh_and_kind_scale_the_thresholds():
    rater, mild = ruler("harsh"), ruler("kind")
    assert [rater.rate(clip(d), 0) for d in (0.79, 0.81, 1.61, 2.41, 3.21)] == [5, 4, 3, 2, 1]
    assert [mild.rate(clip(d), 0) for d in (1.24, 1.26, 2.51, 3.76, 5.01)] == [5, 4, 3, 2, 1]
    assert ruler("harsh:0.5").rate(clip(0.6), 0) == 4


def test_drift_goes_from_kind_to_harsh_over_the_budget():
    rater = ruler("drift", budget=101)
    ratings = [rater.rate(clip(1.1), 0) for _ in range(101)]
    factors = 1.25 - 0.45 * np.arange(101) / 100
    assert ratings == [5 if f >= 1.1 else 4 for f in factors]
    assert ruler("drift", budget=101, given=100).rate(clip(0.81), 0) == 4
    assert ruler("drift", budget=1).rate(clip(1.24), 0) == 5


def test_myopic_looks_at_the_end():
    worse = np.linspace(0, 4, 10)
    weights = 0.9 ** np.arange(9, -1, -1)
    exact = (weights * worse).sum() / weights.sum()
    assert 2.0 < exact < 3.0
    assert ruler().rate(clip(worse), 0) == 4 and ruler("myopic").rate(clip(worse), 0) == 3
    assert ruler("myopic").rate(clip(worse[::-1]), 0) == 4
    assert (
        ruler("myopic:0.01").rate(clip(worse), 0) == 2
    )  # the last step alone, 4.0, and a trace of the others
    assert ruler("myopic:1").rate(clip(worse), 0) == 4


def test_skip_declines_the_least_certain_and_they_cost_nothing():
    rng = np.random.default_rng(0)
    distances = rng.uniform(0.5, 4.5, size=N)
    rater = ruler("skip:0.2", budget=N)
    answers = [rater.rate(clip(d), 0) for d in distances]
    declined = np.array([a is None for a in answers])
    margin = np.abs(distances[:, None] - np.array(THRESHOLDS)).min(axis=1)
    likely(declined.mean(), 0.2)
    assert margin[declined].max() < margin[~declined].min()
    assert rater.given == (~declined).sum() < rater.budget
    plain = ruler(budget=N)
    assert all(a in (None, plain.rate(clip(d), 0)) for a, d in zip(answers, distances, strict=True))


def test_skip_asks_what_the_rater_itself_sees():
    assert ruler("skip:0.1", "harsh").rate(clip(1.6), 0) is None  # at its boundary, not at ours
    assert ruler("skip:0.1", "harsh").rate(clip(2.0), 0) == 3


@pytest.mark.parametrize("name", ERRORS)
def test_the_budget_holds_with_every_error(name):
    rater = ruler(name, budget=300)
    asked = 0
    with pytest.raises(RatingBudgetSpent):
        while asked < 2000:
            rater.rate(clip(0.1 + asked % 45 / 10), 0)
            asked += 1
    assert rater.given == 300 and asked >= 300


@pytest.mark.parametrize("name", ["noisy", "mistake", "jitter"])
def test_chance_comes_from_the_seed_and_the_number_of_the_rating(name):
    distances = np.random.default_rng(1).uniform(0, 5, size=500)

    def answers(seed, given=0):
        rater = ruler(name, f"seed:{seed}", given=given)
        return [rater.rate(clip(d), 0) for d in distances[given:]]

    assert answers(3) == answers(3) != answers(4)
    assert answers(3)[200:] == answers(3, given=200)


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        (["mistak"], "unknown error model 'mistak'; choose from: myopic, harsh, kind"),
        ([""], "unknown error model ''"),
        (["mistake:1.2"], "mistake takes a number from 0 to 1, got '1.2'"),
        (["mistake:"], "mistake takes a number from 0 to 1, got ''"),
        (["skip:nan"], "skip takes a number from 0 to 0.9, got 'nan'"),
        (["jitter", "jitter:0.1"], "'jitter' is given twice"),
        (["seed:1", "seed:2"], "'seed' is given twice"),
        (["seed:-1"], "seed must be a whole number, such as seed:3, got 'seed:-1'"),
        (["seed"], "seed must be a whole number"),
    ],
)
def test_wrong_names_and_numbers_are_one_sentence(parts, sentence):
    with pytest.raises(UserError) as error:
        parse_errors(parts, "oracle+" + "+".join(parts))
    assert sentence in str(error.value) and str(error.value).startswith("rater 'oracle+")
