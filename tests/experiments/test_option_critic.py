"""The experiment on option-critic: short, and (slow) the numbers that must come out."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.four_rooms import FourRooms
from lodestone.experiments import option_critic
from lodestone.learning.progress import Silent
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate


@pytest.mark.parametrize("number", [0, 7])
def test_a_house_is_the_environment_with_its_goal(number):
    house = option_critic.house("text")
    goal, tables = (
        (option_critic.GOAL, house.first)
        if number == 0
        else (int(option_critic.ROOM[number - 1]), house.later[number - 1])
    )
    rooms = FourRooms("text", goal=goal)
    wanted = tabulate(rooms)
    values, others = (value_iteration(one, 0.99).values for one in (tables, wanted))
    order, other_order = (np.argsort(np.asarray(one.space.states.cell)) for one in (tables, wanted))
    np.testing.assert_allclose(values[order], others[other_order], atol=1e-6)
    assert option_critic._fewest_steps(tables) == pytest.approx(optimum(rooms).optimal_steps, abs=1e-6)
    np.testing.assert_allclose(tables.initial_probs[order], wanted.initial_probs[other_order], atol=1e-9)


def test_a_short_run_shows_every_learner(monkeypatch):
    for name, value in (("EPISODES", 20), ("BLOCK", 10), ("LAST", 10), ("DYNAMICS", ("code",))):
        monkeypatch.setattr(option_critic, name, value)
    monkeypatch.setattr(option_critic, "COLLAPSES", (option_critic.FOUR, option_critic.GREEDY))
    study = option_critic.run(2, Silent())
    assert [len(panel.series) for panel in study.panels] == [4, 2, 2, 4]
    assert [len(table.rows) for table in study.tables] == [4, 2]
    for series in study.panels[0].series:
        assert series.seeds.shape == (2, 4)
        assert ((series.seeds >= 1) & (series.seeds <= 1000)).all()
    shares = np.stack([series.seeds for series in study.panels[-1].series])
    np.testing.assert_allclose(shares.sum(axis=0)[:, -1], 1.0)
    assert all(np.isfinite(row[1:]).all() for table in study.tables for row in table.rows)
    gaps = np.array([row[5:7] for row in study.tables[0].rows], dtype=float)
    assert ((gaps > 0) & (gaps < 0.93)).all()


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in option_critic.run(20, Silent()).gates if not gate.passed] == []
