"""Playing episodes by machines: the best edge at every choice, in the joint process or in a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from lodestone.agents.hamq import open_edges
from lodestone.envs.base import next_step, sample_initial
from lodestone.envs.host import HostEnvironment
from lodestone.planning.enumerated import row_of
from lodestone.planning.joint import JointProcess
from lodestone.planning.shown_joint import ShownProcess


def greedy_edges(table: Float[np.ndarray, "N U"]) -> Int[np.ndarray, " N"]:
    """The first best edge of every choice: a policy for `lodestone.planning.joint.evaluate_choices`."""
    return np.asarray(table).argmax(axis=1)


class JointEpisode(NamedTuple):
    """One episode; E choices and primitive steps in all, in order."""

    joint: Int[np.ndarray, " E+1"]
    """The joint states, the one after the last included."""
    edge: Int[np.ndarray, " E"]
    """The edge taken, or -1 where it was a primitive step."""
    reward: Float[np.ndarray, " E"]
    """Reward of the step; 0 for a choice."""
    next_state: Int[np.ndarray, " E"]
    """The environment's state afterwards, or the number that it shows; the end of the episode does not tell."""


def play_choices(
    process: JointProcess,
    policy: Int[np.ndarray, " N"],
    rng: np.random.Generator,
    max_steps: int,
    max_choices: int | None = None,
) -> JointEpisode:
    """One episode of a policy over choices, of at most `max_steps` primitive steps and `max_choices` choices."""
    begins = np.flatnonzero(process.initial_probs)
    begun = int(rng.choice(begins, p=process.initial_probs[begins] / process.initial_probs[begins].sum()))

    def act(joint: int) -> _Acted:
        action = joint - process.num_choices
        draw = rng.choice(process.probs.shape[1], p=process.probs[action])
        state = process.tables.successors[process.state[joint], process.actions[action], draw]
        return _Acted(int(process.successors[action, draw]), float(process.rewards[action, draw]), int(state), False)

    at = int(process.state[begun])
    return _play(process, begun, at, lambda joint: int(policy[joint]), act, max_steps, max_choices)


def play_outside(
    process: ShownProcess,
    environment: HostEnvironment,
    table: Float[np.ndarray, "N U"],
    key: PRNGKeyArray,
    max_steps: int,
) -> JointEpisode:
    """One greedy episode in a new copy of a Gymnasium environment, of at most `max_steps` primitive steps."""
    now = sample_initial(environment, key)
    at = int(row_of(environment, now))

    def choose(joint: int) -> int:
        may = open_edges(jnp.asarray(process.firsts[joint]), now.seen.allowed)
        return int(np.where(may, table[joint], -np.inf).argmax())

    def act(joint: int) -> _Acted:
        nonlocal now
        place = joint - process.num_choices
        now, reward, terminated = next_step(environment, jnp.float32(0), now, jnp.int32(process.actions[place]))
        shown = int(row_of(environment, now))
        landed = process.end if terminated else int(process.landings[process.landing[place], shown])
        return _Acted(landed, float(reward), shown, bool(now.truncated))

    return _play(process, int(process.landings[0, at]), at, choose, act, max_steps, None)


class _Acted(NamedTuple):
    """What a primitive step of an episode brought."""

    joint: int
    reward: float
    state: int
    cut: bool
    """Whether a limit of the environment's own ended the episode."""


def _play(
    process: JointProcess | ShownProcess,
    joint: int,
    state: int,
    choose: Callable[[int], int],
    act: Callable[[int], _Acted],
    max_steps: int,
    max_choices: int | None,
) -> JointEpisode:
    joints, edges, rewards, states, steps, choices, cut = [joint], [], [], [], 0, 0, False
    while joint != process.end and steps < max_steps and not cut:
        if joint < process.num_choices:
            if choices == max_choices:
                break
            choices += 1
            edge, reward = choose(joint), 0.0
            joint = int(process.edges[joint, edge])
        else:
            edge, steps = -1, steps + 1
            joint, reward, state, cut = act(joint)
        joints.append(joint)
        edges.append(edge)
        rewards.append(reward)
        states.append(state)
    return JointEpisode(np.array(joints), np.array(edges), np.array(rewards), np.array(states))
