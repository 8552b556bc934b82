"""Taxi against Gymnasium's own table of transitions, and against known optima of each convention."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.state_space import reachable_states
from lodestone.envs.taxi import (
    ABOARD,
    DELIVERED,
    EAST,
    LANDMARKS,
    NORTH,
    PICKUP,
    PUTDOWN,
    SOUTH,
    TAXI_COLOUR,
    Taxi,
    TaxiState,
)
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate


def at(row: int, column: int, passenger: int, destination: int, may_change: bool = False) -> TaxiState:
    numbers = (jnp.int8(number) for number in (row, column, passenger, destination))
    return TaxiState(*numbers, may_change=jnp.bool_(may_change))


def numbers_of(state: TaxiState) -> list:
    return [leaf.tolist() for leaf in state]


def distribution(taxi: Taxi, state: TaxiState, action: int) -> dict[tuple, float]:
    """Probability of each next state, by its numbers."""
    found: dict[tuple, float] = {}
    probs = np.asarray(taxi.outcome_probs(state, jnp.int32(action)), dtype=np.float64)
    for outcome, prob in enumerate(probs):
        after = tuple(numbers_of(taxi.transition(state, jnp.int32(action), jnp.int32(outcome))))
        found[after] = found.get(after, 0.0) + prob
    return {after: pytest.approx(prob, abs=1e-6) for after, prob in found.items() if prob > 0}


def test_every_transition_of_gymnasium():
    taxi, theirs = Taxi(), TaxiEnv()
    each = np.array([(*theirs.decode(number), action) for number in range(500) for action in range(6)], dtype=np.int32)
    states = TaxiState(*jnp.asarray(each[:, :4].T.astype(np.int8)), may_change=jnp.zeros(len(each), dtype=bool))
    actions = jnp.asarray(each[:, 4])
    following = jax.vmap(taxi.transition, in_axes=(0, 0, None))(states, actions, jnp.int32(0))
    rewards = jax.vmap(taxi.reward)(states, actions, following)
    terminal = jax.vmap(taxi.terminal)(following)

    known = [theirs.P[theirs.encode(*row[:4])][row[4]][0] for row in each.tolist()]
    _, numbers, expected_rewards, ends = map(np.array, zip(*known, strict=True))
    expected = np.array([theirs.decode(number) for number in numbers])
    expected[ends.astype(bool), 2] = DELIVERED
    np.testing.assert_array_equal(np.stack(following[:4], axis=1), expected)
    np.testing.assert_array_equal(rewards, expected_rewards)
    np.testing.assert_array_equal(terminal, ends)


@pytest.mark.parametrize(
    ("parameters", "states", "mean", "lowest", "highest"),
    [
        ({}, 404, 7.93, 3, 15),
        ({"rewards": "jair"}, 404, 6.93, 2, 14),
        ({"starts": "any"}, 504, 9.555, 3, 19),
        ({"move_success": 0.8}, 404, 3.954575, None, None),
        ({"move_success": 0.8, "rewards": "jair"}, 404, 2.954575, None, None),
    ],
)
def test_the_optimal_returns(parameters, states, mean, lowest, highest):
    tables = tabulate(Taxi(**parameters))
    values = value_iteration(tables, discount=1.0).values
    begins = values[tables.initial_probs > 0]
    assert tables.num_states == states
    assert len(begins) == (400 if "starts" in parameters else 300)
    assert begins.mean() == pytest.approx(mean, abs=1e-5)
    if lowest is not None:
        assert (begins.min(), begins.max()) == (pytest.approx(lowest), pytest.approx(highest))


def test_the_optimum_with_a_discount():
    assert optimum(Taxi(), discount=0.99).discounted_value == pytest.approx(6.327464, abs=1e-6)


def test_what_is_illegal_depends_on_the_convention():
    aboard_at_green, waiting_at_red = at(0, 4, ABOARD, 0), at(0, 4, 0, 1)
    for rewards, passenger, reward in (("gym", 1, -1), ("jair", ABOARD, -10)):
        taxi = Taxi(rewards)
        after = taxi.transition(aboard_at_green, jnp.int32(PUTDOWN), jnp.int32(0))
        assert int(after.passenger) == passenger
        assert float(taxi.reward(aboard_at_green, jnp.int32(PUTDOWN), after)) == reward
        for action in (PICKUP, PUTDOWN):
            after = taxi.transition(waiting_at_red, jnp.int32(action), jnp.int32(0))
            assert numbers_of(after) == numbers_of(waiting_at_red)
            assert float(taxi.reward(waiting_at_red, jnp.int32(action), after)) == -10


def test_a_move_slips_to_both_sides_and_walls_hold():
    taxi = Taxi(move_success=0.8)
    assert distribution(taxi, at(0, 1, 2, 3), SOUTH) == {
        (1, 1, 2, 3, False): 0.8,
        (0, 0, 2, 3, False): 0.1,
        (0, 1, 2, 3, False): 0.1,
    }
    assert distribution(taxi, at(3, 0, 2, 3), EAST) == {
        (3, 0, 2, 3, False): 0.8,
        (2, 0, 2, 3, False): 0.1,
        (4, 0, 2, 3, False): 0.1,
    }
    assert distribution(taxi, at(4, 0, 2, 3), PICKUP) == {(4, 0, ABOARD, 3, False): 1}


def test_a_fickle_passenger_may_change_his_mind_once_after_the_pickup():
    taxi = Taxi(fickle=0.3)
    assert distribution(taxi, at(4, 0, 2, 3), PICKUP) == {(4, 0, ABOARD, 3, True): 1}
    assert distribution(taxi, at(4, 0, ABOARD, 3, True), NORTH) == {
        (3, 0, ABOARD, 3, False): 0.7,
        **{(3, 0, ABOARD, other, False): 0.1 for other in range(3)},
    }
    assert distribution(taxi, at(3, 0, ABOARD, 3), NORTH) == {(2, 0, ABOARD, 3, False): 1}
    # Set down at once, at a landmark that is not where he wants to go.
    assert distribution(taxi, at(4, 0, ABOARD, 3, True), PUTDOWN) == {(4, 0, 2, 3, False): 1}


def test_only_a_fickle_passenger_adds_states():
    assert not reachable_states(Taxi()).states.may_change.any()
    # At each of four landmarks he may have been picked up just now, with one of the other three as his destination;
    # set down at once and picked up again, he may want to go to where he is.
    assert reachable_states(Taxi(fickle=0.3)).states.may_change.sum() == 16


@pytest.mark.parametrize("parameters", [{}, {"starts": "any", "fickle": 0.3, "move_success": 0.8}])
def test_the_agent_sees_every_difference(parameters):
    taxi = Taxi(**parameters)
    states = jax.tree.map(jnp.asarray, reachable_states(taxi).states)
    planes = np.asarray(jax.vmap(taxi.observe)(states))
    assert planes.shape == (len(states.row), 5, 5, 4 if not parameters else 5)
    assert len(np.unique(planes.reshape(len(planes), -1), axis=0)) == len(planes)
    np.testing.assert_array_equal(planes[..., :2].sum(axis=(1, 2, 3)), 1)


def test_people_see_the_taxi_in_its_square_and_the_passenger_where_he_is():
    taxi = Taxi()
    side, frame = 72, 12
    for row, column in np.ndindex(5, 5):
        picture = taxi.render(at(row, column, 0, 1))
        rows, columns = np.nonzero((picture == TAXI_COLOUR).all(axis=-1))
        assert {*((rows - frame) // side).tolist()} == {row}
        assert {*((columns - frame) // side).tolist()} == {column}
    pictures = [taxi.render(at(2, 2, passenger, 1)) for passenger in range(5)]
    for passenger, (row, column) in enumerate([*LANDMARKS, (2, 2)]):
        differs = np.any([(pictures[passenger] != other).any(axis=-1) for other in pictures], axis=0)
        top, left = frame + row * side, frame + column * side
        assert differs[top : top + side, left : left + side].any()


@pytest.mark.parametrize("observation", ["planes", "index"])
def test_gymnasium_takes_it(observation):
    env = gymnasium.make("lodestone/Taxi-v0", observation=observation, move_success=0.8, fickle=0.3)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"rewards": "gymnasium"}, "'gymnasium', but must be 'gym' or 'jair'"),
        ({"starts": "all"}, "starts is 'all'"),
        ({"observation": "rgb"}, "observation is 'rgb'"),
        ({"move_success": 1.5}, "move_success is 1.5, but must be a probability"),
        ({"fickle": float("nan")}, "fickle is nan"),
    ],
)
def test_bad_parameters_are_named(wrong, says):
    with pytest.raises(InvalidConfig, match=says):
        Taxi(**wrong)
