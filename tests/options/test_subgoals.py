"""Options from sub-goals: what they are, and that they are the best at what they are for."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_mdp import NUM_ACTIONS, NUM_STATES, dense, random_tables

from lodestone.envs.four_rooms import CELLS, NUMBER, FourRooms
from lodestone.errors import InvalidConfig
from lodestone.options.base import NO_CAP
from lodestone.options.subgoals import Subgoal, solve_subgoal, subgoal_options, subproblem
from lodestone.planning.option_models import expected_option_steps, tabulate_options
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import Tables, tabulate

seeds = st.integers(0, 10_000)


def random_subgoal(seed: int, pays_reward: bool) -> tuple[Tables, Subgoal]:
    rng = np.random.default_rng(seed)
    region = rng.random(NUM_STATES) < 0.5
    region[0] = True
    return random_tables(seed, goals=1), Subgoal("there", region, rng.normal(scale=5.0, size=NUM_STATES), pays_reward)


@settings(max_examples=30)
@given(seed=seeds, pays_reward=st.booleans())
def test_values_satisfy_the_equation_and_the_policy_is_greedy_in_them(seed: int, pays_reward: bool) -> None:
    """Q_o by sweeps over dense arrays; a sub-problem ends in a terminal state inside its region, too."""
    tables, subgoal = random_subgoal(seed, pays_reward)
    probs, rewards = dense(tables)
    beta = np.where(tables.terminal, 1.0, ~subgoal.region)
    action_values = np.zeros((NUM_STATES, NUM_ACTIONS))
    for _ in range(400):
        arriving = beta * subgoal.values + (1 - beta) * action_values.max(axis=1)
        action_values = pays_reward * rewards + 0.9 * probs @ arriving
    runs = beta == 0
    solution = solve_subgoal(tables, subgoal, 0.9)
    np.testing.assert_allclose(solution.action_values[runs], action_values[runs], atol=1e-8)

    options = tabulate_options(subgoal_options(tables, [subgoal], 0.9), tables.space)
    assert (options.names, options.max_steps) == (("there",), (NO_CAP,))
    np.testing.assert_array_equal(options.initiation[0], runs)
    np.testing.assert_array_equal(options.termination[0], beta)
    chosen = options.action_probs[0].argmax(axis=1)
    np.testing.assert_allclose(
        action_values[np.arange(NUM_STATES), chosen][runs], action_values.max(axis=1)[runs], atol=1e-6
    )


def test_no_policy_gets_more_out_of_the_option() -> None:
    """Against every deterministic policy in a region of four states, by linear algebra."""
    tables, subgoal = random_subgoal(7, pays_reward=True)
    region = np.arange(NUM_STATES) < 4
    subgoal = subgoal._replace(region=region)
    probs, rewards = dense(tables)
    best = np.full(4, -np.inf)
    for policy in itertools.product(range(NUM_ACTIONS), repeat=4):
        step, pay = probs[np.arange(4), policy], rewards[np.arange(4), policy]
        pay = pay + 0.9 * step[:, 4:] @ subgoal.values[4:]
        best = np.maximum(best, np.linalg.solve(np.eye(4) - 0.9 * step[:, :4], pay))
    np.testing.assert_allclose(solve_subgoal(tables, subgoal, 0.9).values[:4], best, atol=1e-8)


def test_a_sub_goal_that_is_worth_what_the_state_is_worth_gives_the_optimal_policy() -> None:
    """With g = V* at the exit, the option of a room is as good as the whole plan is there."""
    rooms = FourRooms()
    tables = tabulate(rooms)
    cell = np.asarray(tables.space.states.cell)
    optimal = value_iteration(tables, 0.9).values
    room = np.isin(cell, NUMBER[1:6, 1:6])
    solution = solve_subgoal(tables, Subgoal("out", room, optimal, pays_reward=True), 0.9)
    np.testing.assert_allclose(solution.values[room], optimal[room], atol=1e-8)


def test_an_option_to_a_bottleneck_gets_there_from_everywhere_by_the_shortest_way() -> None:
    rooms = FourRooms("deterministic", goal=CELLS - 1)  # in a corner, where it is in nobody's way
    tables = tabulate(rooms)
    cell = np.asarray(tables.space.states.cell)
    bottleneck = int(NUMBER[3, 6])
    there = Subgoal("north-hallway", cell != bottleneck, (cell == bottleneck).astype(float))
    options = tabulate_options(subgoal_options(tables, [there], 0.9), tables.space)
    walk = tables._replace(terminal=tables.terminal | (cell == bottleneck))
    steps = expected_option_steps(walk, options, np.zeros(CELLS, dtype=int))
    moved = tabulate(FourRooms("deterministic", goal=bottleneck))
    quickest = np.zeros(CELLS)
    quickest[np.asarray(moved.space.states.cell)] = -value_iteration(moved.with_step_reward(-1.0), 1.0).values
    begins = ~walk.terminal
    np.testing.assert_allclose(steps[begins], quickest[cell][begins])
    np.testing.assert_array_equal(options.initiation[0], begins)


def test_what_makes_no_sense_is_refused() -> None:
    tables, subgoal = random_subgoal(0, pays_reward=False)
    with pytest.raises(InvalidConfig, match="'there' has no state"):
        subproblem(tables, subgoal._replace(region=tables.terminal), 0.9)
    with pytest.raises(InvalidConfig, match="must be finite"):
        subproblem(tables, subgoal._replace(values=np.full(NUM_STATES, -np.inf)), 0.9)
