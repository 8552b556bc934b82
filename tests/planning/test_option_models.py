from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Bool, Float
from random_mdp import (
    NUM_ACTIONS,
    NUM_STATES,
    RandomOptions,
    dense,
    random_mdp,
    random_options,
    random_tables,
    simulated_model,
)

from lodestone.envs.magnet_arm import LEFT, MAGNET_OFF, RIGHT, MagnetArm, go_down_task, lift_task
from lodestone.errors import InvalidConfig, LodestoneError, NoOptionAvailable
from lodestone.options.base import NO_CAP, Options, Primitives, Union
from lodestone.options.execution import Rules, draw_chance, start_actor, tick
from lodestone.options.magnet_arm import GO_DOWN, LIFT
from lodestone.options.scripted import Scripted
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import enumerated
from lodestone.planning.option_models import (
    OptionTables,
    check_available,
    evaluate_option_choices,
    evaluate_options,
    expected_decisions,
    expected_option_steps,
    fewest_decisions,
    option_models,
    option_value_iteration,
    tabulate_options,
)
from lodestone.planning.solve import greedy_choices, optimal_choices, value_iteration
from lodestone.planning.tables import Tables, tabulate
from lodestone.types import State, Transition

seeds = st.integers(0, 10_000)
caps = st.lists(st.sampled_from([NO_CAP, 1, 2, 5]), min_size=1, max_size=3).map(tuple)


