"""Random processes: the tables are what was drawn, and the optimum that of a dense solution."""

from __future__ import annotations

import itertools

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.random_mdp import GREEN, RED, NumberedState, RandomMDP
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate


def test_the_tables_are_what_was_drawn():
    mdp = RandomMDP(mdp_seed=3, states=5, actions=2, goals=2)
    rng = np.random.default_rng(3)
    probs = rng.dirichlet([0.4] * 5, size=(5, 2))
    rewards = rng.normal(size=(5, 2, 5))

    tables = tabulate(mdp)
    np.testing.assert_array_equal(tables.space.states.number, np.arange(5))
    np.testing.assert_array_equal(tables.terminal, [False, False, False, True, True])
    np.testing.assert_allclose(tables.initial_probs, [1 / 3] * 3 + [0] * 2)
    np.testing.assert_array_equal(tables.successors[:3], np.broadcast_to(np.arange(5), (3, 2, 5)))
    np.testing.assert_allclose(tables.probs[:3], probs[:3], atol=1e-6)
    np.testing.assert_allclose(tables.rewards[:3], rewards[:3], atol=1e-6)


def test_the_optimum_without_a_discount_is_that_of_the_best_policy():
    mdp = RandomMDP(mdp_seed=1, states=5)
    probs, rewards = (array[:4] for array in mdp.dynamics)
    pay = (probs * rewards).sum(axis=2)
    policies = np.array(list(itertools.product(range(3), repeat=4)))
    chains, pays = probs[np.arange(4), policies][..., :4], pay[np.arange(4), policies]
    values = np.linalg.solve(np.eye(4) - chains, pays[..., None])[..., 0]
    steps = np.linalg.solve(np.eye(4) - chains, np.ones((len(policies), 4, 1)))[..., 0]
    best = values.sum(axis=1).argmax()
    found = optimum(mdp)
    assert found.optimal_return == pytest.approx(values[best].mean(), rel=1e-5)
    assert found.optimal_steps == pytest.approx(steps[best].mean(), rel=1e-4)


def test_without_goals_it_goes_on_for_ever():
    mdp = RandomMDP(goals=0)
    assert not tabulate(mdp).terminal.any()
    assert (value_iteration(tabulate(mdp), 1.0).values == -np.inf).all()
    assert np.isfinite(optimum(mdp, discount=0.9).discounted_value)


def test_each_seed_is_a_process_of_its_own_and_equal_ones_are_one():
    assert RandomMDP(mdp_seed=1) == RandomMDP(mdp_seed=1)
    assert hash(RandomMDP(mdp_seed=1)) == hash(RandomMDP(mdp_seed=1))
    assert (RandomMDP(mdp_seed=1).dynamics[0] != RandomMDP(mdp_seed=2).dynamics[0]).all()
    # The smaller the concentration, the more a row is like one state.
    spread = [RandomMDP(states=20, concentration=value).dynamics[0].max(axis=2).mean() for value in (0.05, 0.4, 5.0)]
    assert spread[0] > spread[1] > spread[2]


def test_pictures_mark_the_current_state_and_the_ends():
    mdp = RandomMDP(states=5, goals=2)
    for number in range(5):
        picture = mdp.render(NumberedState(np.int32(number)))
        row, column = np.argwhere((picture == RED).all(axis=-1)).mean(axis=0)
        angle = np.arctan2(column - 180, 180 - row) % (2 * np.pi)
        assert round(angle / (2 * np.pi / 5)) % 5 == number
        assert (picture == GREEN).all(axis=-1).any()
        plane = np.asarray(mdp.observe(NumberedState(jnp.int32(number))))
        np.testing.assert_array_equal(plane, np.eye(5)[number][None, :, None])


@pytest.mark.parametrize("observation", ["planes", "index"])
def test_gymnasium_takes_it(observation):
    check_env(gymnasium.make("lodestone/RandomMDP-v0", observation=observation).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"mdp_seed": -1}, "mdp_seed is -1, but must be at least 0"),
        ({"states": 0}, "states is 0"),
        ({"goals": 7}, "goals is 7, but must be from 0 to 6"),
        ({"concentration": 0.0}, "concentration is 0.0, but must be a positive number"),
        ({"concentration": float("nan")}, "concentration is nan"),
        ({"observation": "rgb"}, "'rgb'"),
    ],
)
def test_bad_parameters_are_named(wrong, says):
    with pytest.raises(InvalidConfig, match=says):
        RandomMDP(**wrong)
