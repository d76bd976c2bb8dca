import numpy as np
import pytest

from trainer.envs import observe, spec
from trainer.errors import UserError
from trainer.hidden import HiddenStates
from trainer.raters import Oracle, RatingBudgetSpent, appearance, make_rater
from trainer.records import Segment


def states(steps=100, spin=-0.03):
    qpos = np.zeros((steps + 1, 6))
    qpos[:, 1] = 1.25
    qpos[:, 2] = spin * np.arange(steps + 1)
    qvel = np.zeros((steps + 1, 6))
    qvel[:, 2] = spin / 0.008
    return qpos, qvel


@pytest.fixture
def hidden():
    qpos, qvel = states()
    obs = observe(spec("hopper"), qpos, qvel)
    return HiddenStates(obs=obs, actions=np.zeros((100, 3)), qpos=qpos, qvel=qvel)


def segment(qpos, qvel, start, length=38):
    cut = slice(start, start + length)
    obs = observe(spec("hopper"), qpos[cut], qvel[cut])
    return Segment(obs=obs, actions=np.zeros((length, 3)), qpos=qpos[cut], qvel=qvel[cut])


def test_the_demos_own_states_are_a_five(hidden):
    assert Oracle(hidden, budget=1).rate(segment(hidden.qpos, hidden.qvel, 20), 20) == 5


def test_a_turn_more_and_a_metre_further_look_the_same(hidden):
    qpos = hidden.qpos.copy()
    qpos[:, 2] += 4 * np.pi
    qpos[:, 0] += 10
    np.testing.assert_allclose(appearance(qpos, hidden.qvel), appearance(hidden.qpos, hidden.qvel), atol=1e-9)


def test_ratings_fall_with_the_distance(hidden):
    oracle = Oracle(hidden, budget=10)
    ratings = []
    for offset in (0.0, 0.6, 1.0, 1.5, 3.1):
        qpos = hidden.qpos.copy()
        qpos[:, 2] += offset
        ratings.append(oracle.rate(segment(qpos, hidden.qvel, 10), 10))
    assert ratings == sorted(ratings, reverse=True)
    assert ratings[0] == 5 and ratings[-1] == 1 and len(set(ratings)) >= 4


def test_the_wrong_moment_is_not_similar(hidden):
    assert Oracle(hidden, budget=1).rate(segment(hidden.qpos, hidden.qvel, 0), 60) <= 2


def test_the_budget_is_enforced_by_the_rater(hidden):
    oracle = Oracle(hidden, budget=2)
    for _ in range(2):
        oracle.rate(segment(hidden.qpos, hidden.qvel, 0), 0)
    with pytest.raises(RatingBudgetSpent, match="budget of 2 ratings"):
        oracle.rate(segment(hidden.qpos, hidden.qvel, 0), 0)


def test_true_similarity_costs_nothing(hidden):
    oracle = Oracle(hidden, budget=0)
    assert oracle.true_similarity(hidden.qpos[:-1], hidden.qvel[:-1]) == 5.0
    still, _ = states(spin=0.0)
    assert oracle.true_similarity(still[:-1], np.zeros((100, 6))) < 3


def test_unknown_raters_and_demos_without_states(hidden):
    with pytest.raises(UserError, match="unknown rater 'orakel'; choose one of: oracle"):
        make_rater("orakel", hidden, demo="d", budget=1)
    with pytest.raises(UserError, match="demo 'person' has none"):
        make_rater("oracle", None, demo="person", budget=1)
