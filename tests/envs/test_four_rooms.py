"""Four Rooms against the numbers of an independent computation, for each kind of chance."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.four_rooms import CELLS, FREE, HALLWAYS, NUMBER, OPEN, PALETTE, FourRooms, RoomState
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import expected_steps, optimum
from lodestone.planning.tables import tabulate


def test_the_house_has_104_cells_and_known_hallways():
    assert CELLS == 104
    assert [int(NUMBER[hallway]) for hallway in HALLWAYS] == [25, 51, 62, 88]
    assert ["".join("." if free else "w" for free in row) for row in FREE[5:9]] == [
        "w.....w.....w",
        "ww.wwww.....w",
        "w.....www.www",
        "w.....w.....w",
    ]


@pytest.mark.parametrize(
    ("dynamics", "steps", "value"),
    [
        ("deterministic", 7.5922, 0.93654),
        ("sps", 15.0117, 0.87225),
        ("text", 12.0561, 0.89702),
        ("code", 8.3924, 0.92921),
    ],
)
def test_the_optimum_from_a_uniform_start(dynamics, steps, value):
    found = optimum(FourRooms(dynamics=dynamics), discount=0.99)
    assert found.optimal_steps == pytest.approx(steps, abs=1e-4)
    assert found.discounted_value == pytest.approx(value, abs=1e-5)
    assert found.optimal_return == pytest.approx(1)
    assert (found.states, found.goals) == (104, 1)


@pytest.mark.parametrize(
    ("dynamics", "steps"), [("deterministic", 502.44), ("sps", 502.44), ("text", 459.40), ("code", 430.23)]
)
def test_a_random_walk_takes_a_known_time(dynamics, steps):
    tables = tabulate(FourRooms(dynamics=dynamics))
    uniform = np.full((tables.num_states, 4), 0.25)
    assert tables.initial_mean(expected_steps(tables, uniform)) == pytest.approx(steps, abs=0.01)


def test_a_wall_holds_the_agent_surely_in_code_but_not_in_text():
    corner = RoomState(jnp.uint8(0))
    np.testing.assert_allclose(FourRooms("code").outcome_probs(corner, jnp.int32(0)), [1, 0, 0, 0, 0])
    np.testing.assert_allclose(FourRooms("text").outcome_probs(corner, jnp.int32(0)), [2 / 3, 0, 1 / 6, 0, 1 / 6])
    assert OPEN[0].tolist() == [False, True, False, True]


def test_the_agents_picture_shows_goal_and_agent():
    rooms = FourRooms(pixels_per_cell=2)
    picture = np.asarray(rooms.observe(RoomState(jnp.uint8(25))))
    assert picture.shape == (26, 26, 3)
    assert (picture[6, 12] == PALETTE[3]).all()
    assert (picture[15, 19] == PALETTE[2]).all()
    assert (picture[0, 0] == PALETTE[0]).all()
    in_walls = jax.vmap(rooms.observe)(RoomState(jnp.arange(CELLS, dtype=jnp.uint8)))[:, ::2, ::2][:, ~FREE]
    assert (np.asarray(in_walls) == PALETTE[0]).all()


@pytest.mark.parametrize("observation", ["rgb", "cell"])
def test_gymnasium_takes_it(observation):
    env = gymnasium.make("lodestone/FourRooms-v0", observation=observation, goal=0, dynamics="code")
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"dynamics": "windy"}, "'windy', but must be one of deterministic, sps, text, code"),
        ({"goal": 104}, "goal is 104, but cells are numbered from 0 to 103"),
        ({"goal": -1}, "goal is -1"),
        ({"observation": "planes"}, "'planes'"),
        ({"pixels_per_cell": 0}, "pixels_per_cell is 0"),
        ({"step_reward": float("nan")}, "step_reward"),
    ],
)
def test_bad_parameters_are_named(wrong, says):
    with pytest.raises(InvalidConfig, match=says):
        FourRooms(**wrong)
