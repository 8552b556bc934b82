"""Abstract machines against flat Q-learning: the pull-up machine of the magnet arm, and a maze of corridors.

On the arm the settings are those of the authors of Kuzmin and Panov (2018); the maze is of the kind of Parr and Russell
(1997). A machine learns sooner, and is held to what it allows: its exact optimum lies below that of the environment.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from lodestone.agents.hamq import TICKS_PER_ROUND, HAMQConfig, hamq
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.envs.base import Environment
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.following import Followed, follow
from lodestone.experiments.study import Experiment, LearnedMachines, NumberTable, Panel, Series, Study
from lodestone.learning.progress import Progress
from lodestone.learning.schedules import Knots
from lodestone.machines.catalogue import machines
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.planning.joint import (
    evaluate_choices,
    expected_visits,
    hierarchical_optimum,
    joint_process,
    joint_values,
)
from lodestone.planning.solve import evaluate_policy, optimum, value_iteration
from lodestone.planning.tables import tabulate

ARM = MagnetArm(rows=5, columns=3, bricks=4, tower_height=4)
ARM_RULES = Rules(discount=0.9, step_limit=300)
ARM_STEPS = {"HAMQ, pull-up": 80_000, "Q-learning, flat": 400_000}
EPISODES = 1500

MAZE = CorridorMaze()
MAZE_RULES = Rules(discount=0.999, step_limit=5000)
MAZE_STEPS = {"HAMQ, corridors": 4_000_000, "Q-learning, flat": 6_000_000}
MAZE_VALUE = -400.0
"""The value whose first crossing is compared."""
JUDGED_EPSILON = 0.1
"""In the maze policies are judged with so much chance in their choices: one that has never been somewhere may run in a
circle there for ever, which would be all that is seen of it."""
LOOKS = 30


def run(seeds: int, progress: Progress) -> Study:
    """Train on the arm, then in the maze."""
    arm = {name: _on_arm(name, seeds, progress) for name in ARM_STEPS}
    maze = {name: _in_maze(name, seeds, progress) for name in MAZE_STEPS}
    arm_best, arm_machine = optimum(ARM), hierarchical_optimum(ARM, machines(ARM))
    maze_best, maze_machine = optimum(MAZE), hierarchical_optimum(MAZE, machines(MAZE))
    maze_values = _best_in_maze()
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "Left: the arm may go left, go right, let go, or pull up what lies below it, which takes nine steps every "
            "time. Returns of training episodes. Right: in the maze of corridors the machine chooses where to go at an "
            "intersection and how to get round an obstacle; exact value of the policy from the start, which takes a "
            "choice at random with probability 0.1, discount 0.999. Machines learn sooner, and are held to what they "
            "allow (dashed lines: the optimal policies, judged in the same way)."
        ),
        seeds=seeds,
        panels=(
            Panel(
                "Magnet arm, 5 x 3, 4 bricks",
                "episode",
                "return, mean of the last 50 episodes",
                tuple(Series(name, np.arange(1.0, EPISODES + 1), _returns(one, 50)) for name, one in arm.items()),
                references=(
                    (f"optimum {arm_best.optimal_return:g}", arm_best.optimal_return),
                    (f"of the machine {arm_machine.optimal_return:g}", arm_machine.optimal_return),
                ),
            ),
            Panel(
                f"Maze of corridors, {maze_best.states:,} states",
                "primitive steps",
                "discounted value from the start",
                tuple(_maze_series(name, one) for name, one in maze.items()),
                references=(
                    (f"optimal policy {maze_values[0]:.0f}", maze_values[0]),
                    (f"of the machine {maze_values[1]:.0f}", maze_values[1]),
                ),
            ),
        ),
        tables=(
            NumberTable(
                "Exact optima",
                ("", "joint states", "choices", "steps", "return"),
                (
                    ("arm", arm_best.states, arm_best.states, arm_best.optimal_steps, arm_best.optimal_return),
                    (
                        "arm, pull-up machine",
                        arm_machine.joint_states,
                        arm_machine.choice_states,
                        arm_machine.optimal_steps,
                        arm_machine.optimal_return,
                    ),
                    ("maze", maze_best.states, maze_best.states, maze_best.optimal_steps, maze_best.optimal_return),
                    (
                        "maze, corridor machine",
                        maze_machine.joint_states,
                        maze_machine.choice_states,
                        maze_machine.optimal_steps,
                        maze_machine.optimal_return,
                    ),
                ),
            ),
        ),
        gates=tuple(_gates(arm, maze)),
        machines=(
            _learned("The pull-up machine, as learned by seed 0", ARM, arm["HAMQ, pull-up"]),
            _learned("The corridor machine, as learned by seed 0", MAZE, maze["HAMQ, corridors"]),
        ),
    )


def _decaying(steps: int) -> Knots:
    """The authors multiply epsilon, 0.1 at first, by 0.9999 after every step."""
    knots = [(step / steps, 0.1 * math.exp(-step / 10_000)) for step in range(0, min(steps, 80_000) + 1, 4000)]
    return tuple(knots)


def _on_arm(name: str, seeds: int, progress: Progress) -> Followed:
    steps = ARM_STEPS[name]
    progress.begin(f"machines: arm, {name}", steps)
    rate, options = ((0.0, 0.1),), Primitives(ARM.action_names)
    if name.startswith("HAMQ"):
        config = HAMQConfig(rate, _decaying(steps))
        algorithm, rounds = hamq(config, ARM, machines(ARM), ARM_RULES, steps), -(-steps // TICKS_PER_ROUND)
        choices = joint_process(ARM, machines(ARM)).names
    else:
        flat = QLearningConfig(rate, _decaying(steps))
        algorithm, rounds = q_learning(flat, ARM, options, ARM_RULES, steps), -(-steps // STEPS_PER_ROUND)
        choices = options.names
    nothing = np.zeros(seeds)
    tell = lambda done, text: progress.advance(done * steps, "")  # noqa: E731
    return follow(algorithm, choices, seeds, rounds, LOOKS, lambda carry: nothing, steps, tell)


def _in_maze(name: str, seeds: int, progress: Progress) -> Followed:
    steps = MAZE_STEPS[name]
    progress.begin(f"machines: maze, {name}", steps)
    rate, epsilon = ((0.0, 0.5), (1.0, 0.1)), ((0.0, 0.1),)
    if name.startswith("HAMQ"):
        process = joint_process(MAZE, machines(MAZE))
        config = HAMQConfig(rate, epsilon)
        algorithm, rounds = hamq(config, MAZE, machines(MAZE), MAZE_RULES, steps), -(-steps // TICKS_PER_ROUND)
        choices, judge = process.names, partial(_judge_machine, seeds)
    else:
        options, flat = Primitives(MAZE.action_names), QLearningConfig(rate, epsilon)
        algorithm, rounds = q_learning(flat, MAZE, options, MAZE_RULES, steps), -(-steps // STEPS_PER_ROUND)
        choices, judge = options.names, partial(_judge_flat, seeds)
    tell = lambda done, text: progress.advance(done * steps, text)  # noqa: E731
    return follow(algorithm, choices, seeds, rounds, LOOKS, judge, steps, tell)


def _maze_series(name: str, one: Followed) -> Series:
    x = np.linspace(0, MAZE_STEPS[name], 120)
    return Series(name, x, one.at(one.steps, x))


def _learned(title: str, environment: Environment, one: Followed) -> LearnedMachines:
    """With visits of the policy that is greedy but for `JUDGED_EPSILON`, which surely ends."""
    process = joint_process(environment, machines(environment))
    policy = _softened(np.asarray(one.carry.table)[0], process.available)
    return LearnedMachines(title, process, expected_visits(process, policy))


def _judge_machine(seeds: int, carry: Any) -> Float[np.ndarray, " N"]:
    return np.array([_machine_value(table) for table in np.asarray(carry.table)[:seeds]])


def _judge_flat(seeds: int, carry: Any) -> Float[np.ndarray, " N"]:
    return np.array([_flat_value(table) for table in np.asarray(carry.table)[:seeds]])


def _machine_value(choice_values: Float[np.ndarray, "N U"]) -> float:
    process = joint_process(MAZE, machines(MAZE))
    policy = _softened(choice_values, process.available)
    return process.initial_mean(evaluate_choices(process, policy, MAZE_RULES.discount))


def _flat_value(action_values: Float[np.ndarray, "S A"]) -> float:
    tables = tabulate(MAZE)
    policy = _softened(action_values, np.ones(action_values.shape, dtype=bool))
    return tables.initial_mean(evaluate_policy(tables, policy, MAZE_RULES.discount))


def _softened(values: Float[np.ndarray, "N U"], available: Bool[np.ndarray, "N U"]) -> Float[np.ndarray, "N U"]:
    """The greedy policy, with a chance of `JUDGED_EPSILON` for any choice that may be taken."""
    greedy = np.eye(values.shape[1])[values.argmax(axis=1)]
    return (1 - JUDGED_EPSILON) * greedy + JUDGED_EPSILON * available / available.sum(axis=1, keepdims=True)


def _best_in_maze() -> tuple[float, float]:
    """What the optimal policy of the environment and that of the machine are worth, judged as the learners are."""
    best = value_iteration(tabulate(MAZE), MAZE_RULES.discount).action_values
    machine = joint_values(joint_process(MAZE, machines(MAZE)), MAZE_RULES.discount).choice_values
    return _flat_value(best), _machine_value(machine)


def _returns(one: Followed, window: int) -> Float[np.ndarray, "N E"]:
    """Running mean of the returns of each seed's first episodes; not a number where it did not finish so many."""
    seeds = one.judged.shape[1]
    returns = np.full((seeds, EPISODES), np.nan)
    for seed in range(seeds):
        found = one.history.episodes(seed).total_reward[:EPISODES]
        returns[seed, : len(found)] = found
    sums = np.cumsum(np.insert(returns, 0, 0.0, axis=1), axis=1)
    last = np.arange(1, EPISODES + 1)
    first = np.maximum(last - window, 0)
    return (sums[:, last] - sums[:, first]) / (last - first)


