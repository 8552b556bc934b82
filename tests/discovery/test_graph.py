"""The interaction graph, its Laplacians and their eigenvectors."""

from __future__ import annotations

import numpy as np
import pytest
from house import HOUSE, house, square, state_at
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from lodestone.discovery import graph as module
from lodestone.discovery.experience import Recording, observed, record
from lodestone.discovery.graph import (
    interaction_graph,
    laplacian,
    lowest_eigenpairs,
    mean_hitting_steps,
    pieces,
    steps_to,
    unique_basis,
)
from lodestone.errors import CannotDiscover, InvalidConfig, TooManyStates

seeds = st.integers(0, 10_000)


def random_graph(seed: int, size: int = 12, density: float = 0.3) -> sparse.csr_array:
    """Undirected, perhaps in pieces."""
    half = np.triu(np.random.default_rng(seed).random((size, size)) < density, 1)
    return sparse.csr_array((half | half.T).astype(float))


def path(size: int) -> sparse.csr_array:
    """Vertices in a row."""
    return sparse.diags_array([np.ones(size - 1)] * 2, offsets=[-1, 1]).tocsr()


def test_edges_are_the_moves_of_the_house() -> None:
    graph = interaction_graph(house())
    squares = np.array([square(state) for state in graph.states])
    beside = np.abs(squares[:, None] - squares).sum(axis=-1) == 1
    np.testing.assert_array_equal(graph.edges.toarray(), beside)
    assert pieces(graph.edges) == 1


def test_what_was_not_seen_is_no_vertex() -> None:
    trajectories = record(HOUSE, Recording(1, 25))
    graph = interaction_graph(observed(trajectories))
    begin, _, end = trajectories.taken()
    moved = {(int(a), int(b)) for a, b in zip(begin, end, strict=True) if a != b}
    rows, columns = graph.edges.tocoo().coords
    assert set(zip(graph.states[rows].tolist(), graph.states[columns].tolist(), strict=True)) == moved
    values = graph.spread(np.arange(len(graph.states), dtype=float))
    assert np.isnan(values).sum() == 104 - len(graph.states)
    assert graph.vertex_of(int(graph.states[3])) == 3


def test_a_world_in_which_nothing_moves_is_refused() -> None:
    known = house()
    with pytest.raises(CannotDiscover, match="No step leads"):
        interaction_graph(known._replace(tried=np.zeros_like(known.tried)))


def test_distances_follow_the_steps() -> None:
    one_way = sparse.csr_array(np.eye(4, k=1))
    assert steps_to(one_way, 2).tolist() == [2, 1, 0, np.inf]
    graph = interaction_graph(house())
    there = graph.vertex_of(state_at(11, 11))
    assert steps_to(graph.edges, there)[graph.vertex_of(state_at(1, 1))] == 20


@settings(max_examples=30)
@given(seed=seeds, normalised=st.booleans())
def test_laplacians_are_what_they_are_by_definition(seed: int, normalised: bool) -> None:
    edges = random_graph(seed)
    weights = edges.toarray()
    degrees = weights.sum(axis=1)
    wanted = np.diag(degrees) - weights
    if normalised:
        root = np.diag(np.where(degrees > 0, degrees, 1.0) ** -0.5)
        wanted = root @ wanted @ root
    np.testing.assert_allclose(laplacian(edges, normalised).toarray(), wanted, atol=1e-14)
    values, vectors = lowest_eigenpairs(laplacian(edges, normalised), 5)
    np.testing.assert_allclose(wanted @ vectors, vectors * values, atol=1e-9)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(5), atol=1e-9)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(wanted)[:5], atol=1e-9)
    assert (values < module.ZERO).sum() == min(pieces(edges), 5)


def test_a_repeated_eigenvalue_has_one_basis_whatever_the_solver_gives() -> None:
    """Rotations inside the eigenvalue 1 of the house, which is eightfold, change nothing."""
    matrix = laplacian(interaction_graph(house()).edges, normalised=True).toarray()
    values, vectors = np.linalg.eigh(matrix)
    same = np.flatnonzero(np.abs(values - 1) < 1e-9)
    assert len(same) == 8
    wanted = unique_basis(values, vectors)
    np.testing.assert_allclose(matrix @ wanted, wanted * values, atol=1e-9)
    np.testing.assert_allclose(wanted.T @ wanted, np.eye(104), atol=1e-9)
    np.testing.assert_allclose(wanted[:, same] @ wanted[:, same].T, vectors[:, same] @ vectors[:, same].T, atol=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(3):
        rotation, _ = np.linalg.qr(rng.normal(size=(8, 8)))
        rotated = vectors * rng.choice([-1.0, 1.0], 104)
        rotated[:, same] = vectors[:, same] @ rotation
        np.testing.assert_allclose(unique_basis(values, rotated), wanted, atol=1e-7)


def test_the_sparse_solver_agrees_with_the_dense_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for matrix in (laplacian(path(300), True), laplacian(interaction_graph(house()).edges, False)):
        dense = lowest_eigenpairs(matrix, 10)
        with monkeypatch.context() as patch:
            patch.setattr(module, "DENSE_STATES", 50)
            sparsely = lowest_eigenpairs(matrix, 10)
        np.testing.assert_allclose(sparsely[0], dense[0], atol=1e-10)
        np.testing.assert_allclose(sparsely[1], dense[1], atol=1e-6)


def test_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidConfig, match="11 eigenvectors were asked for, but the graph has 10 states"):
        lowest_eigenpairs(laplacian(path(10), True), 11)
    monkeypatch.setattr(module, "DENSE_STATES", 5)
    monkeypatch.setattr(module, "SPARSE_VECTORS", 3)
    with pytest.raises(TooManyStates, match="at most 3 eigenvectors"):
        lowest_eigenpairs(laplacian(path(10), True), 4)
    with pytest.raises(TooManyStates, match="hitting times"):
        mean_hitting_steps(path(10))


@settings(max_examples=20)
@given(seed=seeds)
def test_hitting_times_are_those_of_linear_equations(seed: int) -> None:
    edges = random_graph(seed)
    if pieces(edges) > 1:
        assert mean_hitting_steps(edges) == np.inf
        return
    walk = edges.toarray() / edges.sum(axis=1)[:, None]
    total = 0.0
    for goal in range(12):
        others = np.arange(12) != goal
        total += np.linalg.solve(np.eye(11) - walk[np.ix_(others, others)], np.ones(11)).sum()
    assert mean_hitting_steps(edges) == pytest.approx(total / (12 * 11))
