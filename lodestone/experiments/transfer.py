"""What a united network that learned on one magnet arm is worth on others (Kuzmin and Panov 2018, section 4.3).

The paper expects its options to transfer, as they are specific to no tower. The network of this experiment sees one
plane per kind of cell and keeps each channel's maximum over the grid, so that it takes grids of any size. It learns on
4x3; then, on other grids, numbers of bricks and heights, every option is judged from every layout without learning
anything more; and on one of them learning goes on, from what is there or from nothing.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import median
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lodestone.agents.playing import play
from lodestone.agents.policies import UnitedPolicy
from lodestone.agents.training import train_policy
from lodestone.agents.united import UnitedConfig
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Task
from lodestone.experiments.comparison import Gate, at_least
from lodestone.experiments.study import Experiment, NumberTable, Panel, Study
from lodestone.experiments.united import RULES, WINDOW, decisions_to, learning_curves, wrong_terminations
from lodestone.learning.history import History
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Progress
from lodestone.learning.united_network import BASIC, UnitedNetwork
from lodestone.options.base import Primitives
from lodestone.options.catalogue import tasks
from lodestone.planning.solve import optimum
from lodestone.types import State


def _arm(rows: int, columns: int, bricks: int, tower_height: int) -> MagnetArm:
    """The network sees planes: a picture would show a wall and an empty cell alike."""
    return MagnetArm(rows, columns, bricks, tower_height, observation="planes")


SOURCE = _arm(4, 3, 3, 3)
TARGET = _arm(5, 3, 4, 4)
"""Where learning goes on: another grid, number of bricks and height."""
OTHERS = (_arm(4, 3, 3, 2), _arm(4, 3, 4, 3), TARGET, _arm(5, 4, 4, 4), _arm(6, 4, 4, 4), _arm(7, 5, 4, 4))

CONFIG = UnitedConfig(
    network=NetworkConfig(kernels=(5,), strides=(1,), channels=(64,), hidden=(128,), pooling=True),
    epsilon=((0.3, 1.0), (0.6, 0.1)),
    learning_starts=10_000,
    updates_per_round=4,
)
STEPS = 100_000
"""Primitive steps of every run, per seed."""
THRESHOLD = 50.0
"""Mean return whose first crossing is compared."""

AS_THEY_ARE, TUNED, SCRATCH = "options as they are", "everything learns on", "from nothing"
WAYS: dict[str, UnitedConfig] = {
    AS_THEY_ARE: replace(CONFIG, training="manager"),
    TUNED: CONFIG,
    SCRATCH: CONFIG,
}


class Judged(NamedTuple):
    """Networks of N seeds on one arm, without learning anything there."""

    policies: Float[np.ndarray, "N n"]
    """Share of all layouts from which each option's policy does its task."""
    options: Float[np.ndarray, "N n"]
    """The same where the option stops by its own termination head."""
    terminations: Float[np.ndarray, " N"]
    """Share of the answers of the termination heads, over all reachable states, that are wrong."""
    towers: Bool[np.ndarray, " N"]
    """Whether the greedy policy builds the tower."""


class Learned(NamedTuple):
    """N seeds after learning on one arm."""

    history: History
    gaps: Float[np.ndarray, " N"]
    """Optimal return minus that of the greedy policy."""


def run(seeds: int, progress: Progress) -> Study:
    """Learn on the source, judge everywhere, learn on."""
    source, _ = _learn("source", SOURCE, CONFIG, None, seeds, progress)
    judged = {arm: _judge(source, arm) for arm in (SOURCE, *OTHERS)}
    learned = {
        way: _learn(way, TARGET, config, None if way == SCRATCH else source, seeds, progress)[1]
        for way, config in WAYS.items()
    }
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            f"A united network learns to build towers on {_name(SOURCE)}. It is the same network on any grid, so what "
            "it has learned is tried on others as it is: each option from every layout, and the whole policy. Then "
            f"learning goes on on {_name(TARGET)}: only the policy over options and the basic policy, with the options "
            "as they are; or everything; and, to compare, a network learns there from nothing."
        ),
        seeds=seeds,
        panels=(_curves(learned),),
        tables=(_judged_table(judged), _learned_table(learned)),
        gates=tuple(_gates(judged)),
    )


def _name(arm: MagnetArm) -> str:
    return f"{arm.rows}x{arm.columns}, {arm.bricks} bricks, height {arm.tower_height}"


def _learn(
    way: str, arm: MagnetArm, config: UnitedConfig, start: UnitedPolicy | None, seeds: int, progress: Progress
) -> tuple[UnitedPolicy, Learned]:
    progress.begin(f"transfer: {way}, {_name(arm)}", STEPS)

    def tell(history: History, fraction: float) -> bool:
        recent = [history.episodes(seed).total_reward[-WINDOW:] for seed in range(seeds)]
        means = [returns.mean() for returns in recent if len(returns)]
        progress.advance(fraction * STEPS, f"mean return {np.mean(means):.0f}" if means else "")
        return False

    primitives = Primitives(arm.action_names)
    policy, history = train_policy(config, arm, primitives, RULES, STEPS, range(seeds), tell, start=start)
    assert isinstance(policy, UnitedPolicy)
    reached = np.asarray(play(policy, jax.random.key(0)).total_reward)
    return policy, Learned(history, optimum(arm).optimal_return - reached)


