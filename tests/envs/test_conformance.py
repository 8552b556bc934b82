"""What every environment of the registry must keep to, so that it can be compiled, enumerated, wrapped and drawn."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.base import Environment, example_state, sample_initial, sample_step
from lodestone.envs.chain import Chain
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.goal_maze import GoalMaze
from lodestone.envs.magnet_arm import MagnetArm, go_down_task, lift_task
from lodestone.envs.random_mdp import RandomMDP
from lodestone.envs.registry import ENVIRONMENTS
from lodestone.envs.state_space import reachable_states
from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.types import State

CASES = {
    **{name: cls() for name, cls in ENVIRONMENTS.items()},
    "magnet-arm, magnet not sticky, planes": MagnetArm(4, 3, 2, 2, sticky_magnet=False, observation="planes"),
    "magnet-arm, index": MagnetArm(observation="index"),
    "magnet-arm, go down": go_down_task(MagnetArm()),
    "magnet-arm, lift": lift_task(MagnetArm()),
    "four-rooms, deterministic": FourRooms("deterministic"),
    "four-rooms, text": FourRooms("text", goal=0),
    "four-rooms, code": FourRooms("code", observation="cell"),
    "taxi, all of its chance": Taxi("jair", move_success=0.8, fickle=0.3),
    "taxi, index": Taxi(fickle=0.3, starts="any", observation="index"),
    "corridor-maze, small": CorridorMaze(2, 3, width=2, length=4, maze_seed=1, observation="cell"),
    "corridor-maze, deterministic": CorridorMaze(1, 2, move_success=1.0, pixels_per_cell=2),
    "goal-maze, planes": GoalMaze(observation="planes"),
    "random-mdp, index": RandomMDP(mdp_seed=1, states=9, actions=2, goals=3, observation="index"),
    "chain, index": Chain(length=4, start=4, right_success=0.8, observation="index"),
    "two-rooms, cell": TwoRooms(observation="cell"),
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys(), scope="module")
def environment(request: pytest.FixtureRequest) -> Environment:
    return request.param


@pytest.fixture(scope="module")
def states(environment: Environment) -> State:
    """All that it can reach."""
    return jax.tree.map(jnp.asarray, reachable_states(environment).states)


def shapes(tree: object) -> list:
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), jax.tree.leaves(tree))


def one(states: State, index: int) -> State:
    return jax.tree.map(lambda leaf: leaf[index], states)


def test_names_and_outcomes(environment: Environment) -> None:
    assert environment.num_actions == len(set(environment.action_names)) > 0
    assert environment.num_outcomes >= 1


def test_initial_probabilities_sum_to_one(environment: Environment) -> None:
    probs, starts = environment.initial_distribution()
    assert {leaf.shape[0] for leaf in jax.tree.leaves(starts)} == {len(probs)}
    assert float(jnp.sum(probs)) == pytest.approx(1, abs=1e-5)
    assert bool(jnp.all(probs > 0))


def test_outcome_probabilities_sum_to_one(environment: Environment, states: State) -> None:
    each_action = jax.vmap(environment.outcome_probs, in_axes=(None, 0))
    probs = jax.vmap(each_action, in_axes=(0, None))(states, jnp.arange(environment.num_actions))
    assert probs.shape[1:] == (environment.num_actions, environment.num_outcomes)
    np.testing.assert_allclose(probs.sum(axis=-1), 1, atol=1e-5)
    assert bool(jnp.all(probs >= 0))


def test_a_transition_keeps_shapes_and_dtypes_so_that_one_compilation_serves(environment: Environment) -> None:
    compiled = []

    @jax.jit
    def step(environment: Environment, state: State, action: int, outcome: int) -> State:
        compiled.append(1)
        return environment.transition(state, action, outcome)

    state = example_state(environment)
    for action in range(environment.num_actions):
        after = step(environment, state, jnp.int32(action), jnp.int32(0))
        assert shapes(after) == shapes(state)
        assert jax.tree.structure(after) == jax.tree.structure(state)
        state = after
    assert len(compiled) == 1


def test_rewards_are_finite_floats_and_ends_are_bools(environment: Environment, states: State) -> None:
    @jax.jit
    @jax.vmap
    def every_step(state: State) -> tuple:
        def step(action: jax.Array, outcome: jax.Array) -> tuple:
            after = environment.transition(state, action, outcome)
            return environment.reward(state, action, after), environment.terminal(after)

        each_outcome = jax.vmap(step, in_axes=(None, 0))
        each_action = jax.vmap(each_outcome, in_axes=(0, None))
        return each_action(jnp.arange(environment.num_actions), jnp.arange(environment.num_outcomes))

    rewards, terminals = every_step(states)
    assert rewards.dtype == jnp.float32
    assert terminals.dtype == jnp.bool_
    assert bool(jnp.all(jnp.isfinite(rewards)))
    assert bool(jnp.any(terminals))


def test_the_sampler_draws_the_enumerated_successors(environment: Environment, states: State) -> None:
    """From random states, 200 draws each: only successors of positive probability, in about the right numbers."""
    space, draws, rng = reachable_states(environment), 200, np.random.default_rng(0)

    @eqx.filter_jit
    def numbers(state: State, action: jax.Array, key: jax.Array) -> tuple:
        keys = jax.random.split(key, draws)
        drawn = jax.vmap(lambda key: sample_step(environment, key, state, action).state)(keys)
        possible = jax.vmap(environment.transition, in_axes=(None, None, 0))(
            state, action, jnp.arange(environment.num_outcomes)
        )
        return jax.vmap(space.index_of)(drawn), jax.vmap(space.index_of)(possible)

    live = np.flatnonzero(~np.asarray(jax.vmap(environment.terminal)(states)))
    for index in rng.choice(live, size=min(12, len(live)), replace=False):
        state, action = one(states, int(index)), jnp.int32(rng.integers(environment.num_actions))
        drawn, possible = (np.asarray(value) for value in numbers(state, action, jax.random.key(int(index))))
        expected = np.zeros(space.size)
        np.add.at(expected, possible, np.asarray(environment.outcome_probs(state, action)))
        frequency = np.bincount(drawn, minlength=space.size) / draws
        assert np.all(expected[drawn] > 0)
        assert np.all(np.abs(frequency - expected) <= 6 * np.sqrt(expected * (1 - expected) / draws) + 1e-6)


def test_the_first_state_is_one_of_the_initial_ones(environment: Environment) -> None:
    space = reachable_states(environment)
    probs, _ = environment.initial_distribution()
    keys = jax.random.split(jax.random.key(0), 100)
    drawn = jax.jit(jax.vmap(lambda key: space.index_of(sample_initial(environment, key))))(keys)
    assert int(jnp.max(drawn)) < len(probs)


def test_observations_do_not_depend_on_the_batch(environment: Environment, states: State) -> None:
    observe = jax.jit(environment.observe)
    some = jax.tree.map(lambda leaf: leaf[:5], states)
    together = jax.jit(jax.vmap(environment.observe))(some)
    for index in range(5):
        np.testing.assert_array_equal(observe(one(some, index)), one(together, index))


def test_pictures_for_people(environment: Environment, states: State) -> None:
    picture = environment.render(jax.tree.map(np.asarray, one(states, -1)))
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[-1] == 3
    assert picture.std() > 0
    np.testing.assert_array_equal(picture, environment.render(one(states, -1)))


def test_it_can_be_hashed_and_compared(environment: Environment) -> None:
    """The compiled functions are found again by this."""
    copy = jax.tree.map(lambda leaf: leaf, environment)
    assert copy == environment
    assert hash(copy) == hash(environment)
