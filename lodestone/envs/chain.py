"""A chain whose end pays only after a visit to its far end (Kulkarni et al. 2016, section 4.1).

Leaving at once is safe and pays little; the far end lies against the stream. There the reward depends on the past; here
the state says whether the far end was visited, so that the process is Markov.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Int32, UInt8
from PIL import Image, ImageDraw, ImageFont

from lodestone.envs.base import Environment
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Task, goal
from lodestone.errors import InvalidConfig

LEFT, RIGHT = range(2)

MAX_LENGTH = 10_000
"""Of a chain: a longer one takes too long to find its states, step by step."""


class ChainState(NamedTuple):
    """Where the agent is, and where it has been."""

    position: Int32[Array, ""]
    """From 1, where the episode ends, to the length of the chain."""
    visited: Bool[Array, ""]
    """Whether the far end was reached in this episode."""


class Chain(Environment):
    """A row of states, two actions; the episode ends in the first state."""

    length: int = eqx.field(static=True, default=6)
    """How many states are in the row."""
    start: int = eqx.field(static=True, default=2)
    """Where the episode begins, counted from 1."""
    right_success: float = eqx.field(static=True, default=0.5)
    """Probability that RIGHT goes right, or stays at the far end; else it goes left, as LEFT always does."""
    large_reward: float = eqx.field(static=True, default=1.0)
    """Reward of the step that ends the episode, if the far end was visited."""
    small_reward: float = eqx.field(static=True, default=0.01)
    """Reward of the step that ends the episode, if it was not. All other steps pay nothing."""
    observation: Literal["planes", "index"] = eqx.field(static=True, default="planes")
    """What the agent sees: 0/1 planes over the row, or the number of the state."""

    def __check_init__(self) -> None:
        if not 2 <= self.length <= MAX_LENGTH:
            raise InvalidConfig(f"length is {self.length}, but must be from 2 to {MAX_LENGTH}.")
        if not 2 <= self.start <= self.length:
            raise InvalidConfig(f"start is {self.start}, but must be from 2 to {self.length}, the length.")
        if not 0 <= self.right_success <= 1:
            raise InvalidConfig(f"right_success is {self.right_success}, but must be a probability from 0 to 1.")
        for name in ("large_reward", "small_reward"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")
        if self.observation not in ("planes", "index"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'planes' or 'index'.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("left", "right")

    @property
    def num_outcomes(self) -> int:
        """Whether the action does as it says, or goes left."""
        return 2

    def initial_distribution(self) -> tuple[Float[Array, " 1"], ChainState]:
        position = jnp.array([self.start], dtype=jnp.int32)
        return jnp.ones(1), ChainState(position, position == self.length)

    def outcome_probs(self, state: ChainState, action: Int[Array, ""]) -> Float[Array, " 2"]:
        del state
        does = jnp.where(action == RIGHT, jnp.float32(self.right_success), jnp.float32(1))
        return jnp.stack([does, 1 - does])

    def transition(self, state: ChainState, action: Int[Array, ""], outcome: Int[Array, ""]) -> ChainState:
        step = jnp.where((action == RIGHT) & (outcome == 0), 1, -1)
        position = jnp.clip(state.position + step, 1, self.length).astype(jnp.int32)
        return ChainState(position, state.visited | (position == self.length))

    def reward(self, state: ChainState, action: Int[Array, ""], next_state: ChainState) -> Float[Array, ""]:
        del state, action
        paid = jnp.where(next_state.visited, jnp.float32(self.large_reward), jnp.float32(self.small_reward))
        return jnp.where(self.terminal(next_state), paid, jnp.float32(0))

    def terminal(self, state: ChainState) -> Bool[Array, ""]:
        """The agent is in the first state."""
        return state.position == 1

    def observe(self, state: ChainState) -> Int8[Array, "1 length 2"] | Int[Array, ""]:
        """`planes`: int8 [1, length, 2], 1 where the agent is, in the first plane before it has visited the far end and
        in the second from then on; `index`: int32 [], the state's number in `reachable_states`."""
        if self.observation == "index":
            return reachable_states(self).index_of(state)
        here = jnp.arange(1, self.length + 1) == state.position
        return jnp.stack([here & ~state.visited, here & state.visited], axis=-1)[None].astype(jnp.int8)

    def render(self, state: ChainState) -> UInt8[np.ndarray, "height width 3"]:
        """A row of numbered circles, the agent's one red; the first says what it pays now, and a flag at the last is
        green once it was visited."""
        picture = Image.new("RGB", (self.length * SPACE, 2 * SPACE), PAPER)
        draw = ImageDraw.Draw(picture)
        small, large = ImageFont.load_default(SPACE // 5), ImageFont.load_default(SPACE // 3)
        middle = SPACE * 6 // 5
        draw.line((SPACE // 2, middle, self.length * SPACE - SPACE // 2, middle), GRID, SPACE // 14)
        for position in range(1, self.length + 1):
            x, radius = position * SPACE - SPACE // 2, SPACE * 3 // 8
            fill, ink = (RED, PAPER) if position == int(state.position) else (CIRCLE, INK)
            draw.ellipse((x - radius, middle - radius, x + radius, middle + radius), fill, INK, SMOOTH * 2)
            draw.text((x, middle), str(position), ink, large, anchor="mm")

        visited = bool(state.visited)
        pays = self.large_reward if visited else self.small_reward
        draw.text((SPACE // 2, middle + SPACE * 3 // 5), f"pays {pays:g}", INK, small, anchor="mm")
        pole, top, foot = self.length * SPACE - SPACE // 2, SPACE // 6, middle - SPACE * 3 // 8
        draw.line((pole, top, pole, foot), INK, SMOOTH * 2)
        flag = [(pole, top), (pole + SPACE * 2 // 5, top + SPACE // 6), (pole, top + SPACE // 3)]
        draw.polygon(flag, GREEN if visited else PAPER, INK, SMOOTH)
        return np.asarray(picture.reduce(SMOOTH))


@dataclass(frozen=True)
class At:
    """The agent is at a position, counted from 1."""

    position: int

    def __call__(self, chain: Chain, state: ChainState) -> Bool[Array, ""]:
        del chain
        return state.position == self.position


def position_goals(chain: Chain) -> tuple[Task, ...]:
    """One goal for each position but the start's (Kulkarni et al. 2016)."""
    others = (position for position in range(1, chain.length + 1) if position != chain.start)
    return tuple(goal(chain, f"to-{position}", At(position)) for position in others)


SMOOTH = 3
"""Pictures for people are painted this many times larger and then reduced, for smooth edges."""
SPACE = 80 * SMOOTH
"""Width that each state takes, in painted pixels."""
PAPER, CIRCLE, GRID, INK = (250, 250, 247), (232, 238, 246), (190, 196, 204), (52, 58, 68)
GREEN, RED = (34, 150, 84), (204, 60, 40)
