"""Invented comparisons that look like the real ones: two agents, one of them with options, a thousand episodes each."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np

from lodestone.agents.playing import Playback
from lodestone.envs.magnet_arm import DOWN, LEFT, MAGNET_OFF, MAGNET_ON, RIGHT, UP, MagnetArm
from lodestone.experiments.comparison import AgentRun, Comparison, Gate, GreedyResult, OptionRun
from lodestone.learning.history import Episodes, Usage

ACTIONS = ("left", "up", "right", "down", "magnet-on", "magnet-off")
OPTIONS = (*ACTIONS, "go-down", "lift")
GO_DOWN, LIFT = 6, 7
LIMIT = 200


def make_episodes(
    rng: np.random.Generator, optimum: int, learnt_at: float, steps_per_decision: float, budget: int
) -> Episodes:
    """Episodes that shrink from the limit to about the optimum, around one moment of a budget of decisions."""
    lengths, decisions, taken = [], [], 0
    while True:
        late = 1 / (1 + np.exp((learnt_at - taken / budget) / 0.03))
        mean = LIMIT * 0.8 * (1 - late) + 0.8 * late
        length = int(min(optimum + rng.gamma(2.0, mean / 2.0), LIMIT))
        decided = max(round(length / steps_per_decision), 5)
        taken += decided
        if taken > budget:
            break
        lengths.append(length)
        decisions.append(decided)
    length = np.array(lengths, dtype=np.int64)
    success = length < LIMIT
    return Episodes(
        decisions=np.cumsum(decisions, dtype=np.int64),
        steps=np.cumsum(length),
        total_reward=np.where(success, 100.0, 0.0) - length,
        length_steps=length,
        length_decisions=np.array(decisions, dtype=np.int64),
        success=success,
    )


def make_usage(rng: np.random.Generator, seeds: int, options: int, budget: int, chunks: int = 60) -> tuple[Usage, ...]:
    """Calls that move from uniform to a few favourites."""
    favourite = rng.dirichlet(np.full(options, 0.8))
    usage = []
    for chunk in range(chunks):
        done = (chunk + 1) / chunks
        late = 1 / (1 + np.exp((0.4 - done) / 0.08))
        calls = rng.multinomial(budget // chunks, (1 - late) / options + favourite * late, size=seeds)
        decisions = np.full(seeds, budget // chunks * (chunk + 1))
        usage.append(Usage(decisions, calls, calls * 2, np.full(seeds, 1 - done), 60.0 * done))
    return tuple(usage)


def make_agent(
    rng: np.random.Generator, name: str, optimum: int, learnt_at: float, with_options: bool, seeds: int, budget: int
) -> AgentRun:
    """One agent; its last seed does not solve the task unless it has options."""
    names = OPTIONS if with_options else ACTIONS
    ratio = 1.6 if with_options else 1.0
    episodes = tuple(make_episodes(rng, optimum, learnt_at + rng.normal(0, 0.05), ratio, budget) for _ in range(seeds))
    greedy = []
    for seed in range(seeds):
        success = with_options or seed < seeds - 1
        steps = optimum + 2 * int(seed == 2) if success else LIMIT
        total_reward = (100.0 if success else 0.0) - steps
        greedy.append(
            GreedyResult(seed, steps, round(steps / ratio), total_reward, success, 100.0 - optimum - total_reward)
        )
    return AgentRun(
        name=name,
        option_names=names,
        primitives=len(ACTIONS),
        seeds=tuple(range(seeds)),
        episodes=episodes,
        usage=make_usage(rng, seeds, len(names), budget),
        greedy=tuple(greedy),
        seconds=71.3 if with_options else 64.9,
    )


@cache
def make_playback() -> Playback:
    """A real way to build the tower of the 4 x 3 arm, with invented values."""
    arm = MagnetArm()
    _, starts = arm.initial_distribution()
    state = jax.tree.map(lambda leaf: leaf[0], starts)
    transition = jax.jit(arm.transition)
    plan = (
        (LIFT, (DOWN, DOWN, MAGNET_ON, UP, UP)),
        (RIGHT, (RIGHT,)),
        (MAGNET_OFF, (MAGNET_OFF,)),
        (RIGHT, (RIGHT,)),
        (LIFT, (DOWN, DOWN, MAGNET_ON, UP, UP)),
        (LEFT, (LEFT,)),
        (MAGNET_OFF, (MAGNET_OFF,)),
    )
    rng = np.random.default_rng(5)
    pictures, option, chosen, action = [arm.render(state)], [], [], []
    for which, primitives in plan:
        for number, primitive in enumerate(primitives):
            state = transition(state, np.int32(primitive), np.int32(0))
            pictures.append(arm.render(state))
            option.append(which)
            chosen.append(number == 0)
            action.append(primitive)
    steps = len(action)
    available = rng.random((steps, len(OPTIONS))) < 0.8
    available[:, : len(ACTIONS)] = True
    available[np.arange(steps), option] = True
    values = 87.0 - (steps - np.arange(steps))[:, None] * 0.3 - rng.gamma(2.0, 2.0, (steps, len(OPTIONS)))
    values[np.arange(steps), option] = 87.0 - (steps - np.arange(steps)) * 0.3
    termination = rng.random((steps, len(OPTIONS)))
    termination[np.arange(1, steps), option[:-1]] = np.where(chosen[1:], 0.98, 0.03)
    termination[:, : len(ACTIONS)] = 1.0
    termination[1, GO_DOWN] = np.nan
    total_reward = -np.arange(1.0, steps + 1)
    total_reward[-1] += 100.0
    return Playback(
        agent="DQN with options",
        seed=0,
        option_names=OPTIONS,
        action_names=ACTIONS,
        pictures=np.stack(pictures),
        option=np.array(option),
        chosen=np.array(chosen),
        action=np.array(action),
        values=values,
        available=available,
        termination=termination,
        total_reward=total_reward,
    )


@cache
def make_comparison(name: str = "figure-2", seeds: int = 6, budget: int = 50_000) -> Comparison:
    """A small and a large problem: figure-2 and figure-3."""
    rng = np.random.default_rng(7)
    small = name == "figure-2"
    optimum = 13 if small else 25
    return Comparison(
        name=name,
        title="Magnet arm 4 x 3, 3 bricks (figure 2)" if small else "Magnet arm 6 x 4, 4 bricks (figure 3)",
        optimal_return=100.0 - optimum,
        optimal_steps=optimum,
        optimal_decisions=7 if small else 10,
        thresholds=(50.0, 80.0) if small else (0.0, 50.0, 70.0),
        options=(
            OptionRun("go-down", 1.0, 1.5, 1.5, 30, 4000, 5.2),
            OptionRun("lift", 29 / 30, 5.31, 5.2, 30, 20_000, 12.8),
        ),
        agents=(
            make_agent(rng, "DQN", optimum, 0.45 if small else 0.8, False, seeds, budget),
            make_agent(rng, "DQN with options", optimum, 0.3, True, seeds, budget),
        ),
        playback=make_playback(),
    )


GATES = (
    Gate("greedy steps with options, 4 x 3", 13.0, "<= 13", True),
    Gate("seeds that solve 4 x 3", 1.0, ">= 0.9", True),
    Gate("speed-up over DQN on 6 x 4 (decisions to a mean return above 50)", 1.7, ">= 2", False),
    Gate("not measured", float("nan"), ">= 0", False),
)

SETTINGS: dict[str, object] = {
    "command": "lodestone reproduce --seeds 6 --out report",
    "seconds": 412.7,
    "machine": "2 x Intel Xeon, CPU, jax 0.10.0",
    "version": "0.1.0",
    "dqn": {"learning_rate": 5e-4, "batch_size": 32, "hidden": (64, 64)},
}


def seeds_that_differ(seeds: int) -> np.ndarray:
    """One number per seed, with a long tail."""
    return np.random.default_rng(11).lognormal(3.0, 0.7, seeds)
