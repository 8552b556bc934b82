"""h-DQN: a plain NumPy second implementation, a plain interpreter of what is remembered, exact values of both."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor

from lodestone.agents import dqn
from lodestone.agents.hdqn import (
    HDQNConfig,
    Pursued,
    exploration,
    hdqn,
    loss,
    without_repeat,
)
from lodestone.envs.chain import LEFT, Chain, ChainState, position_goals
from lodestone.envs.task import Task, goal
from lodestone.errors import InvalidConfig, UnknownName
from lodestone.learning.goal_network import GoalOptions, init_goal_network
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.replay import Replay
from lodestone.learning.united_network import one_head
from lodestone.options.execution import Rules
from lodestone.options.subgoals import arrival, solve_subgoal, subgoal_options
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate
from lodestone.types import Transition

TABLE = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
SMALL = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(8,))
CHAIN = Chain()
GOALS = position_goals(CHAIN)
NAMES = tuple(one.name for one in GOALS)
POSITIONS = (1, 3, 4, 5, 6)
B, GAMMA = 16, 0.9


# What a goal is, exactly.


def test_the_chance_of_reaching_the_far_end_first_is_a_fifth():
    """Gambler's ruin: (2 - 1) / (6 - 1)."""
    tables = tabulate(CHAIN)
    solution = solve_subgoal(tables, arrival(tables, GOALS[-1], 1.0), 1.0)
    assert tables.initial_mean(solution.values) == pytest.approx(0.2, abs=1e-8)


@pytest.mark.parametrize(("discount", "best"), [(1.0, 0.208), (0.99, 0.185318), (0.9, 0.068924)])
def test_choosing_goals_is_as_good_as_choosing_actions(discount, best):
    """With exact controllers: to the far end, then back."""
    tables = tabulate(CHAIN)
    exact = subgoal_options(tables, [arrival(tables, one, discount) for one in GOALS], discount)
    solution = option_value_iteration(tables, tabulate_options(exact, tables.space), discount)
    assert tables.initial_mean(solution.values) == pytest.approx(best, abs=1e-6)


def test_the_critic_pays_on_arrival_and_nowhere_else():
    six = GOALS[-1]
    near, there = ChainState(jnp.int32(5), jnp.bool_(False)), ChainState(jnp.int32(6), jnp.bool_(True))
    assert [float(six.reward(near, jnp.int32(1), after)) for after in (near, there)] == [0.0, 1.0]
    assert [bool(six.terminal(state)) for state in (near, there)] == [False, True]
    assert position_goals(CHAIN) == GOALS  # goals of one kind are equal


# The losses.


def batch() -> tuple[Pursued, Transition]:
    """Steps and pursuits on the chain; some steps reach their goal, some end the episode, some pursuits end it."""
    rng = np.random.default_rng(0)

    def states(low: int, size: int = B) -> ChainState:
        position = rng.integers(low, 7, size)
        return ChainState(jnp.asarray(position, jnp.int32), jnp.asarray((position == 6) | (rng.random(size) < 0.5)))

    state = states(2)
    action = rng.integers(0, 2, B)
    moved = np.clip(np.asarray(state.position) + 2 * action - 1, 1, 6)
    after = ChainState(jnp.asarray(moved, jnp.int32), state.visited | jnp.asarray(moved == 6))
    numbers = rng.integers(0, 5, B)
    steps = Pursued(state, jnp.asarray(numbers, jnp.int32), jnp.asarray(action, jnp.int32), after)
    available = rng.random((B, 5)) < 0.6
    available[:, 1] = True
    pursuits = Transition(
        obs=states(2),
        action=jnp.asarray(rng.integers(0, 5, B), jnp.int32),
        reward=jnp.asarray(3 * rng.normal(size=B), jnp.float32),
        discount=jnp.asarray(GAMMA ** rng.integers(1, 5, B) * (rng.random(B) < 0.7), jnp.float32),
        next_obs=states(1),
        next_available=jnp.asarray(available),
    )
    return steps, pursuits


def one_of(tree, index):
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]), tree)


def numpy_layers(network, x):
    for layer in network.layers[:-1]:
        x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return x @ np.asarray(network.layers[-1].weight) + np.asarray(network.layers[-1].bias)


