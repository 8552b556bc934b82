"""Betweenness: the count of paths, the maxima of the four rooms, options that get there."""

from __future__ import annotations

import numpy as np
import pytest
from house import house, square
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from lodestone.discovery import betweenness as module
from lodestone.discovery.betweenness import BetweennessConfig, betweenness, bottlenecks, local_maxima
from lodestone.discovery.graph import interaction_graph, steps_to
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.planning.option_models import tabulate_options

seeds = st.integers(0, 10_000)

MAXIMA = {
    (3, 7): 0.2901,
    (3, 5): 0.2860,
    (6, 9): 0.2771,
    (8, 9): 0.2735,
    (5, 2): 0.2335,
    (7, 2): 0.2281,
    (10, 7): 0.2247,
    (10, 5): 0.2230,
}
"""Of the four rooms: the cells beside the hallways, not the hallways."""


def counted(edges: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """From the powers of the adjacency matrix: as many walks of the shortest length as shortest paths."""
    size = len(edges)
    distance, paths = np.full((size, size), np.inf), np.zeros((size, size))
    power = np.eye(size)
    for length in range(size):
        new = (power > 0) & np.isinf(distance)
        distance[new], paths[new] = length, power[new]
        power = power @ edges
    total = np.zeros(size)
    for v in range(size):
        for s in range(size):
            for t in range(size):
                if len({v, s, t}) == 3 and np.isfinite(distance[s, t]):
                    through = distance[s, v] + distance[v, t] == distance[s, t]
                    total[v] += through * weights[s, t] * paths[s, v] * paths[v, t] / paths[s, t]
    return total


@settings(max_examples=40)
@given(seed=seeds, density=st.sampled_from([0.1, 0.25, 0.6]), weighted=st.booleans())
def test_it_is_what_counting_gives(seed: int, density: float, weighted: bool) -> None:
    """On directed graphs that may be in pieces, a few sources at a time."""
    rng = np.random.default_rng(seed)
    edges = (rng.random((9, 9)) < density) & ~np.eye(9, dtype=bool)
    weights = rng.random((9, 9)) if weighted else np.ones((9, 9))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SOURCES", 4)
        found = betweenness(sparse.csr_array(edges.astype(float)), weights if weighted else None)
    np.testing.assert_allclose(found, counted(edges.astype(float), weights), atol=1e-9)


def test_it_is_what_networkx_gives() -> None:
    networkx = pytest.importorskip("networkx")
    edges = interaction_graph(house()).edges
    wanted = networkx.betweenness_centrality(networkx.from_numpy_array(edges.toarray()), normalized=False)
    np.testing.assert_allclose(betweenness(edges) / 2, [wanted[vertex] for vertex in range(104)], rtol=1e-9)


def test_the_maxima_of_the_four_rooms() -> None:
    found = bottlenecks(house(), BetweennessConfig(number=100))
    centrality = {square(state): found.centrality[state] for state in range(104)}
    assert {square(state) for state in found.subgoals} == set(MAXIMA)
    assert [square(state) for state in found.subgoals] == list(MAXIMA)
    for at, value in MAXIMA.items():
        assert centrality[at] == pytest.approx(value, abs=5e-5)
    assert centrality[3, 6] == pytest.approx(0.2782, abs=5e-5)
    assert centrality[7, 9] == pytest.approx(0.2664, abs=5e-5)


def test_a_plateau_has_no_maximum() -> None:
    ring = sparse.csr_array(np.roll(np.eye(6), 1, axis=1) + np.roll(np.eye(6), -1, axis=1))
    assert local_maxima(ring, np.ones(6)).tolist() == []
    assert local_maxima(ring, np.array([0.0, 2.0, 1.0, 1.0, 3.0, 0.0])).tolist() == [4, 1]
    assert local_maxima(ring, np.array([0.0, 2.0, 2.0 - 1e-12, 1.0, 1.0, 0.0])).tolist() == []


def test_an_option_starts_in_the_states_nearest_to_its_sub_goal_and_gets_there() -> None:
    known = house()
    graph = interaction_graph(known)
    found = bottlenecks(known, BetweennessConfig(number=3, nearest=30))
    options = tabulate_options(found.options, known.tables.space)
    assert options.names == ("bottleneck-1", "bottleneck-2", "bottleneck-3")
    for option, subgoal in enumerate(found.subgoals):
        distance = steps_to(graph.edges, graph.vertex_of(int(subgoal)))
        inside = options.initiation[option]
        assert inside.sum() == 30
        assert not inside[subgoal]
        assert distance[inside].max() <= np.sort(distance)[30]
        np.testing.assert_array_equal(options.termination[option], ~inside)
        states = np.arange(104)
        for steps in range(1, 104):
            action = options.action_probs[option][states].argmax(axis=1)
            states = np.where(options.initiation[option][states], known.tables.successors[states, action, 0], states)
            arrived = (states == subgoal) & inside
            np.testing.assert_array_equal(arrived, inside & (distance <= steps))


def test_one_way_steps_count_one_way_if_asked_to() -> None:
    """In a row that leads one way only, every inner state is between fewer pairs; and no option leads back."""
    known = house()
    tables = known.tables
    row = tables._replace(
        successors=np.minimum(np.arange(104), 4)[:, None, None]
        + (np.arange(104) < 4)[:, None, None] * np.ones((1, 4, 1), int)
    )
    known = known._replace(tables=row, tried=np.broadcast_to((np.arange(104) < 4)[:, None], (104, 4)))
    both, one_way = (bottlenecks(known, BetweennessConfig(directed=way)) for way in (False, True))
    assert both.subgoals.tolist() == one_way.subgoals.tolist() == [2]
    assert both.centrality[:5] * 12 == pytest.approx([0, 6, 8, 6, 0])
    assert one_way.centrality[:5] * 12 == pytest.approx([0, 3, 4, 3, 0])
    starts = np.asarray(one_way.options.initiation_table)[:, 0]
    assert np.flatnonzero(starts).tolist() == [0, 1]


def test_where_no_state_stands_out_it_is_said() -> None:
    known = house()
    ring = known.tables._replace(successors=np.broadcast_to((np.arange(104) + 1)[:, None, None] % 104, (104, 4, 1)))
    with pytest.raises(CannotDiscover, match="No state lies on more shortest paths"):
        bottlenecks(known._replace(tables=ring), BetweennessConfig())


@pytest.mark.parametrize(("settings", "name"), [({"number": 0}, "number is 0"), ({"nearest": 0}, "nearest is 0")])
def test_settings_out_of_range_are_refused(settings: dict, name: str) -> None:
    with pytest.raises(InvalidConfig, match=name):
        BetweennessConfig(**settings)
