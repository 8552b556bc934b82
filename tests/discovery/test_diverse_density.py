"""Diverse density: the formula on points of a line, and a door that random walks find."""

from __future__ import annotations

import numpy as np
import pytest
from house import TwoRoomGrid

from lodestone.discovery.diverse_density import DiverseDensityConfig, diverse_density, kernel, log_densities
from lodestone.discovery.experience import Recording, Trajectories, observed, record
from lodestone.discovery.knowledge import everything
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.planning.option_models import tabulate_options
from lodestone.planning.tables import tabulate

ROOMS = TwoRoomGrid()
SUCCESSES = 30


def test_the_formula_on_a_line() -> None:
    """Bags +{0,5}, +{5,9}, +{2,5}, -{0,2,9}: only 5 is in all positive ones and in no negative one."""
    points = np.array([[0.0], [2.0], [5.0], [9.0]])
    bags = [([0, 5], True), ([5, 9], True), ([2, 5], True), ([0, 2, 9], False)]
    near = [kernel(np.array(bag, dtype=float)[:, None], points, 1.0) for bag, _ in bags]
    density = np.exp(log_densities(near, [positive for _, positive in bags]).sum(axis=0))
    np.testing.assert_allclose(density, [0, 0, 0.99987648, 0], atol=5e-9)


def walks(seed: int, rooms: TwoRoomGrid = ROOMS) -> Trajectories:
    """The first so many successes of random walks of up to 100 steps, and the failures before them."""
    found = record(rooms, Recording(1500, 100, seed))
    last = int(np.flatnonzero(found.success)[SUCCESSES - 1]) + 1
    return found._replace(
        states=found.states[:last],
        actions=found.actions[:last],
        lengths=found.lengths[:last],
        success=found.success[:last],
    )


@pytest.mark.parametrize("source", ["tables", "trajectories"])
def test_the_door_stands_out(source: str) -> None:
    """In at least 9 of 10 seeds. Its option leads there from wherever it may start."""
    found_door = 0
    for seed in range(10):
        trajectories = walks(seed)
        knowledge = everything(tabulate(ROOMS)) if source == "tables" else observed(trajectories)
        space = knowledge.tables.space
        squares = ROOMS.squares[np.asarray(space.states.cell)]
        found = diverse_density(knowledge, trajectories, DiverseDensityConfig(), squares)
        assert found.successes == SUCCESSES
        found_door += tuple(squares[found.subgoals[0]]) == (4, 5)
        peak = np.nanargmax(found.log_density)
        assert np.abs(squares[peak] - (4, 5)).sum() <= 1  # a walk through the door is on both sides of it, too
        options = tabulate_options(found.options, space)
        begins = np.flatnonzero(options.initiation[0])
        assert 0 < len(begins) < 91
        states = begins
        for _ in range(100):
            going = options.termination[0][states] == 0
            following = knowledge.tables.successors[states, options.action_probs[0][states].argmax(axis=1), 0]
            states = np.where(going, following, states)
        assert set(states) == {found.subgoals[0]}
    assert found_door >= 9


def test_of_a_wide_door_the_cell_behind_stands_out() -> None:
    """Where the door has two cells, what all successes share is the cell behind it, into which both lead."""
    wide = TwoRoomGrid(doors=(4, 5))
    squares = wide.squares[np.asarray(tabulate(wide).space.states.cell)]
    beside = 0
    for seed in range(5):
        trajectories = walks(seed, wide)
        found = diverse_density(observed(trajectories), trajectories, DiverseDensityConfig(threshold=1.0), squares)
        beside += int(np.abs(squares[found.subgoals[0]] - (4.5, 5)).sum() <= 1.5)
    assert beside >= 4


def test_the_second_sub_goal_is_another_one() -> None:
    """Not within two steps of the door."""
    trajectories = walks(0)
    squares = ROOMS.squares[np.asarray(trajectories.space.states.cell)]
    config = DiverseDensityConfig(number=2, filter_steps=2, threshold=0.5)
    found = diverse_density(observed(trajectories), trajectories, config, squares)
    assert tuple(squares[found.subgoals[0]]) == (4, 5)
    assert np.abs(squares[found.subgoals[1]] - (4, 5)).sum() > 2
    assert found.options.names == ("dense-1", "dense-2")


def test_negative_bags_rule_out_what_is_on_them() -> None:
    trajectories = walks(0)
    config = DiverseDensityConfig(unsuccessful=10, threshold=0.5)
    squares = ROOMS.squares[np.asarray(trajectories.space.states.cell)]
    found = diverse_density(observed(trajectories), trajectories, config, squares)
    failures = np.flatnonzero(~trajectories.success)[:10]
    assert (found.log_density[np.unique(trajectories.states[failures])] == -np.inf).sum() > 50
    assert not np.isin(found.subgoals, trajectories.states[failures]).any()


def test_what_cannot_be_found_is_said() -> None:
    short = record(ROOMS, Recording(20, 5))
    with pytest.raises(CannotDiscover, match="None of 20 trajectories of at most 5 steps reached the goal"):
        diverse_density(observed(short), short, DiverseDensityConfig())
    few = walks(0)
    few = few._replace(**{name: getattr(few, name)[:60] for name in ("states", "actions", "lengths", "success")})
    assert 0 < few.success.sum() < 8
    with pytest.raises(CannotDiscover, match="No state stood out among"):
        diverse_density(observed(few), few, DiverseDensityConfig())


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"number": 0}, "number is 0"),
        ({"scale": 0.0}, "scale is 0.0"),
        ({"memory": 1.0}, "memory is 1.0"),
        ({"threshold": 5.0}, "rho is between 0 and 5"),
        ({"before": 0}, "before is 0"),
        ({"unsuccessful": -1}, "unsuccessful is -1"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict, sentence: str) -> None:
    with pytest.raises(InvalidConfig, match=sentence):
        DiverseDensityConfig(**settings)