class SomePrimitives(Options):
    """Some of six primitive actions as options of one step."""

    actions: tuple[int, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"action-{action}" for action in self.actions)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (1,) * len(self.actions)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return jnp.ones(len(self.actions), dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return jnp.eye(6)[jnp.asarray(self.actions)]

    def termination(self, state: State) -> Float[Array, " O"]:
        return jnp.ones(len(self.actions))


@cache
def arm_and_options(size: tuple[int, int, int, int]) -> tuple[Tables, OptionTables]:
    """The magnet arm with its six actions, go-down and lift."""
    arm = MagnetArm(*size)
    tables = tabulate(arm)
    options = Union((Primitives(arm.action_names), Scripted(arm, (GO_DOWN, LIFT))))
    return tables, tabulate_options(options, tables.space)


def random_problem(seed: int, caps: tuple[int, ...], goals: int = 1) -> tuple[Tables, OptionTables]:
    tables = random_tables(seed, goals)
    # Tabulated without the caps: each tuple of caps would be compiled anew.
    options = tabulate_options(random_options(seed, (NO_CAP,) * len(caps)), tables.space)
    return tables, options._replace(max_steps=caps)


# The magnet arm: SYSTEMS 1.1.

START_VALUES = {
    ((4, 3, 3, 3), False): [74.6267, 74.6267, 72.8804, 76.3906, 76.3906, 74.6267, 76.3906, 72.8804],
    ((4, 3, 3, 3), True): [74.6267, 74.6267, 72.8804, 76.3906, 76.3906, 74.6267, 76.3806, 72.7814],
    ((6, 4, 4, 4), False): [54.7865, 54.7865, 53.2386, 56.3500, 56.3500, 54.7865, 56.3500, 47.2004],
    ((6, 4, 4, 4), True): [54.7865, 54.7865, 53.2386, 56.3500, 56.3500, 54.7865, 56.2903, 46.8486],
}


@pytest.mark.parametrize(("size", "undiscounted"), START_VALUES)
def test_option_values_at_the_start(size, undiscounted) -> None:
    tables, options = arm_and_options(size)
    solution = option_value_iteration(tables, options, 0.99, undiscounted_option_reward=undiscounted)
    start = int(tables.initial_probs.argmax())
    np.testing.assert_allclose(solution.option_values[start], START_VALUES[size, undiscounted], atol=1e-4)


@pytest.mark.parametrize("size", [(4, 3, 2, 2), (4, 3, 3, 3), (6, 4, 4, 4)])
@pytest.mark.parametrize("discount", [0.99, 1.0])
def test_options_beside_the_primitives_change_no_optimal_value(size, discount) -> None:
    tables, options = arm_and_options(size)
    with_options = option_value_iteration(tables, options, discount).values
    without = value_iteration(tables, discount).values
    np.testing.assert_allclose(with_options, without, atol=1e-9)


@pytest.mark.parametrize(
    ("size", "decisions", "steps", "decisions_of_the_shortest"),
    [((4, 3, 2, 2), 4, 8, 6), ((4, 3, 3, 3), 7, 15, 9), ((6, 4, 4, 4), 12, 36, 21)],
)
def test_fewest_decisions(size, decisions, steps, decisions_of_the_shortest) -> None:
    tables, options = arm_and_options(size)
    start = int(tables.initial_probs.argmax())
    fewest = fewest_decisions(tables, options)
    assert fewest.values[start] == pytest.approx(-decisions)
    policy = greedy_choices(fewest.option_values)
    assert expected_decisions(tables, options, policy)[start] == pytest.approx(decisions)
    assert expected_option_steps(tables, options, policy)[start] == pytest.approx(steps)

    best = option_value_iteration(tables, options, 1.0)
    shortest = fewest_decisions(tables, options, allowed=optimal_choices(best.option_values))
    assert shortest.values[start] == pytest.approx(-decisions_of_the_shortest)


def test_fewest_decisions_with_the_options_that_are_optimal_for_their_tasks() -> None:
    """The table of SYSTEMS 1.1 was made with these: over an empty column they go sideways to a brick, the scripts
    do not, and with two bricks in three columns that saves one decision."""
    arm = MagnetArm(4, 3, 2, 2)
    tables = tabulate(arm)
    states = jax.tree.map(jnp.asarray, tables.space.states)
    rows, actions = np.arange(tables.num_states), jnp.arange(arm.num_actions)
    following = jax.tree.map(lambda leaf: jnp.asarray(leaf)[tables.successors[:, :, 0]], tables.space.states)
    policies, stops = [], []
    for task in (go_down_task(arm), lift_task(arm)):
        done = np.asarray(jax.vmap(task.terminal)(states))
        each_action = jax.vmap(task.reward, in_axes=(None, 0, 0))
        rewards = np.asarray(jax.vmap(each_action, in_axes=(0, None, 0))(states, actions, following), dtype=np.float64)
        as_task = tables._replace(
            successors=np.where(done[:, None, None], rows[:, None, None].astype(np.int32), tables.successors),
            rewards=np.where(done[:, None], 0.0, rewards)[:, :, None],
            terminal=done,
        )
        policies.append(np.eye(6)[greedy_choices(value_iteration(as_task, 0.99).action_values)])
        stops.append(done)
    primitives = tabulate_options(Primitives(arm.action_names), tables.space)
    options = OptionTables(
        names=(*primitives.names, "go-down", "lift"),
        initiation=np.concatenate([primitives.initiation, ~np.stack(stops)]),
        action_probs=np.concatenate([primitives.action_probs, policies]),
        termination=np.concatenate([primitives.termination, stops]),
        max_steps=(*primitives.max_steps, NO_CAP, NO_CAP),
    )
    start = int(tables.initial_probs.argmax())
    fewest = fewest_decisions(tables, options)
    assert fewest.values[start] == pytest.approx(-3)
    assert expected_option_steps(tables, options, greedy_choices(fewest.option_values))[start] == pytest.approx(8)
    best = option_value_iteration(tables, options, 1.0)
    shortest = fewest_decisions(tables, options, allowed=optimal_choices(best.option_values))
    assert shortest.values[start] == pytest.approx(-5)


@pytest.mark.parametrize(("size", "value", "steps"), [((4, 3, 3, 3), 72.8804, 15), ((6, 4, 4, 4), 39.9861, 36)])
def test_options_in_place_of_the_basic_actions(size, value, steps) -> None:
    arm, (tables, _) = MagnetArm(*size), arm_and_options(size)
    few = Union((SomePrimitives((LEFT, RIGHT, MAGNET_OFF)), Scripted(arm, (GO_DOWN, LIFT))))
    options = tabulate_options(few, tables.space)
    start = int(tables.initial_probs.argmax())
    assert option_value_iteration(tables, options, 0.99).values[start] == pytest.approx(value, abs=1e-4)
    assert option_value_iteration(tables, options, 1.0).values[start] == pytest.approx(100 - steps)


def test_scripts_do_what_running_them_step_by_step_does() -> None:
    tables, options = arm_and_options((6, 4, 4, 4))
    models = option_models(tables, options, 0.9)
    rng = np.random.default_rng(0)
    marks = rng.uniform(1, 2, size=tables.num_states)
    for option in (6, 7):
        may_start = np.flatnonzero(options.initiation[option] & ~tables.terminal)
        lengths = set()
        for first in rng.choice(may_start, size=200):
            state, total, elapsed = int(first), 0.0, 0
            while True:
                action = int(options.action_probs[option, state].argmax())
                total += 0.9**elapsed * tables.rewards[state, action, 0]
                state, elapsed = int(tables.successors[state, action, 0]), elapsed + 1
                if tables.terminal[state] or options.termination[option, state] == 1:
                    break
            lengths.add(elapsed)
            assert models[option].rewards[first] == pytest.approx(total, abs=1e-12)
            assert models[option].backup(marks)[first] == pytest.approx(0.9**elapsed * marks[state], abs=1e-12)
        assert len(lengths) > 3


# Random worlds and options.


@settings(max_examples=40)
@given(seed=seeds, caps=caps, goals=st.integers(0, 2), discount=st.sampled_from([0.5, 0.9]), undiscounted=st.booleans())
def test_models_are_what_following_the_distribution_gives(seed, caps, goals, discount, undiscounted) -> None:
    tables, options = random_problem(seed, caps, goals)
    models = option_models(tables, options, discount, undiscounted_option_reward=undiscounted)
    for option, model in enumerate(models):
        reward_discount = 1.0 if undiscounted else discount
        rewards, ended = simulated_model(tables, options, option, discount, reward_discount, horizon=900)
        live = ~tables.terminal
        np.testing.assert_allclose(model.rewards, rewards, atol=1e-9)
        np.testing.assert_allclose(model.backup(np.eye(NUM_STATES))[live], ended[live], atol=1e-9)


@pytest.mark.parametrize("caps", [(NO_CAP, NO_CAP, NO_CAP), (3, 1, NO_CAP)])
def test_models_are_what_running_the_options_gives(caps: tuple[int, ...]) -> None:
    """Oracle T1: 100,000 runs of each option by the executor, from one state, agree within 3 standard errors."""
    runs, start = 100_000, 1
    environment = random_mdp(seed=4, goals=1)
    tables, options = tabulate(environment), random_options(seed=4, caps=caps)
    world, numbered = enumerated(tables, environment.action_names), on_numbers(options, tables.space)
    models = option_models(tables, tabulate_options(options, tables.space), 0.9)

    @partial(jax.jit, static_argnums=1)
    def run_all(key: Array, option: int) -> Transition:
        def one(key: Array) -> Transition:
            def step(carry: tuple) -> tuple:
                key, actor, _ = carry
                key, tick_key = jax.random.split(key)
                actor, decision = tick(world, numbered, rules, draw_chance(tick_key), actor, jnp.int32(option))
                return key, actor, decision

            rules = Rules(discount=0.9)
            actor = start_actor(world, key)._replace(state=jnp.int32(start))
            return jax.lax.while_loop(lambda carry: ~carry[2].valid, step, step((key, actor, None)))[2].transition

        return jax.vmap(one)(jax.random.split(key, runs))

    for option, model in enumerate(models):
        transitions = jax.tree.map(np.asarray, run_all(jax.random.key(option), option))
        found = transitions.reward.astype(np.float64)
        assert abs(found.mean() - model.rewards[start]) < 3 * found.std() / np.sqrt(runs)
        # The executor's discount is 0 where the environment ended: that column of F is left out.
        ended = np.where(np.arange(NUM_STATES) == transitions.next_obs[:, None], transitions.discount[:, None], 0.0)
        exact = model.backup(np.eye(NUM_STATES))[start] * ~tables.terminal
        assert np.all(np.abs(ended.mean(axis=0) - exact) <= 3 * ended.std(axis=0) / np.sqrt(runs))


def test_call_cost_is_paid_once_a_call_and_not_for_primitives() -> None:
    tables, options = random_problem(seed=2, caps=(NO_CAP, 1, 4))
    free, charged = option_models(tables, options, 0.9), option_models(tables, options, 0.9, call_cost=0.25)
    cost = [model.rewards - other.rewards for model, other in zip(free, charged, strict=True)]
    live = ~tables.terminal
    np.testing.assert_allclose(cost, [0.25 * live, 0.0 * live, 0.25 * live], atol=1e-15)


@settings(max_examples=40)
@given(seed=seeds, caps=caps)
def test_a_backup_is_exactly_zero_where_the_option_cannot_stop(seed: int, caps: tuple[int, ...]) -> None:
    """The dead-end rule without a discount rests on this."""
    rng = np.random.default_rng(seed)
    tables, options = random_problem(seed, caps)
    probs = np.where(rng.random(tables.probs.shape) < 0.6, 0.0, tables.probs)
    probs[..., 0] += 1.0 - probs.sum(axis=2)
    termination = rng.choice([0.0, 0.2, 1.0], size=options.termination.shape).astype(np.float32)
    tables, options = tables._replace(probs=probs), options._replace(termination=termination)
    for option, model in enumerate(option_models(tables, options, 0.9)):
        matrix = model.backup(np.eye(NUM_STATES))
        _, ended = simulated_model(tables, options, option, 0.9, 0.9, horizon=60)
        live = ~tables.terminal
        assert matrix.min() >= 0.0
        np.testing.assert_array_equal(matrix[live] > 0, ended[live] > 0)


@settings(max_examples=30)
@given(seed=seeds, goals=st.integers(0, 1))
def test_intra_option_value_iteration_has_the_same_fixed_point(seed: int, goals: int) -> None:
    """Oracle T2: Q(s, o) = sum_a pi_o(a|s) [r + gamma U(s', o)], U = (1 - beta) Q + beta max over available."""
    tables, options = random_problem(seed, (NO_CAP,) * 3, goals)
    probs, rewards = dense(tables)
    acts = options.action_probs / options.action_probs.sum(axis=2, keepdims=True, dtype=np.float64)
    starts = options.initiation | (np.arange(3)[:, None] == 0)
    options, live = options._replace(initiation=starts), ~tables.terminal
    stops = options.termination.astype(np.float64)
    values = np.zeros((3, NUM_STATES))
    for _ in range(400):
        best = np.where(starts, values, -np.inf).max(axis=0)
        arriving = live * ((1 - stops) * values + stops * best)
        values = np.einsum("osa,sa->os", acts, rewards) + 0.9 * np.einsum("osa,sax,ox->os", acts, probs, arriving)
    solution = option_value_iteration(tables, options, 0.9, tolerance=1e-12)
    np.testing.assert_allclose(solution.option_values.T[starts & live], values[starts & live], atol=1e-10)
    assert np.all(solution.option_values.T[~starts] == -np.inf)
    np.testing.assert_allclose(solution.values, live * np.where(starts, values, -np.inf).max(axis=0), atol=1e-10)


@settings(max_examples=30)
@given(seed=seeds, caps=caps, undiscounted=st.booleans())
def test_value_iteration_on_dense_models_has_the_same_fixed_point(seed, caps, undiscounted) -> None:
    """Q(s, o) = R_o(s) + sum_x F_o(s, x) max over available o' of Q(x, o'), with R and F by simulation."""
    tables, options = random_problem(seed, caps)
    starts = options.initiation | (np.arange(len(caps))[:, None] == 0)
    options, live = options._replace(initiation=starts), ~tables.terminal
    models = [simulated_model(tables, options, one, 0.9, 1.0 if undiscounted else 0.9, 900) for one in range(len(caps))]
    values = np.zeros(NUM_STATES)
    for _ in range(400):
        option_values = np.stack([rewards + ended @ values for rewards, ended in models])
        values = live * np.where(starts, option_values, -np.inf).max(axis=0)
    solution = option_value_iteration(tables, options, 0.9, undiscounted_option_reward=undiscounted, tolerance=1e-11)
    np.testing.assert_allclose(solution.values, values, atol=1e-9)
    np.testing.assert_allclose(solution.option_values.T[starts & live], option_values[starts & live], atol=1e-9)


@settings(max_examples=30)
@given(seed=seeds, caps=caps)
def test_random_options_beside_the_primitives_change_no_optimal_value(seed: int, caps: tuple[int, ...]) -> None:
    """Oracle T5; and every switch that is not the definition does change it."""
    tables = random_tables(seed, goals=1)
    names = tuple(f"action-{action}" for action in range(NUM_ACTIONS))
    both = Union((Primitives(names), random_options(seed, (NO_CAP,) * len(caps))))
    options = tabulate_options(both, tables.space)._replace(max_steps=(1,) * NUM_ACTIONS + caps)
    optimal = value_iteration(tables, 0.9)
    solution = option_value_iteration(tables, options, 0.9)
    np.testing.assert_allclose(solution.values, optimal.values, atol=2e-9)
    np.testing.assert_allclose(solution.option_values[:, :NUM_ACTIONS], optimal.action_values, atol=2e-9)
    # No option is so bad that a call is not worth so much.
    paid_to_call = option_value_iteration(tables, options, 0.9, call_cost=-100.0)
    calls = options.initiation & (np.array(options.max_steps)[:, None] != 1) & ~tables.terminal
    assert (paid_to_call.values > optimal.values + 1.0).any() == calls.any()


@settings(max_examples=40)
@given(seed=seeds, caps=caps, discount=st.sampled_from([0.5, 0.9]), undiscounted=st.booleans())
def test_policy_over_options_is_worth_what_its_dense_model_says(seed, caps, discount, undiscounted) -> None:
    tables, options = random_problem(seed, caps)
    options = options._replace(initiation=options.initiation | (np.arange(len(caps))[:, None] == 0))
    policy = np.random.default_rng(seed).dirichlet(np.ones(len(caps)), size=NUM_STATES) * options.initiation.T
    policy /= policy.sum(axis=1, keepdims=True)
    policy[tables.terminal] = 0.0
    pay, chain = np.zeros(NUM_STATES), np.zeros((NUM_STATES, NUM_STATES))
    for option in range(len(caps)):
        reward_discount = 1.0 if undiscounted else discount
        rewards, ended = simulated_model(tables, options, option, discount, reward_discount, horizon=900)
        chain += policy[:, option, None] * ended
        pay += policy[:, option] * (rewards - 0.1 * (caps[option] != 1))
    expected = np.linalg.solve(np.eye(NUM_STATES) - chain, pay)
    values = evaluate_options(tables, options, policy, discount, undiscounted_option_reward=undiscounted, call_cost=0.1)
    np.testing.assert_allclose(values, expected, atol=1e-9)


@settings(max_examples=40)
@given(seed=seeds, caps=caps, discount=st.sampled_from([0.5, 0.9]), undiscounted=st.booleans())
def test_each_choice_is_worth_its_dense_model_and_then_the_policy(seed, caps, discount, undiscounted) -> None:
    """Q [S, O] of a policy, of options that may not start too; its mean under the policy is V."""
    tables, options = random_problem(seed, caps)
    options = options._replace(initiation=options.initiation | (np.arange(len(caps))[:, None] == 0))
    policy = np.random.default_rng(seed).dirichlet(np.ones(len(caps)), size=NUM_STATES) * options.initiation.T
    policy /= policy.sum(axis=1, keepdims=True)
    switches = {"undiscounted_option_reward": undiscounted, "call_cost": 0.1}
    values = evaluate_options(tables, options, policy, discount, **switches)
    option_values = evaluate_option_choices(tables, options, policy, discount, **switches)
    for option in range(len(caps)):
        reward_discount = 1.0 if undiscounted else discount
        rewards, ended = simulated_model(tables, options, option, discount, reward_discount, horizon=900)
        rewards = rewards - 0.1 * (caps[option] != 1) * ~tables.terminal
        np.testing.assert_allclose(option_values[:, option], rewards + ended @ values, atol=1e-9)
    live = ~tables.terminal
    np.testing.assert_allclose((policy * option_values).sum(axis=1)[live], values[live], atol=1e-9)
    np.testing.assert_array_equal(option_values[~live], 0.0)


@pytest.mark.parametrize("discount", [0.9, 1.0])
@pytest.mark.parametrize("caps", [(NO_CAP, NO_CAP, NO_CAP), (1, 4, NO_CAP)])
def test_greedy_options_earn_the_optimal_values(discount: float, caps: tuple[int, ...]) -> None:
    tables, options = random_problem(11, caps)
    tables = tables._replace(rewards=np.where(tables.terminal[:, None, None], 0.0, tables.rewards - 4.0))
    options = options._replace(initiation=options.initiation | (np.arange(3)[:, None] == 0))
    solution = option_value_iteration(tables, options, discount, tolerance=1e-11)
    policy = greedy_choices(solution.option_values)
    assert np.isfinite(solution.values).all()
    assert len(set(policy[~tables.terminal])) > 1
    np.testing.assert_allclose(evaluate_options(tables, options, policy, discount), solution.values, atol=1e-7)


def test_decisions_and_steps_of_a_random_policy() -> None:
    tables, options = random_problem(5, (NO_CAP, 3, 1))
    options = options._replace(initiation=np.ones((3, NUM_STATES), dtype=bool))
    policy = np.full((NUM_STATES, 3), 1 / 3)
    chain, steps = np.zeros((NUM_STATES, NUM_STATES)), np.zeros(NUM_STATES)
    for option in range(3):
        lengths, ended = simulated_model(tables.with_step_reward(1.0), options, option, 1.0, 1.0, horizon=900)
        chain, steps = chain + ended / 3, steps + lengths / 3
    live = (~tables.terminal).astype(float)
    fundamental = np.linalg.inv(np.eye(NUM_STATES) - chain)
    np.testing.assert_allclose(expected_decisions(tables, options, policy), fundamental @ live, rtol=1e-9)
    np.testing.assert_allclose(expected_option_steps(tables, options, policy), fundamental @ steps, rtol=1e-9)


# What has no answer.


def corridor(loops: bool) -> tuple[Tables, OptionTables]:
    """States 0, 1 and the goal 2; action 0 stays, 1 moves on. The option `waits` in 0 and moves on from 1."""
    base = random_tables(seed=0, goals=1)
    probs = np.zeros((3, 2, 3))
    probs[0, 0, 0] = probs[0, 1, 1] = probs[1, 0, 1] = probs[1, 1, 2] = probs[2, :, 2] = 1.0
    successors = np.tile(np.arange(3, dtype=np.int32), (3, 2, 1))
    rewards = np.where(np.arange(3)[:, None, None] < 2, -1.0, 0.0) * np.ones((3, 2, 3))
    terminal = np.array([False, False, True])
    tables = Tables(base.space, successors, probs, rewards, terminal, np.array([1.0, 0.0, 0.0]))
    options = OptionTables(
        names=("on", "waits"),
        initiation=np.array([[True, True, False], [loops, True, False]]),
        action_probs=np.array([[[0, 1]] * 3, [[1, 0], [0, 1], [1, 0]]], dtype=np.float32),
        termination=np.zeros((2, 3), dtype=np.float32),
        max_steps=(1, NO_CAP),
    )
    return tables, options


def test_an_option_that_never_stops_is_worth_minus_infinity_without_a_discount() -> None:
    tables, options = corridor(loops=True)
    solution = option_value_iteration(tables, options, 1.0)
    np.testing.assert_allclose(solution.values, [-2, -1, 0])
    np.testing.assert_allclose(solution.option_values[:2], [[-2, -np.inf], [-1, -1]])
    np.testing.assert_allclose(fewest_decisions(tables, options).values, [-2, -1, 0])

    waiting = np.array([1, 1, 0])
    np.testing.assert_allclose(evaluate_options(tables, options, waiting, 1.0), [-np.inf, -1, 0])
    np.testing.assert_allclose(expected_option_steps(tables, options, waiting), [np.inf, 1, 0])
    np.testing.assert_allclose(expected_decisions(tables, options, waiting), [np.inf, 1, 0])
    # With a discount it is worth -1 / (1 - 0.9).
    np.testing.assert_allclose(evaluate_options(tables, options, waiting, 0.9), [-10, -1, 0])


def test_a_choice_before_a_policy_that_never_ends_is_worth_minus_infinity_without_a_discount() -> None:
    tables, options = corridor(loops=True)
    probs, acts = tables.probs.copy(), options.action_probs.copy()
    probs[1, 0] = [1, 0, 0]  # action 0 leads back from 1 to 0,
    acts[0, 1] = [1, 0]  # where the option `on` takes it
    tables, options = tables._replace(probs=probs), options._replace(action_probs=acts)
    found = evaluate_option_choices(tables, options, np.array([1, 1, 0]), 1.0)
    np.testing.assert_allclose(found, [[-2, -np.inf], [-np.inf, -1], [0, 0]])


def test_only_dead_ends_are_left_with_minus_infinity() -> None:
    tables, options = corridor(loops=True)
    only_waits = np.array([[False, True], [True, True], [True, True]])
    solution = option_value_iteration(tables, options, 1.0, allowed=only_waits)
    np.testing.assert_allclose(solution.values, [-np.inf, -1, 0])


def test_an_undiscounted_reward_that_is_not_finite_is_refused() -> None:
    tables, options = corridor(loops=True)
    with pytest.raises(LodestoneError, match="'waits'"):
        option_models(tables, options, 0.9, undiscounted_option_reward=True)
    # Where it may not start, it does no harm.
    tables, options = corridor(loops=False)
    solution = option_value_iteration(tables, options, 0.9, undiscounted_option_reward=True)
    np.testing.assert_allclose(solution.values, [-1.9, -1, 0])
    # Nor with a cap on its steps.
    tables, options = corridor(loops=True)
    models = option_models(tables, options._replace(max_steps=(1, 7)), 0.9, undiscounted_option_reward=True)
    np.testing.assert_allclose(models[1].rewards, [-7, -1, 0])


def test_a_state_without_options_is_named() -> None:
    arm, (tables, _) = MagnetArm(4, 3, 3, 3), arm_and_options((4, 3, 3, 3))
    alone = tabulate_options(Scripted(arm, (GO_DOWN,)), tables.space)
    with pytest.raises(NoOptionAvailable, match=r"reachable states, the first of which is bricks=\[1, 1, 1\], row=2"):
        check_available(tables, alone)
    with pytest.raises(NoOptionAvailable):
        option_value_iteration(tables, alone, 0.9)
    with pytest.raises(NoOptionAvailable):
        fewest_decisions(tables, alone)
    # A terminal state needs none.
    check_available(*corridor(loops=False))


def test_what_makes_no_sense_is_refused() -> None:
    tables, options = corridor(loops=False)
    with pytest.raises(LodestoneError, match="may not start"):
        evaluate_options(tables, options, np.array([1, 1, 0]), 0.9)
    with pytest.raises(InvalidConfig, match="discount"):
        option_models(tables, options, 1.5)
    with pytest.raises(LodestoneError, match="action probabilities of option 'on'"):
        option_models(tables, options._replace(action_probs=options.action_probs * np.float32(0.5)), 0.9)


def test_options_are_tabulated_in_the_order_of_the_states() -> None:
    tables = random_tables(seed=0, goals=1)
    options: RandomOptions = random_options(seed=8, caps=(3, NO_CAP))
    tabulated = tabulate_options(options, tables.space)
    states = np.asarray(tables.space.states)
    np.testing.assert_array_equal(tabulated.initiation, np.asarray(options.start)[states].T)
    np.testing.assert_array_equal(tabulated.action_probs, np.asarray(options.acts)[states].swapaxes(0, 1))
    np.testing.assert_array_equal(tabulated.termination, np.asarray(options.stops)[states].T)
    assert (tabulated.max_steps, tabulated.names, tabulated.size) == ((3, NO_CAP), ("option-0", "option-1"), 2)
