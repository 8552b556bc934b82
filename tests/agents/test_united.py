"""Learning a united network: a plain NumPy second implementation, exact values from the planner, what stands still."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from united_corridor import CORRIDOR, LENGTH, OPTIONS

from lodestone.agents import dqn
from lodestone.agents.united import (
    JOINT,
    PARTS,
    SEQUENTIAL,
    Errors,
    Learner,
    Remembered,
    Renewed,
    Stage,
    UnitedConfig,
    loss,
    termination_loss,
    united,
    with_new_errors,
)
from lodestone.errors import InvalidConfig, UnknownName
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.prioritized import LEAST_ERROR, Drawn, empty_prioritized, remember
from lodestone.learning.united_execution import Step, UnitedOptions, choices
from lodestone.learning.united_network import init_united_network, one_head
from lodestone.options.execution import Rules
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate
from lodestone.types import Transition

LINEAR = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
SMALL = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(8,))
B, GAMMA = 12, 0.9


def drawn(items, seed):
    weights = np.random.default_rng(seed).random(B)
    return Drawn(items, jnp.arange(B), jnp.asarray(weights, jnp.float32))


def batch() -> tuple[Drawn[Step], Drawn[Remembered]]:
    rng = np.random.default_rng(0)
    state, action = rng.integers(0, LENGTH - 1, B), rng.integers(0, 2, B)
    steps = Step(
        jnp.asarray(state, jnp.int32),
        jnp.asarray(action, jnp.int32),
        jnp.asarray(np.clip(state + 2 * action - 1, 0, LENGTH - 1), jnp.int32),
    )
    available = rng.random((B, 3)) < 0.6
    available[:, 1] = True
    transition = Transition(
        obs=jnp.asarray(rng.integers(0, LENGTH - 1, B), jnp.int32),
        action=jnp.asarray(rng.integers(0, 3, B), jnp.int32),
        reward=jnp.asarray(3 * rng.normal(size=B), jnp.float32),
        discount=jnp.asarray(GAMMA ** rng.integers(1, 5, B) * (rng.random(B) < 0.8), jnp.float32),
        next_obs=jnp.asarray(rng.integers(0, LENGTH, B), jnp.int32),
        next_available=jnp.asarray(available),
    )
    return drawn(steps, 1), drawn(Remembered(transition, jnp.asarray(rng.integers(0, 2, B), jnp.int32)), 2)


def numpy_layers(network, x):
    for layer in network.layers[:-1]:
        x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return x @ np.asarray(network.layers[-1].weight) + np.asarray(network.layers[-1].bias)


def numpy_outputs(network, cell):
    x = np.eye(LENGTH)[cell]
    if network.trunk is not None:
        for layer in network.trunk.layers:
            x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return (
        numpy_layers(network.manager, x),
        np.stack([numpy_layers(one_head(network.policies, head), x) for head in range(3)]),
        np.stack([numpy_layers(one_head(network.terminations, head), x) for head in range(2)]),
    )


def huber(error, delta):
    size = abs(error)
    return error**2 / 2 if size <= delta else delta * (size - delta / 2)


def numpy_loss(config, stage, network, target, steps, decisions):
    """Everything one sample and one head at a time. Returns the losses of every step and every decision, too."""
    total, goals = 0.0, (LENGTH - 1, 2, 4)
    of_steps, of_decisions = np.zeros(B), np.zeros(B)

    def best(next_values, preferences, usable):
        usable = np.flatnonzero(usable)
        chooser = preferences if config.double else next_values
        return next_values[usable[np.argmax(chooser[usable])]]

    ends = {1: [], 2: []}
    for index, (state, action, after) in enumerate(zip(*map(np.asarray, steps.items), strict=True)):
        _, values, _ = numpy_outputs(network, state)
        next_choices, next_actions, logits = numpy_outputs(network, after)
        target_choices, target_actions, _ = numpy_outputs(target, after)
        for head, goal in enumerate(goals):
            part = "basic policy" if head == 0 else "option policies"
            reward = after - 7.0 if head == 0 else 10.0 * (after == goal) - 1.0
            if head == 0 and "manager" in stage.learns:
                cost = config.decision_cost * config.reward_scale
                follows = [
                    np.append(actions[0] - cost, chosen[1:])
                    for actions, chosen in ((target_actions, target_choices), (next_actions, next_choices))
                ]
                later = best(*follows, np.ones(4))
            else:
                later = best(target_actions[head], next_actions[head], np.ones(2))
            wanted = reward * config.reward_scale + (0 if after == goal else GAMMA * later)
            if part in stage.learns:
                error = huber(values[head, action] - wanted, config.huber_delta)
                of_steps[index] += error
                total += config.policy_weight * float(steps.weights[index]) * error
            if head > 0:
                ended = after == goal
                entropy = np.log(np.exp(logits[head - 1]).sum()) - logits[head - 1, int(ended)]
                ends[head].append((ended, entropy))
    if "terminations" in stage.learns:
        for pairs in ends.values():
            for kind in (True, False):
                of_kind = [entropy for ended, entropy in pairs if ended == kind]
                total += config.termination_weight * B / 2 * (np.mean(of_kind) if of_kind else 0.0)
    if "manager" in stage.learns:
        for index in range(B):
            one = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), decisions.items)
            move = one.transition
            values, actions, _ = numpy_outputs(network, move.obs)
            if actions[move.action].argmax() != one.first_action:
                continue
            later = 0.0
            if move.discount > 0:
                later = best(
                    numpy_outputs(target, move.next_obs)[0],
                    numpy_outputs(network, move.next_obs)[0],
                    move.next_available,
                )
                later *= move.discount
            wanted = (move.reward - config.decision_cost) * config.reward_scale + later
            of_decisions[index] = huber(values[move.action] - wanted, config.huber_delta)
            total += config.manager_weight * float(decisions.weights[index]) * of_decisions[index]
    return total, of_steps, of_decisions


@pytest.mark.parametrize("shared", ["nothing", "hidden"])
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("stage", [*JOINT, *SEQUENTIAL], ids=lambda stage: "+".join(stage.learns))
def test_loss_equals_a_plain_numpy_loop(shared, double, stage):
    config = UnitedConfig(
        network=SMALL,
        shared=shared,
        double=double,
        batch_size=B,
        huber_delta=1.0,
        policy_weight=0.7,
        termination_weight=0.3,
        manager_weight=1.5,
        trunk_gradient=0.2,
    )
    network, target = (init_united_network(SMALL, shared, (LENGTH,), 2, 2, jax.random.key(number)) for number in (0, 1))
    steps, decisions = batch()
    found, errors = loss(config, stage, CORRIDOR, OPTIONS, GAMMA, network, target, steps, decisions)
    wanted, of_steps, of_decisions = numpy_loss(config, stage, network, target, steps, decisions)
    assert wanted > 0.1
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    np.testing.assert_allclose(errors.steps, np.sqrt(2 * of_steps), rtol=1e-4)
    np.testing.assert_allclose(errors.decisions, np.sqrt(2 * of_decisions), rtol=1e-4)


def gradient_of(config, stage, options=OPTIONS):
    network, target = (
        init_united_network(config.network, config.shared, (LENGTH,), 2, len(options), jax.random.key(number))
        for number in (0, 1)
    )
    steps, decisions = batch()
    if not options:
        steps = steps._replace(weights=jnp.ones(B))
        decisions = jax.tree.map(jnp.zeros_like, decisions)

    def total(network):
        return loss(config, stage, CORRIDOR, options, GAMMA, network, target, steps, decisions)[0]

    return network, target, jax.grad(total)(network)


@pytest.mark.parametrize("part", PARTS[1:])
def test_each_loss_teaches_its_own_heads_alone(part):
    """Also: the manager's loss has no gradient in the heads that it chooses from."""
    config = UnitedConfig(network=SMALL, batch_size=B)
    _, _, gradient = gradient_of(config, Stage(1.0, (part,)))

    def moves(tree):
        return any(bool((leaf != 0).any()) for leaf in jax.tree.leaves(tree))

    assert not moves(gradient.trunk)
    assert moves(gradient.manager) == (part == "manager")
    assert moves(one_head(gradient.policies, 0)) == (part == "basic policy")
    assert [moves(one_head(gradient.policies, head)) for head in (1, 2)] == [part == "option policies"] * 2
    assert [moves(one_head(gradient.terminations, head)) for head in (0, 1)] == [part == "terminations"] * 2