def numpy_values(network, state):
    """Q2(s, .) and Q1(s, .; .)."""
    x = np.zeros((6, 2))
    x[state.position - 1, int(state.visited)] = 1
    x = x.ravel()
    if network.trunk is not None:
        for layer in network.trunk.layers:
            x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return numpy_layers(network.meta, x), [numpy_layers(one_head(network.controller, head), x) for head in range(5)]


def huber(error, delta):
    return error**2 / 2 if abs(error) <= delta else delta * (abs(error) - delta / 2)


def numpy_loss(config, network, target, steps, pursuits, both):
    """Everything one sample at a time."""

    def best(later, preferences, usable):
        usable = np.flatnonzero(usable)
        return later[usable[np.argmax((preferences if config.double else later)[usable])]]

    total = 0.0
    for index in range(B):
        step = one_of(steps, index)
        reached = step.next_state.position == POSITIONS[step.goal]
        wanted = config.critic_scale * reached
        if not reached and step.next_state.position != 1:
            later, preferences = (numpy_values(one, step.next_state)[1][step.goal] for one in (target, network))
            wanted += GAMMA * best(later, preferences, np.ones(2))
        total += huber(numpy_values(network, step.state)[1][step.goal][step.action] - wanted, config.huber_delta)
        if both:
            move = one_of(pursuits, index)
            wanted = config.reward_scale * move.reward
            if move.discount > 0:
                later, preferences = (numpy_values(one, move.next_obs)[0] for one in (target, network))
                wanted += move.discount * best(later, preferences, move.next_available)
            total += huber(numpy_values(network, move.obs)[0][move.action] - wanted, config.huber_delta)
    return total


def networks(config, goals=GOALS, environment=CHAIN):
    seen = jax.eval_shape(
        environment.observe, jax.tree.map(lambda leaf: leaf[0], environment.initial_distribution()[1])
    )
    return [
        init_goal_network(config.network, config.shared, seen.shape, 2, len(goals), jax.random.key(number))
        for number in (0, 1)
    ]


@pytest.mark.parametrize("shared", ["nothing", "hidden"])
@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("both", [False, True])
def test_loss_equals_a_plain_numpy_loop(shared, double, both):
    config = HDQNConfig(
        network=SMALL, shared=shared, double=double, huber_delta=1.0, reward_scale=0.5, critic_scale=3.0
    )
    network, target = networks(config)
    steps, pursuits = batch()
    found = loss(config, CHAIN, GOALS, GAMMA, network, target, steps, pursuits, jnp.bool_(both))
    np.testing.assert_allclose(found, numpy_loss(config, network, target, steps, pursuits, both), rtol=1e-5)


@pytest.mark.parametrize("both", [False, True])
def test_each_level_teaches_its_own_network_alone(both):
    config = HDQNConfig(network=SMALL)
    network, target = networks(config)
    steps, pursuits = batch()
    steps = steps._replace(goal=jnp.full(B, 2, jnp.int32))
    gradient = jax.grad(
        lambda network: loss(config, CHAIN, GOALS, GAMMA, network, target, steps, pursuits, jnp.bool_(both))
    )(network)

    def moves(tree):
        return any(bool((leaf != 0).any()) for leaf in jax.tree.leaves(tree))

    assert [moves(one_head(gradient.controller, head)) for head in range(5)] == [head == 2 for head in range(5)]
    assert moves(gradient.meta) == both


def test_with_the_end_as_its_only_goal_it_is_dqn_on_the_critics_reward():
    config = HDQNConfig(network=SMALL, huber_delta=1.0, critic_scale=2.0)
    end = GOALS[:1]
    network, target = networks(config, end)
    steps, pursuits = batch()
    steps = steps._replace(goal=jnp.zeros(B, jnp.int32))
    gradient = jax.grad(
        lambda network: loss(config, CHAIN, end, GAMMA, network, target, steps, pursuits, jnp.bool_(False))
    )(network)
    ends = steps.next_state.position == 1
    observe = jax.vmap(CHAIN.observe)
    flat = Transition(
        obs=observe(steps.state),
        action=steps.action,
        reward=ends.astype(jnp.float32),
        discount=jnp.where(ends, 0.0, GAMMA),
        next_obs=observe(steps.next_state),
        next_available=jnp.ones((B, 2), bool),
    )
    settings = dqn.DQNConfig(network=SMALL, huber_delta=1.0, reward_scale=2.0)
    wanted = jax.grad(partial(dqn.loss, settings))(*(one_head(one.controller, 0) for one in (network, target)), flat)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), one_head(gradient.controller, 0), wanted
    )


