"""What HAMQ learns, against the exact joint process."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor
from random_mdp import random_mdp

from lodestone.agents.hamq import (
    TICKS_PER_ROUND,
    HAMQConfig,
    hamq,
    internal_edges,
)
from lodestone.agents.machine_playing import greedy_edges, play_choices
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.taxi import Taxi
from lodestone.errors import InvalidConfig
from lodestone.learning.history import History
from lodestone.learning.loop import train
from lodestone.machines.machine import Action, Call, Choice, Hierarchy, Machine, Stop, every_action, sequence
from lodestone.machines.magnet_arm import pull_up
from lodestone.machines.taxi import get_and_put
from lodestone.options.execution import Rules
from lodestone.planning.joint import evaluate_choices, joint_process, joint_values

EXPLORE = ((0.0, 1.0),)


def learn(config, environment, hierarchy, rules, ticks, seeds=(0,)):
    """The tables [S, N, U], and the history."""
    process = joint_process(environment, hierarchy)
    history = History(len(seeds), process.names)
    for carry, chunk in train(
        hamq(config, environment, hierarchy, rules, ticks), seeds, ticks // TICKS_PER_ROUND, 1000
    ):
        history.add(chunk)
    return np.asarray(carry.table)[: len(seeds)], history


def assert_learned(table, process, discount, atol) -> None:
    exact = joint_values(process, discount).choice_values
    np.testing.assert_array_equal(table == -np.inf, ~process.available)
    np.testing.assert_allclose(table[process.available], exact[process.available], atol=atol)


@pytest.mark.parametrize("internal_transitions", [False, True])
def test_learned_values_are_the_exact_ones(internal_transitions: bool) -> None:
    """Everywhere: a random policy builds the tower often enough. The machine calls another one with arguments, has
    choices that follow one another in no time, and takes a step before the first."""
    arm = MagnetArm(3, 3, 2, 2)
    # Nothing is random here, so that an update may believe all that it sees.
    config = HAMQConfig(((0.0, 1.0),), EXPLORE, internal_transitions)
    for hierarchy in (pull_up(arm), nested(arm)):
        table, _ = learn(config, arm, hierarchy, Rules(discount=0.95, step_limit=500), 320_000)
        assert_learned(table[0], joint_process(arm, hierarchy), 0.95, 1e-3)


def nested(arm: MagnetArm) -> Hierarchy:
    """One of two kinds of actions, then the action; the first step is always down."""
    moves, magnet = arm.action_names[:4], arm.action_names[4:]
    root = {
        "first": Action("down", then="kind"),
        "kind": Choice({"move": "move", "magnet": "magnet"}),
        "move": Call("move", then="kind"),
        "magnet": Call("magnet", then="kind"),
    }
    return Hierarchy("root", (Machine("root", "first", root), one_of("move", moves), one_of("magnet", magnet)))


def one_of(name, actions) -> Machine:
    steps = {action: Action(action, then="stop") for action in actions}
    return Machine(name, "which", {"which": Choice({each: each for each in actions}), **steps, "stop": Stop()})


def test_learned_values_in_a_world_of_chance() -> None:
    world = random_mdp(2, goals=1)
    hierarchy = Hierarchy(
        "root",
        (
            Machine(
                "root",
                "which",
                {
                    "which": Choice({"one": "one", "many": "many"}),
                    "one": Action("action-0", then="which"),
                    "many": Call("many", then="which"),
                },
            ),
            sequence("many", "action-1", "action-2", "action-1"),
        ),
    )
    config = HAMQConfig(learning_rate=((0.0, 0.5), (0.1, 0.05), (1.0, 0.0005)), epsilon=EXPLORE)
    table, _ = learn(config, world, hierarchy, Rules(discount=0.9), 100_000, seeds=range(16))
    assert_learned(table.mean(axis=0), joint_process(world, hierarchy), 0.9, 0.05)


def test_the_stack_tells_two_calls_of_one_machine_apart() -> None:
    """After one call comes a step to the right, which pays; after the other the episode ends."""
    wait = Machine("wait", "go on", {"go on": Choice({"yes": "left"}), "left": Action("left", "stop"), "stop": Stop()})
    root = Machine(
        "root",
        "which",
        {
            "which": Choice({"first": "first", "second": "second"}),
            "first": Call("wait", then="right"),
            "second": Call("wait", then="stop"),
            "right": Action("right", then="stop"),
            "stop": Stop(),
        },
    )
    hierarchy = Hierarchy("root", (root, wait))
    process = joint_process(Corridor(), hierarchy)
    table, _ = learn(HAMQConfig(epsilon=EXPLORE), Corridor(), hierarchy, Rules(), 2000)
    inside = [number for number in range(process.num_choices) if ">" in process.text(number)]
    assert len(inside) == 2
    assert {process.text(number).split(" ")[0]: table[0, number, 0] for number in inside} == pytest.approx(
        {"root.first": 0.99, "root.second": 0.0}, abs=1e-5
    )


def test_nothing_is_learned_across_episodes() -> None:
    """The first step of every episode pays, before any choice: it is worth nothing to the last choice before it."""
    corridor = Corridor(length=3)
    vertices = {
        "first": Action("right", then="which"),
        "which": Choice({"stop": "stop"}),
        "stop": Stop(),
    }
    hierarchy = Hierarchy("root", (Machine("root", "first", vertices),))
    table, history = learn(HAMQConfig(), corridor, hierarchy, Rules(), 3200)
    np.testing.assert_array_equal(table, 0.0)
    episodes = history.episodes(0)
    assert set(episodes.total_reward) == {1.0}
    assert set(episodes.length_steps) == set(episodes.length_decisions) == {1}
    assert history.taken(0)[1] == len(episodes.steps)


class Endless(Corridor):
    """The last cell ends nothing: there every step to the right pays."""

    def terminal(self, state):
        return jnp.bool_(False)


THREE_STEPS = Hierarchy(
    "root",
    (
        Machine("root", "which", {"which": Choice({"walk": "walk"}), "walk": Call("walk", then="which")}),
        sequence("walk", "right", "right", "right"),
    ),
)


def test_a_limit_between_two_choices_is_not_learned_from_and_one_at_a_choice_bootstraps() -> None:
    """In the last of three cells each step pays 2, so that it is worth 2 / (1 - 0.9) = 20, and the first cell less,
    whether the limit cuts the walk of three steps or comes with its end. Where the limit is taken for an end, it is
    not."""
    process = joint_process(Endless(length=3), THREE_STEPS)
    exact = joint_values(process, 0.9).choice_values
    assert sorted(exact[:, 0]) == pytest.approx([1 + 0.9 * 2 + 0.81 * 2 + 0.729 * 20, 20.0])
    for limit in (6, 10):
        table, history = learn(
            HAMQConfig(), Endless(length=3), THREE_STEPS, Rules(discount=0.9, step_limit=limit), 9600
        )
        np.testing.assert_allclose(table[0], exact, atol=1e-3)
        assert set(history.episodes(0).length_steps) == {limit}
        assert not history.episodes(0).success.any()
    rules = Rules(discount=0.9, step_limit=6, bootstrap_at_limit=False)
    table, _ = learn(HAMQConfig(), Endless(length=3), THREE_STEPS, rules, 9600)
    last = 2 * (1 + 0.9 + 0.81)
    assert sorted(table[0, :, 0]) == pytest.approx([last, 1 + 0.9 * 2 + 0.81 * 2 + 0.729 * last], abs=1e-4)


def test_a_decision_limit_counts_choices() -> None:
    _, history = learn(HAMQConfig(), Endless(length=3), THREE_STEPS, Rules(decision_limit=7), 3200)
    episodes = history.episodes(0)
    assert set(episodes.length_decisions) == {7}
    assert set(episodes.length_steps) == {21}


def test_every_step_and_every_choice_is_told() -> None:
    """Steps of all decisions and those of all episodes are the same steps."""
    taxi = Taxi(move_success=0.8)
    table, history = learn(HAMQConfig(), taxi, get_and_put(taxi), Rules(step_limit=40), 32_000, seeds=(0, 1))
    for seed in range(2):
        episodes = history.episodes(seed)
        assert episodes.steps[-1] == episodes.length_steps.sum()
        assert episodes.decisions[-1] == episodes.length_decisions.sum()
        assert episodes.length_steps.max() == 40
    calls, steps = (sum(getattr(usage, field) for usage in history.usage) for field in ("calls", "steps"))
    names = joint_process(taxi, get_and_put(taxi)).names
    assert names == ("south", "north", "east", "west", "one step", "two steps")
    # Directions lead to another choice in no time, but a pickup may come before all choices; how far takes one step or
    # two, and perhaps a pickup or putdown.
    assert np.all(steps[:, :4].sum(axis=1) < 0.1 * len(history.episodes(0).steps))
    assert np.all(calls[:, :4].sum(axis=1) - calls[:, 4:].sum(axis=1) <= 1)
    assert np.all((steps[:, 5] >= 1.5 * calls[:, 5]) & (steps[:, 5] <= 4 * calls[:, 5]))
    assert not np.array_equal(table[0], table[1])


def test_seeds_do_not_influence_one_another() -> None:
    arm = MagnetArm(3, 3, 2, 2)
    both, _ = learn(HAMQConfig(), arm, pull_up(arm), Rules(step_limit=50), 3200, seeds=(5, 6))
    alone, _ = learn(HAMQConfig(), arm, pull_up(arm), Rules(step_limit=50), 3200, seeds=(6,))
    np.testing.assert_array_equal(both[1], alone[0])


def test_internal_edges_are_those_that_lead_to_a_choice_in_no_time() -> None:
    taxi = Taxi()
    process = joint_process(taxi, get_and_put(taxi))
    into, chain = internal_edges(process)
    assert chain == 1
    into = np.asarray(into)
    found = {(*edge, choice) for choice in range(process.num_choices) for edge in into[choice].tolist()}
    wanted = {
        (choice, edge, int(process.edges[choice, edge]))
        for choice, edge in np.argwhere(process.available).tolist()
        if process.edges[choice, edge] < process.num_choices
    }
    assert {(choice, edge, after) for choice, edge, after in found if choice < process.num_choices} == wanted
    assert len(wanted) == 4 * process.num_choices / 5  # of five choices, one is of a direction


def test_substitution_learns_sooner() -> None:
    """Half of the updates teach something that is known; without them, values spread faster."""
    taxi = Taxi()
    exact = joint_values(joint_process(taxi, get_and_put(taxi)), 0.99).choice_values
    errors, known = {}, np.isfinite(exact)
    for internal in (False, True):
        config = HAMQConfig(epsilon=EXPLORE, internal_transitions=internal)
        table, _ = learn(config, taxi, get_and_put(taxi), Rules(step_limit=200), 320_000)
        errors[internal] = np.abs(table[0][known] - exact[known]).mean()
    assert errors[True] < 0.8 * errors[False]


def test_rules_about_options_and_machines_without_a_choice_are_refused() -> None:
    corridor = Corridor()
    with pytest.raises(InvalidConfig, match="no options"):
        hamq(HAMQConfig(), corridor, every_action(corridor), Rules(call_cost=1.0), 100)
    walk = Hierarchy("walk", (sequence("walk", "right"),))
    with pytest.raises(InvalidConfig, match="no choice open"):
        hamq(HAMQConfig(), corridor, walk, Rules(), 100)
    with pytest.raises(InvalidConfig, match="epsilon"):
        HAMQConfig(epsilon=((0.0, 2.0),))


def test_an_episode_of_the_greedy_policy_is_worth_its_exact_value() -> None:
    arm = MagnetArm(4, 3, 3, 3)
    process = joint_process(arm, pull_up(arm))
    policy = greedy_edges(joint_values(process, 0.99).choice_values)
    episode = play_choices(process, policy, np.random.default_rng(0), max_steps=1000)
    exact = process.initial_mean(evaluate_choices(process, policy, 1.0))
    assert episode.reward.sum() == pytest.approx(exact)
    assert episode.joint[-1] == process.end
    assert process.tables.terminal[episode.next_state[-1]]
    assert np.all((episode.edge >= 0) == (episode.joint[:-1] < process.num_choices))
    cut = play_choices(process, policy, np.random.default_rng(0), max_steps=5)
    assert (cut.edge < 0).sum() == 5


SIZE = (5, 3, 4, 4)
EPISODES = 1500


def returns_in_the_authors_settings(hierarchy, arm, seeds, length):
    """Returns [S, 1500] with alpha 0.1, gamma 0.9, and an epsilon of 0.1 times 0.9999 for each step (authors' code)."""
    knots = tuple((step / length, 0.1 * 0.9999**step) for step in range(0, length + 1, length // 40))
    config = HAMQConfig(learning_rate=((0.0, 0.1),), epsilon=knots)
    _, history = learn(config, arm, hierarchy, Rules(discount=0.9, step_limit=300), length, seeds)
    return np.stack([history.episodes(seed).total_reward[:EPISODES] for seed in range(len(seeds))])


def test_machines_learn_faster_and_reach_their_own_optimum() -> None:
    """The pull-up machine is far ahead after a hundred episodes, and ends at 24 steps where 18 are the fewest."""
    arm = MagnetArm(*SIZE)
    returns = returns_in_the_authors_settings(pull_up(arm), arm, range(5), 60_000)
    assert returns.shape == (5, EPISODES)
    assert -160 < returns[:, :50].mean() < -100
    assert returns[:, 100:150].mean() >= 70
    assert returns[:, -100:].mean() == pytest.approx(76.0, abs=0.1)

    flat = returns_in_the_authors_settings(every_action(arm), arm, range(5), 120_000)
    assert flat.shape == (5, EPISODES)
    assert flat[:, 100:150].mean() < -200
    assert flat[:, -100:].mean() == pytest.approx(82.0, abs=0.1)


class Unequal(Corridor):
    """Episodes begin one step from the end four times out of five, and else two steps from it."""

    def initial_distribution(self):
        return jnp.array([0.2, 0.8]), jnp.array([0, 1], dtype=jnp.int32)


def test_episodes_begin_as_often_as_the_environment_says() -> None:
    corridor = Unequal(length=3)
    walk = {"which": Choice({"on": "on"}), "on": Action("right", then="which")}
    _, history = learn(HAMQConfig(), corridor, Hierarchy("walk", (Machine("walk", "which", walk),)), Rules(), 32_000)
    lengths = history.episodes(0).length_steps
    assert set(lengths) == {1, 2}
    assert (lengths == 1).mean() == pytest.approx(0.8, abs=0.02)


def test_machines_that_never_act_end_in_no_time() -> None:
    vertices = {"which": Choice({"stop": "stop"}), "stop": Stop()}
    table, history = learn(HAMQConfig(), Corridor(), Hierarchy("m", (Machine("m", "which", vertices),)), Rules(), 320)
    assert table.tolist() == [[[0.0]]]
    assert history.episodes(0).length_decisions.tolist() == [1] * 320
    assert not history.episodes(0).length_steps.any()