def _judge(source: UnitedPolicy, arm: MagnetArm) -> Judged:
    policy = replace(source, environment=arm, tasks=tasks(arm))
    networks = [policy.network(position) for position in range(len(policy.seeds))]
    done = np.array([[_success(policy, network, head) for head in _heads(policy)] for network in networks])
    answers = reachable_states(arm).size * len(policy.tasks)
    return Judged(
        policies=done[:, :, 0],
        options=done[:, :, 1],
        terminations=np.array([wrong_terminations(policy, network) / answers for network in networks]),
        towers=np.asarray(play(policy, jax.random.key(0)).success),
    )


def _heads(policy: UnitedPolicy) -> range:
    return range(BASIC + 1, BASIC + 1 + len(policy.tasks))


def _success(policy: UnitedPolicy, network: UnitedNetwork, head: int) -> tuple[float, float]:
    """Share of the layouts from which the policy of a head does its task, and does it where its termination head stops
    it."""
    task = policy.tasks[head - 1]
    _, starts = task.initial_distribution()
    done, stopped = _runs(task, network, head, policy.option_cap, starts)
    return float(done.mean()), float(stopped.mean())


@eqx.filter_jit
def _runs(
    task: Task, network: UnitedNetwork, head: int, cap: int, starts: State
) -> tuple[Bool[Array, " I"], Bool[Array, " I"]]:
    def one(start: State) -> tuple[Array, Array]:
        def step(carry: tuple[State, Array, Array, Array], _: None) -> tuple[tuple[State, Array, Array, Array], None]:
            state, done, runs, stopped_well = carry
            action = jnp.argmax(network(task.observe(state)).actions[head]).astype(jnp.int32)
            state = task.transition(state, action, jnp.int32(0))
            ends = task.terminal(state)
            stops = runs & network(task.observe(state)).ended[head - 1]
            return (state, done | ends, runs & ~stops, stopped_well | (stops & ends)), None

        never = jnp.bool_(False)
        (_, done, _, stopped_well), _ = jax.lax.scan(step, (start, never, ~never, never), None, length=cap)
        return done, stopped_well

    return jax.vmap(one)(starts)


def _curves(learned: dict[str, Learned]) -> Panel:
    return learning_curves(f"Learning, {_name(TARGET)}", TARGET, {way: one.history for way, one in learned.items()})


def _judged_table(judged: dict[MagnetArm, Judged]) -> NumberTable:
    names = [task.name for task in tasks(SOURCE)]
    rows: list[tuple[str | float, ...]] = []
    for arm, one in judged.items():
        rows.append(
            (
                _name(arm) + (" (learned here)" if arm == SOURCE else ""),
                len(tasks(arm)[0].initial_distribution()[0]),
                *(_spread(one.policies[:, option]) for option in range(len(names))),
                *(_spread(one.options[:, option]) for option in range(len(names))),
                _spread(one.terminations),
                f"{one.towers.sum()} of {len(one.towers)}",
            )
        )
    return NumberTable(
        "Nothing more learned: median over seeds (worst to best)",
        (
            "",
            "layouts",
            *(f"{name}: layouts done" for name in names),
            *(f"{name}, stopped by its own head" for name in names),
            "termination heads: answers that are wrong",
            "seeds whose policy builds the tower",
        ),
        tuple(rows),
    )


def _spread(shares: Float[np.ndarray, " N"]) -> str:
    return f"{np.median(shares):.1%} ({shares.min():.1%} to {shares.max():.1%})"


def _learned_table(learned: dict[str, Learned]) -> NumberTable:
    rows = tuple(
        (
            way,
            median(decisions_to(one.history, THRESHOLD)),
            f"{(one.gaps == 0).sum()} of {len(one.gaps)}",
            float(np.median(one.gaps)),
            float(one.gaps.max()),
            round(one.history.seconds),
        )
        for way, one in learned.items()
    )
    return NumberTable(
        f"Learning on: {_name(TARGET)}, {STEPS:,} steps",
        (
            "",
            f"decisions to return {THRESHOLD:g}, median",
            "seeds at the optimum",
            "gap, median",
            "gap, worst",
            "seconds",
        ),
        rows,
    )


def _gates(judged: dict[MagnetArm, Judged]) -> list[Gate]:
    """Only where the network has learned: what it does elsewhere is reported as it is."""
    here = judged[SOURCE]
    return [at_least(f"{_name(SOURCE)}: options on all layouts, worst seed", float(here.options.min()), 1.0)]


EXPERIMENT = Experiment(
    "transfer",
    "What was learned on one magnet arm, on others",
    seeds=10,
    work=float(STEPS * (1 + len(WAYS))),
    run=run,
)
