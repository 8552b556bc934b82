"""Updates a second of HAMQ and MAXQ-Q on the taxi (moves go astray with probability 0.2), beside plain loops.

    python benchmarks/hierarchies.py            # a table
    python benchmarks/hierarchies.py --json     # the same, for a program

Lodestone trains a batch of seeds on all cores, its log included. The plain loops are the same learners for one seed on
one core, in Python with NumPy, on the same tables. An update is one of a choice's value (HAMQ), or one of a stored
reward or completion (MAXQ-Q with all-states updating).
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for a checkout that is not installed

from command import run

from lodestone.agents.hamq import TICKS_PER_ROUND, HAMQConfig, hamq
from lodestone.agents.maxq import EVENTS_PER_ROUND, MAXQConfig, maxq
from lodestone.envs.taxi import Taxi
from lodestone.learning.loop import Algorithm, train
from lodestone.machines.catalogue import machines
from lodestone.options.execution import Rules
from lodestone.planning.joint import JointProcess, joint_process
from lodestone.planning.tables import Tables, tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.task_graph import TaskTables, tabulate_tasks

TAXI = Taxi(move_success=0.8)
RULES = Rules(discount=0.99, step_limit=200)
EPSILON, LEARNING_RATE = 0.1, 0.25
STEPS = 20_000
"""Primitive steps of a plain loop; and about as many for each seed of the compiled ones."""
SEEDS = 400
"""On two cores, tables of 200 seeds each: from 512 KB on XLA splits every look-up in them over threads, which costs
more than the look-up."""
CHUNKS, REPEATS = 10, 3
"""The first chunk compiles and is left out; the fastest of the repeats counts."""


def compiled_rate(algorithm: Algorithm, seeds: int, rounds: int) -> float:
    """Primitive steps a second of all seeds together."""
    best = 0.0
    for _ in range(REPEATS):
        steps, began = 0, 0.0
        for _, chunk in train(algorithm, range(seeds), rounds, rounds // CHUNKS):
            steps += int(chunk.log.steps[chunk.log.valid].sum()) if began else 0
            began = began or chunk.seconds
        best = max(best, steps / (chunk.seconds - began))
    return best


class PlainHAMQ:
    """HAMQ for one seed on the arrays of the joint process."""

    def __init__(self, process: JointProcess) -> None:
        self.random = np.random.default_rng(0)
        self.process = process
        self.edges = [np.flatnonzero(row) for row in process.available]
        self.cumulative = process.probs.cumsum(axis=1)
        self.starts = np.flatnonzero(process.initial_probs)
        self.values = np.zeros(process.edges.shape)
        self.steps = self.updates = 0

    def choose(self, choice: int) -> int:
        edges = self.edges[choice]
        if self.random.random() < EPSILON:
            return int(edges[self.random.integers(len(edges))])
        values = self.values[choice, edges]
        best = edges[values == values.max()]
        return int(best[self.random.integers(len(best))])

    def episode(self) -> None:
        process = self.process
        joint = int(self.starts[self.random.integers(len(self.starts))])
        last, reward, factor = None, 0.0, 1.0
        for _ in range(RULES.step_limit or 0):
            while joint < process.num_choices:
                if last is not None:
                    self.learn(last, reward + factor * self.values[joint, self.edges[joint]].max())
                last, reward, factor = (joint, self.choose(joint)), 0.0, 1.0
                joint = int(process.edges[last])
            action = joint - process.num_choices
            draw = int(np.searchsorted(self.cumulative[action], self.random.random(), side="right"))
            reward, factor = reward + factor * float(process.rewards[action, draw]), factor * RULES.discount
            joint = int(process.successors[action, draw])
            self.steps += 1
            if joint == process.end:
                self.learn(last, reward)
                return

    def learn(self, at: tuple[int, int], target: float) -> None:
        self.values[at] += LEARNING_RATE * (target - self.values[at])
        self.updates += 1


class PlainMAXQ:
    """MAXQ-Q for one seed, by recursion, on the tables of the task graph."""

    def __init__(self, tables: Tables, tasks: TaskTables) -> None:
        self.random = np.random.default_rng(0)
        self.tables, self.tasks = tables, tasks
        self.cumulative = tables.probs.cumsum(axis=2)
        self.starts = np.flatnonzero(tables.initial_probs)
        self.edges = [tasks.edges_of(subtask) for subtask in range(len(tasks.ends))]
        self.child = [edge.child for edge in tasks.edges]
        self.values, self.inner = np.zeros(tasks.num_slots), np.zeros(tasks.num_slots)
        self.steps = self.updates = self.episode_steps = 0

    def evaluate(self, node: int, state: int) -> float:
        """V, pseudo-rewards left out."""
        tasks = self.tasks
        if node < tasks.num_actions:
            return float(self.values[tasks.reward_slot[node, state]])
        if tasks.ends[node - tasks.num_actions, state]:
            return 0.0
        return self.best(node - tasks.num_actions, state)[1]

    def best(self, subtask: int, state: int) -> tuple[float, float, int]:
        """(Q~, Q, edge) of the edge with the largest Q~."""
        found = (-np.inf, 0.0, -1)
        for edge in self.edges[subtask]:
            if self.tasks.available[edge, state]:
                value, slot = self.evaluate(self.child[edge], state), self.tasks.completion_slot[edge, state]
                completion, inner = (self.values[slot], self.inner[slot]) if slot >= 0 else (0.0, 0.0)
                found = max(found, (value + inner, value + completion, edge))
        return found

    def run(self, subtask: int, state: int) -> tuple[int, list[int]]:
        """Run a subtask; returns where it ended and the states that it went through."""
        tasks, visited = self.tasks, []
        while not tasks.ends[subtask, state] and self.episode_steps < (RULES.step_limit or 0):
            edges = [edge for edge in self.edges[subtask] if tasks.available[edge, state]]
            explores = self.random.random() < EPSILON
            edge = edges[self.random.integers(len(edges))] if explores else self.best(subtask, state)[2]
            child = self.child[edge]
            if child < tasks.num_actions:
                after, through = self.act(child, state), [state]
            else:
                after, through = self.run(child - tasks.num_actions, state)
                if not tasks.ends[child - tasks.num_actions, after]:
                    return after, visited + through
            self.learn(subtask, edge, after, through)
            visited, state = visited + through, after
        return state, visited

    def act(self, action: int, state: int) -> int:
        draw = int(np.searchsorted(self.cumulative[state, action], self.random.random(), side="right"))
        slot, reward = self.tasks.reward_slot[action, state], self.tables.rewards[state, action, draw]
        self.values[slot] += LEARNING_RATE * (reward - self.values[slot])
        self.updates, self.steps, self.episode_steps = self.updates + 1, self.steps + 1, self.episode_steps + 1
        return int(self.tables.successors[state, action, draw])

    def learn(self, subtask: int, edge: int, after: int, through: list[int]) -> None:
        if self.tasks.ends[subtask, after]:
            inner, value = float(self.tasks.pseudo_rewards[subtask, after]), 0.0
        else:
            inner, value, _ = self.best(subtask, after)
        factor = 1.0
        for state in reversed(through):
            factor *= RULES.discount
            slot = self.tasks.completion_slot[edge, state]
            if slot >= 0:
                self.values[slot] += LEARNING_RATE * (factor * value - self.values[slot])
                self.inner[slot] += LEARNING_RATE * (factor * inner - self.inner[slot])
                self.updates += 1

    def episode(self) -> None:
        self.episode_steps = 0
        self.run(0, int(self.starts[self.random.integers(len(self.starts))]))


def plain_rate(loop: PlainHAMQ | PlainMAXQ) -> tuple[float, float]:
    """(updates a second, updates a primitive step) on one core."""
    started = time.perf_counter()
    while loop.steps < STEPS:
        loop.episode()
    return loop.updates / (time.perf_counter() - started), loop.updates / loop.steps


def measure(seeds: int) -> dict[str, dict[str, float]]:
    """Updates a second of both learners, and the ratios to the plain loops."""
    tables, graph, hierarchy = tabulate(TAXI), task_graph(TAXI), machines(TAXI)
    rate, epsilon = ((0.0, LEARNING_RATE),), ((0.0, EPSILON),)
    learners = {
        "HAMQ": (
            hamq(HAMQConfig(rate, epsilon), TAXI, hierarchy, RULES, STEPS),
            PlainHAMQ(joint_process(TAXI, hierarchy)),
            2 * STEPS // TICKS_PER_ROUND,
        ),
        "MAXQ-Q": (
            maxq(MAXQConfig(rate, epsilon), TAXI, graph, RULES, STEPS),
            PlainMAXQ(tables, tabulate_tasks(graph, TAXI, tables)),
            4 * STEPS // EVENTS_PER_ROUND,
        ),
    }
    found = {}
    for name, (algorithm, loop, rounds) in learners.items():
        steps = compiled_rate(algorithm, seeds, rounds)
        plain, updates_per_step = plain_rate(loop)
        found[name] = {
            "primitive steps/s": steps,
            "updates/s": steps * updates_per_step,
            "plain loop, updates/s on one core": plain,
            "ratio": steps * updates_per_step / plain,
        }
    return found


if __name__ == "__main__":
    run(__doc__ or "", "Taxi", measure, SEEDS)
