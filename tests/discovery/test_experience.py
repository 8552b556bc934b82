"""Recorded trajectories, and the world that they show."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from house import HOUSE, TwoRoomGrid, house

from lodestone.discovery.experience import Recording, observed, record
from lodestone.discovery.knowledge import everything, everything_without_task, within
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import endless
from lodestone.errors import InvalidConfig
from lodestone.planning.tables import tabulate


def test_steps_are_those_of_the_environment() -> None:
    """Every step is one of the tables', trajectories hang together, and the goal ends them."""
    tables = tabulate(HOUSE)
    found = record(HOUSE, Recording(40, 300, seed=1))
    begin, action, end = found.taken()
    np.testing.assert_array_equal(tables.successors[begin, action, 0], end)
    assert found.num_steps == len(begin) == found.lengths.sum()
    assert found.success.any()
    assert not found.success.all()
    assert (found.lengths[~found.success] == 300).all()
    np.testing.assert_array_equal(tables.terminal[found.states[:, -1]], found.success)
    for states, length in zip(found.states, found.lengths, strict=True):
        assert not tables.terminal[states[:length]].any()


def test_every_action_is_as_likely_unless_a_policy_is_given() -> None:
    _, action, _ = record(HOUSE, Recording(20, 2000)).taken()
    assert np.abs(np.bincount(action) / len(action) - 0.25).max() < 0.02
    _, action, _ = record(HOUSE, Recording(20, 50), lambda state: jnp.array([0.0, 0.75, 0.25, 0.0])).taken()
    assert np.bincount(action, minlength=4)[[0, 3]].sum() == 0
    assert np.mean(action == 1) == pytest.approx(0.75, abs=0.05)


def test_the_same_seed_records_the_same() -> None:
    one, same, other = (record(HOUSE, Recording(3, 20, seed)).states for seed in (5, 5, 6))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_what_was_seen_is_known_and_nothing_else() -> None:
    """A short walk: each action that was taken leads where it did, the others nowhere."""
    tables = tabulate(HOUSE)
    trajectories = record(HOUSE, Recording(2, 30))
    begin, action, end = trajectories.taken()
    tried = np.zeros((104, 4), dtype=bool)
    tried[begin, action] = True
    known = observed(trajectories)
    np.testing.assert_array_equal(known.tried, tried)
    assert known.tables.successors.shape == (104, 4, 1)
    stays = np.broadcast_to(np.arange(104)[:, None], (104, 4))
    wanted = np.where(tried, tables.successors[:, :, 0], stays)
    np.testing.assert_array_equal(known.tables.successors[:, :, 0], wanted)
    assert set(np.flatnonzero(known.seen)) == set(begin) | set(end)
    np.testing.assert_allclose(known.tables.initial_probs[trajectories.states[:, 0]].sum(), 1.0)


def test_chances_are_the_shares_that_were_seen() -> None:
    """After many steps close to the truth, and each a multiple of one step."""
    rooms = endless(FourRooms("sps"))
    tables = tabulate(rooms)
    trajectories = record(rooms, Recording(100, 4000))
    known = observed(trajectories)
    assert known.tried.all()
    np.testing.assert_allclose(known.tables.probs.sum(axis=2), 1.0)
    begin, action, _ = trajectories.taken()
    counts = np.bincount(begin * 4 + action).reshape(104, 4)
    whole = known.tables.probs * counts[:, :, None]
    np.testing.assert_allclose(whole, np.round(whole), atol=1e-9)

    def dense(successors: np.ndarray, probs: np.ndarray) -> np.ndarray:
        matrix = np.zeros((104, 4, 104))
        np.add.at(matrix, (np.arange(104)[:, None, None], np.arange(4)[None, :, None], successors), probs)
        return matrix

    off = dense(known.tables.successors, known.tables.probs) - dense(tables.successors, tables.probs)
    assert np.abs(off).max() < 0.1
    assert not known.tables.terminal.any()


def test_an_end_that_was_seen_is_an_end() -> None:
    rooms = TwoRoomGrid()
    trajectories = record(rooms, Recording(1000, 100))
    known = observed(trajectories)
    np.testing.assert_array_equal(
        np.flatnonzero(known.tables.terminal), np.unique(trajectories.states[:, -1][trajectories.success])
    )
    assert not known.tried[known.tables.terminal].any()


def test_without_its_task_the_house_has_no_goal() -> None:
    """The same cells, and one can walk through what was the goal."""
    whole = house()
    assert whole.tables.num_states == 104
    assert whole.tried.all()
    assert not whole.tables.terminal.any()
    goal = tabulate(HOUSE).terminal
    np.testing.assert_array_equal(whole.tables.successors[~goal], tabulate(HOUSE).successors[~goal])
    assert len(np.unique(whole.tables.successors[goal])) == 3


def test_what_lies_behind_the_goal_of_the_arm_is_not_known() -> None:
    """Beyond its 8 goals there are states that no episode shows; where an action may lead there, it is not tried."""
    arm = MagnetArm(rows=6, columns=4, bricks=4, tower_height=4)
    free = tabulate(endless(arm))
    known = everything_without_task(arm)
    space = reachable_states(arm)
    assert known.tables.num_states == space.size == 1512 < free.num_states
    goals = tabulate(arm).terminal
    assert known.tried[~goals].all()
    assert not known.tried[goals].all()
    np.testing.assert_array_equal(known.tables.successors[~goals], tabulate(arm).successors[~goals])
    assert known.seen.all()
    same = within(everything(tabulate(arm)), space)
    np.testing.assert_array_equal(same.tables.successors, tabulate(arm).successors)


@pytest.mark.parametrize("settings", [{"trajectories": 0}, {"steps": 0}])
def test_nothing_to_record_is_refused(settings: dict) -> None:
    with pytest.raises(InvalidConfig, match="is 0, but must be at least 1"):
        Recording(**settings)
