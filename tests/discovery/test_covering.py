"""Covering options: the connectivity of a row and of the four rooms, and options between their ends."""

from __future__ import annotations

import numpy as np
import pytest
from house import HOUSE, house, square, state_at
from scipy import sparse

from lodestone.discovery.covering import CoveringConfig, covering, fiedler, with_edge
from lodestone.discovery.diffusion import diffusion_time
from lodestone.discovery.experience import Recording, observed, record
from lodestone.discovery.graph import interaction_graph, mean_hitting_steps, steps_to
from lodestone.envs.task import endless
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.options.base import Primitives, Union
from lodestone.planning.option_models import tabulate_options

PAIRS = [((1, 11), (11, 1)), ((11, 11), (1, 1)), ((5, 11), (5, 1)), ((7, 5), (1, 5))]
CONNECTIVITY = [0.0229, 0.02714, 0.05079, 0.05465, 0.06464]


@pytest.mark.parametrize("size", [4, 10, 30])
def test_a_row_becomes_a_ring(size: int) -> None:
    row = sparse.diags_array([np.ones(size - 1)] * 2, offsets=[-1, 1]).tocsr()
    value, vector = fiedler(row)
    assert value == pytest.approx(2 - 2 * np.cos(np.pi / size), abs=1e-12)
    ends = int(vector.argmax()), int(vector.argmin())
    assert set(ends) == {0, size - 1}
    ring = with_edge(row, *ends)
    assert fiedler(ring)[0] == pytest.approx(2 - 2 * np.cos(2 * np.pi / size), abs=1e-12)
    if size == 10:
        assert value == pytest.approx(0.0978870, abs=5e-8)
        assert fiedler(ring)[0] == pytest.approx(0.3819660, abs=5e-8)


def test_the_ends_of_the_house() -> None:
    found = covering(house(), CoveringConfig(number=8))
    np.testing.assert_allclose(found.connectivity, CONNECTIVITY, atol=5e-6)
    assert found.connectivity[0] == pytest.approx(0.0229, abs=5e-5)
    assert [{square(one), square(other)} for one, other in found.pairs] == [set(pair) for pair in PAIRS]
    assert mean_hitting_steps(interaction_graph(house()).undirected()) == pytest.approx(501.39, abs=0.005)
    assert mean_hitting_steps(found.edges) == pytest.approx(300.67, abs=0.005)


def test_an_option_goes_from_one_end_to_the_other_by_a_shortest_way() -> None:
    known = house()
    found = covering(known, CoveringConfig(number=8))
    options = tabulate_options(found.options, known.tables.space)
    graph = interaction_graph(known)
    for position, (high, low) in enumerate(found.pairs):
        for option, begin, end in ((2 * position, high, low), (2 * position + 1, low, high)):
            np.testing.assert_array_equal(np.flatnonzero(options.initiation[option]), [begin])
            assert np.flatnonzero(options.termination[option]).tolist() == [end]
            state, steps = begin, 0
            while steps == 0 or options.termination[option][state] == 0:
                state = known.tables.successors[state, options.action_probs[option][state].argmax(), 0]
                steps += 1
            assert state == end
            assert steps == steps_to(graph.edges, graph.vertex_of(end))[graph.vertex_of(begin)]


def test_where_options_may_start_matters() -> None:
    """Between the ends they speed a random walk up; from everywhere to the ends they hold it back."""
    times = {}
    for initiation in ("point", "everywhere"):
        options = Union((Primitives(HOUSE.action_names), covering(house(), CoveringConfig(8, initiation)).options))
        times[initiation] = diffusion_time(house().tables, tabulate_options(options, house().tables.space))
    assert times["everywhere"] == pytest.approx(4362.68, abs=0.005)
    assert times["point"] == pytest.approx(326.28, abs=0.005)


def test_a_walk_that_saw_everything_gives_the_same_options() -> None:
    known = observed(record(endless(HOUSE), Recording(100, 2000)))
    one, other = (covering(each, CoveringConfig(number=4)) for each in (known, house()))
    np.testing.assert_allclose(one.connectivity, other.connectivity)
    np.testing.assert_array_equal(one.options.policy_table, other.options.policy_table)
    np.testing.assert_array_equal(one.options.initiation_table, other.options.initiation_table)


def test_a_world_in_pieces_is_refused() -> None:
    known = observed(record(endless(HOUSE), Recording(3, 5, seed=1)))
    with pytest.raises(CannotDiscover, match=r"states that were seen is in \d pieces with no step between them"):
        covering(known, CoveringConfig(number=2))


def test_an_end_that_no_way_leads_to_has_no_option() -> None:
    """A row that leads one way only."""
    known, numbers = house(), np.arange(104)
    ahead = np.broadcast_to(np.minimum(numbers + 1, 103)[:, None, None], (104, 4, 1))
    row = known._replace(tables=known.tables._replace(successors=ahead))
    found = covering(row, CoveringConfig(number=2))
    assert set(found.pairs[0]) == {0, 103}
    assert found.options.size == 1
    assert np.flatnonzero(np.asarray(found.options.initiation_table)[:, 0]).tolist() == [0]


def test_the_states_of_the_pairs_are_where_they_should_be() -> None:
    assert square(state_at(7, 5)) == (7, 5)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"number": 0}, "number is 0"),
        ({"number": 5}, "come in pairs"),
        ({"initiation": "moon"}, "initiation is 'moon'"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict, sentence: str) -> None:
    with pytest.raises(InvalidConfig, match=sentence):
        CoveringConfig(**settings)
