"""Tabular updates a second on Four Rooms with the four primitive actions and the eight hallway options.

    python benchmarks/tabular.py            # a table
    python benchmarks/tabular.py --json     # the same, for a program

Option Q-learning makes one update an option execution, intra-option Q-learning one for every option that would have
taken the step. Lodestone trains a batch of seeds on all cores, its log of every decision included. The plain loop is
the same learner for one seed on one core, in Python with NumPy; its row for all cores is that number times the cores,
which no worker processes could exceed. Both count the updates that they make.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for a checkout that is not installed

from command import run

from lodestone.agents.intra_option import IntraOptionConfig, intra_option_q_learning
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.envs.four_rooms import FourRooms
from lodestone.learning.loop import Algorithm, train
from lodestone.options.base import Options, Primitives, Union
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import hallway_options
from lodestone.planning.option_models import OptionTables, tabulate_options
from lodestone.planning.tables import Tables, tabulate

RULES = Rules(decision_limit=200)
ROUNDS = 500
"""Rounds of 32 primitive steps that every seed is trained for, under the default schedules."""
CHUNK = 50
"""Rounds between two looks at the clock; the first such look is left out, as it compiles."""
REPEATS = 3
"""The fastest of so many runs counts: the others tell what else the machine was doing."""


def compiled_rate(algorithm: Algorithm, seeds: int) -> tuple[float, float]:
    """(primitive steps, decisions) a second of all seeds together."""
    best = (0.0, 0.0)
    for _ in range(REPEATS):
        decisions, began = 0, 0.0
        for _, chunk in train(algorithm, range(seeds), ROUNDS, CHUNK):
            began = began or chunk.seconds
            decisions += int(chunk.log.valid.sum()) if chunk.rounds > CHUNK else 0
        seconds = chunk.seconds - began
        best = max(best, (seeds * (ROUNDS - CHUNK) * STEPS_PER_ROUND / seconds, decisions / seconds))
    return best


class PlainLoop:
    """Option Q-learning and intra-option Q-learning for one seed, as one would write them in NumPy."""

    def __init__(self, tables: Tables, options: OptionTables, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.successors, self.probs, self.rewards = tables.successors, tables.probs.cumsum(axis=2), tables.rewards
        self.terminal = tables.terminal
        self.starts = np.flatnonzero(tables.initial_probs)
        self.available = [np.flatnonzero(options.initiation[:, state]) for state in range(tables.num_states)]
        self.actions = options.action_probs.argmax(axis=2).T.copy()
        self.stops = options.termination.T.astype(np.float64)
        self.one_step = np.array(options.max_steps) == 1
        self.stops[:, self.one_step] = 1.0
        self.values = np.zeros((tables.num_states, options.size))
        self.epsilon = self.learning_rate = 0.0
        self.steps = self.updates = 0

    def choose(self, state: int) -> int:
        available = self.available[state]
        if self.random.random() < self.epsilon:
            return int(available[self.random.integers(len(available))])
        values = self.values[state, available]
        best = available[values == values.max()]
        return int(best[self.random.integers(len(best))])

    def step(self, state: int, action: int) -> tuple[int, float]:
        outcome = int(np.searchsorted(self.probs[state, action], self.random.random(), side="right"))
        self.steps += 1
        return int(self.successors[state, action, outcome]), float(self.rewards[state, action, outcome])

    def best(self, state: int) -> float:
        return 0.0 if self.terminal[state] else float(self.values[state, self.available[state]].max())

    def episode(self, within: bool) -> None:
        """One episode; `within` teaches every option from every step, else each decision teaches its option."""
        state = int(self.starts[self.random.integers(len(self.starts))])
        for _ in range(RULES.decision_limit or 0):
            option, start, total, factor = self.choose(state), state, 0.0, 1.0
            while True:
                before, action = state, int(self.actions[state, option])
                state, reward = self.step(state, action)
                total, factor = total + factor * reward, factor * RULES.discount
                if within:
                    self.learn_within(before, action, reward, state)
                if self.terminal[state] or self.random.random() < self.stops[state, option]:
                    break
            if not within:
                error = total + factor * self.best(state) - self.values[start, option]
                self.values[start, option] += self.learning_rate * error
                self.updates += 1
            if self.terminal[state]:
                return

    def learn_within(self, state: int, action: int, reward: float, after: int) -> None:
        same = np.flatnonzero(self.actions[state] == action)
        if self.terminal[after]:
            target = np.full(len(same), reward)
        else:
            stops = self.stops[after, same]
            arriving = (1 - stops) * self.values[after, same] + stops * self.best(after)
            target = reward + RULES.discount * arriving
        self.values[state, same] += self.learning_rate * (target - self.values[state, same])
        self.updates += len(same)


def plain_rate(
    tables: Tables, options: OptionTables, config: QLearningConfig | IntraOptionConfig, length: int
) -> tuple[float, float]:
    """(updates a second, updates a primitive step) of the plain loop on one core, over a run of `length` steps."""
    loop = PlainLoop(tables, options, seed=0)
    started = time.perf_counter()
    while loop.steps < length:
        fraction = loop.steps / length
        loop.epsilon, loop.learning_rate = (
            float(np.interp(fraction, *zip(*knots, strict=True))) for knots in (config.epsilon, config.learning_rate)
        )
        loop.episode(within=isinstance(config, IntraOptionConfig))
    return loop.updates / (time.perf_counter() - started), loop.updates / loop.steps


def measure(seeds: int) -> dict[str, dict[str, float]]:
    """Updates a second of both learners, and the ratios to the plain loop."""
    rooms = FourRooms()
    options: Options = Union((Primitives(rooms.action_names), hallway_options(rooms)))
    tables = tabulate(rooms)
    tabulated = tabulate_options(options, tables.space)
    length, cores = ROUNDS * STEPS_PER_ROUND, jax.device_count()
    learners: dict[str, tuple[Callable[..., Algorithm], QLearningConfig | IntraOptionConfig]] = {
        "option Q-learning": (q_learning, QLearningConfig()),
        "intra-option Q-learning": (intra_option_q_learning, IntraOptionConfig()),
    }
    found = {}
    for name, (learner, config) in learners.items():
        steps, decisions = compiled_rate(learner(config, rooms, options, RULES, length), seeds)
        plain, updates_per_step = plain_rate(tables, tabulated, config, length)
        # How many options a step teaches depends on where the agent is: the plain loop counts it.
        updates = decisions if isinstance(config, QLearningConfig) else steps * updates_per_step
        found[name] = {
            "primitive steps/s": steps,
            "updates/s": updates,
            "plain loop, updates/s on one core": plain,
            f"plain loop, updates/s on {cores} cores": plain * cores,
            "ratio": updates / (plain * cores),
        }
    return found


if __name__ == "__main__":
    run(__doc__ or "", "Four Rooms", measure)