def test_the_trunk_gets_its_share_of_the_gradient():
    whole = UnitedConfig(network=SMALL, batch_size=B)
    (_, _, all_), (_, _, half) = (gradient_of(replace(whole, trunk_gradient=factor), JOINT[0]) for factor in (1.0, 0.5))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(0.5 * a, b, rtol=1e-5, atol=1e-7), all_.trunk, half.trunk)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), all_.policies, half.policies)


def test_without_options_the_basic_policy_is_dqn():
    config = UnitedConfig(network=SMALL, shared="nothing", batch_size=B, huber_delta=1.0, reward_scale=0.5)
    network, target, gradient = gradient_of(config, Stage(1.0, ("basic policy",)), options=())
    steps = batch()[0].items
    eye = jnp.eye(LENGTH)
    transitions = Transition(
        obs=eye[steps.state],
        action=steps.action,
        reward=jax.vmap(CORRIDOR.reward)(steps.state, steps.action, steps.next_state),
        discount=jnp.where(steps.next_state == LENGTH - 1, 0.0, GAMMA),
        next_obs=eye[steps.next_state],
        next_available=jnp.ones((B, 2), bool),
    )
    settings = dqn.DQNConfig(network=SMALL, batch_size=B, reward_scale=0.5)
    flat, flat_target = (one_head(one.policies, 0) for one in (network, target))
    wanted = jax.grad(partial(dqn.loss, settings))(flat, flat_target, transitions)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), one_head(gradient.policies, 0), wanted
    )


