"""Recursive against hierarchical optimality, in the two rooms (after Dietterich 2000, section 3 and figure 6).

Leaving the left room by the nearer door is best for *exit* taken by itself, and not for what comes after. MAXQ learns
the recursive optimum of -8.5; a pseudo-reward for the doors gives the flat optimum of -7.75.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from lodestone.agents.maxq import MAXQConfig, as_configured, chooser, maxq, rounds_for
from lodestone.envs.two_rooms import TwoRooms
from lodestone.experiments.comparison import Gate, at_most
from lodestone.experiments.following import Followed, follow
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.progress import Progress
from lodestone.options.execution import Rules
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import evaluate_choices, recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks

ROOMS = TwoRooms()
RULES = Rules(discount=1.0, step_limit=50)
STEPS, LOOKS = 40_000, 60
WORST = -50.0
"""What a policy is judged to be worth that never gets to the goal from some start: a loss of the step limit."""

WITH, WITHOUT = "MAXQ-Q, doors valued", "MAXQ-Q, no pseudo-reward"
CONFIGS = {
    name: MAXQConfig(((0.0, 0.5),), ((0.0, 0.5), (1.0, 0.1)), pseudo_rewards=name == WITH) for name in (WITHOUT, WITH)
}


def run(seeds: int, progress: Progress) -> Study:
    """Train with and without the pseudo-reward."""
    tables = tabulate(ROOMS)
    best = value_iteration(tables, 1.0).values
    optimum = tables.initial_mean(best)
    exact = {}
    for name, config in CONFIGS.items():
        tasks = tabulate_tasks(as_configured(config, task_graph(ROOMS)), ROOMS, tables)
        exact[name] = recursive_optimum(tasks, tables).values[0]
    followed = {name: _follow(config, name, seeds, progress) for name, config in CONFIGS.items()}
    recursive = tables.initial_mean(exact[WITHOUT])
    begins = tables.initial_probs > 0
    losing = {name: int((np.abs(best[begins] - values[begins]) > 1e-6).sum()) for name, values in exact.items()}
    x = np.linspace(0, STEPS, 100)
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "Each step costs 1. The subtask exit ends in the right room and is solved for itself: without a "
            "pseudo-reward it takes the nearer door, which from 8 of the 32 cells is not on the shortest way to the "
            "goal. Valuing the doors by what is still to come mends it. Curves: exact value of the greedy hierarchical "
            "policy, mean over the 32 cells."
        ),
        seeds=seeds,
        panels=(
            Panel(
                "Value of the learned hierarchical policy",
                "primitive steps",
                "return, mean over the left room",
                tuple(Series(name, x, one.at(one.steps, x)) for name, one in followed.items()),
                references=((f"flat optimum {optimum:g}", optimum), (f"recursive optimum {recursive:g}", recursive)),
                y_range=(-14.0, -7.0),
            ),
        ),
        tables=(
            NumberTable(
                "Exact values",
                ("", "mean over the left room", "cells that lose"),
                (
                    ("flat optimum", optimum, 0),
                    ("recursive optimum, no pseudo-reward", recursive, losing[WITHOUT]),
                    ("recursive optimum, doors valued", tables.initial_mean(exact[WITH]), losing[WITH]),
                ),
            ),
        ),
        gates=tuple(_gates(followed, recursive, optimum, losing)),
    )


def _follow(config: MAXQConfig, name: str, seeds: int, progress: Progress) -> Followed:
    tables, graph = tabulate(ROOMS), task_graph(ROOMS)
    tasks = tabulate_tasks(as_configured(config, graph), ROOMS, tables)
    progress.begin(f"two-rooms: {name}", STEPS)

    choose = chooser(config, ROOMS, graph)

    def judge(carry: Any) -> Float[np.ndarray, " N"]:
        found = [evaluate_choices(tasks, tables, choices) for choices in choose(carry.learned)[:seeds]]
        return np.maximum([tables.initial_mean(one.values[0]) for one in found], WORST)

    return follow(
        maxq(config, ROOMS, graph, RULES, STEPS),
        tasks.edge_names,
        seeds,
        rounds_for(graph, STEPS),
        LOOKS,
        judge,
        STEPS,
        lambda done, text: progress.advance(done * STEPS, text),
    )


def _gates(followed: dict[str, Followed], recursive: float, optimum: float, losing: dict[str, int]) -> list[Gate]:
    ends = {name: one.judged[-1] for name, one in followed.items()}
    return [
        at_most("recursive optimum, distance from -8.5", abs(recursive + 8.5), 1e-9),
        at_most("flat optimum, distance from -7.75", abs(optimum + 7.75), 1e-9),
        at_most("cells that lose by the recursive optimum, distance from 8", abs(losing[WITHOUT] - 8), 0),
        at_most("cells that lose where doors are valued", losing[WITH], 0),
        at_most(f"worst seed's distance from -8.5, {WITHOUT}", float(np.abs(ends[WITHOUT] + 8.5).max()), 1e-6),
        at_most(f"worst seed's distance from -7.75, {WITH}", float(np.abs(ends[WITH] + 7.75).max()), 1e-6),
    ]


EXPERIMENT = Experiment("two-rooms", "Recursive against hierarchical optimality", seeds=20, work=2.0 * STEPS, run=run)
