"""Options that join the two ends of the world, again and again (Jinnai et al. 2019).

The second smallest eigenvalue lambda_2 of a graph's combinatorial Laplacian, its algebraic connectivity, bounds the
time that a walk at random takes to cover the graph: about n^2 ln n / lambda_2. Its eigenvector, Fiedler's, is lowest
and highest at two ends that are far apart. Two options, from either end to the other, add an edge between them, and
lambda_2 grows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from lodestone.discovery.graph import (
    InteractionGraph,
    as_undirected,
    interaction_graph,
    laplacian,
    lowest_eigenpairs,
    pieces,
)
from lodestone.discovery.knowledge import Knowledge
from lodestone.discovery.reaching import Destination, nearest, options_to
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.options.tabular import TabularOptions

Initiation = Literal["point", "everywhere"]

MAX_NUMBER = 1000
"""Of options: every two take an eigenvector."""


@dataclass(frozen=True)
class CoveringConfig:
    """Settings of the method."""

    number: int = 8
    """Options: two for each pair of ends."""
    initiation: Initiation = "point"
    """Where an option may start. `point`: at the other end of its pair only. `everywhere`: where there is a way."""

    def __post_init__(self) -> None:
        if not 2 <= self.number <= MAX_NUMBER or self.number % 2:
            raise InvalidConfig(f"number is {self.number}, but covering options come in pairs: 2, 4, ... {MAX_NUMBER}.")
        if self.initiation not in get_args(Initiation):
            raise InvalidConfig(
                f"initiation is {self.initiation!r}, but must be one of {', '.join(get_args(Initiation))}."
            )


class Covering(NamedTuple):
    """What the method found: P pairs of ends."""

    options: TabularOptions
    """For each pair from the highest state to the lowest and back, as far as a way is known."""
    subgoals: Int[np.ndarray, " O"]
    """Number of the state where each option goes."""
    pair_of: Int[np.ndarray, " O"]
    """Which pair each option belongs to, counted from 0."""
    pairs: tuple[tuple[int, int], ...]
    """Numbers of the states where each vector is highest and lowest."""
    connectivity: tuple[float, ...]
    """lambda_2 before the first pair and after each, of the graph with an edge for each pair so far; P + 1 numbers."""
    vectors: Float[np.ndarray, "S P"]
    """The Fiedler vector that gave each pair; not a number where a state was not seen."""
    edges: sparse.csr_array
    """The graph [V, V] with an edge for each pair."""


def covering(knowledge: Knowledge, config: CoveringConfig) -> Covering:
    """Join the ends `number / 2` times. Raises `CannotDiscover` where the graph is in pieces, which no random walk
    covers."""
    graph = interaction_graph(knowledge)
    edges = graph.undirected()
    apart = pieces(edges)
    if apart > 1:
        raise CannotDiscover(
            f"The graph of the {len(graph.states):,} states that were seen is in {apart} pieces with no step between "
            "them, so that there is no eigenvector that joins them: covering options need a connected world."
        )
    pairs, connectivity, vectors = [], [], []
    for _ in range(config.number // 2):
        value, vector = fiedler(edges)
        ends = int(vector.argmax()), int(vector.argmin())
        connectivity.append(value)
        vectors.append(vector)
        pairs.append(ends)
        edges = with_edge(edges, *ends)
    connectivity.append(fiedler(edges)[0])

    destinations, pair_of = [], []
    for position, (high, low) in enumerate(pairs):
        for begin, end, way in ((high, low, "down"), (low, high, "up")):
            there = _destination(graph, begin, end, f"cover-{position + 1}-{way}", config.initiation)
            if there is not None:
                destinations.append(there)
                pair_of.append(position)
    if not destinations:
        raise CannotDiscover("No way is known from one end of the world to the other.")
    return Covering(
        options_to(knowledge, destinations),
        np.array([destination.state for destination in destinations]),
        np.array(pair_of),
        tuple((int(graph.states[high]), int(graph.states[low])) for high, low in pairs),
        tuple(connectivity),
        graph.spread(np.stack(vectors, axis=1)),
        edges,
    )


def fiedler(undirected: sparse.csr_array) -> tuple[float, Float[np.ndarray, " V"]]:
    """lambda_2 of a connected graph and its eigenvector, whose largest entry is positive."""
    values, vectors = lowest_eigenpairs(laplacian(undirected, normalised=False), 2)
    return float(values[1]), vectors[:, 1]


def with_edge(undirected: sparse.csr_array, one: int, other: int) -> sparse.csr_array:
    """The graph with an edge of weight 1 between two vertices."""
    new = sparse.csr_array(([1.0], ([one], [other])), shape=undirected.shape)
    return as_undirected(undirected.maximum(new))


def _destination(
    graph: InteractionGraph, begin: int, end: int, name: str, initiation: Initiation
) -> Destination | None:
    """None where no way leads from one vertex to the other."""
    there, here = int(graph.states[end]), int(graph.states[begin])
    region = nearest(graph, there, None)
    if not region[here]:
        return None
    only_here = np.arange(graph.num_states) == here
    return Destination(name, there, region, region if initiation == "everywhere" else only_here)