# What is remembered.


def run(config, rules, rounds, goals=GOALS, environment=CHAIN, seeds=(0,)):
    steps = rounds * config.steps_per_round
    for carry, _ in train(hdqn(config, environment, goals, rules, steps), seeds, rounds, rounds):
        pass
    return jax.tree.map(np.array, (carry.learner, carry.outcomes))


@pytest.mark.parametrize(
    ("rules", "repeat"),
    [
        (Rules(discount=GAMMA, step_limit=9), True),
        (Rules(discount=GAMMA, decision_limit=3), False),
        (Rules(discount=GAMMA, undiscounted_option_reward=True, step_limit=9, bootstrap_at_limit=False), False),
        (Rules(discount=GAMMA, undiscounted_option_reward=True, discount_per_decision=True, step_limit=9), True),
    ],
    ids=["step limit", "decision limit, no repeat", "a plain sum, no repeat", "the paper's sum and discount"],
)
def test_both_replays_hold_what_a_plain_interpreter_says(rules, repeat):
    """The controller's replay is read as one story per environment; out of it comes the meta-controller's."""
    paying = Chain(small_reward=0.5)  # at the first end, too, so that a lost last reward would show
    environments, cap, rounds = 3, 4, 150
    config = HDQNConfig(
        network=TABLE,
        environments=environments,
        max_goal_steps=cap,
        repeat_goals=repeat,
        controller_first=0.5,
        success_window=7,
    )
    found = run(config, rules, rounds, position_goals(paying), paying)
    learner, outcomes = jax.tree.map(lambda leaf: leaf[0], found)
    steps, found = learner.steps, learner.pursuits
    assert int(steps.size) == rounds * config.steps_per_round == len(steps.storage.action)

    told = []  # (tick, environment, pursuit)
    again = 0
    for lane in range(environments):
        position, visited, start, episode, decisions, given_up, before = 2, False, None, 0, 0, None, None
        for tick in range(rounds * config.ticks_per_round):
            step = one_of(steps.storage, tick * environments + lane)
            assert (int(step.state.position), bool(step.state.visited)) == (position, visited)
            if start is None:
                start, elapsed, total, weight = (position, visited), 0, 0.0, 1.0
                chosen = int(step.goal)
                decisions += 1
                again += decisions == 1 and chosen == before
                assert POSITIONS[chosen] != position
                assert repeat or chosen != given_up
            assert int(step.goal) == chosen
            left = int(step.next_state.position) == max(1, position - 1)
            assert left or (step.action != LEFT and int(step.next_state.position) == min(6, position + 1))
            position = int(step.next_state.position)
            visited = visited or position == 6
            elapsed, episode = elapsed + 1, episode + 1
            paid = (1.0 if visited else 0.5) if position == 1 else 0.0
            total += (1.0 if rules.undiscounted_option_reward else weight) * paid
            weight *= GAMMA
            over = position == 1
            stops = POSITIONS[chosen] == position or elapsed == cap
            limit = not over and (
                (rules.step_limit is not None and episode == rules.step_limit)
                or (rules.decision_limit is not None and stops and decisions == rules.decision_limit)
            )
            if not (over or stops or limit):
                continue
            may = [goal_at != position for goal_at in POSITIONS]
            if limit and not stops:
                may = [number == chosen for number in range(5)]
            elif not repeat:
                may[chosen] = False
            onward = GAMMA if rules.discount_per_decision else weight
            kept = 0.0 if over or (limit and not rules.bootstrap_at_limit) else onward
            told.append((tick, lane, (start, chosen, total, kept, (position, visited), may)))
            start, given_up, before = None, chosen, chosen
            if over or limit:
                position, visited, episode, decisions, given_up = 2, False, 0, 0, None

    assert len(told) == int(found.size) > 100
    assert again > 0  # a new episode remembers no goal
    kinds = set()
    for index, (_, _, (start, chosen, total, kept, end, may)) in enumerate(sorted(told)):
        move = one_of(found.storage, index)
        assert ((int(move.obs.position), bool(move.obs.visited)), int(move.action)) == (start, chosen)
        assert (int(move.next_obs.position), bool(move.next_obs.visited)) == end
        assert float(move.reward) == pytest.approx(total, rel=1e-5)
        assert float(move.discount) == pytest.approx(kept, rel=1e-5)
        assert move.next_available.tolist() == may
        kinds.add((end[0] == 1, kept == 0, sum(may) == 1))
    assert {kind[0] for kind in kinds} == {True, False}
    for number in range(5):
        last = [POSITIONS[number] == end[0] for _, _, (_, chosen, *_, end, _) in sorted(told) if chosen == number][-7:]
        assert int(outcomes.size[number]) == len(last) == 7
        assert sorted(outcomes.storage[number].tolist()) == sorted(last)


