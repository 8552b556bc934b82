"""Option-critic in the four rooms, where the goal moves (after Bacon, Harb and Precup 2017).

The goal is the hallway in the east. After 1000 episodes of its own each seed's goal moves to a cell of the lower right
room, drawn at random, and the learner goes on for 1000 more with what it has learned. The flat actor-critic is the same
learner with one option, whose termination changes nothing. What each has learned is valued exactly.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.special import expit

from lodestone.agents.option_critic import Learned, OptionCriticConfig, option_critic_on_numbers
from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.agents.sarsa import SarsaConfig, sarsa_on_numbers
from lodestone.envs.four_rooms import NUMBER, Dynamics, FourRooms
from lodestone.envs.task import endless
from lodestone.experiments.changing_world import Moving, changing_world
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.following import at_looks
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import History
from lodestone.learning.loop import Algorithm, train
from lodestone.learning.progress import Progress
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.options.soft import numbered_names
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import Enumerated, enumerated
from lodestone.planning.option_gradients import OptionParameters, SoftOptionProcess, soft_option_process
from lodestone.planning.solve import evaluate_policy, optimal_choices, value_iteration
from lodestone.planning.tables import Tables, tabulate

EPISODES = 1000
"""Before the goal moves, and after."""
RULES = Rules(discount=0.99, step_limit=1000)
DYNAMICS: tuple[Dynamics, ...] = ("code", "text", "sps")
GOAL, ROOM = int(NUMBER[7, 9]), NUMBER[8:12, 7:12].ravel()
"""The first goal, and the cells that it may move to."""

FOUR, EIGHT, FLAT, SARSA = "4 options", "8 options", "actor-critic", "SARSA"
AUTHORS, GREEDY, COSTLY = "4 options, authors' order", "4 options, epsilon 0", "4 options, deliberation cost"
FAST = ((0.0, 1.0),)
_FOUR = OptionCriticConfig(critic_rate=((0.0, 0.8),), policy_rate=((0.0, 0.1),), epsilon=((0.0, 0.05),))
"""Chosen on other seeds, by the steps after the move. With the authors' rates, the learner's defaults, options recover
no faster than SARSA."""
SARSA_EPSILON = 0.1
CONFIGS: dict[str, OptionCriticConfig | SarsaConfig] = {
    FOUR: _FOUR,
    EIGHT: replace(_FOUR, num_options=8),
    FLAT: replace(_FOUR, num_options=1),
    SARSA: SarsaConfig(epsilon=((0.0, SARSA_EPSILON),)),
    AUTHORS: replace(_FOUR, order="authors"),
    GREEDY: replace(_FOUR, epsilon=((0.0, 0.0),), termination_rate=FAST),
    COSTLY: replace(_FOUR, deliberation_cost=1.0, termination_rate=FAST),
}
COMPARED = (FOUR, EIGHT, FLAT, SARSA)
COLLAPSES = (FOUR, EIGHT, AUTHORS, GREEDY, COSTLY)
"""Whose options are watched; the last two are made to collapse."""
BLOCK = 20
"""Episodes whose mean is one point of a curve."""
LAST = 50
"""Episodes at an end, or after the move, whose mean is reported."""
ROUNDS_PER_LOOK = 50


class House(NamedTuple):
    """The rooms under one kind of chance, with the first goal and with each later one; all number cells alike."""

    first: Tables
    later: tuple[Tables, ...]
    action_names: tuple[str, ...]


class Run(NamedTuple):
    """One learner, N seeds, looked at C times."""

    before: Float[np.ndarray, "N E"]
    """Steps of each episode before the goal moved."""
    after: Float[np.ndarray, "N E"]
    finished: Float[np.ndarray, "C N"]
    """Episodes that each seed had finished."""
    length: Float[np.ndarray, "C N"]
    """Mean steps of an option since the last look."""
    shares: Float[np.ndarray, "C N O"]
    """Share of the steps under each option since then, the most used one first."""
    stops: Float[np.ndarray, "C N"]
    """Mean of beta over cells and options."""
    least_stop: float
    """The smallest beta of all seeds in the end."""
    stops_on_arrival: float
    """Mean of beta where options arrive, exact, in the end; mean over seeds."""
    gaps: tuple[float, float]
    """Optimal discounted value minus that of the policy as it acts, exact, when the goal moved and in the end; means
    over seeds. The end is when the slowest seed has finished."""
    seconds: float


def run(seeds: int, progress: Progress) -> Study:
    """Train every learner under every kind of chance."""
    houses = {dynamics: house(dynamics) for dynamics in DYNAMICS}
    wanted = [(dynamics, name) for dynamics in DYNAMICS for name in COMPARED]
    wanted += [("code", name) for name in COLLAPSES if name not in COMPARED]
    runs = {key: _learn(houses[key[0]], *key, seeds, progress) for key in wanted}
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "Options are learned from the task alone, by the gradients of the option-critic. After 1000 episodes the "
            "goal moves from the hallway in the east to a random cell of the lower right room, and learning goes on. "
            "Three kinds of chance go by the name of this experiment. code: a move may be followed by a second one; "
            "text: a move goes astray to a free neighbour; sps: a move goes astray in any other direction.\n\n"
            "Terminations can collapse in two ways, shown at four times the rate. Against a greedy choice (epsilon 0) "
            "no option is ever worth more than choosing anew: terminations only grow, towards options of one step. "
            "With a large deliberation cost they only fall, towards one option for the whole episode."
        ),
        seeds=seeds,
        panels=(
            *(_lengths(houses[dynamics], dynamics, runs) for dynamics in DYNAMICS),
            *_over_training({name: runs["code", name] for name in COLLAPSES}),
        ),
        tables=(*(_numbers(houses[dynamics], dynamics, runs) for dynamics in DYNAMICS), _ends(runs)),
        gates=tuple(_gates(runs)),
    )


# --------------------------------------------------------------------------------------------------------- the house


def house(dynamics: Dynamics) -> House:
    """Each goal is a task on the tables of the rooms without one."""
    rooms = FourRooms(dynamics)
    tables = tabulate(endless(rooms))
    cells = np.asarray(tables.space.states.cell)
    with_goals = [with_goal(tables, int(np.flatnonzero(cells == goal)[0])) for goal in (GOAL, *ROOM)]
    return House(with_goals[0], tuple(with_goals[1:]), rooms.action_names)


def with_goal(tables: Tables, goal: int) -> Tables:
    """The process with an end in state `goal`, which pays 1; episodes begin in any other state."""
    terminal = np.arange(tables.num_states) == goal
    there = terminal[:, None, None]
    reaches = (tables.successors == goal) & ~there
    return tables._replace(
        successors=np.where(there, goal, tables.successors).astype(np.int32),
        probs=np.where(there, np.eye(tables.probs.shape[2])[0], tables.probs),
        rewards=reaches.astype(np.float64),
        terminal=terminal,
        initial_probs=np.where(terminal, 0.0, 1 / (tables.num_states - 1)),
    )


# ---------------------------------------------------------------------------------------------------------- learning


def moving_goal(config: OptionCriticConfig | SarsaConfig, house: House) -> Algorithm:
    """The learner, whose goal moves; schedules are constant."""
    first = enumerated(house.first, house.action_names)
    each = [enumerated(tables, house.action_names) for tables in house.later]
    later = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
    primitives = on_numbers(Primitives(house.action_names), house.first.space)

    def learner(world: Enumerated) -> Algorithm:
        if isinstance(config, SarsaConfig):
            return sarsa_on_numbers(config, world, primitives, RULES, 1)
        return option_critic_on_numbers(config, world, RULES, 1)

    def hand_over(old: Any, fresh: Any) -> Any:
        if isinstance(config, SarsaConfig):
            return fresh._replace(table=old.table)
        return fresh._replace(learned=old.learned)

    return changing_world(learner, hand_over, first, later, EPISODES)


def _learn(house: House, dynamics: Dynamics, name: str, seeds: int, progress: Progress) -> Run:
    config, work = CONFIGS[name], 2 * EPISODES
    count = len(house.action_names) if isinstance(config, SarsaConfig) else config.num_options
    history, looked = History(seeds, numbered_names(count)), []
    progress.begin(f"option-critic: {dynamics}, {name}", work)
    most = 2 * (EPISODES + STEPS_PER_ROUND) * (RULES.step_limit or 1) // STEPS_PER_ROUND
    for carry, chunk in train(moving_goal(config, house), range(seeds), most, ROUNDS_PER_LOOK):
        history.add(chunk)
        carry = jax.tree.map(lambda leaf: leaf[:seeds], carry)
        usage, finished, moved = history.usage[-1], np.asarray(carry.episodes), np.asarray(carry.moved)
        steps = usage.steps.sum(axis=1)
        stops = np.nan if isinstance(config, SarsaConfig) else _terminations(carry).mean(axis=(1, 2))
        shares = np.sort(usage.steps / np.maximum(steps, 1)[:, None], axis=1)[:, ::-1]
        looked.append((finished, steps / np.maximum(usage.calls.sum(axis=1), 1), shares, np.full(seeds, stops)))
        done = np.where(moved > 0, EPISODES + finished - moved, np.minimum(finished, EPISODES))
        progress.advance(float(min(done.min(), work)), f"{finished.min():,} episodes")
        if done.min() >= work:
            break
    lengths = [history.episodes(seed).length_steps for seed in range(seeds)]
    finished, length, shares, stops = (np.stack(column) for column in zip(*looked, strict=True))
    moments = _moments(house, config, carry, seeds)
    return Run(
        before=np.stack([steps[:EPISODES] for steps in lengths]),
        after=np.stack([steps[at : at + EPISODES] for steps, at in zip(lengths, moved, strict=True)]),
        finished=finished,
        length=length,
        shares=shares,
        stops=stops,
        least_stop=np.nan if isinstance(config, SarsaConfig) else float(_terminations(carry).min()),
        stops_on_arrival=float(np.mean([stop for *_, stop in moments])),
        gaps=(float(np.mean([gap for gap, _, _ in moments])), float(np.mean([gap for _, gap, _ in moments]))),
        seconds=history.seconds,
    )


def _terminations(carry: Moving) -> Float[np.ndarray, "N S O"]:
    return expit(np.asarray(carry.inner.learned.exits))


def _moments(
    house: House, config: OptionCriticConfig | SarsaConfig, carry: Moving, seeds: int
) -> list[tuple[float, float, float]]:
    """Of each seed, the exact gap when the goal moved and in the end, and beta where options arrive."""
    found = []
    for seed in range(seeds):
        at = jax.tree.map(lambda leaf, seed=seed: leaf[seed], carry)
        later = house.later[int(at.world)]
        ends = ((house.first, at.before), (later, at.inner))
        if isinstance(config, SarsaConfig):
            values = [evaluate_policy(tables, _choices(one.table), RULES.discount) for tables, one in ends]
            stop = np.nan
        else:
            processes = [_process(config, tables, one.learned) for tables, one in ends]
            values = [process.values().values for process in processes]
            stop = _stop_on_arrival(processes[-1])
        gaps = [_best(tables) - tables.initial_mean(value) for (tables, _), value in zip(ends, values, strict=True)]
        found.append((gaps[0], gaps[1], stop))
    return found


def _process(config: OptionCriticConfig, tables: Tables, learned: Learned) -> SoftOptionProcess:
    parameters = OptionParameters(np.asarray(learned.preferences), np.asarray(learned.exits), config.temperature)
    policy = _choices(learned.table, config.epsilon[0][1])
    return soft_option_process(tables, parameters, policy, RULES.discount)


def _choices(table: Any, epsilon: float = SARSA_EPSILON) -> Float[np.ndarray, "S O"]:
    """Probabilities of an epsilon-greedy choice."""
    best = optimal_choices(np.asarray(table, dtype=np.float64), tolerance=0.0)
    return (1 - epsilon) * best / best.sum(axis=1, keepdims=True) + epsilon / best.shape[1]


def _stop_on_arrival(process: SoftOptionProcess) -> float:
    starts = process.tables.initial_probs[:, None] * process.policy
    arriving = process.arriving(process.after_a_step(starts))
    return float((arriving * process.parameters.terminations).sum() / arriving.sum())


def _best(tables: Tables) -> float:
    return tables.initial_mean(value_iteration(tables, RULES.discount).values)


def _fewest_steps(tables: Tables) -> float:
    return -tables.initial_mean(value_iteration(tables.with_step_reward(-1.0), 1.0).values)


# ----------------------------------------------------------------------------------------------------------- showing


def _lengths(house: House, dynamics: Dynamics, runs: dict[tuple[Dynamics, str], Run]) -> Panel:
    x = np.arange(1, 2 * EPISODES // BLOCK + 1, dtype=np.float64) * BLOCK
    best = _fewest_steps(house.first)

    def blocks(one: Run) -> Float[np.ndarray, "N X"]:
        return np.concatenate([one.before, one.after], axis=1).reshape(len(one.before), -1, BLOCK).mean(axis=2)

    return Panel(
        f"Episodes, {dynamics}; the goal moves after {EPISODES}",
        "episode",
        f"steps, mean of {BLOCK} episodes",
        tuple(Series(name, x, blocks(runs[dynamics, name])) for name in COMPARED),
        references=((f"optimum of the first goal {best:.1f}", best),),
        y_range=(0.0, 200.0),
    )


def _over_training(runs: dict[str, Run]) -> list[Panel]:
    """Length and terminations of all options, and how much each of four is used."""
    x = np.linspace(0, 2 * EPISODES, 101)

    def series(name: str, one: Run, looked: Float[np.ndarray, "C N"]) -> Series:
        return Series(name, x, at_looks(one.finished, looked, x))

    lengths = tuple(series(name, one, one.length) for name, one in runs.items())
    stops = tuple(series(name, one, one.stops) for name, one in runs.items())
    places = ("most used option", "second", "third", "fourth")
    four = runs[FOUR]
    shares = tuple(series(name, four, four.shares[:, :, place]) for place, name in enumerate(places))
    return [
        Panel("Length of an option, code", "episode", "steps, mean", lengths, y_range=(0.0, 4.0)),
        Panel("Terminations, code", "episode", "beta, mean of cells and options", stops),
        Panel(f"Use of each option, code, {FOUR}", "episode", "share of the steps", shares, y_range=(0.0, 1.0)),
    ]


def _numbers(house: House, dynamics: Dynamics, runs: dict[tuple[Dynamics, str], Run]) -> NumberTable:
    fewest = _fewest_steps(house.first), float(np.mean([_fewest_steps(tables) for tables in house.later]))
    return NumberTable(
        f"{dynamics}: optimum {fewest[0]:.2f} steps; where the goal has moved, {fewest[1]:.2f}",
        (
            "",
            f"steps, episodes {EPISODES - LAST + 1}-{EPISODES}",
            f"first {LAST} after the move",
            f"last {LAST}",
            f"last {LAST}, median seed",
            "gap in value at the move",
            "in the end",
            "seconds",
        ),
        tuple(
            (
                name,
                float(one.before[:, -LAST:].mean()),
                float(one.after[:, :LAST].mean()),
                float(one.after[:, -LAST:].mean()),
                float(np.median(one.after[:, -LAST:].mean(axis=1))),
                *one.gaps,
                one.seconds,
            )
            for name in COMPARED
            for one in [runs[dynamics, name]]
        ),
    )


def _ends(runs: dict[tuple[Dynamics, str], Run]) -> NumberTable:
    return NumberTable(
        "code: options in the end",
        (
            "",
            "beta, mean of cells and options",
            "where options arrive",
            "smallest",
            "option length, steps",
            "share of the most used",
            f"steps, episodes {EPISODES - LAST + 1}-{EPISODES}",
            f"last {LAST} after the move",
        ),
        tuple(
            (
                name,
                float(one.stops[-1].mean()),
                one.stops_on_arrival,
                one.least_stop,
                float(one.length[-1].mean()),
                float(one.shares[-1, :, 0].mean()),
                float(one.before[:, -LAST:].mean()),
                float(one.after[:, -LAST:].mean()),
            )
            for name in COLLAPSES
            for one in [runs["code", name]]
        ),
    )


def _gates(runs: dict[tuple[Dynamics, str], Run]) -> list[Gate]:
    four = runs["code", FOUR]
    recovery = {name: float(runs["code", name].after[:, :LAST].mean()) for name in COMPARED}
    beta = float(four.stops[-1].mean())
    return [
        at_most(f"code, {FOUR}: steps, episodes {EPISODES - LAST + 1}-{EPISODES}", four.before[:, -LAST:].mean(), 14),
        at_most(f"code, {FOUR}: steps, last {LAST} after the move", four.after[:, -LAST:].mean(), 30),
        at_least(f"code, {FOUR}: mean beta", beta, 0.05),
        at_most(f"code, {FOUR}: mean beta, not too large", beta, 0.95),
        at_most(f"code, {GREEDY}: by how much a beta has fallen", 0.5 - runs["code", GREEDY].least_stop, 0.0),
        *(
            at_most(f"code: steps in the first {LAST} episodes after the move, {name} / {other}", ratio, 0.999)
            for name in (FOUR, EIGHT)
            for other in (FLAT, SARSA)
            for ratio in [recovery[name] / recovery[other]]
        ),
    ]


EXPERIMENT = Experiment(
    "option-critic",
    "Option-critic in the four rooms, where the goal moves",
    seeds=20,
    work=2.0 * EPISODES * (len(DYNAMICS) * len(COMPARED) + len(set(COLLAPSES) - set(COMPARED))),
    run=run,
)
