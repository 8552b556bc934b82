"""The data that travels between layers.

Shapes: S states, A primitive actions, O options, K outcomes, B batch, N environments, T time.
A *step* is one primitive step of the environment; a *decision* is one choice of the policy over options.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int, PyTree

State = PyTree
"""Whatever an environment's state is made of: a pytree of arrays, without a batch axis."""

Observation = PyTree
"""What the agent sees of a state."""


class Transition(NamedTuple):
    """One decision's experience in a semi-Markov decision process: a primitive step is the case k = 1.

    The target that every learner here uses is
    `reward + discount * max over next_available of Q(next_obs, .)` (Sutton, Precup and Singh 1999, section 3).
    """

    obs: PyTree
    """Where the decision was taken: an observation, or a state from which the observation is drawn later."""
    action: Int[Array, "*batch"]
    """The option chosen (primitive actions are options)."""
    reward: Float[Array, "*batch"]
    """Sum of gamma^i r_{i+1} over the k steps of the option."""
    discount: Float[Array, "*batch"]
    """gamma^k, or 0 where the environment terminated. A time limit does not make it 0."""
    next_obs: PyTree
    """Where the option ended."""
    next_available: Bool[Array, "*batch O"]
    """Options that the maximum at `next_obs` runs over: those that may start there; or, where a time limit cut an
    option that would have gone on, that option alone."""
