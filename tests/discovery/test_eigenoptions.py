"""Eigenoptions: the vectors from three sources, and options that climb them."""

from __future__ import annotations

import numpy as np
import pytest
from house import HOUSE, house, square

from lodestone.discovery.eigenoptions import EigenoptionsConfig, eigenoptions, option_values
from lodestone.discovery.experience import Recording, observed, record
from lodestone.discovery.graph import interaction_graph, laplacian
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.task import endless
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.planning.option_models import tabulate_options
from lodestone.planning.tables import tabulate

ALL = EigenoptionsConfig(number=206)


def test_the_eigenvalues_of_the_house() -> None:
    found = eigenoptions(house(), ALL)
    np.testing.assert_allclose(found.eigenvalues[:5], [0.00701, 0.00850, 0.01741, 0.09398, 0.11929], atol=5e-6)
    assert found.eigenvalues[-1] == pytest.approx(2.0, abs=1e-12)  # every step changes the colour of the chessboard
    assert found.vectors.shape == (104, 103)
    values = np.linalg.eigvalsh(laplacian(interaction_graph(house()).edges, normalised=True).toarray())
    np.testing.assert_allclose(found.eigenvalues, values[1:], atol=1e-12)
    assert values[0] == pytest.approx(0.0, abs=1e-12)


def test_the_ends_of_the_slowest_ways() -> None:
    """Normalised: inside the corners; combinatorial: in the corners."""
    found = eigenoptions(house(), EigenoptionsConfig(number=4))
    ends = [square(state) for state in found.subgoals]
    assert {ends[0], ends[1]} == {(10, 2), (2, 10)}
    assert {ends[2], ends[3]} == {(10, 10), (2, 2)}
    plain = eigenoptions(house(), EigenoptionsConfig(number=2, basis="differences"))
    assert {square(state) for state in plain.subgoals} == {(1, 11), (11, 1)}


def test_the_successor_representation_has_the_same_eigenvectors() -> None:
    """Psi = (I - gamma P)^-1 of the random walk along the edges: eigenvalue 1 / (1 - gamma (1 - lambda)), and vectors
    that are ours scaled by the roots of the degrees. Whole eigenspaces are compared."""
    edges = interaction_graph(house()).edges.toarray()
    degrees = edges.sum(axis=1)
    psi = np.linalg.inv(np.eye(104) - 0.9 * edges / degrees[:, None])
    found = eigenoptions(house(), ALL)
    roots = np.sqrt(degrees)
    symmetric = roots[:, None] * psi / roots
    np.testing.assert_allclose(
        symmetric @ found.vectors, found.vectors / (1 - 0.9 * (1 - found.eigenvalues)), atol=1e-9
    )
    values, vectors = np.linalg.eigh(symmetric)
    for low, high in ((0.0, 0.01), (0.05, 0.2), (0.999, 1.001)):
        ours = found.vectors[:, (found.eigenvalues > low) & (found.eigenvalues < high)]
        psi_eigenvalues = 1 / (1 - 0.9 * (1 - np.array([low, high])))
        theirs = vectors[:, (values > psi_eigenvalues[1]) & (values < psi_eigenvalues[0] - 1e-9)]
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours @ ours.T, theirs @ theirs.T, atol=1e-8)


def test_the_differences_of_samples_have_the_eigenvectors_of_the_graph() -> None:
    """By the singular value decomposition of what a long walk saw: a row for each step that was seen. Compared as
    projectors on the spaces of the first vectors, which are apart."""
    trajectories = record(endless(HOUSE), Recording(100, 2000))
    known = observed(trajectories)
    begin, _, end = trajectories.taken()
    steps = np.unique(np.stack([begin, end])[:, begin != end], axis=1)
    rows = np.eye(104)[steps[1]] - np.eye(104)[steps[0]]
    _, singular, right = np.linalg.svd(rows)
    sampled = eigenoptions(known, EigenoptionsConfig(number=8, basis="differences"))
    np.testing.assert_allclose(sampled.eigenvalues, np.square(singular[::-1])[1:5], atol=1e-9)
    np.testing.assert_allclose(np.abs(np.diag(sampled.vectors.T @ right[::-1][1:5].T)), 1.0, atol=1e-9)
    exact = np.linalg.eigh(laplacian(interaction_graph(house()).edges, normalised=False).toarray())
    np.testing.assert_allclose(sampled.eigenvalues, 2 * exact[0][1:5], atol=1e-9)
    np.testing.assert_allclose(np.abs(np.diag(sampled.vectors.T @ exact[1][:, 1:5])), 1.0, atol=1e-9)


