"""Following a tabular learner: judgements on a common axis, and returns of policies that may never end."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.chain import Chain
from lodestone.envs.taxi import Taxi
from lodestone.experiments.following import Followed, return_within
from lodestone.learning.history import History
from lodestone.planning.solve import evaluate_policy, greedy_choices, value_iteration
from lodestone.planning.tables import tabulate


def test_a_judgement_holds_until_the_next():
    counts = np.array([[10, 20], [30, 40]])
    one = Followed(History(2, ()), counts, counts * 2, np.array([[1.0, 2.0], [3.0, 4.0]]), None, 0.0)
    found = one.at(one.episodes, np.array([0.0, 10.0, 25.0, 30.0, 99.0]))
    np.testing.assert_array_equal(found, [[np.nan, 1, 1, 3, 3], [np.nan, np.nan, 2, 2, 4]])
    np.testing.assert_array_equal(one.at(one.steps, np.array([60.0])), [[3.0], [2.0]])


def test_returns_within_a_limit():
    """A policy that ends is worth what the planner says; one that never does costs its steps."""
    tables = tabulate(Taxi(move_success=0.8))
    best = greedy_choices(value_iteration(tables, 1.0).action_values)
    against_the_wall = np.zeros(tables.num_states, dtype=int)
    found = return_within(tables, np.stack([best, against_the_wall]), 300)
    assert found[0] == pytest.approx(tables.initial_mean(evaluate_policy(tables, best, 1.0)), abs=1e-6)
    assert found[1] == pytest.approx(-300)
    chain = tabulate(Chain())
    right = np.ones(chain.num_states, dtype=int)
    np.testing.assert_allclose(
        return_within(chain, right[None], 2000), chain.initial_mean(evaluate_policy(chain, right, 1.0)), atol=1e-6
    )
