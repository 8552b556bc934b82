import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_mdp import NUM_ACTIONS, NUM_STATES, ArrayMDP, dense, random_tables

from lodestone.envs.magnet_arm import MagnetArm
from lodestone.errors import InvalidConfig, Unbounded
from lodestone.planning import solve
from lodestone.planning.solve import (
    evaluate_policy,
    expected_steps,
    greedy_choices,
    optimal_choices,
    optimum,
    value_iteration,
)
from lodestone.planning.tables import tabulate

seeds = st.integers(0, 10_000)


def small_world(moves: dict[tuple[int, int], dict[int, float]], pay: dict[tuple[int, int], float], size: int):
    """A world of two actions whose last state is the goal; an action that `moves` leaves out stays."""
    probs, rewards = np.zeros((size, 2, size)), np.zeros((size, 2, size))
    for state, action in np.ndindex(size, 2):
        for following, prob in moves.get((state, action), {state: 1.0}).items():
            probs[state, action, following] = prob
        rewards[state, action] = pay.get((state, action), 0.0)
    return ArrayMDP(jnp.asarray(probs, jnp.float32), jnp.asarray(rewards, jnp.float32), goals=1)


@pytest.mark.parametrize(
    ("size", "states", "goals", "steps", "value"),
    [
        ((4, 3, 2, 2), 84, 6, 7, 87.35455),
        ((4, 3, 3, 3), 156, 3, 13, 76.39059),
        ((5, 3, 4, 4), 330, 3, 18, None),
        ((5, 4, 4, 4), 1180, 4, 24, None),
        ((6, 4, 4, 4), 1512, 8, 25, 56.34995),
        ((7, 5, 4, 4), 4820, 15, 27, None),
    ],
)
def test_optimum_of_the_magnet_arm(size, states, goals, steps, value) -> None:
    arm = MagnetArm(*size)
    best = optimum(arm)
    assert (best.states, best.goals) == (states, goals)
    assert best.optimal_steps == pytest.approx(steps, abs=1e-9)
    assert best.optimal_return == pytest.approx(100 - steps, abs=1e-9)
    # In a deterministic world the return after n steps has a closed form.
    closed_form = 100 * 0.99 ** (steps - 1) - (1 - 0.99**steps) / 0.01
    assert best.discounted_value == pytest.approx(closed_form, abs=1e-6)
    if value is not None:
        assert best.discounted_value == pytest.approx(value, abs=1e-5)


@pytest.mark.parametrize(("seed", "goals"), [(0, 0), (1, 0), (2, 2)])
def test_value_iteration_finds_the_best_of_all_deterministic_policies(seed: int, goals: int) -> None:
    tables = random_tables(seed, goals)
    probs, rewards = dense(tables)
    policies = np.array(list(itertools.product(range(NUM_ACTIONS), repeat=NUM_STATES)))
    states = np.arange(NUM_STATES)
    values = np.linalg.solve(np.eye(NUM_STATES) - 0.9 * probs[states, policies], rewards[states, policies][..., None])
    best = values[..., 0].max(axis=0)
    solution = value_iteration(tables, 0.9, tolerance=1e-10)
    np.testing.assert_allclose(solution.values, best, atol=1e-10)
    np.testing.assert_allclose(solution.action_values, rewards + 0.9 * probs @ best, atol=1e-10)
    np.testing.assert_allclose(evaluate_policy(tables, greedy_choices(solution.action_values), 0.9), best, atol=1e-10)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5])
def test_values_are_within_the_tolerance(tolerance: float) -> None:
    tables = random_tables(seed=5)
    rough, fine = value_iteration(tables, 0.95, tolerance), value_iteration(tables, 0.95, 1e-12)
    assert 0 < np.abs(rough.values - fine.values).max() <= tolerance
    assert rough.sweeps < fine.sweeps


@settings(max_examples=30)
@given(seed=seeds, discount=st.sampled_from([0.0, 0.5, 0.95]))
def test_policy_evaluation_is_the_dense_solution(seed: int, discount: float) -> None:
    tables = random_tables(seed, goals=1)
    probs, rewards = dense(tables)
    policy = np.random.default_rng(seed).dirichlet(np.ones(NUM_ACTIONS), size=NUM_STATES)
    chain = np.einsum("sa,sax->sx", policy, probs)
    expected = np.linalg.solve(np.eye(NUM_STATES) - discount * chain, (policy * rewards).sum(axis=1))
    np.testing.assert_allclose(evaluate_policy(tables, policy, discount), expected, atol=1e-10)


def test_expected_steps_are_those_of_a_long_simulation() -> None:
    tables = random_tables(seed=4, goals=1)
    probs, _ = dense(tables)
    policy = np.full((NUM_STATES, NUM_ACTIONS), 1 / NUM_ACTIONS)
    chain, alive = np.einsum("sa,sax->sx", policy, probs), (~tables.terminal).astype(float)
    steps, running = np.zeros(NUM_STATES), np.eye(NUM_STATES)
    for _ in range(3000):
        steps += running @ alive
        running = running @ chain
    assert running.max() < 1e-12
    np.testing.assert_allclose(expected_steps(tables, policy), steps, rtol=1e-9)
    assert steps.max() > 2


