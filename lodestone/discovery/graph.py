"""The interaction graph: states, and an edge where one step may lead from one to another.

Eigenvectors of a matrix L of the graph say how it hangs together: the combinatorial Laplacian D - W, or the normalised
one, D^-1/2 (D - W) D^-1/2, where W holds the weights of the undirected edges and D its row sums.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import eigsh

from lodestone.discovery.knowledge import Knowledge
from lodestone.errors import CannotDiscover, InvalidConfig, TooManyStates

DENSE_STATES = 1000
"""States up to which matrices are decomposed densely; a few eigenvectors of larger ones are found sparsely."""
REPEATED = 16
"""How often an eigenvalue may be repeated without being cut where the eigenvectors that were asked for end."""
SPARSE_VECTORS = 200
"""Eigenvectors of a larger graph, at most."""
ZERO = 1e-9
"""Eigenvalues of a Laplacian below this are 0: there is one for each connected piece."""


class InteractionGraph(NamedTuple):
    """V states that were seen, and the steps between them."""

    states: Int[np.ndarray, " V"]
    """Their numbers, ascending: vertices are counted along this array."""
    edges: sparse.csr_array
    """[V, V], 1 where one step may lead from row to column; no loops."""
    num_states: int
    """S, with those that were not seen."""

    def undirected(self) -> sparse.csr_array:
        """[V, V], symmetric, 1 where a step may lead one way or the other."""
        return as_undirected(self.edges)

    def vertex_of(self, state: int) -> int:
        """The vertex of a state that was seen."""
        return int(np.searchsorted(self.states, state))

    def spread(self, values: Float[np.ndarray, "V *N"]) -> Float[np.ndarray, "S *N"]:
        """Values of the vertices as values of all states; not a number where a state was not seen."""
        whole = np.full((self.num_states, *values.shape[1:]), np.nan)
        whole[self.states] = values
        return whole


def interaction_graph(knowledge: Knowledge) -> InteractionGraph:
    """The graph of what is known. Raises `CannotDiscover` where no step leads anywhere."""
    tables = knowledge.tables
    states = np.flatnonzero(knowledge.seen)
    vertex = np.full(tables.num_states, -1)
    vertex[states] = np.arange(len(states))
    begin, action, outcome = np.nonzero(knowledge.tried[:, :, None] & (tables.probs > 0))
    end = tables.successors[begin, action, outcome]
    moves = begin != end
    if not moves.any():
        raise CannotDiscover("No step leads from one state to another, so that there is nothing to discover.")
    ones = np.ones(moves.sum())
    edges = sparse.csr_array((ones, (vertex[begin[moves]], vertex[end[moves]])), shape=(len(states),) * 2)
    edges.sum_duplicates()
    edges.data[:] = 1.0
    return InteractionGraph(states, edges, tables.num_states)


def as_undirected(edges: sparse.csr_array) -> sparse.csr_array:
    """Symmetric [V, V]: the larger weight of the two directions."""
    return edges.maximum(edges.T).tocsr()


def pieces(undirected: sparse.csr_array) -> int:
    """How many connected pieces the graph has."""
    return int(connected_components(undirected, directed=False)[0])


def steps_to(edges: sparse.csr_array, vertex: int) -> Float[np.ndarray, " V"]:
    """Fewest steps from each vertex to one; inf where no path leads there."""
    return dijkstra(edges.T.tocsr(), indices=vertex, unweighted=True)


def laplacian(undirected: sparse.csr_array, normalised: bool) -> sparse.csr_array:
    """D - W, or D^-1/2 (D - W) D^-1/2; a vertex without edges counts as one of degree 1."""
    degrees = undirected.sum(axis=1)
    plain = sparse.diags_array(degrees) - undirected
    if not normalised:
        return plain.tocsr()
    roots = sparse.diags_array(np.where(degrees > 0, degrees, 1.0) ** -0.5)
    return (roots @ plain @ roots).tocsr()


def lowest_eigenpairs(matrix: sparse.csr_array, count: int) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "V N"]]:
    """The `count` smallest eigenvalues of a positive semi-definite matrix, ascending, and orthonormal eigenvectors.

    Where an eigenvalue is repeated, any rotation of its vectors would do: `unique_basis` is taken.
    Raises `InvalidConfig` where there are not so many, and `TooManyStates`.
    """
    size = matrix.shape[0]
    if count > size:
        raise InvalidConfig(f"{count:,} eigenvectors were asked for, but the graph has {size:,} states.")
    # A few more, so that no repeated eigenvalue is cut.
    wanted = min(count + REPEATED, size)
    if size <= DENSE_STATES:
        values, vectors = linalg.eigh(matrix.toarray(), subset_by_index=(0, wanted - 1))
    elif count <= SPARSE_VECTORS:
        # Shifted to below 0, where the matrix can be inverted and the smallest eigenvalues become the largest.
        begin = np.random.default_rng(0).normal(size=size)
        values, vectors = eigsh(matrix.tocsc(), k=wanted, sigma=-1e-4, v0=begin)
        order = np.argsort(values)
        values, vectors = values[order], vectors[:, order]
    else:
        raise TooManyStates(
            f"The graph has {size:,} states: of more than {DENSE_STATES:,}, at most {SPARSE_VECTORS} eigenvectors can "
            f"be found, but {count:,} were asked for."
        )
    return values[:count], unique_basis(values, vectors)[:, :count]


def unique_basis(
    values: Float[np.ndarray, " N"], vectors: Float[np.ndarray, "V N"], tolerance: float = 1e-8
) -> Float[np.ndarray, "V N"]:
    """Eigenvectors of ascending eigenvalues, made unique: of values closer than `tolerance` the vectors become those
    that a Cholesky factorisation of their projector gives, pivoted by the largest diagonal entry; then each gets the
    sign that makes its largest entry positive. Of equally large entries the first counts."""
    unique = vectors.copy()
    ends = [*(np.flatnonzero(np.diff(values) > tolerance) + 1), len(values)]
    for begin, end in zip([0, *ends], ends, strict=False):
        if end - begin > 1:
            left = vectors[:, begin:end] @ vectors[:, begin:end].T
            for column in range(begin, end):
                pivot = _first_largest(left.diagonal())
                unique[:, column] = left[:, pivot] / np.sqrt(left[pivot, pivot])
                left -= np.outer(unique[:, column], unique[:, column])
    signs = [np.sign(vector[_first_largest(np.abs(vector))]) for vector in unique.T]
    return unique * np.array(signs)


def _first_largest(values: Float[np.ndarray, " V"]) -> int:
    return int(np.argmax(values >= values.max() - 1e-9))


def mean_hitting_steps(undirected: sparse.csr_array) -> float:
    """Steps of a random walk along the edges from one vertex to another, mean over all pairs of different ones.

    By the commute times of Chandra et al. (1989) it is vol / (V - 1) times the sum of 1 / lambda over the non-zero
    eigenvalues of the combinatorial Laplacian, where vol is the sum of all degrees; inf for a graph in pieces.
    Raises `TooManyStates`.
    """
    size = undirected.shape[0]
    if size > DENSE_STATES:
        raise TooManyStates(f"The graph has {size:,} states, but hitting times are for up to {DENSE_STATES:,}.")
    values = linalg.eigvalsh(laplacian(undirected, normalised=False).toarray())
    if values[1] < ZERO:
        return np.inf
    return float(undirected.sum() / (size - 1) * np.sum(1 / values[1:]))
