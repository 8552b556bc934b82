"""Options along the slowest ways in which a walk at random spreads (Machado, Bellemare and Bowling 2017).

An eigenvector e of the graph's Laplacian rises, or falls, along such a way. An option of the vector pays itself
r(s, s') = e(s') - e(s) and may stop, for nothing, instead of acting on:

    q(s, a) = E [ e(s') - e(s) + gamma max(0, max over a' of q(s', a')) ]

It starts, and goes on, where the best q is above 0, and takes the best action. Each vector gives two options, as -e is
an eigenvector, too. The vectors of the eigenvalue 0 are constant on each connected piece and lead nowhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from lodestone.discovery.graph import (
    InteractionGraph,
    interaction_graph,
    laplacian,
    lowest_eigenpairs,
    pieces,
)
from lodestone.discovery.knowledge import Knowledge
from lodestone.discovery.reaching import build_options
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.options.tabular import TabularOptions
from lodestone.planning.solve import check_discount, greedy_choices

Basis = Literal["laplacian", "differences"]

SETTLED = 1e-13
"""Value iteration ends when no value changes by more."""
TIE = 1e-9
"""Actions whose values differ by less are equally good; the first is taken."""


@dataclass(frozen=True)
class EigenoptionsConfig:
    """Settings of the method."""

    number: int = 8
    """Options: two for each eigenvector."""
    discount: float = 0.9
    """gamma of an option's own reward."""
    tolerance: float = 1e-8
    """An option stops where no action is worth more."""
    basis: Basis = "laplacian"
    """Where the vectors come from. `laplacian`: the normalised one of the interaction graph. `differences`: the right
    singular vectors of the differences phi(s') - phi(s), one row for each step between two states; phi has one entry a
    state, so where every step has one back they are the eigenvectors of the combinatorial Laplacian, whose eigenvalues
    are half as large."""

    def __post_init__(self) -> None:
        if self.number < 2 or self.number % 2:
            raise InvalidConfig(f"number is {self.number}, but eigenoptions come in pairs: 2, 4, ...")
        check_discount(self.discount)
        if self.discount == 1:
            raise InvalidConfig("discount is 1, but the options' own values need one below.")
        if not self.tolerance >= 0:
            raise InvalidConfig(f"tolerance is {self.tolerance}, but must not be negative.")
        if self.basis not in get_args(Basis):
            raise InvalidConfig(f"basis is {self.basis!r}, but must be one of {', '.join(get_args(Basis))}.")


class Eigenoptions(NamedTuple):
    """What the method found: O options, two for each of O/2 vectors."""

    options: TabularOptions
    """For each vector that which climbs it, then that which descends."""
    subgoals: Int[np.ndarray, " O"]
    """The highest, or lowest, state of each option's vector."""
    eigenvalues: Float[np.ndarray, " O/2"]
    """Ascending."""
    vectors: Float[np.ndarray, "S O/2"]
    """Of length 1; not a number where a state was not seen."""


def eigenoptions(knowledge: Knowledge, config: EigenoptionsConfig) -> Eigenoptions:
    """The options of the lowest non-constant vectors. Raises `CannotDiscover` where there are not so many, and
    `TooManyStates`."""
    graph = interaction_graph(knowledge)
    undirected = graph.undirected()
    constant, count = pieces(undirected), config.number // 2
    if len(graph.states) - constant < count:
        raise CannotDiscover(
            f"{config.number} options need {count} eigenvectors that are not constant, but the graph of the "
            f"{len(graph.states):,} states that were seen has {len(graph.states) - constant:,}."
        )
    if config.basis == "laplacian":
        matrix = laplacian(undirected, normalised=True)
    else:
        # The right singular vectors of a matrix are the eigenvectors of its Gram matrix.
        seen = differences(graph)
        matrix = (seen.T @ seen).tocsr()
    values, vectors = lowest_eigenpairs(matrix, constant + count)
    values, vectors = values[constant:], vectors[:, constant:]
    both = np.stack([vectors, -vectors], axis=2).reshape(len(graph.states), 2 * count)
    along = np.zeros((graph.num_states, 2 * count))
    along[graph.states] = both
    action_values = option_values(knowledge, along, config.discount)
    runs = action_values.max(axis=1) > config.tolerance
    names = tuple(f"eigen-{vector}-{way}" for vector in range(1, count + 1) for way in ("up", "down"))
    options = build_options(
        knowledge,
        names,
        starts=runs,
        goes_on=runs,
        actions=np.stack([greedy_choices(values, TIE) for values in np.moveaxis(action_values, 2, 0)], axis=1),
    )
    return Eigenoptions(options, graph.states[both.argmax(axis=0)], values, graph.spread(vectors))


def differences(graph: InteractionGraph) -> sparse.csr_array:
    """phi(s') - phi(s), one row for each step between two states that was seen, one column for each state."""
    begin, end = graph.edges.tocoo().coords
    steps, states = graph.edges.nnz, len(graph.states)
    rows, ones = np.arange(steps), np.ones(steps)
    entries = (np.append(-ones, ones), (np.append(rows, rows), np.append(begin, end)))
    return sparse.csr_array(entries, shape=(steps, states))


def option_values(knowledge: Knowledge, along: Float[np.ndarray, "S O"], discount: float) -> Float[np.ndarray, "S A O"]:
    """q of the options that climb each of O vectors, over all states."""
    tables = knowledge.tables
    matrix, shape = tables.matrix(), (tables.num_actions, tables.num_states, along.shape[1])
    rewards = (matrix @ along).reshape(shape) - along
    values, change = np.zeros(along.shape), np.inf
    while change > SETTLED:
        action_values = rewards + discount * (matrix @ values).reshape(shape)
        updated = np.maximum(action_values.max(axis=0), 0.0)
        values, change = updated, np.abs(updated - values).max()
    return action_values.swapaxes(0, 1)
