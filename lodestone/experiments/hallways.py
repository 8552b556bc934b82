"""Planning and learning with hallway options in the four rooms (Sutton, Precup and Singh 1999, sections 3, 5 and 6).

The goal is a hallway, which hallway options lead to, or inside a room, where they alone get no better than by chance.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from lodestone.agents.intra_option import IntraOptionConfig, intra_option_q_learning
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.envs.four_rooms import NUMBER, FourRooms
from lodestone.experiments.comparison import Gate, at_most
from lodestone.experiments.following import Followed, follow
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.progress import Progress
from lodestone.options.base import Options, Primitives, Union
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import hallway_options
from lodestone.planning.option_models import OptionSolution, option_value_iteration, tabulate_options
from lodestone.planning.solve import optimum
from lodestone.planning.tables import tabulate

IN_HALLWAY, IN_ROOM = "goal in a hallway", "goal in a room"
GOALS = {IN_HALLWAY: FourRooms(goal=int(NUMBER[7, 9])), IN_ROOM: FourRooms(goal=int(NUMBER[9, 9]))}
DISCOUNT = 0.9
RULES = Rules(discount=DISCOUNT, step_limit=1000)

ACTIONS, HALLWAYS, BOTH, INTRA = "actions", "hallways", "both", "both, intra-option"
EXPECTED = {
    (IN_HALLWAY, ACTIONS): (0.093109, 0.326272, 106),
    (IN_HALLWAY, HALLWAYS): (0.093109, 0.326209, 34),
    (IN_HALLWAY, BOTH): (0.093109, 0.326272, 74),
    (IN_ROOM, ACTIONS): (0.062541, 0.322896, 110),
    (IN_ROOM, HALLWAYS): (0.020486, 0.134995, 47),
    (IN_ROOM, BOTH): (0.062541, 0.322896, 88),
}
"""V* of the upper left corner, its mean over all cells, and the sweeps until one changes no value by more than 1e-12:
from an independent computation."""

LEARNING_RATES = {ACTIONS: 1 / 8, HALLWAYS: 1 / 4, BOTH: 1 / 16, INTRA: 1 / 16}
STEPS, LOOKS = 60_000, 100
EPISODES = 200
"""Episodes that are shown."""


def run(seeds: int, progress: Progress) -> Study:
    """Plan exactly, then let every learner learn for both goals."""
    exact = {(goal, name): _plan(GOALS[goal], name) for goal, name in EXPECTED}
    followed = {(goal, name): _follow(goal, name, exact, seeds, progress) for goal in GOALS for name in LEARNING_RATES}
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "Moves go astray with probability 1/3. Planning with hallway options alone takes a third to a half of the "
            "sweeps, and loses much where the goal is in a room; together with the actions it takes 0.7 to 0.8 of the "
            "sweeps and loses nothing. Learning by Q-learning over options, epsilon 0.1: with options the first "
            "episodes are shorter. Intra-option learning updates every option that would have acted alike after each "
            "step, so the values of all options settle sooner than where an option is updated only when it was run to "
            "its end."
        ),
        seeds=seeds,
        panels=(
            *(_lengths(goal, followed) for goal in GOALS),
            *(_errors(goal, followed) for goal in GOALS),
        ),
        tables=(
            NumberTable(
                "Exact planning, discount 0.9, until a sweep changes nothing by more than 1e-12",
                ("", "goal", "V*(corner)", "V*, mean of all cells", "sweeps"),
                tuple((name, goal, *_numbers(goal, solution)) for (goal, name), solution in exact.items()),
            ),
        ),
        gates=tuple(_gates(exact, followed)),
    )


def _options(rooms: FourRooms, name: str) -> Options:
    primitives, hallways = Primitives(rooms.action_names), hallway_options(rooms)
    return {ACTIONS: primitives, HALLWAYS: hallways}.get(name) or Union((primitives, hallways))


def _plan(rooms: FourRooms, name: str) -> OptionSolution:
    tables = tabulate(rooms)
    options = tabulate_options(_options(rooms, name), tables.space)
    return option_value_iteration(tables, options, DISCOUNT, tolerance=1e-12 / (1 - DISCOUNT))


def _numbers(goal: str, solution: OptionSolution) -> tuple[float, float, int]:
    """The corner's value, the mean value, the sweeps."""
    cell = np.asarray(tabulate(GOALS[goal]).space.states.cell)
    return float(solution.values[cell == 0][0]), float(solution.values.mean()), solution.sweeps


