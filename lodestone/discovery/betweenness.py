"""Sub-goals that many shortest paths pass through (Simsek and Barto 2008).

The betweenness of a vertex v is the sum, over ordered pairs of other vertices s and t, of the share of the shortest
paths from s to t that go through v,

    C(v) = sum over s != v != t of w(s, t) sigma_st(v) / sigma_st

Sub-goals are the states where it is a strict local maximum among the neighbours in the interaction graph. An option
starts in the n states nearest to its sub-goal and goes there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from lodestone.discovery.graph import interaction_graph
from lodestone.discovery.knowledge import Knowledge
from lodestone.discovery.reaching import Destination, nearest, options_to
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.options.tabular import TabularOptions

SOURCES = 512
"""Vertices from which paths are counted at once: so many rows of V numbers are held."""
TIE = 1e-9
"""A maximum must exceed its neighbours by this part of itself: less is rounding."""


@dataclass(frozen=True)
class BetweennessConfig:
    """Settings of the method."""

    number: int = 8
    """Options, at most: the highest maxima are taken."""
    nearest: int | None = None
    """n, the states in which each option may start; all from which its sub-goal can be reached if None."""
    directed: bool = False
    """Whether paths follow the steps only the way they lead. If not, a step counts as one back, too."""

    def __post_init__(self) -> None:
        if self.number < 1:
            raise InvalidConfig(f"number is {self.number}, but at least 1 option must be asked for.")
        if self.nearest is not None and self.nearest < 1:
            raise InvalidConfig(f"nearest is {self.nearest}, but an option must be able to start in at least 1 state.")


class Bottlenecks(NamedTuple):
    """What the method found: G sub-goals, the highest first."""

    options: TabularOptions
    subgoals: Int[np.ndarray, " G"]
    """Numbers of states."""
    centrality: Float[np.ndarray, " S"]
    """Normalised betweenness; not a number where a state was not seen."""


def betweenness(edges: sparse.csr_array, weights: Float[np.ndarray, "V V"] | None = None) -> Float[np.ndarray, " V"]:
    """C of every vertex of a graph whose edges are the non-zero entries [V, V], from row to column. `weights` are those
    of the ordered pairs (default: 1).

    Brandes (2001): from each source, breadth first, the numbers of shortest paths sigma; then, the farthest first,

        delta(v) = sum over the successors u of v on shortest paths of sigma(v) / sigma(u) (w(s, u) + delta(u))

    here for many sources at once, one product of sparse matrices a level.
    """
    size = edges.shape[0]
    forward = sparse.csr_array((np.ones(edges.nnz), edges.indices, edges.indptr), edges.shape)
    backward = forward.T.tocsr()
    total = np.zeros(size)
    for first in range(0, size, SOURCES):
        sources = np.arange(first, min(first + SOURCES, size))
        level_of = np.full((len(sources), size), -1, dtype=np.int32)
        paths = np.zeros(level_of.shape)
        rows, columns, counts = np.arange(len(sources)), sources, np.ones(len(sources))
        levels: list[tuple[np.ndarray, np.ndarray]] = []
        while len(rows):
            level_of[rows, columns] = len(levels)
            paths[rows, columns] = counts
            levels.append((rows, columns))
            reached = (sparse.csr_array((counts, (rows, columns)), level_of.shape) @ forward).tocoo()
            new = level_of[reached.coords] < 0
            rows, columns, counts = reached.coords[0][new], reached.coords[1][new], reached.data[new]

        dependence = np.zeros(level_of.shape)
        for depth in range(len(levels) - 1, 0, -1):
            at = levels[depth]
            wanted = 1.0 if weights is None else weights[first + at[0], at[1]]
            shares = (wanted + dependence[at]) / paths[at]
            before = (sparse.csr_array((shares, at), level_of.shape) @ backward).tocoo()
            on_path = level_of[before.coords] == depth - 1
            where = before.coords[0][on_path], before.coords[1][on_path]
            dependence[where] = paths[where] * before.data[on_path]
        dependence[np.arange(len(sources)), sources] = 0.0
        total += dependence.sum(axis=0)
    return total


def local_maxima(undirected: sparse.csr_array, values: Float[np.ndarray, " V"]) -> Int[np.ndarray, " G"]:
    """Vertices whose value is above 0 and above those of all neighbours, the highest first."""
    begin, end = undirected.tocoo().coords
    beside = np.full(len(values), -np.inf)
    np.maximum.at(beside, begin, values[end])
    maxima = np.flatnonzero((values > 0) & (values * (1 - TIE) > beside))
    return maxima[np.argsort(-values[maxima], kind="stable")]


def bottlenecks(knowledge: Knowledge, config: BetweennessConfig) -> Bottlenecks:
    """Sub-goals and options. Raises `CannotDiscover` where no state stands out among its neighbours."""
    graph = interaction_graph(knowledge)
    size, undirected = len(graph.states), graph.undirected()
    central = betweenness(graph.edges if config.directed else undirected) / max((size - 1) * (size - 2), 1)
    vertices = local_maxima(undirected, central)
    reachable = [(state, nearest(graph, state, config.nearest)) for state in graph.states[vertices]]
    chosen = [(state, near) for state, near in reachable if near.any()][: config.number]
    if not chosen:
        raise CannotDiscover("No state lies on more shortest paths than all its neighbours do.")
    destinations = [
        Destination(f"bottleneck-{position}", int(state), near, near)
        for position, (state, near) in enumerate(chosen, start=1)
    ]
    subgoals = np.array([destination.state for destination in destinations])
    return Bottlenecks(options_to(knowledge, destinations), subgoals, graph.spread(central))
