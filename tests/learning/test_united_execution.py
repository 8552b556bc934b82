"""Acting with a united network against the executor of options, and against a plain interpreter."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from united_corridor import CORRIDOR, LENGTH, OPTIONS

from lodestone.envs.magnet_arm import MagnetArm, go_down_task, lift_task
from lodestone.envs.state_space import reachable_states
from lodestone.learning.evaluation import play_episode, trace_episode
from lodestone.learning.networks import Linear, NetworkConfig, QNetwork
from lodestone.learning.united_execution import (
    UnitedActor,
    UnitedOptions,
    choices,
    explore,
    greedy_decision,
    play_united,
    start_united_actor,
    tick,
    trace_united,
)
from lodestone.learning.united_network import Outputs, UnitedNetwork, init_united_network
from lodestone.options import execution
from lodestone.options.execution import Chance, Rules
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate

FLAT = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(16,))


def tables_as_network(choice_values, action_values, ended) -> UnitedNetwork:
    """A united network over one-hot observations whose heads are given tables."""

    def head(table):
        table = jnp.asarray(table, jnp.float32)
        return QNetwork((), (Linear(table, jnp.zeros((*table.shape[:-2], table.shape[-1]))),))

    return UnitedNetwork(None, head(choice_values), head(action_values), head(np.stack([~ended, ended], axis=-1)))


class OneHot(MagnetArm):
    """The magnet arm that says which of its states it is in."""

    def observe(self, state):
        return jax.nn.one_hot(reachable_states(self).index_of(state), reachable_states(self).size)


@pytest.fixture(scope="module")
def exact():
    """4x3: every head exact, from the planner. The manager is random, so that all choices come about."""
    arm = OneHot(4, 3, 3, 3)
    space = reachable_states(arm)
    tasks = (go_down_task(arm), lift_task(arm))
    ended = np.stack([np.asarray(jax.vmap(task.terminal)(space.states)) for task in tasks])
    rng = np.random.default_rng(0)
    actions = rng.normal(size=(3, space.size, 6))
    return arm, tables_as_network(rng.normal(size=(space.size, 3)), actions, ended), space, ended, actions


def test_call_and_return_in_all_states_of_4x3(exact):
    """From each of the 156 states with each of the 3 choices running: what a plain interpreter does."""
    arm, network, space, ended, actions = exact
    rules, cap = Rules(discount=0.9), 5
    tables = tabulate(arm)
    manager = np.asarray(network.manager.layers[-1].weight).argmax(axis=1)
    look = jax.jit(jax.vmap(lambda state: network(arm.observe(state))))
    step = jax.jit(jax.vmap(partial(tick, arm, rules, cap)))
    start = jax.vmap(partial(start_united_actor, arm))(jax.random.split(jax.random.key(0), space.size))

    for choice in range(3):
        actor = start.actor._replace(
            state=space.states,
            deciding=jnp.zeros(space.size, bool),
            option=jnp.full(space.size, choice, jnp.int32),
            elapsed=jnp.ones(space.size, jnp.int32),
        )
        united = UnitedActor(actor, start.first_action)
        at, running, elapsed = np.arange(space.size), np.full(space.size, choice), np.ones(space.size, int)
        alive = np.ones(space.size, bool)
        for _ in range(12):
            alive &= ~tables.terminal[at]
            outputs = look(united.actor.state)
            united, brought = step(outputs, jax.vmap(greedy_decision)(outputs), jnp.zeros((space.size, 2)), united)
            for state in range(space.size):
                if not alive[state]:
                    continue
                option = running[state]
                stops = option == 0 or ended[option - 1, at[state]] or elapsed[state] >= cap
                if stops:
                    running[state], elapsed[state] = manager[at[state]], 0
                elapsed[state] += 1
                at[state] = tables.successors[at[state], actions[running[state], at[state]].argmax(), 0]
                assert bool(brought.decision.valid[state]) == stops
            np.testing.assert_array_equal(np.asarray(brought.choice)[alive], running[alive])
            np.testing.assert_array_equal(np.asarray(jax.vmap(space.index_of)(united.actor.state))[alive], at[alive])


@pytest.mark.parametrize(
    "rules",
    [
        Rules(discount=0.9),
        Rules(discount=0.9, step_limit=7),
        Rules(discount=0.9, decision_limit=3),
        Rules(discount=0.9, step_limit=7, bootstrap_at_limit=False, undiscounted_option_reward=True, call_cost=0.5),
        Rules(discount=0.9, discount_per_decision=True),
    ],
)
def test_the_same_decisions_as_the_executor_of_options(rules):
    """A random manager, random heads: transition by transition what `options.execution` records of the same options."""
    rng = np.random.default_rng(3)
    ended = rng.random((2, LENGTH)) < 0.3
    actions = rng.normal(size=(3, LENGTH, 2)) + np.array([0.0, 1.0])  # mostly to the right, where the end is
    network = tables_as_network(rng.normal(size=(LENGTH, 3)), actions, ended)
    options = UnitedOptions(CORRIDOR, network, choices(OPTIONS), option_cap=4)
    ticks = 300
    random_choices = jnp.asarray(rng.integers(0, 3, (ticks, LENGTH)), dtype=jnp.int32)

    def choose(state, number):
        """By the state and the number of the decision, so that both executors choose alike."""
        return random_choices[number % ticks, state]

    def of_options(carry, _):
        actor, count = carry
        actor, decision = execution.tick(
            CORRIDOR, options, rules, Chance(*[jnp.float32(0.5)] * 4), actor, choose(actor.state, count)
        )
        return (actor, count + decision.valid.astype(jnp.int32)), decision

    def of_network(carry, _):
        united, count = carry
        outputs = network(CORRIDOR.observe(united.actor.state))
        _, actions = greedy_decision(outputs)
        begun = ~united.actor.deciding
        # A decision that ends on this tick is counted before the next one is chosen.
        ends = tick(CORRIDOR, rules, 4, outputs, (jnp.int32(0), actions), jnp.zeros(2), united)[1].decision.valid
        count = count + (begun & ends).astype(jnp.int32)
        choice = choose(united.actor.state, count)
        united, brought = tick(CORRIDOR, rules, 4, outputs, (choice, actions), jnp.zeros(2), united)
        return (united, count), brought.decision

    start = start_united_actor(CORRIDOR, jax.random.key(0))
    _, wanted = jax.lax.scan(of_options, (start.actor, jnp.int32(0)), None, length=ticks)
    _, found = jax.lax.scan(of_network, (start, jnp.int32(0)), None, length=3 * ticks)
    wanted, found = (jax.tree.map(lambda leaf, one=one: leaf[one.valid], one) for one in (wanted, found))
    count = len(wanted.steps)
    assert count > 100
    assert bool(wanted.episode_ended.any())
    found = jax.tree.map(lambda leaf: leaf[:count], found)
    for name in ("transition", "steps", "episode_ended", "terminated", "episode_return", "episode_steps"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), getattr(wanted, name), getattr(found, name)
        )
    np.testing.assert_array_equal(wanted.episode_decisions, found.episode_decisions)


def test_playing_equals_playing_the_same_options():
    """The greedy episode of a random network, by both executors."""
    rules, seen = Rules(step_limit=40), 0
    for seed in range(4):
        network = init_united_network(FLAT, "hidden", (LENGTH,), 2, 2, jax.random.key(seed))
        options = UnitedOptions(CORRIDOR, network, choices(OPTIONS), option_cap=3)

        def values(state, network=network):
            return network(CORRIDOR.observe(state)).choices

        key = jax.random.key(0)
        wanted = play_episode(CORRIDOR, options, rules, values, key, 100)
        found = play_united(CORRIDOR, rules, 3, network, key, 100)
        assert jax.tree.map(float, wanted) == jax.tree.map(float, found)
        length = int(found.steps)
        a = trace_episode(CORRIDOR, options, rules, values, key, length)
        b = trace_united(CORRIDOR, rules, 3, network, key, length)
        assert bool(b.live.all())
        for name in ("state", "next_state", "option", "chosen", "action", "available"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_allclose(a.reward, b.reward)
        np.testing.assert_array_equal(a.termination > 0.5, b.termination > 0.5)
        seen += len(set(np.asarray(b.option).tolist())) > 1
    assert seen


def test_a_batch_is_its_samples_one_by_one():
    rng = np.random.default_rng(1)
    network = init_united_network(FLAT, "hidden", (LENGTH,), 2, 2, jax.random.key(0))
    rules, size = Rules(step_limit=5), 40
    actor = execution.Actor(
        state=jnp.asarray(rng.integers(0, LENGTH, size), jnp.int32),
        deciding=jnp.asarray(rng.random(size) < 0.3),
        start=jnp.zeros(size, jnp.int32),
        option=jnp.asarray(rng.integers(0, 3, size), jnp.int32),
        elapsed=jnp.asarray(rng.integers(1, 4, size), jnp.int32),
        reward=jnp.asarray(rng.normal(size=size), jnp.float32),
        discount=jnp.full(size, 0.5),
        episode_return=jnp.zeros(size),
        episode_steps=jnp.asarray(rng.integers(1, 6, size), jnp.int32),
        episode_decisions=jnp.ones(size, jnp.int32),
    )
    united = UnitedActor(actor, jnp.zeros(size, jnp.int32))

    def one(united):
        outputs = network(CORRIDOR.observe(united.actor.state))
        return tick(CORRIDOR, rules, 3, outputs, greedy_decision(outputs), jnp.full(2, 0.5), united)

    together = jax.vmap(one)(united)
    for index in range(size):
        alone = one(jax.tree.map(lambda leaf, index=index: leaf[index], united))
        jax.tree.map(lambda a, b, index=index: np.testing.assert_allclose(a[index], b, rtol=1e-5), together, alone)


def test_exploring_draws_actions_and_options_alike():
    outputs = Outputs(jnp.array([0.0, 1.0, 0.5]), jnp.array([[0.0, 2.0], [1.0, 0.0], [0.0, 1.0]]), jnp.zeros(2))
    points = jnp.array([0.125, 0.375, 0.625, 0.875])

    def draw(point, manager_acts, explores=0.0):
        return explore(outputs, jnp.stack([jnp.float32(explores), point]), jnp.float32(0.5), manager_acts)

    drawn = [draw(point, True) for point in points]
    assert [(int(choice), int(actions[0])) for choice, actions in drawn] == [(0, 0), (0, 1), (1, 1), (2, 1)]
    assert all(actions[1:].tolist() == [0, 1] for _, actions in drawn)  # options act greedily
    flat = [draw(point, False) for point in points]
    assert [(int(choice), int(actions[0])) for choice, actions in flat] == [(0, 0), (0, 0), (0, 1), (0, 1)]
    choice, actions = draw(points[0], True, explores=0.7)
    assert (int(choice), actions.tolist()) == (1, [1, 0, 1])
    assert int(draw(points[0], False, explores=0.7)[0]) == 0


def test_exact_heads_build_the_tower_in_the_fewest_steps():
    """With exact action values in the basic head and a manager that never calls an option."""
    arm = OneHot(4, 3, 3, 3)
    tables = tabulate(arm)
    solution = value_iteration(tables, 0.99)
    size = tables.num_states
    choice_values = np.tile([1.0, 0.0, 0.0], (size, 1))
    actions = np.stack([solution.action_values] * 3)
    network = tables_as_network(choice_values, actions, np.zeros((2, size), bool))
    episode = play_united(arm, Rules(), 21, network, jax.random.key(0), 100)
    assert (float(episode.total_reward), int(episode.steps), bool(episode.success)) == (87.0, 13, True)