def _follow(
    goal: str, name: str, exact: dict[tuple[str, str], OptionSolution], seeds: int, progress: Progress
) -> Followed:
    """Judged by the root mean square error of the learned option values."""
    rooms, rate = GOALS[goal], ((0.0, LEARNING_RATES[name]),)
    options = _options(rooms, name)
    wanted = exact[goal, BOTH if name == INTRA else name].option_values
    counted = np.isfinite(wanted) & ~tabulate(rooms).terminal[:, None]
    progress.begin(f"hallways: {goal}, {name}", STEPS)

    def judge(carry: Any) -> Float[np.ndarray, " N"]:
        error = np.asarray(carry.table)[:seeds][:, counted] - wanted[counted]
        return np.sqrt(np.square(error).mean(axis=1))

    epsilon = ((0.0, 0.1),)
    algorithm = (
        intra_option_q_learning(IntraOptionConfig(rate, epsilon), rooms, options, RULES, STEPS)
        if name == INTRA
        else q_learning(QLearningConfig(rate, epsilon), rooms, options, RULES, STEPS)
    )
    return follow(
        algorithm,
        options.names,
        seeds,
        STEPS // STEPS_PER_ROUND,
        LOOKS,
        judge,
        STEPS,
        lambda done, text: progress.advance(done * STEPS, text),
    )


def _lengths(goal: str, followed: dict[tuple[str, str], Followed]) -> Panel:
    best, x = optimum(GOALS[goal]).optimal_steps, np.arange(1.0, EPISODES + 1)
    return Panel(
        f"Episodes, {goal}",
        "episode",
        "steps, mean of the last 10 episodes",
        tuple(Series(name, x, followed[goal, name].episode_lengths(EPISODES)) for name in LEARNING_RATES),
        references=((f"optimum {best:.1f}", best),),
        log_x=True,
        y_range=(0.0, 600.0),
    )


def _errors(goal: str, followed: dict[tuple[str, str], Followed]) -> Panel:
    x = np.linspace(0, STEPS, 120)
    return Panel(
        f"Error of the option values, {goal}",
        "primitive steps",
        "root mean square error",
        tuple(Series(name, x, followed[goal, name].at(followed[goal, name].steps, x)) for name in (BOTH, INTRA)),
        y_range=(0.0, 0.4),
    )


def _gates(exact: dict[tuple[str, str], OptionSolution], followed: dict[tuple[str, str], Followed]) -> list[Gate]:
    off = np.array([np.subtract(_numbers(goal, exact[goal, name]), EXPECTED[goal, name]) for goal, name in EXPECTED])
    gates = [
        at_most("exact values, largest distance from the independent ones", float(np.abs(off[:, :2]).max()), 1e-6),
        at_most("sweeps, largest distance from the independent ones", float(np.abs(off[:, 2]).max()), 0),
    ]
    for goal in GOALS:
        lengths = {name: followed[goal, name].episode_lengths(EPISODES)[:, 9] for name in (BOTH, ACTIONS)}
        first = {name: float(np.nanmean(length)) for name, length in lengths.items()}
        errors = {name: float(followed[goal, name].judged[-1].mean()) for name in (BOTH, INTRA)}
        gates += [
            at_most(f"{goal}: steps of the first 10 episodes, {BOTH} / {ACTIONS}", first[BOTH] / first[ACTIONS], 0.8),
            at_most(f"{goal}: final error of values, intra-option / run to the end", errors[INTRA] / errors[BOTH], 0.8),
        ]
    return gates


EXPERIMENT = Experiment(
    "hallways",
    "Planning and learning with hallway options",
    seeds=20,
    work=float(len(GOALS) * len(LEARNING_RATES) * STEPS),
    run=run,
)
