"""Interrupting options (Sutton, Precup and Singh 1999, section 4, theorem 2).

An option that was begun is run on although another may have become better on the way. Stopping it wherever going on is
worth less than choosing anew,

    beta'(s') = 1 where Q^mu(s', o) < V^mu(s'), else beta(s'),

never makes the policy over options worse, and makes it better wherever such a stop can happen.

An option with a cap is worth less the longer it has run, so that no table over states says what going on is worth:
capped options are refused, but for those of one step, which have nothing to go on with.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lodestone.envs.state_space import Numbers, StateSpace
from lodestone.errors import InvalidConfig
from lodestone.options.base import NO_CAP, Options
from lodestone.planning.option_models import OptionTables
from lodestone.types import State

SLACK = 1e-12
"""How much worse going on must be, so that rounding in float64 does not stop an option."""

LEARNED_SLACK = 1e-6
"""The same for float32 tables, relative to the best value."""


def interrupted(
    options: OptionTables, option_values: Float[np.ndarray, "S O"], values: Float[np.ndarray, " S"]
) -> OptionTables:
    """The options with a stop wherever Q(s, o) < V(s).

    For the theorem to hold, `option_values` and `values` are Q and V of one policy over options
    (`evaluate_option_choices`, `evaluate_options`) that chooses an available option in every state. Without a discount
    it also takes that going on for ever never pays.
    Raises `InvalidConfig` for options with a cap of more than one step.
    """
    refuse_caps(options.names, options.max_steps, "interrupted")
    better_elsewhere = values - SLACK > option_values.T
    return options._replace(termination=np.where(better_elsewhere, np.float32(1), options.termination))


class Interrupting(Options):
    """Options that stop, besides where they do anyway, wherever they are worth less than the best that may start.

    It is interruption under the policy that is greedy in `table`: play that policy with these options. Nothing is known
    of an option where it may not start, so that there it goes on.
    """

    options: Options
    space: StateSpace | Numbers
    table: Float[Array, "S O"]
    """Values of the options in each state of `space`, planned or learned."""

    def __check_init__(self) -> None:
        refuse_caps(self.names, self.max_steps, "interrupted")
        if self.table.shape != (self.space.size, self.size):
            raise InvalidConfig(
                f"The table has the shape {list(self.table.shape)}, but there are {self.space.size:,} states and "
                f"{self.size} options."
            )

    @property
    def names(self) -> tuple[str, ...]:
        return self.options.names

    @property
    def max_steps(self) -> tuple[int, ...]:
        return self.options.max_steps

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return self.options.initiation(state)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return self.options.action_probs(state)

    def termination(self, state: State) -> Float[Array, " O"]:
        values, available = self.table[self.space.index_of(state)], self.initiation(state)
        best = jnp.max(values, where=available, initial=-jnp.inf)
        worse = available & (values < best - LEARNED_SLACK * jnp.maximum(1.0, jnp.abs(best)))
        return jnp.where(worse, 1.0, self.options.termination(state))


def refuse_caps(names: tuple[str, ...], max_steps: tuple[int, ...], what: str) -> None:
    """Raise `InvalidConfig` if an option has a cap of more than one step: what it is worth to go on with it then
    depends on how long it has run."""
    capped = [(name, cap) for name, cap in zip(names, max_steps, strict=True) if cap not in (1, NO_CAP)]
    if capped:
        name, cap = capped[0]
        raise InvalidConfig(
            f"Option {name!r} is stopped after {cap} steps, so that going on with it is worth the less the longer it "
            f"has run: it cannot be {what}. Take it without a cap."
        )
