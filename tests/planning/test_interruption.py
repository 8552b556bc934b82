"""Interruption never loses value, and gets an agent through the house in fewer steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_mdp import NUM_ACTIONS, NUM_STATES, dense, random_options, random_tables

from lodestone.envs.four_rooms import NUMBER, FourRooms
from lodestone.envs.state_space import Numbers
from lodestone.errors import InvalidConfig
from lodestone.learning.evaluation import play_episode
from lodestone.options.base import NO_CAP, Capped, Primitives, Union
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import hallway_options
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import enumerated
from lodestone.planning.interruption import Interrupting, interrupted
from lodestone.planning.option_models import (
    OptionTables,
    evaluate_option_choices,
    evaluate_options,
    expected_option_steps,
    option_value_iteration,
    tabulate_options,
)
from lodestone.planning.solve import greedy_choices
from lodestone.planning.tables import Tables, tabulate

seeds = st.integers(0, 10_000)


def random_problem(seed: int, caps: tuple[int, ...], goals: int) -> tuple[Tables, OptionTables, np.ndarray]:
    """A process, options of which the first may start anywhere, and a random policy over those that may start."""
    tables = random_tables(seed, goals)
    options = tabulate_options(random_options(seed, (NO_CAP,) * len(caps)), tables.space)._replace(max_steps=caps)
    options = options._replace(initiation=options.initiation | (np.arange(len(caps))[:, None] == 0))
    policy = np.random.default_rng(seed).dirichlet(np.ones(len(caps)), size=NUM_STATES) * options.initiation.T
    return tables, options, policy / policy.sum(axis=1, keepdims=True)


def dense_interrupted_value(tables: Tables, options: OptionTables, policy: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """V of the policy where options stop besides in `stop` [O, S]: the chain over (state, running option), dense."""
    probs, rewards = dense(tables)
    acts = options.action_probs / options.action_probs.sum(axis=2, keepdims=True, dtype=np.float64)
    beta = np.where(stop, 1.0, options.termination.astype(np.float64))
    count = options.size
    step, pay = np.einsum("osa,sax->osx", acts, probs), np.einsum("osa,sa->os", acts, rewards)
    going_on = np.einsum("osx,ox,op->ospx", step, 1 - beta, np.eye(count))
    choosing = np.einsum("osx,ox,xp->ospx", step, beta, policy)
    size = count * NUM_STATES
    chain = (going_on + choosing).reshape(size, size)
    running = np.linalg.solve(np.eye(size) - 0.9 * chain, pay.ravel()).reshape(count, NUM_STATES)
    return np.einsum("so,os->s", policy, running)


@settings(max_examples=60)
@given(seed=seeds, goals=st.integers(0, 2), count=st.integers(1, 4), one_step=st.booleans())
def test_interruption_never_loses_value(seed: int, goals: int, count: int, one_step: bool) -> None:
    caps = (1 if one_step else NO_CAP,) + (NO_CAP,) * count
    tables, options, policy = random_problem(seed, caps, goals)
    values = evaluate_options(tables, options, policy, 0.9)
    option_values = evaluate_option_choices(tables, options, policy, 0.9)
    after = interrupted(options, option_values, values)
    better = evaluate_options(tables, after, policy, 0.9)
    assert (better - values).min() > -1e-10
    if not one_step:
        stop = values - 1e-12 > option_values.T
        np.testing.assert_allclose(better, dense_interrupted_value(tables, options, policy, stop), atol=1e-9)


def test_interruption_gains_in_most_random_problems() -> None:
    """Oracle T3: gains of whole units of a reward of variance 1."""
    gains = []
    for seed in range(8):
        tables, options, policy = random_problem(seed, (NO_CAP,) * 4, goals=0)
        greedy = greedy_choices(np.where(options.initiation.T, policy, -np.inf))
        values = evaluate_options(tables, options, greedy, 0.9)
        after = interrupted(options, evaluate_option_choices(tables, options, greedy, 0.9), values)
        gains.append(evaluate_options(tables, after, greedy, 0.9) - values)
    assert np.min(gains) > -1e-10
    assert sum(gain.max() > 0.01 for gain in gains) >= 6


@pytest.mark.parametrize(("dynamics", "goal"), [("deterministic", (9, 9)), ("sps", (9, 8))])
def test_interrupted_hallway_options_come_to_the_goal_in_fewer_steps(dynamics, goal) -> None:
    """The goal lies beside the way between two hallways; an option to either walks past it unless it is left."""
    rooms = FourRooms(dynamics, goal=int(NUMBER[goal]))
    tables = tabulate(rooms)
    hallways = hallway_options(rooms)
    options = tabulate_options(hallways, tables.space)
    policy = greedy_choices(option_value_iteration(tables, options, 0.9, tolerance=1e-12).option_values)
    values = evaluate_options(tables, options, policy, 0.9)
    option_values = evaluate_option_choices(tables, options, policy, 0.9)
    after = interrupted(options, option_values, values)
    before_steps = expected_option_steps(tables, options, policy)
    after_steps = expected_option_steps(tables, after, policy)
    assert tables.initial_mean(after_steps) < 0.95 * tables.initial_mean(before_steps)
    if dynamics == "deterministic":
        assert (after_steps <= before_steps + 1e-9).all()

    # The same while executing, by the wrapper, on numbered states.
    world, numbered = enumerated(tables, rooms.action_names), on_numbers(hallways, tables.space)
    table = jnp.asarray(option_values, dtype=jnp.float32)
    wrapped = Interrupting(numbered, Numbers(tables.num_states), table)
    preferences = jax.nn.one_hot(jnp.asarray(policy), options.size)
    episodes = 4000
    for chosen, expected in ((numbered, before_steps), (wrapped, after_steps)):

        @jax.jit
        @jax.vmap
        def play(key, chosen=chosen):
            return play_episode(world, chosen, Rules(), lambda state: preferences[state], key, 5000)

        played = play(jax.random.split(jax.random.key(1), episodes))
        assert bool(played.success.all())
        steps = np.asarray(played.steps)
        assert steps.mean() == pytest.approx(tables.initial_mean(expected), abs=4 * steps.std() / np.sqrt(episodes))


def test_the_wrapper_stops_where_the_tables_do() -> None:
    """Except where an option may not start, of which a learner knows nothing."""
    tables = random_tables(seed=3, goals=1)
    names = tuple(f"action-{action}" for action in range(NUM_ACTIONS))
    both = Union((Primitives(names), random_options(3)))
    options = tabulate_options(both, tables.space)
    solution = option_value_iteration(tables, options, 0.9)
    policy = greedy_choices(solution.option_values)
    option_values = evaluate_option_choices(tables, options, policy, 0.9)
    wanted = interrupted(options, option_values, evaluate_options(tables, options, policy, 0.9)).termination
    wrapped = Interrupting(both, tables.space, jnp.asarray(option_values, dtype=jnp.float32))
    found = tabulate_options(wrapped, tables.space)
    differs = ~options.initiation
    np.testing.assert_array_equal(found.termination[~differs], wanted[~differs])
    np.testing.assert_array_equal(found.termination[differs], options.termination[differs])
    assert (wanted != options.termination)[~differs].any()
    np.testing.assert_array_equal(found.initiation, options.initiation)
    np.testing.assert_array_equal(found.action_probs, options.action_probs)


def test_capped_options_are_refused() -> None:
    tables, options, _ = random_problem(0, (NO_CAP, 5), goals=1)
    values = np.zeros((NUM_STATES, 2))
    with pytest.raises(InvalidConfig, match="'option-1' is stopped after 5 steps"):
        interrupted(options, values, values[:, 0])
    with pytest.raises(InvalidConfig, match="cannot be interrupted"):
        Interrupting(Capped(random_options(0), 5), tables.space, jnp.zeros((NUM_STATES, 3)))
    with pytest.raises(InvalidConfig, match=r"shape \[7, 2\], but there are 7 states and 3 options"):
        Interrupting(random_options(0), tables.space, jnp.zeros((NUM_STATES, 2)))
