"""Playing saved policies: their results, and an episode to look at."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray, PyTree, UInt8

from lodestone.agents.saved import Policy
from lodestone.learning.evaluation import Episode, Trace, play_episode, trace_episode

MAX_STEPS = 5000
"""Primitive steps after which an episode is given up where the policy's rules have no limit that ends it sooner."""


@dataclass(frozen=True)
class Playback:
    """One greedy episode to look at; T primitive steps, O options."""

    agent: str
    seed: int
    option_names: tuple[str, ...]
    action_names: tuple[str, ...]
    pictures: UInt8[np.ndarray, "T+1 height width 3"]
    """Before every step, and after the last."""
    option: Int[np.ndarray, " T"]
    """The option that runs at each step."""
    chosen: Bool[np.ndarray, " T"]
    """Whether it was chosen at this step, rather than continued."""
    action: Int[np.ndarray, " T"]
    """The primitive action that was taken."""
    values: Float[np.ndarray, "T O"]
    """Q(s, .) in units of the environment's reward."""
    available: Bool[np.ndarray, "T O"]
    total_reward: Float[np.ndarray, " T"]
    """Return so far, after each step."""


def play(policy: Policy, key: PRNGKeyArray) -> Episode:
    """One greedy episode of every seed, all with the same key; leaves have a leading seed axis."""

    @jax.jit
    @jax.vmap
    def run(learned: PyTree) -> Episode:
        values = policy.values_of(learned)
        return play_episode(policy.environment, policy.options, policy.rules, values, key, MAX_STEPS)

    return jax.tree.map(np.asarray, run(policy.learned))


def record(policy: Policy, position: int, key: PRNGKeyArray, agent: str) -> Playback:
    """One greedy episode of the seed at this position, with its pictures."""
    values = policy.values(position)
    length = int(play(policy, key).steps[position])

    @jax.jit
    def run(key: PRNGKeyArray) -> Trace:
        return trace_episode(policy.environment, policy.options, policy.rules, values, key, length)

    trace = jax.tree.map(np.asarray, run(key))
    states = [jax.tree.map(lambda leaf, step=step: leaf[step], trace.state) for step in range(length)]
    states.append(jax.tree.map(lambda leaf: leaf[-1], trace.next_state))
    return Playback(
        agent=agent,
        seed=policy.seeds[position],
        option_names=policy.options.names,
        action_names=policy.environment.action_names,
        pictures=np.stack([policy.environment.render(state) for state in states]),
        option=trace.option,
        chosen=trace.chosen,
        action=trace.action,
        values=trace.values,
        available=trace.available,
        total_reward=np.cumsum(trace.reward),
    )
