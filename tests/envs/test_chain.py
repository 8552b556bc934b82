"""The chain against the gambler's ruin and the numbers known for it."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.chain import GREEN, LEFT, RED, RIGHT, Chain, ChainState
from lodestone.envs.state_space import reachable_states
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import evaluate_policy, optimum, value_iteration
from lodestone.planning.tables import Tables, tabulate


def right_with(tables: Tables, prob: float, after_the_visit: float) -> np.ndarray:
    """A policy that goes right with a probability before the visit to the far end and with another one after."""
    right = np.where(tables.space.states.visited, after_the_visit, prob)
    return np.stack([1 - right, right], axis=1)


def test_the_optimum_is_that_of_the_gamblers_ruin():
    found = optimum(Chain())
    # From 2, five steps from ruin to riches, one of them done.
    assert found.optimal_return == pytest.approx(1 / 5 * 1 + 4 / 5 * 0.01, abs=1e-7)
    # Before the visit 1 to 5, after it 1 to 6.
    assert (found.states, found.goals) == (11, 2)
    assert optimum(Chain(length=9, start=4)).optimal_return == pytest.approx(3 / 8 + 5 / 8 * 0.01, abs=1e-7)


@pytest.mark.parametrize(("discount", "value", "always_right"), [(0.99, 0.185318, 0.155619), (0.9, 0.068924, 0.027009)])
def test_values_with_a_discount(discount, value, always_right):
    assert optimum(Chain(), discount).discounted_value == pytest.approx(value, abs=1e-6)
    # Always right, but left at the far end.
    tables = tabulate(Chain())
    policy = np.where(tables.space.states.position == 6, LEFT, RIGHT)
    assert tables.initial_mean(evaluate_policy(tables, policy, discount)) == pytest.approx(always_right, abs=1e-6)


@pytest.mark.parametrize(("prob", "value"), [(1, 0.208), (0.95, 0.17047), (0.9, 0.13736), (0.5, 0.01818)])
def test_the_value_of_going_right_with_a_probability_until_the_visit(prob, value):
    tables = tabulate(Chain())
    for after_the_visit in (0.0, 0.5):
        policy = right_with(tables, prob, after_the_visit)
        assert tables.initial_mean(evaluate_policy(tables, policy, 1.0)) == pytest.approx(value, abs=5e-6)


def test_the_best_policy_goes_right_until_the_visit_and_then_left():
    tables = tabulate(Chain())
    best = value_iteration(tables, 0.99).action_values.argmax(axis=1)
    live = ~tables.terminal
    np.testing.assert_array_equal(best[live], np.where(tables.space.states.visited, LEFT, RIGHT)[live])


def test_right_may_stay_at_the_far_end_and_the_visit_is_remembered():
    chain, far = Chain(), ChainState(jnp.int32(5), jnp.bool_(False))
    far = chain.transition(far, jnp.int32(RIGHT), jnp.int32(0))
    assert (int(far.position), bool(far.visited)) == (6, True)
    for outcome, position in ((0, 6), (1, 5)):
        after = chain.transition(far, jnp.int32(RIGHT), jnp.int32(outcome))
        assert (int(after.position), bool(after.visited)) == (position, True)
    np.testing.assert_allclose(chain.outcome_probs(far, jnp.int32(RIGHT)), [0.5, 0.5])
    np.testing.assert_allclose(chain.outcome_probs(far, jnp.int32(LEFT)), [1, 0])


def test_the_agent_sees_every_difference_and_so_do_people():
    chain = Chain()
    states = jax.tree.map(jnp.asarray, reachable_states(chain).states)
    planes = np.asarray(jax.vmap(chain.observe)(states))
    assert planes.shape == (11, 1, 6, 2)
    _, _, position, visited = np.nonzero(planes)
    np.testing.assert_array_equal(position + 1, states.position)
    np.testing.assert_array_equal(visited, states.visited)
    for index in range(11):
        picture = chain.render(jax.tree.map(lambda leaf, index=index: leaf[index], states))
        _, columns = np.nonzero((picture == RED).all(axis=-1))
        assert {*(columns // 80 + 1).tolist()} == {int(states.position[index])}
        assert (picture == GREEN).all(axis=-1).any() == bool(states.visited[index])


@pytest.mark.parametrize("observation", ["planes", "index"])
def test_gymnasium_takes_it(observation):
    check_env(gymnasium.make("lodestone/Chain-v0", observation=observation).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"length": 1}, "length is 1, but must be from 2 to 10000"),
        ({"start": 1}, "start is 1, but must be from 2 to 6"),
        ({"start": 7}, "start is 7"),
        ({"right_success": 1.1}, "right_success is 1.1"),
        ({"small_reward": float("nan")}, "small_reward"),
        ({"observation": "rgb"}, "'rgb'"),
    ],
)
def test_bad_parameters_are_named(wrong, says):
    with pytest.raises(InvalidConfig, match=says):
        Chain(**wrong)
