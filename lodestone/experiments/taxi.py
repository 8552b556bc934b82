"""MAXQ on the taxi: a task graph, with and without state abstraction, against flat Q-learning (Dietterich 2000).

Rewards are Gymnasium's, moves do not slip, time is not discounted: the best policy gets 7.93 on average over the 300
starts, which the task graph can reach. Each learner is judged by its greedy policy, exactly.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from lodestone.agents.maxq import MAXQConfig, as_configured, chooser, maxq, rounds_for
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.envs.taxi import Taxi
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.following import Followed, follow, return_within
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.progress import Progress
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import check_abstraction, polled_policy, recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks

TAXI = Taxi()
RULES = Rules(discount=1.0, step_limit=1000)
JUDGED_STEPS = 50
"""Steps after which a greedy policy is stopped: the optimum takes 18 at most."""

ABSTRACT, WHOLE, FLAT = "MAXQ-Q, abstraction", "MAXQ-Q, whole states", "Q-learning, flat"
EPSILON = ((0.0, 0.5), (0.8, 0.5), (1.0, 0.02))
CONFIGS: dict[str, MAXQConfig | QLearningConfig] = {
    ABSTRACT: MAXQConfig(learning_rate=((0.0, 0.25),), epsilon=EPSILON),
    WHOLE: MAXQConfig(learning_rate=((0.0, 0.5),), epsilon=EPSILON, abstraction=False),
    FLAT: QLearningConfig(learning_rate=((0.0, 0.5),), epsilon=EPSILON),
}
STEPS = {ABSTRACT: 70_000, WHOLE: 250_000, FLAT: 120_000}
"""Primitive steps of each seed."""
LOOKS = 800


def run(seeds: int, progress: Progress) -> Study:
    """Train the three learners on all seeds."""
    tables, graph = tabulate(TAXI), task_graph(TAXI)
    tasks = tabulate_tasks(graph, TAXI, tables)
    best, recursive = value_iteration(tables, 1.0), recursive_optimum(tasks, tables)
    check_abstraction(tasks, tables, recursive)
    optimum = tables.initial_mean(best.values)
    followed = {name: _follow(name, seeds, progress) for name in CONFIGS}
    stored = {name: _stored(name) for name in CONFIGS}
    rows = [
        (name, stored[name], _reached(one, 0.0), _reached(one, 7.5), float(one.judged[-1].mean()), one.seconds)
        for name, one in followed.items()
    ]
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "The task graph splits the taxi's work into getting the passenger, putting him down and navigating. With "
            "Dietterich's state abstractions navigation is learned once for all journeys, and MAXQ-Q needs fewer "
            "episodes than flat Q-learning; without them it needs more. Each curve is the exact expected return of the "
            "greedy policy over the 300 starts, stopped after 50 steps. Task graphs are played by polling: every step "
            "asks anew from the root down."
        ),
        seeds=seeds,
        panels=tuple(
            Panel(
                title=f"Greedy return over {what}",
                x_label=what,
                y_label="greedy return, mean over the starts",
                series=tuple(_series(name, one, what) for name, one in followed.items()),
                references=((f"optimum {optimum:.2f}", optimum),),
                y_range=(-60.0, 12.0),
            )
            for what in ("episodes", "primitive steps")
        ),
        tables=(
            NumberTable(
                "Learners",
                ("", "values stored", "episodes to return 0", "episodes to return 7.5", "return at the end", "seconds"),
                tuple(rows),
            ),
        ),
        gates=tuple(_gates(followed, optimum, tables.initial_mean(recursive.values[0]), stored[ABSTRACT])),
    )


def _follow(name: str, seeds: int, progress: Progress) -> Followed:
    config, steps, tables = CONFIGS[name], STEPS[name], tabulate(TAXI)
    progress.begin(f"taxi: {name}", steps)
    tell = lambda done, text: progress.advance(done * steps, text)  # noqa: E731
    looking = partial(follow, seeds=seeds, looks=LOOKS, steps=steps, tell=tell)
    if isinstance(config, QLearningConfig):
        options = Primitives(TAXI.action_names)

        def judge_table(carry: Any) -> Float[np.ndarray, " N"]:
            return return_within(tables, np.asarray(carry.table)[:seeds].argmax(axis=2), JUDGED_STEPS)

        algorithm = q_learning(config, TAXI, options, RULES, steps)
        return looking(algorithm, options.names, rounds=steps // STEPS_PER_ROUND, judge=judge_table)

    graph = task_graph(TAXI)
    tasks = tabulate_tasks(as_configured(config, graph), TAXI, tables)

    choose = chooser(config, TAXI, graph)

    def judge(carry: Any) -> Float[np.ndarray, " N"]:
        policies = np.stack([polled_policy(tasks, choices) for choices in choose(carry.learned)[:seeds]])
        return return_within(tables, policies, JUDGED_STEPS)

    algorithm = maxq(config, TAXI, graph, RULES, steps)
    return looking(algorithm, tasks.edge_names, rounds=rounds_for(graph, steps), judge=judge)


def _stored(name: str) -> int:
    config, tables = CONFIGS[name], tabulate(TAXI)
    if isinstance(config, QLearningConfig):
        return tables.num_states * tables.num_actions
    return tabulate_tasks(as_configured(config, task_graph(TAXI)), TAXI, tables).num_slots


def _series(name: str, one: Followed, what: str) -> Series:
    counts = one.episodes if what == "episodes" else one.steps
    grid = np.linspace(0, min(6000 if what == "episodes" else 120_000, counts[-1].min()), 160)
    return Series(name, grid, one.at(counts, grid))


def _reached(one: Followed, threshold: float) -> float:
    """Median over seeds of the episodes after which the greedy policy was first judged to be worth so much."""
    reached = one.judged >= threshold
    first = np.where(reached.any(axis=0), one.episodes[reached.argmax(axis=0), np.arange(reached.shape[1])], np.inf)
    return float(np.median(first))


def _after(one: Followed, episodes: int) -> float:
    """Mean over seeds of what the greedy policy was worth after so many episodes."""
    return float(one.at(one.episodes, np.array([float(episodes)])).mean())


def _gates(followed: dict[str, Followed], optimum: float, recursive: float, stored: int) -> list[Gate]:
    episodes = {name: _reached(one, 7.5) for name, one in followed.items()}
    return [
        at_most("recursive optimum, distance from the flat optimum", abs(recursive - optimum), 1e-6),
        at_most(f"values stored, {ABSTRACT}", stored, 632),
        at_least(f"greedy return after 800 episodes, {ABSTRACT}", _after(followed[ABSTRACT], 800), 3.9),
        at_least(f"greedy return after 1600 episodes, {ABSTRACT}", _after(followed[ABSTRACT], 1600), 7.925),
        at_least(f"greedy return after 3000 episodes, {WHOLE}", _after(followed[WHOLE], 3000), 2.5),
        at_least(f"greedy return after 6000 episodes, {WHOLE}", _after(followed[WHOLE], 6000), 7.925),
        at_least(f"greedy return after 3000 episodes, {FLAT}", _after(followed[FLAT], 3000), 7.88),
        at_most(f"episodes to return 7.5, {ABSTRACT} / {FLAT}", episodes[ABSTRACT] / episodes[FLAT], 0.999),
        at_most(f"episodes to return 7.5, {FLAT} / {WHOLE}", episodes[FLAT] / episodes[WHOLE], 0.999),
    ]


EXPERIMENT = Experiment("taxi", "MAXQ on the taxi", seeds=20, work=float(sum(STEPS.values())), run=run)