def test_samples_and_tables_give_the_same_options_where_all_was_seen() -> None:
    known = observed(record(endless(HOUSE), Recording(100, 2000)))
    assert known.tried.all()
    for basis in ("laplacian", "differences"):
        config = EigenoptionsConfig(number=8, basis=basis)
        one, other = eigenoptions(known, config), eigenoptions(house(), config)
        assert [square(state) for state in one.subgoals] == [square(state) for state in other.subgoals]
        for table in ("initiation_table", "policy_table", "termination_table"):
            np.testing.assert_array_equal(getattr(one.options, table), getattr(other.options, table))


@pytest.mark.parametrize("dynamics", ["deterministic", "sps"])
def test_an_option_is_the_best_for_its_own_reward(dynamics: str) -> None:
    """Sweeps over dense arrays with stopping as one more action; it starts where stopping at once is not the best."""
    tables = tabulate(endless(FourRooms(dynamics)))
    known = house()._replace(tables=tables)
    found = eigenoptions(known, EigenoptionsConfig(number=4))
    along = np.stack([found.vectors, -found.vectors], axis=2).reshape(104, 4)
    probs = np.zeros((104, 4, 104))
    np.add.at(probs, (np.arange(104)[:, None, None], np.arange(4)[None, :, None], tables.successors), tables.probs)
    options = tabulate_options(found.options, tables.space)
    ours = option_values(known, along, 0.9)
    for option in range(4):
        rewards = np.einsum("sat,st->sa", probs, along[None, :, option] - along[:, None, option])
        values = np.zeros((104, 5))
        for _ in range(400):
            values[:, :4] = rewards + 0.9 * probs @ values.max(axis=1)
        np.testing.assert_allclose(ours[:, :, option], values[:, :4], atol=1e-12)
        best = values[:, :4].max(axis=1)
        runs = best > 1e-8
        np.testing.assert_array_equal(options.initiation[option], runs)
        np.testing.assert_array_equal(options.termination[option], ~runs)
        chosen = options.action_probs[option].argmax(axis=1)
        np.testing.assert_allclose(values[np.arange(104), chosen][runs], best[runs], atol=1e-9)
        assert not runs[found.subgoals[option]]
        assert runs.sum() > 90


def test_a_state_that_was_only_arrived_in_starts_nothing() -> None:
    trajectories = record(endless(HOUSE), Recording(3, 40))
    known = observed(trajectories)
    unknown = ~known.tried.any(axis=1)
    assert unknown.sum() > 30
    found = eigenoptions(known, EigenoptionsConfig(number=4))
    assert not np.asarray(found.options.initiation_table)[unknown].any()
    assert np.asarray(found.options.termination_table)[unknown].all()
    assert np.isnan(found.vectors[~known.seen]).all()
    policy = np.asarray(found.options.policy_table).argmax(axis=2)
    starts = np.asarray(found.options.initiation_table)
    states, options = np.nonzero(starts)
    assert known.tried[states, policy[states, options]].all()


def test_too_few_states_for_so_many_options_are_refused() -> None:
    with pytest.raises(CannotDiscover, match="208 options need 104 eigenvectors that are not constant"):
        eigenoptions(house(), EigenoptionsConfig(number=208))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"number": 0}, "number is 0"),
        ({"number": 3}, "come in pairs"),
        ({"discount": 1.0}, "need one below"),
        ({"discount": 1.1}, "discount is 1.1"),
        ({"tolerance": -1.0}, "tolerance is -1"),
        ({"basis": "moon"}, "basis is 'moon'"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict, sentence: str) -> None:
    with pytest.raises(InvalidConfig, match=sentence):
        EigenoptionsConfig(**settings)
