"""Options as arrays over numbered states: the fastest kind, and the exact image of any other on an enumerable world."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lodestone.envs.state_space import Numbers, StateSpace
from lodestone.errors import check_name
from lodestone.options.base import Options
from lodestone.planning.option_models import tabulate_options
from lodestone.types import State


class TabularOptions(Options):
    """O options over S states."""

    space: StateSpace | Numbers
    option_names: tuple[str, ...] = eqx.field(static=True)
    caps: tuple[int, ...] = eqx.field(static=True)
    initiation_table: Bool[Array, "S O"]
    policy_table: Float[Array, "S O A"]
    termination_table: Float[Array, "S O"]

    @property
    def names(self) -> tuple[str, ...]:
        return self.option_names

    @property
    def max_steps(self) -> tuple[int, ...]:
        return self.caps

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return self.initiation_table[self.space.index_of(state)]

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return self.policy_table[self.space.index_of(state)]

    def termination(self, state: State) -> Float[Array, " O"]:
        return self.termination_table[self.space.index_of(state)]


def chosen(options: TabularOptions, names: Sequence[str]) -> TabularOptions:
    """Some of the options by name, in this order. Raises `UnknownName`."""
    for name in names:
        check_name("option", name, options.names)
    positions = jnp.asarray([options.names.index(name) for name in names], dtype=jnp.int32)
    return TabularOptions(
        options.space,
        tuple(names),
        tuple(options.caps[options.names.index(name)] for name in names),
        initiation_table=options.initiation_table[:, positions],
        policy_table=options.policy_table[:, positions],
        termination_table=options.termination_table[:, positions],
    )


def as_tabular(options: Options, space: StateSpace) -> TabularOptions:
    """The same options as tables over `space`: equal in every state of it, and as cheap as a look-up."""
    return _from_tables(space, options, space)


def on_numbers(options: Options, space: StateSpace) -> TabularOptions:
    """The same options where a state is given as its number in `space`, as in an `Enumerated` environment."""
    return _from_tables(Numbers(space.size), options, space)


def _from_tables(numbering: StateSpace | Numbers, options: Options, space: StateSpace) -> TabularOptions:
    tables = tabulate_options(options, space)
    return TabularOptions(
        numbering,
        tables.names,
        tables.max_steps,
        initiation_table=jnp.asarray(tables.initiation.T),
        policy_table=jnp.asarray(tables.action_probs.swapaxes(0, 1)),
        termination_table=jnp.asarray(tables.termination.T),
    )
