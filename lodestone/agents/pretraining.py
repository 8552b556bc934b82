"""Pretraining options: one Q-network per task, trained by the flat DQN and judged from every start of the task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.envs.task import Task
from lodestone.learning.loop import train
from lodestone.learning.networks import QNetwork
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.options.networks import NetworkOptions
from lodestone.planning.solve import optimum
from lodestone.types import Observation, State

ActionValues = Callable[[Observation], Float[Array, " A"]]
"""A network, or a head of one."""

JUDGE_EVERY = 1000
"""Decisions between two judgements."""

GOOD_ENOUGH = 1.01


@dataclass(frozen=True)
class Judgement:
    """How a greedy network does its task, over every start that the task can have."""

    success: float
    """Share of the starts from which the task is completed within the step cap."""
    mean_steps: float
    """Mean length over the successful starts, weighted by their probabilities, in primitive steps."""
    starts: int
    """Number of starts."""

    def __str__(self) -> str:
        length = f", mean length {self.mean_steps:.2f}" if self.success else ""
        return f"success {self.success:.0%}{length}"


@dataclass(frozen=True)
class Pretrained:
    """One option's training."""

    task: Task
    network: QNetwork
    judgement: Judgement
    optimal_steps: float
    """Mean length of the exact optimum from the task's starts, in primitive steps."""
    decisions: int
    """Decisions that each seed trained for."""
    seconds: float


@eqx.filter_jit
def _lengths(task: Task, network: ActionValues, starts: State, cap: int) -> tuple[Int[Array, " I"], Bool[Array, " I"]]:
    """Steps taken from each start, and whether the task was completed."""

    def run(state: State) -> tuple[Array, Array]:
        def step(carry: tuple) -> tuple:
            state, steps = carry
            action = jnp.argmax(network(task.observe(state))).astype(jnp.int32)
            return task.transition(state, action, jnp.int32(0)), steps + 1

        def running(carry: tuple) -> Array:
            return ~task.terminal(carry[0]) & (carry[1] < cap)

        state, steps = jax.lax.while_loop(running, step, (state, jnp.int32(0)))
        return steps, task.terminal(state)

    return jax.vmap(run)(starts)


def judge(task: Task, network: ActionValues, cap: int) -> Judgement:
    """Play the greedy policy from every start of a deterministic task, for at most `cap` steps each."""
    probs, starts = task.initial_distribution()
    steps, done = (np.asarray(leaf) for leaf in _lengths(task, network, starts, cap))
    weights = np.asarray(probs, dtype=np.float64) * done
    mean = float(weights @ steps / weights.sum()) if done.any() else float("nan")
    return Judgement(float(done.mean()), mean, len(done))


def pretrain(
    task: Task,
    config: DQNConfig,
    rules: Rules,
    decisions: int,
    seeds: Sequence[int],
    cap: int,
    on_progress: Callable[[int, Judgement], None],
) -> Pretrained:
    """Train one network per seed for `decisions` decisions, and keep the best: more success, then fewer steps.

    Training stops early once a network completes the task from every start, within `cap` steps, and is on average at
    most `GOOD_ENOUGH` times as long as the exact optimum. `on_progress` gets the decisions so far and the best
    judgement.
    """
    optimal_steps = optimum(task).optimal_steps
    algorithm = dqn(config, task, Primitives(task.action_names), rules, decisions)
    best: Pretrained | None = None
    for carry, chunk in train(algorithm, seeds, config.rounds(decisions), config.rounds(JUDGE_EVERY)):
        taken = chunk.rounds * config.decisions_per_round
        for position in range(len(seeds)):
            network = jax.tree.map(lambda leaf, position=position: leaf[position], carry.learner.network)
            judgement = judge(task, network, cap)
            if best is None or _rank(judgement) > _rank(best.judgement):
                best = Pretrained(task, network, judgement, optimal_steps, taken, chunk.seconds)
        assert best is not None
        on_progress(taken, best.judgement)
        if best.judgement.success == 1.0 and best.judgement.mean_steps <= GOOD_ENOUGH * optimal_steps:
            break
    assert best is not None
    return replace(best, decisions=taken, seconds=chunk.seconds)


def _rank(judgement: Judgement) -> tuple[float, float]:
    return judgement.success, -judgement.mean_steps if judgement.success else 0.0


def as_options(pretrained: Sequence[Pretrained]) -> NetworkOptions:
    """The trained networks as one set of options."""
    networks = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one.network for one in pretrained))
    return NetworkOptions(tuple(one.task for one in pretrained), networks)