def test_terminations_weigh_ends_and_others_alike():
    logits = jnp.log(jnp.array([[[0.25, 0.75]], [[0.5, 0.5]], [[0.5, 0.5]], [[0.9, 0.1]]]))
    ended = jnp.array([[True], [False], [False], [False]])
    others = -(2 * np.log(0.5) + np.log(0.9)) / 3
    np.testing.assert_allclose(termination_loss(logits, ended), [2 * (-np.log(0.75) + others)], rtol=1e-6)
    never = termination_loss(logits, jnp.zeros((4, 1), bool))
    np.testing.assert_allclose(never, [-2 * (np.log(0.25) + 2 * np.log(0.5) + np.log(0.9)) / 4], rtol=1e-6)


EXACT = UnitedConfig(
    network=LINEAR,
    shared="nothing",
    learning_rate=((0.0, 3e-2), (0.4, 1e-2), (1.0, 1e-4)),
    learning_starts=200,
    replay_capacity=4000,  # decisions that the heads took while they learned are forgotten
    target_period=20,
    epsilon=((0.0, 1.0),),
    task_epsilon=((0.0, 1.0),),
    environments=4,
    start_environments=2,
    task_environments=2,
    reward_scale=0.2,
    decision_cost=0.0,
    max_option_steps=4,
)


def test_every_head_learns_its_exact_table():
    """One number a state and action: the policies' values are the planner's, the manager's are those of the options
    that the other heads make up, the terminations are right."""
    rules, steps = Rules(discount=GAMMA), 24_000
    config = EXACT
    algorithm = united(config, CORRIDOR, OPTIONS, rules, steps)
    for carry, _ in train(algorithm, (0, 1), config.rounds(steps), config.rounds(steps)):
        networks = carry.learner.network
    tables = tabulate(CORRIDOR)
    cells = np.asarray(tables.space.states)
    live = ~tables.terminal
    for position in range(2):
        network = jax.tree.map(lambda leaf, position=position: leaf[position], networks)
        outputs = jax.vmap(lambda cell, network=network: network(CORRIDOR.observe(cell)))(tables.space.states)
        for head, task in enumerate(OPTIONS, start=1):
            goals = tabulate(task)
            wanted = value_iteration(goals, GAMMA).action_values[np.asarray(jax.vmap(goals.space.index_of)(cells))]
            inside = live & (cells != (2, 4)[head - 1])
            np.testing.assert_allclose(outputs.actions[inside, head] / 0.2, wanted[inside], atol=0.1)
        np.testing.assert_array_equal(outputs.ended, np.stack([cells == 2, cells == 4], axis=1))
        options = tabulate_options(
            UnitedOptions(CORRIDOR, network, choices(OPTIONS), config.max_option_steps), tables.space
        )
        wanted = option_value_iteration(tables, options, GAMMA).option_values
        np.testing.assert_allclose(outputs.choices[live] / 0.2, wanted[live], atol=0.15)
        flat = value_iteration(tables, GAMMA).action_values
        np.testing.assert_allclose(outputs.actions[live, 0] / 0.2, flat[live], atol=0.15)


