"""Random Markov decision processes: small problems without any structure, to test learners and planners on.

Any state may follow any other, so that an episode ends whatever the agent does, if a state ends it at all. But rewards
are as often gains as costs, and the best policy without a discount may stay for a long time.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, Int32, UInt8
from PIL import Image, ImageDraw, ImageFont

from lodestone.envs.base import Environment
from lodestone.errors import InvalidConfig


@lru_cache(maxsize=64)
def random_dynamics(
    mdp_seed: int, states: int, actions: int, concentration: float
) -> tuple[Float[np.ndarray, "S A S"], Float[np.ndarray, "S A S"]]:
    """Probabilities of the next state, each row Dirichlet(`concentration`), and rewards, each N(0, 1), of every state,
    action and next state, float64; remembered and read-only."""
    rng = np.random.default_rng(mdp_seed)
    probs = rng.dirichlet(np.full(states, concentration), size=(states, actions))
    rewards = rng.normal(size=probs.shape)
    for array in (probs, rewards):
        array.setflags(write=False)
    return probs, rewards


MAX_PAIRS = 10_000_000
"""Of states, with every action."""


class NumberedState(NamedTuple):
    """A state is a number."""

    number: Int32[Array, ""]


class RandomMDP(Environment):
    """Nature's draw is the next state; episodes begin in any state that does not end them."""

    mdp_seed: int = eqx.field(static=True, default=0)
    """Which process is drawn."""
    states: int = eqx.field(static=True, default=7)
    """How many states there are."""
    actions: int = eqx.field(static=True, default=3)
    """How many actions there are."""
    goals: int = eqx.field(static=True, default=1)
    """How many of the states, the last ones, end the episode; with none it goes on for ever."""
    concentration: float = eqx.field(static=True, default=0.4)
    """Parameter of the Dirichlet distribution of the next state: the smaller, the fewer states follow an action with
    much probability."""
    observation: Literal["planes", "index"] = eqx.field(static=True, default="planes")
    """What the agent sees: one 0/1 plane over the states in a row, or the number of the state."""

    def __check_init__(self) -> None:
        for name, least in (("mdp_seed", 0), ("states", 1), ("actions", 1)):
            if getattr(self, name) < least:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least {least}.")
        if self.states**2 * self.actions > MAX_PAIRS:
            raise InvalidConfig(
                f"states is {self.states} and actions is {self.actions}, but states x actions x states must be at most "
                f"{MAX_PAIRS}: they are tables."
            )
        if not 0 <= self.goals < self.states:
            raise InvalidConfig(
                f"goals is {self.goals}, but must be from 0 to {self.states - 1}: episodes begin in another state."
            )
        if not 0 < self.concentration < np.inf:
            raise InvalidConfig(f"concentration is {self.concentration}, but must be a positive number.")
        if self.observation not in ("planes", "index"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'planes' or 'index'.")

    @property
    def dynamics(self) -> tuple[Float[np.ndarray, "S A S"], Float[np.ndarray, "S A S"]]:
        """Probabilities and rewards of every state, action and next state."""
        return random_dynamics(self.mdp_seed, self.states, self.actions, self.concentration)

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(f"action-{action}" for action in range(self.actions))

    @property
    def num_outcomes(self) -> int:
        """The next state."""
        return self.states

    def initial_distribution(self) -> tuple[Float[Array, " I"], NumberedState]:
        """Any state that does not end the episode."""
        count = self.states - self.goals
        probs = jnp.full(count, 1 / count, dtype=jnp.float32)
        return probs, NumberedState(jnp.arange(count, dtype=jnp.int32))

    def outcome_probs(self, state: NumberedState, action: Int[Array, ""]) -> Float[Array, " K"]:
        probs, _ = self.dynamics
        return jnp.asarray(probs, dtype=jnp.float32)[state.number, action]

    def transition(self, state: NumberedState, action: Int[Array, ""], outcome: Int[Array, ""]) -> NumberedState:
        del state, action
        return NumberedState(jnp.asarray(outcome, dtype=jnp.int32))

    def reward(self, state: NumberedState, action: Int[Array, ""], next_state: NumberedState) -> Float[Array, ""]:
        _, rewards = self.dynamics
        return jnp.asarray(rewards, dtype=jnp.float32)[state.number, action, next_state.number]

    def terminal(self, state: NumberedState) -> Bool[Array, ""]:
        return state.number >= self.states - self.goals

    def observe(self, state: NumberedState) -> Int8[Array, "1 S 1"] | Int[Array, ""]:
        """`planes`: int8 [1, S, 1], 1 where the agent is; `index`: int32 [], the state."""
        if self.observation == "index":
            return state.number
        return (jnp.arange(self.states) == state.number)[None, :, None].astype(jnp.int8)

    def render(self, state: NumberedState) -> UInt8[np.ndarray, "height width 3"]:
        """The states as a ring, the current one red, those that end the episode green; lines lead to what may follow,
        one colour an action and the wider the more probable."""
        centre = SIDE // 2
        ring, radius = SIDE * 0.4, min(SIDE * 0.07, SIDE * 0.4 * np.pi / self.states * 0.8)
        angle = 2 * np.pi * np.arange(self.states) / self.states
        places = centre + ring * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        picture = Image.new("RGB", (SIDE, SIDE), PAPER)
        draw = ImageDraw.Draw(picture)
        draw.ellipse((centre - ring, centre - ring, centre + ring, centre + ring), outline=GRID, width=SMOOTH)

        here, first_goal = int(state.number), self.states - self.goals
        if here < first_goal:
            _draw_successors(draw, places, here, self.dynamics[0][here], radius)
        font = ImageFont.load_default(max(round(radius * 0.9), 8))
        for number, (x, y) in enumerate(places):
            fill = RED if number == here else GREEN if number >= first_goal else CIRCLE
            ink = PAPER if number == here or number >= first_goal else INK
            edge = GREEN if number == here >= first_goal else INK
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill, edge, 2 * SMOOTH)
            draw.text((x, y), str(number), ink, font, anchor="mm")
        return np.asarray(picture.reduce(SMOOTH))


SMOOTH = 3
"""Pictures for people are painted this many times larger and then reduced, for smooth edges."""
SIDE = 360 * SMOOTH
"""Side of the picture, in painted pixels."""
PAPER, CIRCLE, GRID, INK = (250, 250, 247), (232, 238, 246), (220, 222, 226), (52, 58, 68)
GREEN, RED = (34, 150, 84), (204, 60, 40)
ACTION_COLOURS = ((86, 140, 210), (226, 150, 50), (150, 100, 180), (110, 120, 130))
"""Colours of the actions' lines, in turn."""


def _draw_successors(
    draw: ImageDraw.ImageDraw,
    places: Float[np.ndarray, "S 2"],
    here: int,
    probs: Float[np.ndarray, "A S"],
    radius: float,
) -> None:
    """Lines from a state to the others, side by side where several actions lead to the same one."""
    widest = radius / len(probs)
    for action, row in enumerate(probs):
        aside = (action - (len(probs) - 1) / 2) * 1.5 * widest
        for number in range(len(places)):
            width = round(widest * row[number])
            if number != here and width:
                along = places[number] - places[here]
                shift = aside * np.array([-along[1], along[0]]) / np.linalg.norm(along)
                line = (*(places[here] + shift), *(places[number] + shift))
                draw.line(line, ACTION_COLOURS[action % len(ACTION_COLOURS)], width)