# Exploration and memory.


def test_a_goal_is_explored_less_as_the_run_goes_on_or_where_it_is_reached():
    knots = ((0.0, 1.0), (1.0, 0.2))
    outcomes = Replay(
        storage=jnp.array([[True] * 4, [True, True, False, False], [True, False, False, False], [False] * 4]),
        cursor=jnp.zeros(4, jnp.int32),
        size=jnp.array([4, 4, 1, 0], jnp.int32),
    )
    np.testing.assert_allclose(exploration(knots, jnp.float32(0.0), outcomes), [0.2, 0.5, 0.2, 1.0])
    np.testing.assert_allclose(exploration(knots, jnp.float32(0.75), outcomes), [0.2, 0.4, 0.2, 0.4])


def test_the_last_goal_is_left_out_unless_it_is_the_only_one():
    available = jnp.array([True, False, True])
    assert without_repeat(available, jnp.int32(2)).tolist() == [True, False, False]
    assert without_repeat(available, jnp.int32(1)).tolist() == [True, False, True]
    assert without_repeat(jnp.array([False, False, True]), jnp.int32(2)).tolist() == [False, False, True]


def test_goals_that_hold_may_not_be_chosen_unless_all_do():
    config = HDQNConfig(network=TABLE)
    for goals, wanted in ((GOALS, [True, False, True, True, True]), (GOALS[1:2], [True])):
        options = GoalOptions(goals, networks(config, goals)[0], jnp.zeros(len(goals)), 5)
        assert options.initiation(ChainState(jnp.int32(3), jnp.bool_(False))).tolist() == wanted


def test_a_controller_explores_as_much_as_it_is_told():
    options = GoalOptions(GOALS, networks(HDQNConfig(network=TABLE))[0], jnp.array([0.0, 0.5, 1.0, 0.2, 0.0]), 5)
    state = ChainState(jnp.int32(3), jnp.bool_(False))
    best = np.argmax(options.network.action_values(CHAIN.observe(state)), axis=1)
    found = np.take_along_axis(np.asarray(options.action_probs(state)), best[:, None], axis=1)[:, 0]
    np.testing.assert_allclose(found, [1.0, 0.75, 0.5, 0.9, 1.0])


# What is learned.


def _at(cell, corridor, state):
    return state == cell


CORRIDOR = Corridor(length=7, step_reward=-7.0)
CELLS = (2, 4, 6)
WALKS: tuple[Task, ...] = tuple(goal(CORRIDOR, f"to-{cell}", partial(_at, cell)) for cell in CELLS)
EXACT = HDQNConfig(
    network=TABLE,
    learning_rate=((0.0, 3e-2), (0.4, 1e-2), (1.0, 1e-4)),
    learning_starts=200,
    goal_replay_capacity=2000,  # pursuits of the time when the controller learned are forgotten
    target_period=20,
    epsilon=((0.0, 1.0), (0.5, 0.0)),
    goal_epsilon=((0.0, 1.0),),
    environments=4,
    max_goal_steps=4,
    reward_scale=0.2,
)