def test_some_copies_explore_less_and_some_begin_elsewhere():
    """What the run tells is of the environment's own copies alone."""
    config = replace(
        EXACT, environments=3, ticks_per_round=4, epsilon_spread=1e6, epsilon=((0.0, 0.5),), learning_starts=100_000
    )
    algorithm = united(config, CORRIDOR, OPTIONS, Rules(discount=GAMMA, step_limit=10), 100_000)
    network = init_united_network(LINEAR, "nothing", (LENGTH,), 2, 2, jax.random.key(0))
    step, visited, begun = jax.jit(algorithm.run_round), [], []
    for seed in range(2):
        carry, cells = algorithm.init(jax.random.key(seed), network), []
        for number in range(60):
            carry, log = step(carry, jnp.int32(number))
            cells.append(np.asarray(carry.actors[0].actor.state))
            elsewhere = carry.actors[1].actor
            begun.append(np.asarray(elsewhere.state)[np.asarray(elsewhere.deciding)])
        visited.append(np.stack(cells))
        assert log.valid.shape == (4 * 3,)
        assert carry.actors[1].first_action.shape == (2,)
    assert (visited[0][:, 0] != visited[1][:, 0]).any()
    np.testing.assert_array_equal(visited[0][:, 1:], visited[1][:, 1:])
    assert set(np.concatenate(begun)) == set(range(LENGTH - 1))


@pytest.mark.parametrize(
    ("learns", "learned", "steps", "decisions"),
    [
        (("option policies", "manager"), True, [0.0, 2.0], [0.0, 3.0]),
        (("option policies", "manager"), False, [1.0, 1.0], [1.0, 1.0]),
        (("basic policy",), True, [0.0, 2.0], [1.0, 1.0]),
        (("terminations",), True, [1.0, 1.0], [1.0, 1.0]),
    ],
)
def test_what_was_learned_from_gets_a_new_error(learns, learned, steps, decisions):
    replay = remember(empty_prioritized(jnp.int32(0), 2), jnp.arange(2, dtype=jnp.int32), jnp.ones(2, bool))
    learner = Learner(None, None, None, replay, replay)
    slots, errors = jnp.array([[0], [1]]), Errors(jnp.array([[0.0], [2.0]]), jnp.array([[0.0], [3.0]]))
    found = Renewed(jnp.zeros(2), (slots, slots), errors)
    after = with_new_errors(Stage(1.0, learns), learner, found, jnp.bool_(learned))
    for found_errors, wanted in ((after.steps, steps), (after.decisions, decisions)):
        np.testing.assert_allclose(found_errors.ring.storage.error, wanted, atol=LEAST_ERROR)


def test_what_does_not_learn_stands_still():
    """Stage by stage: the trunk after the first, every head but those whose stage it is."""
    config = UnitedConfig(network=SMALL, training="sequential", learning_starts=8, environments=2, task_environments=1)
    steps = 400
    algorithm = united(config, CORRIDOR, OPTIONS, Rules(discount=GAMMA), steps)
    rounds = config.rounds(steps)
    per_chunk = rounds // 20  # stages are multiples of a twentieth
    found = [
        jax.tree.map(lambda leaf: np.array(leaf[0]), carry.learner.network)
        for carry, _ in train(algorithm, (0,), rounds, per_chunk)
    ]
    ends = np.cumsum([round(20 * stage.share) for stage in SEQUENTIAL])

    def parts(network):
        return {
            "trunk": network.trunk,
            "basic policy": one_head(network.policies, 0),
            "option policies": jax.tree.map(lambda leaf: leaf[1:], network.policies),
            "terminations": network.terminations,
            "manager": network.manager,
        }

    for stage, first, last in zip(SEQUENTIAL, [0, *ends[:-1]], ends, strict=True):
        before, after = parts(found[max(0, first - 1)]), parts(found[last - 1])
        for name in PARTS:
            same = jax.tree.all(jax.tree.map(np.array_equal, before[name], after[name]))
            assert same == (name not in stage.learns), (stage.learns, name)


def test_bad_settings_are_refused():
    with pytest.raises(UnknownName, match="joint, sequential"):
        UnitedConfig(training="both")
    with pytest.raises(UnknownName, match="trunk, basic policy"):
        Stage(1.0, ("everything",))
    with pytest.raises(InvalidConfig, match="positive share"):
        Stage(0.0, ("trunk",))
    with pytest.raises(InvalidConfig, match="decision_cost is -1"):
        UnitedConfig(decision_cost=-1.0)
    with pytest.raises(InvalidConfig, match="max_option_steps is 0"):
        UnitedConfig(max_option_steps=0)