def _gates(arm: dict[str, Followed], maze: dict[str, Followed]) -> list[Gate]:
    machine, flat = (_returns(one, EPISODES) * np.arange(1, EPISODES + 1) for one in arm.values())

    def mean(sums: Float[np.ndarray, "N E"], first: int, last: int) -> float:
        """Of the returns of episodes first + 1 to last."""
        return float(np.mean((sums[:, last - 1] - sums[:, first - 1]) / (last - first)))

    def crossing(one: Followed) -> float:
        values = one.judged.mean(axis=1)
        return float(one.steps[np.argmax(values >= MAZE_VALUE)].mean()) if values.max() >= MAZE_VALUE else math.inf

    ham, q = maze.values()
    ratio = crossing(ham) / crossing(q)
    return [
        at_least("arm: mean return of episodes 101-150, HAMQ", mean(machine, 100, 150), 70),
        at_least("arm: mean return of episodes 1401-1500, HAMQ", mean(machine, 1400, 1500), 75.95),
        at_most("arm: mean return of episodes 101-150, flat", mean(flat, 100, 150), -200),
        at_least("arm: mean return of episodes 1401-1500, flat", mean(flat, 1400, 1500), 81.5),
        at_most(f"maze: steps until policies are worth {MAZE_VALUE:g}, HAMQ / flat", ratio, 0.5),
    ]


EXPERIMENT = Experiment(
    "machines",
    "Abstract machines against flat Q-learning",
    seeds=20,
    work=float(sum(ARM_STEPS.values()) + sum(MAZE_STEPS.values())),
    run=run,
)