def test_without_a_discount_a_state_that_may_never_end_is_worth_minus_infinity() -> None:
    # 0 is a gamble between the goal 3 and the trap 2, or a safe way over 1, which ends after two steps on average.
    moves = {(0, 0): {2: 0.5, 3: 0.5}, (0, 1): {1: 1.0}, (1, 0): {0: 1.0}, (1, 1): {1: 0.5, 3: 0.5}}
    pay = {(state, action): -1.0 for state in range(3) for action in range(2)}
    tables = tabulate(small_world(moves, pay, size=4))
    number_of = np.argsort(tables.space.states)

    solution = value_iteration(tables, 1.0)
    np.testing.assert_allclose(solution.values[number_of], [-3, -2, -np.inf, 0])
    np.testing.assert_allclose(solution.action_values[number_of][:2], [[-np.inf, -3], [-4, -2]])
    np.testing.assert_array_equal(
        optimal_choices(solution.action_values)[number_of][:3], [[False, True], [False, True], [False, False]]
    )

    gamble = np.array([0, 1, 0, 0])[tables.space.states]
    np.testing.assert_allclose(expected_steps(tables, gamble)[number_of], [np.inf, 2, np.inf, 0])
    assert evaluate_policy(tables, gamble, 1.0)[number_of][0] == -np.inf
    # With a discount, all of it is finite: the trap costs 1 / (1 - 0.5).
    assert evaluate_policy(tables, gamble, 0.5)[number_of][2] == pytest.approx(-2)


def test_the_optimum_takes_no_free_detour() -> None:
    # Only the step from 1 to the goal pays; action 0 is first in order, free, and goes round for ever.
    world = small_world({(0, 1): {1: 1.0}, (1, 0): {0: 1.0}, (1, 1): {2: 1.0}}, {(1, 1): 1.0}, size=3)
    best = optimum(world, discount=0.5)
    assert best.optimal_return == pytest.approx(1)
    # Episodes begin in 0 or 1, with probability 1/2 each.
    assert best.optimal_steps == pytest.approx(1.5)
    assert best.discounted_value == pytest.approx(0.5 * 0.5 + 0.5 * 1)
    assert best.discount == 0.5


def test_optimal_steps_are_those_of_the_best_return_and_not_the_fewest() -> None:
    # From 0, one step to the goal costs 5, and two steps over 1 cost 2; episodes begin in 0 or 1.
    moves = {(0, 0): {2: 1.0}, (0, 1): {1: 1.0}, (1, 0): {2: 1.0}}
    best = optimum(small_world(moves, {(0, 0): -5.0, (0, 1): -1.0, (1, 0): -1.0, (1, 1): -1.0}, size=3))
    assert (best.optimal_return, best.optimal_steps) == (pytest.approx(-1.5), pytest.approx(1.5))


def test_an_endless_problem_has_no_optimal_steps() -> None:
    world = small_world({(0, 0): {1: 1.0}}, {(0, 0): -1.0, (0, 1): -1.0, (1, 0): -1.0, (1, 1): -1.0}, size=3)
    best = optimum(world)
    assert (best.optimal_steps, best.optimal_return) == (np.inf, -np.inf)
    assert best.discounted_value == pytest.approx(-100)


def test_a_cycle_with_a_gain_has_no_finite_optimum(monkeypatch) -> None:
    monkeypatch.setattr(solve, "MAX_UNDISCOUNTED_SWEEPS", 200)
    world = small_world({(0, 1): {2: 1.0}, (1, 1): {0: 1.0}}, {(0, 0): 1.0}, size=3)
    with pytest.raises(Unbounded, match="cycle of states pays"):
        value_iteration(tabulate(world), 1.0)
    best = optimum(world, discount=0.5)
    assert best.optimal_return == np.inf
    assert np.isnan(best.optimal_steps)
    # Episodes begin in 0 or 1; from either, the cycle at 0 pays 1 at each step, in 1 from the next step on.
    assert best.discounted_value == pytest.approx((2 + 1) / 2)


@pytest.mark.parametrize("discount", [-0.1, 1.1, float("nan")])
def test_a_discount_outside_the_unit_interval_is_refused(discount: float) -> None:
    tables = random_tables(seed=0)
    with pytest.raises(InvalidConfig, match="discount"):
        value_iteration(tables, discount)
    with pytest.raises(InvalidConfig, match="discount"):
        evaluate_policy(tables, np.zeros(NUM_STATES, dtype=int), discount)


def test_restricted_actions() -> None:
    tables = random_tables(seed=6)
    only_last = np.zeros((NUM_STATES, NUM_ACTIONS), dtype=bool)
    only_last[:, -1] = True
    restricted = value_iteration(tables, 0.9, allowed=only_last)
    np.testing.assert_allclose(
        restricted.values, evaluate_policy(tables, np.full(NUM_STATES, NUM_ACTIONS - 1), 0.9), atol=1e-8
    )
    assert np.all(restricted.action_values[:, :-1] == -np.inf)


def test_ties_go_to_the_first_choice() -> None:
    values = np.array([[1.0, 3.0, 3.0 + 1e-9], [2.0, -np.inf, 1.0], [-np.inf, -np.inf, -np.inf]])
    np.testing.assert_array_equal(greedy_choices(values), [1, 0, 0])
    np.testing.assert_array_equal(
        optimal_choices(values), [[False, True, True], [True, False, False], [False, False, False]]
    )
    np.testing.assert_array_equal(greedy_choices(values, tolerance=0.0), [2, 0, 0])
