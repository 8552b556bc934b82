"""The joint process against a plain interpreter of machines, and what is known of particular machines."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from machine_interpreter import Interpreter, is_even, part, random_hierarchy
from random_mdp import random_mdp

from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.taxi import Taxi
from lodestone.errors import InvalidConfig, InvalidMachine, LodestoneError, TooManyStates
from lodestone.machines.configurations import configurations
from lodestone.machines.corridor_maze import walk_corridors
from lodestone.machines.machine import (
    Action,
    Branch,
    Call,
    Choice,
    Hierarchy,
    Machine,
    Predicate,
    Stop,
    every_action,
    sequence,
)
from lodestone.machines.magnet_arm import pull_up
from lodestone.machines.taxi import get_and_put
from lodestone.planning import landing
from lodestone.planning.joint import (
    evaluate_choices,
    expected_choices,
    expected_joint_steps,
    hierarchical_optimum,
    joint_process,
    joint_values,
)
from lodestone.planning.solve import greedy_choices, optimum, value_iteration
from lodestone.planning.tables import tabulate

WORLD = random_mdp(3, goals=1)
"""One world for all random machines: each compiles anew."""


def stack_of(process, number):
    """The stack of a joint state, as the interpreter writes it."""
    frames, at = [], process.configuration[number]
    while at >= 0:
        machine, arguments, vertex, caller = process.configurations.configurations[at]
        frames.append((machine, tuple(sorted(arguments)), vertex))
        at = caller
    return int(process.state[number]), tuple(reversed(frames))


def same_as_interpreted(environment, hierarchy, discount=0.9) -> None:
    process = joint_process(environment, hierarchy)
    interpreter = Interpreter(environment, process.tables, hierarchy)
    found, values = interpreter.expand(), interpreter.values(discount)
    stacks = [stack_of(process, number) for number in range(process.end)]
    assert len(set(stacks)) == process.end
    assert set(stacks) == set(found)
    solution = joint_values(process, discount)
    np.testing.assert_allclose(solution.values[:-1], [values[stack] for stack in stacks], atol=1e-7)
    assert solution.values[-1] == 0
    for number in range(process.num_choices):
        taken = {
            process.names[process.name[number, edge]]: solution.choice_values[number, edge]
            for edge in np.flatnonzero(process.available[number])
        }
        wanted = {name: values[after] for name, after in found[stacks[number]].items()}
        assert taken == pytest.approx(wanted, abs=1e-7)
    assert np.all(solution.choice_values[~process.available] == -np.inf)
    begins = np.flatnonzero(process.tables.initial_probs)
    mean = sum(process.tables.initial_probs[state] * values[interpreter.start(int(state))] for state in begins)
    assert process.initial_mean(solution.values) == pytest.approx(mean, abs=1e-7)


@settings(max_examples=120)
@given(st.integers(0, 10**9))
def test_random_machines_are_what_a_plain_interpreter_makes_of_them(seed: int) -> None:
    hierarchy = random_hierarchy(seed, WORLD.action_names, sound=True)
    try:
        configurations(hierarchy)
    except InvalidMachine:
        assume(False)  # it may run on without taking time, which is the only thing that is not sound
    same_as_interpreted(WORLD, hierarchy)


def test_the_library_machines_are_what_a_plain_interpreter_makes_of_them() -> None:
    arm = MagnetArm(3, 3, 2, 2)
    same_as_interpreted(arm, pull_up(arm))
    maze = CorridorMaze(rows=1, columns=2, length=3, maze_seed=1)
    same_as_interpreted(maze, walk_corridors(maze))


@pytest.mark.parametrize("environment", [FourRooms(), MagnetArm(4, 3, 3, 3), WORLD], ids=["rooms", "arm", "random"])
@pytest.mark.parametrize("discount", [0.9, 0.99, 1.0])
def test_a_choice_over_all_actions_loses_nothing(environment, discount: float) -> None:
    process = joint_process(environment, every_action(environment))
    flat = value_iteration(tabulate(environment), discount)
    solution = joint_values(process, discount)
    np.testing.assert_allclose(
        solution.choice_values, flat.action_values[process.state[: process.num_choices]], atol=1e-6
    )
    assert process.num_choices == (~process.tables.terminal).sum()


@pytest.mark.parametrize(
    ("size", "steps", "choices", "choice_states"),
    [((5, 3, 4, 4), 24, 8, 93), ((5, 4, 4, 4), 36, 12, 324)],
)
def test_the_pull_up_machine_is_slower_than_the_best_policy(size, steps, choices, choice_states) -> None:
    arm = MagnetArm(*size)
    best = hierarchical_optimum(arm, pull_up(arm))
    assert best.optimal_steps == pytest.approx(steps, abs=1e-9)
    assert best.optimal_choices == pytest.approx(choices, abs=1e-9)
    assert best.optimal_return == pytest.approx(100 - steps, abs=1e-9)
    assert best.choice_states == choice_states
    assert best.optimal_steps > optimum(arm).optimal_steps
    closed_form = 100 * 0.99 ** (steps - 1) - (1 - 0.99**steps) / 0.01
    assert best.discounted_value == pytest.approx(closed_form, abs=1e-6)


def test_the_taxi_machine_is_as_good_as_the_best_policy() -> None:
    taxi = Taxi(move_success=0.8)
    best = hierarchical_optimum(taxi, get_and_put(taxi))
    assert best.optimal_return == pytest.approx(3.954575, abs=1e-6)
    assert best.optimal_return == pytest.approx(optimum(taxi).optimal_return, abs=1e-6)
    assert best.optimal_steps == pytest.approx(optimum(taxi).optimal_steps, abs=1e-5)
    # Of equal policies it takes the one with the fewest choices, which may go two steps at once.
    assert best.optimal_choices < 2 * (best.optimal_steps - 2)


def test_the_maze_machine_reaches_the_goal() -> None:
    maze = CorridorMaze(rows=3, columns=3, length=5)
    best, flat = hierarchical_optimum(maze, walk_corridors(maze)), optimum(maze)
    assert flat.optimal_return > best.optimal_return > flat.optimal_return - 25
    assert best.optimal_choices < best.optimal_steps / 3


def two_calls(second: str) -> Hierarchy:
    """One machine called from two places. A step to the right follows the first call, and `second` the second."""
    root = Machine(
        "root",
        "which",
        {
            "which": Choice({"first": "first", "second": "second"}),
            "first": Call("wait", then="right"),
            "second": Call("wait", then="other"),
            "right": Action("right", then="stop"),
            "other": Action(second, then="stop"),
            "stop": Stop(),
        },
    )
    wait = Machine("wait", "go on", {"go on": Choice({"yes": "left"}), "left": Action("left", "stop"), "stop": Stop()})
    return Hierarchy("root", (root, wait))


class Ends(Corridor):
    """One step to the right pays 1, one to the left -1, from the middle of three cells; nothing else pays."""

    def initial_distribution(self):
        return jnp.ones(1), jnp.ones(1, dtype=jnp.int32)

    def reward(self, state, action, next_state):
        return jnp.where(action == 1, 1.0, 0.0) - jnp.where((action == 0) & (state == 0), 1.0, 0.0)


def test_one_machine_called_from_two_places_has_two_values() -> None:
    """A table without the stack would have one value for the choice inside; its two values here are 1 and -1."""
    process = joint_process(Ends(length=4), two_calls("left"))
    solution = joint_values(process, 1.0)
    inside = {
        process.text(number): solution.choice_values[number, 0]
        for number in range(process.num_choices)
        if ">" in process.text(number)
    }
    assert {text.split(" > ")[0]: value for text, value in inside.items()} == {"root.first": 1.0, "root.second": -1.0}


def test_time_is_discounted_by_steps_and_not_by_choices() -> None:
    """Three choices in a row, then a walk of four steps to the end, of which the last pays."""
    corridor = Corridor(length=5)
    vertices = {
        "a": Choice({"on": "b"}),
        "b": Choice({"on": "c"}),
        "c": Choice({"on": "walk"}),
        "walk": Call("walk", then="stop"),
        "stop": Stop(),
    }
    hierarchy = Hierarchy("root", (Machine("root", "a", vertices), sequence("walk", *["right"] * 4)))
    process = joint_process(corridor, hierarchy)
    assert process.configurations.choices_in_a_row == 3
    worth = sum(0.5**step * (step + 1) for step in range(4))  # entering cell n pays n
    np.testing.assert_allclose(joint_values(process, 0.5).values[:3], worth, atol=1e-9)
    policy = np.zeros(3, dtype=int)
    np.testing.assert_allclose(evaluate_choices(process, policy, 0.5)[:3], worth, atol=1e-9)
    assert process.initial_mean(expected_joint_steps(process, policy)) == pytest.approx(4)
    assert process.initial_mean(expected_choices(process, policy)) == pytest.approx(3)


def test_the_episode_ends_in_the_middle_of_a_machine() -> None:
    """Nine steps to the right of which the fourth reaches the end: no more of them are taken."""
    corridor = Corridor(length=5, step_reward=-1.0)
    root = Machine("root", "go", {"go": Call("walk", then="go")})
    process = joint_process(corridor, Hierarchy("root", (root, sequence("walk", *["right"] * 9))))
    assert process.num_choices == 0
    assert process.end == 4
    assert process.initial_mean(evaluate_choices(process, np.zeros(0, dtype=int), 1.0)) == pytest.approx(0 + 1 + 2 + 3)


def test_the_roots_stop_ends_the_episode() -> None:
    """One step to the right, or two, and the corridor goes on."""
    vertices = {
        "which": Choice({"one": "one", "two": "two"}),
        "one": Action("right", then="stop"),
        "two": Action("right", then="one"),
        "stop": Stop(),
    }
    process = joint_process(Corridor(), Hierarchy("root", (Machine("root", "which", vertices),)))
    assert joint_values(process, 1.0).choice_values.tolist() == [[1.0, 1.0 + 2.0]]
    assert not process.tables.terminal[process.state[:-1]].any()


def test_an_edge_may_be_forbidden_where_a_predicate_does_not_hold() -> None:
    """Left may be gone from even cells only: from cell 1 there is no way but right."""
    choose = Choice({"left": "left", "right": "right"}, only_if={"left": Predicate(is_even)})
    vertices = {"choose": choose, "left": Action("left", "choose"), "right": Action("right", "choose")}
    process = joint_process(Corridor(), Hierarchy("root", (Machine("root", "choose", vertices),)))
    even = np.asarray(process.tables.space.states)[process.state[: process.num_choices]] % 2 == 0
    np.testing.assert_array_equal(process.available, np.stack([even, np.ones_like(even)], axis=1))
    odd = int(np.flatnonzero(~even)[0])
    with pytest.raises(LodestoneError, match="may not be taken"):
        evaluate_choices(process, np.where(np.arange(process.num_choices) == odd, 0, 1), 0.9)


@pytest.mark.parametrize("discount", [0.9, 1.0])
def test_a_policy_is_worth_what_it_brings(discount: float) -> None:
    """The greedy policy attains the optimum; a random one is worth the mean over its edges."""
    taxi = Taxi(move_success=0.8)
    process = joint_process(taxi, get_and_put(taxi))
    solution = joint_values(process, discount)
    greedy = evaluate_choices(process, greedy_choices(solution.choice_values), discount)
    np.testing.assert_allclose(greedy, solution.values, atol=1e-5)
    uniform = process.available / process.available.sum(axis=1, keepdims=True)
    values = evaluate_choices(process, uniform, discount)
    mean = (uniform * values[process.edges]).sum(axis=1)
    np.testing.assert_allclose(values[: process.num_choices], mean, atol=1e-8)
    step = (process.probs * (process.rewards + discount * values[process.successors])).sum(axis=1)
    np.testing.assert_allclose(values[process.num_choices : -1], step, atol=1e-8)


def test_without_a_discount_what_may_never_end_is_worth_minus_infinity() -> None:
    """Two ways, of which one leads to and fro for ever."""
    vertices = {
        "which": Choice({"on": "on", "round": "left"}),
        "on": Action("right", then="on"),
        "left": Action("left", then="left"),
    }
    process = joint_process(Corridor(step_reward=-1.0), Hierarchy("root", (Machine("root", "which", vertices),)))
    assert joint_values(process, 1.0).choice_values.tolist() == [[0 + 1 + 2 + 3, -np.inf]]
    assert process.initial_mean(evaluate_choices(process, np.array([1]), 1.0)) == -np.inf
    assert process.initial_mean(expected_joint_steps(process, np.array([1]))) == np.inf
    assert process.initial_mean(expected_joint_steps(process, np.array([0]))) == pytest.approx(4)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_values_are_within_the_tolerance(tolerance: float) -> None:
    hierarchy = get_and_put(Taxi(move_success=0.8))
    process = joint_process(Taxi(move_success=0.8), hierarchy)
    rough, fine = joint_values(process, 0.95, tolerance), joint_values(process, 0.95, 1e-11)
    assert 0 < np.abs(rough.values - fine.values).max() <= tolerance


def test_what_only_shows_in_states_is_said() -> None:
    """Cells count from 0: of three classes, only two have an edge; and in odd cells, nothing may be chosen."""
    vertices = {"ask": Branch(Predicate(part, {"parts": 3}), {0: "go", 1: "go"}), "go": Action("right", then="ask")}
    with pytest.raises(InvalidMachine, match=r"an answer without an edge in root.ask where 2\."):
        joint_process(Corridor(), Hierarchy("root", (Machine("root", "ask", vertices),)))
    vertices = {"ask": Choice({"go": "go"}, {"go": Predicate(is_even)}), "go": Action("right", then="ask")}
    with pytest.raises(InvalidMachine, match=r"No edge may be taken in root.ask where 1\."):
        joint_process(Corridor(), Hierarchy("root", (Machine("root", "ask", vertices),)))


def half(environment, state):
    return state / 2


def test_a_predicate_that_does_not_answer_with_a_bool_or_an_integer_is_refused() -> None:
    vertices = {"ask": Branch(Predicate(half), {0: "go"}), "go": Action("right", then="ask")}
    with pytest.raises(InvalidMachine, match="half must answer with one bool or integer, but answers with float32"):
        joint_process(Corridor(), Hierarchy("root", (Machine("root", "ask", vertices),)))


def test_too_many_pairs_are_refused(monkeypatch) -> None:
    monkeypatch.setattr(landing, "MAX_PAIRS", 10)
    with pytest.raises(TooManyStates, match="5 states times 3 configurations"):
        joint_process(Corridor(), every_action(Corridor()))


def test_a_discount_outside_the_unit_interval_is_refused() -> None:
    process = joint_process(Corridor(), every_action(Corridor(length=5)))
    with pytest.raises(InvalidConfig, match="discount"):
        joint_values(process, 1.5)