def test_both_levels_learn_their_exact_tables():
    """The controller's values are those of each goal's own problem; the meta-controller's are those of choosing among
    the options that the controller makes, within what may be chosen."""
    rules, rounds = Rules(discount=GAMMA, step_limit=30), 3000
    learner, _ = run(EXACT, rules, rounds, WALKS, CORRIDOR, seeds=(0, 1))
    tables = tabulate(CORRIDOR)
    live, cells = ~tables.terminal, np.asarray(tables.space.states)
    for seed in range(2):
        network = jax.tree.map(lambda leaf, seed=seed: jnp.asarray(leaf[seed]), learner.network)
        observations = jax.vmap(CORRIDOR.observe)(tables.space.states)
        actions = np.asarray(jax.vmap(network.action_values)(observations)) / EXACT.critic_scale
        for number, one in enumerate(WALKS):
            wanted = solve_subgoal(tables, arrival(tables, one, GAMMA), GAMMA).action_values
            inside = live & (cells != CELLS[number])
            np.testing.assert_allclose(actions[inside, number], wanted[inside], atol=0.02)
        as_options = GoalOptions(WALKS, network, jnp.zeros(3), EXACT.goal_cap)
        options = tabulate_options(as_options, tables.space)
        wanted = option_value_iteration(tables, options, GAMMA).option_values
        found = np.asarray(jax.vmap(network.goal_values)(observations)) / EXACT.reward_scale
        # A goal is chosen where an episode begins, where another one was reached, or where one was given up.
        may = options.initiation.T & live[:, None]
        seen = may & np.isin(cells, (0, 2, 4))[:, None]
        np.testing.assert_allclose(found[seen], wanted[seen], atol=0.3)
        best = value_iteration(tables, GAMMA).values
        assert tables.initial_mean(np.where(may, wanted, -np.inf).max(axis=1)) == pytest.approx(
            tables.initial_mean(best), abs=1e-6
        )


def test_the_controller_learns_first_then_both_and_the_target_follows_once_a_period():
    config = HDQNConfig(
        network=TABLE,
        learning_starts=32,
        environments=2,
        controller_first=0.5,
        goal_epsilon=((0.0, 0.0),),
        updates_per_round=5,
        target_period=10,
    )
    rounds = 160
    algorithm = hdqn(config, CHAIN, GOALS, Rules(discount=GAMMA), rounds * config.steps_per_round)
    learners = [
        jax.tree.map(lambda leaf: np.array(leaf[0]), carry.learner) for carry, _ in train(algorithm, (0,), rounds, 1)
    ]

    def stood_still(part, first, last):
        before, after = (getattr(learners[at].network, part).layers[0].weight for at in (first, last))
        return np.array_equal(before, after)

    # Learning starts in round 8, counted from 0, with two rounds to a period.
    assert stood_still("controller", 0, 7)
    assert not stood_still("controller", 7, 8)
    assert stood_still("meta", 0, 79)
    assert not stood_still("meta", 79, 80)
    for number in range(9, 30):
        one = learners[number]
        same = jax.tree.map(np.array_equal, one.target.controller, one.network.controller)
        assert jax.tree.all(same) == (number % 2 == 1)
        if number % 2 == 0:
            jax.tree.map(np.testing.assert_array_equal, one.target, learners[number - 1].target)

    pursuits, half = learners[-1].pursuits, int(learners[79].pursuits.size)
    from_start = pursuits.storage.obs.position == 2
    at_first = pursuits.storage.action[:half][from_start[:half]]
    assert len(set(at_first.tolist())) == 5  # goals at random
    later = pursuits.storage.action[half : int(pursuits.size)][from_start[half : int(pursuits.size)]]
    counts = np.bincount(later, minlength=5)
    assert counts.max() > 0.5 * counts.sum()  # the best ones


def test_other_seeds_change_nothing():
    config = HDQNConfig(network=TABLE, learning_starts=32, environments=2)
    together, _ = run(config, Rules(discount=GAMMA), 40, seeds=(3, 4, 5))
    alone, _ = run(config, Rules(discount=GAMMA), 40, seeds=(4,))
    np.testing.assert_array_equal(together.steps.storage.action[1], alone.steps.storage.action[0])
    np.testing.assert_allclose(
        together.network.meta.layers[0].weight[1], alone.network.meta.layers[0].weight[0], atol=1e-5
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"controller_first": 1.5},
        {"epsilon": ((0.0, 2.0),)},
        {"max_goal_steps": 0},
        {"critic_scale": 0.0},
        {"learning_starts": -1},
        {"success_window": 15},
    ],
)
def test_bad_settings_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        HDQNConfig(**wrong)


def test_an_unknown_part_to_share_is_refused():
    with pytest.raises(UnknownName, match="nothing, convolutions, hidden"):
        HDQNConfig(shared="everything")
