"""Options learned for sub-goals against the exact ones."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.subgoals import learn_subgoals
from lodestone.envs.four_rooms import NUMBER, FourRooms
from lodestone.options.execution import Rules
from lodestone.options.subgoals import Subgoal, solve_subgoal, subgoal_options, subproblem
from lodestone.options.tabular import TabularOptions
from lodestone.planning.option_models import tabulate_options
from lodestone.planning.solve import evaluate_policy
from lodestone.planning.tables import tabulate


@pytest.mark.parametrize(("dynamics", "close"), [("deterministic", 1e-9), ("sps", 0.05)])
def test_learned_options_are_as_good_as_the_exact_ones(dynamics, close) -> None:
    """Out of the north-western room by either hallway; the values of the learned policies are exact."""
    rooms = FourRooms(dynamics)
    tables = tabulate(rooms)
    cell = np.asarray(tables.space.states.cell)
    room = np.isin(cell, NUMBER[1:6, 1:6])
    subgoals = [
        Subgoal("north", room, (cell == NUMBER[3, 6]).astype(float)),
        Subgoal("west", room, (cell == NUMBER[6, 2]).astype(float)),
    ]
    config = QLearningConfig(learning_rate=((0.0, 0.5), (1.0, 0.02)), epsilon=((0.0, 1.0), (1.0, 0.5)))
    rules = Rules(discount=0.9, step_limit=50)
    learned = learn_subgoals(config, tables, rooms.action_names, subgoals, rules, 30_000, seed=0)
    exact = subgoal_options(tables, subgoals, 0.9)
    assert isinstance(learned, TabularOptions)
    found, wanted = (tabulate_options(options, tables.space) for options in (learned, exact))
    assert found.names == wanted.names
    np.testing.assert_array_equal(found.initiation, wanted.initiation)
    np.testing.assert_array_equal(found.termination, wanted.termination)
    for option, subgoal in enumerate(subgoals):
        problem = subproblem(tables, subgoal, 0.9)
        best = solve_subgoal(tables, subgoal, 0.9).values
        values = evaluate_policy(problem, found.action_probs[option].argmax(axis=1), 0.9)
        np.testing.assert_allclose(values[room], best[room], atol=close)
        assert best[room].min() > 0.2
