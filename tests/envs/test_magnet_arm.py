"""The magnet arm: its rules one by one, against a second implementation, its pictures, its limits, its tasks."""

from collections.abc import Callable
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.numpy_magnet_arm import NumpyMagnetArm
from lodestone.envs.base import example_state
from lodestone.envs.magnet_arm import (
    ARM_OFF,
    ARM_ON,
    BRICK,
    DOWN,
    EMPTY,
    LEFT,
    MAGNET_OFF,
    MAGNET_ON,
    RIGHT,
    UP,
    ArmState,
    MagnetArm,
    arm_has_lifted,
    arm_is_down,
    go_down_task,
    lift_task,
    random_layouts,
    tower_goals,
    tower_heights,
)
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig

SIZES = [(4, 3, 2, 2), (4, 3, 3, 3), (5, 4, 4, 4), (6, 4, 4, 4), (7, 5, 9, 3), (9, 2, 5, 5), (12, 3, 7, 6)]

CODES = {".": EMPTY, "b": BRICK, "M": ARM_ON, "m": ARM_OFF}


@jax.jit
def move(arm: MagnetArm, state: ArmState, action: int) -> ArmState:
    return arm.transition(state, action, jnp.int32(0))


def world(picture: str, **parameters: object) -> tuple[MagnetArm, ArmState]:
    """A state from rows such as `.m. ...`: b brick, m magnet off, M magnet on, with the smallest fitting arm."""
    codes = np.array([[CODES[cell] for cell in row] for row in picture.split()])
    rows, columns = codes.shape
    bricks = codes == BRICK
    arm = MagnetArm(rows, columns, **{"bricks": columns + 2, "tower_height": 3, **parameters})
    ((row, column),) = np.argwhere(codes >= ARM_ON)
    weights = 1 << np.arange(rows - 1, -1, -1)
    example = example_state(arm)
    return arm, ArmState(
        bricks=jnp.asarray(weights @ bricks, dtype=example.bricks.dtype),
        row=jnp.asarray(row, dtype=example.row.dtype),
        column=jnp.asarray(column, dtype=example.column.dtype),
        magnet=jnp.asarray(codes[row, column] == ARM_ON),
    )


def picture(arm: MagnetArm, state: ArmState) -> str:
    """The reverse of `world`."""
    letters = np.array(list(".bMm"))
    return " ".join("".join(row) for row in letters[np.asarray(arm.cell_codes(state))])


def play(before: str, *actions: int, **parameters: object) -> str:
    arm, state = world(before, **parameters)
    for action in actions:
        state = move(arm, state, jnp.int32(action))
    return picture(arm, state)


# The rules


@pytest.mark.parametrize(
    ("action", "after"),
    [
        (LEFT, "... m.. ... bbb"),
        (RIGHT, "... ..m ... bbb"),
        (UP, ".m. ... ... bbb"),
        (DOWN, "... ... .m. bbb"),
        (MAGNET_ON, "... .M. ... bbb"),
    ],
)
def test_a_free_arm_moves_one_cell_and_switches_on(action: int, after: str) -> None:
    assert play("... .m. ... bbb", action) == after


@pytest.mark.parametrize("magnet", ["m", "M"])
@pytest.mark.parametrize(
    ("before", "action"),
    [
        ("m.. ... ... bbb", LEFT),
        ("m.. ... ... bbb", UP),
        ("..m ... ... bbb", RIGHT),
        ("... ... .b. .bm", DOWN),
        ("... ... .m. bbb", DOWN),
        ("... ... .b. mb.", RIGHT),
        ("... ... bm. bb.", LEFT),
    ],
)
def test_a_move_out_of_the_grid_or_into_a_brick_changes_nothing(before: str, action: int, magnet: str) -> None:
    before = before.replace("m", magnet)
    assert play(before, action) == before


@pytest.mark.parametrize(
    ("action", "after"),
    [
        (UP, ".M. .b. ... b.b"),
        (DOWN, "... ... .M. bbb"),
        (LEFT, "... M.. b.. b.b"),
        (RIGHT, "... ..M ..b b.b"),
    ],
)
def test_a_held_brick_moves_along_also_downwards(action: int, after: str) -> None:
    assert play("... .M. .b. b.b", action) == after


@pytest.mark.parametrize(
    ("before", "action"),
    [
        ("... .M. .bb b.b", RIGHT),  # the brick's way is blocked
        ("... .Mb .bb b.b", RIGHT),  # the arm's too
        ("... ... .M. bbb", DOWN),  # the brick stands on the floor
        ("... .M. .b. bbb", DOWN),  # the brick stands on a brick
        (".M. .b. ... b.b", UP),  # the arm is at the top
        ("... M.. b.. bbb", LEFT),  # the arm is at the wall
    ],
)
def test_a_held_brick_that_cannot_move_holds_the_arm(before: str, action: int) -> None:
    assert play(before, action) == before


def test_a_brick_is_not_held_while_the_magnet_is_off() -> None:
    assert play("... .m. .b. bbb", UP) == ".m. ... .b. bbb"


def test_a_brick_is_held_as_soon_as_the_magnet_passes_over_it() -> None:
    assert play("... M.. .b. bbb", RIGHT, UP) == ".M. .b. ... bbb"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (".M. .b. ... ...", ".m. ... ... .b."),
        (".M. .b. ... .b.", ".m. ... .b. .b."),
        (".M. .b. .b. .b.", ".m. .b. .b. .b."),
        (".M. .b. ... bbb", ".m. ... .b. bbb"),
    ],
)
def test_a_brick_falls_to_the_first_support(before: str, after: str) -> None:
    assert play(before, MAGNET_OFF) == after


@pytest.mark.parametrize("before", ["M.. ... ... bbb", "... ... M.. .bb", "... ... ... Mbb"])
def test_switching_off_with_nothing_below_depends_on_the_magnet_being_sticky(before: str) -> None:
    assert play(before, MAGNET_OFF) == before
    assert play(before, MAGNET_OFF, sticky_magnet=False) == before.replace("M", "m")


def test_switching_on_twice_or_off_twice_changes_nothing_more() -> None:
    assert play("... .m. .b. bbb", MAGNET_ON, MAGNET_ON) == "... .M. .b. bbb"
    assert play("... .m. .b. bbb", MAGNET_OFF) == "... .m. .b. bbb"


def test_the_start_has_bricks_from_the_right_to_the_left() -> None:
    arm = MagnetArm(5, 4, bricks=6, tower_height=4)
    assert picture(arm, example_state(arm)) == "m... .... .... ..bb bbbb"


@pytest.mark.parametrize(
    ("before", "heights"),
    [
        ("m.. .b. .b. .bb", [0, 3, 1]),
        (".M. .b. ... .bb", [0, 1, 1]),  # a brick in the air does not count
        ("... M.. b.. bbb", [2, 1, 1]),
        (".M. .b. ... b.b", [1, 0, 1]),
    ],
)
def test_tower_heights(before: str, heights: list[int]) -> None:
    _, state = world(before)
    assert tower_heights(state).tolist() == heights


@pytest.mark.parametrize(
    ("state", "terminal"),
    [
        ("m.. .b. .b. .b.", True),
        ("M.. .b. .b. .b.", False),  # the magnet must be off
        ("m.. ... .b. .b.", False),
        ("m.. ... ... ... .b. .b. .b.", True),
        ("m.. ... ... .b. .b. .b. .b.", False),  # exactly, not at least
    ],
)
def test_terminal_means_exactly_the_wanted_height_and_the_magnet_off(state: str, terminal: bool) -> None:
    arm, state = world(state)
    assert bool(arm.terminal(state)) is terminal


def test_the_step_that_completes_the_tower_is_paid() -> None:
    arm, before = world(".M. .b. .b. .b.", step_reward=-2.0, tower_reward=50.0)
    after = move(arm, before, jnp.int32(MAGNET_OFF))
    assert float(arm.reward(before, jnp.int32(MAGNET_OFF), after)) == 48.0
    assert float(arm.reward(before, jnp.int32(UP), before)) == -2.0


# A second implementation


def same_as_numpy(arm: MagnetArm, state: ArmState, other: NumpyMagnetArm) -> None:
    np.testing.assert_array_equal(arm.observe(state), other.observation())
    codes = np.asarray(arm.cell_codes(state))
    np.testing.assert_array_equal(codes == BRICK, other.grid)
    assert (int(state.row), int(state.column), bool(state.magnet)) == (other.row, other.column, other.magnet)


@pytest.mark.parametrize("sticky", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_random_rollouts_agree_with_the_numpy_version(size: tuple[int, int, int, int], sticky: bool) -> None:
    arm = MagnetArm(*size, sticky_magnet=sticky)
    other = NumpyMagnetArm(*size, sticky_magnet=sticky, step_limit=10_000)
    actions = np.random.default_rng(sum(size)).integers(6, size=600)

    @jax.jit
    def rollout(actions: jax.Array) -> tuple:
        def step(state: ArmState, action: jax.Array) -> tuple:
            after = arm.transition(state, action, jnp.int32(0))
            reward, terminal = arm.reward(state, action, after), arm.terminal(after)
            start = example_state(arm)
            again = jax.tree.map(lambda new, old: jnp.where(terminal, new, old), start, after)
            return again, (arm.observe(after), arm.cell_codes(after), reward, terminal)

        return jax.lax.scan(step, example_state(arm), actions)[1]

    pictures, codes, rewards, terminals = (np.asarray(value) for value in rollout(jnp.asarray(actions)))
    other.reset()
    for time, action in enumerate(actions.tolist()):
        observation, reward, success, _, _ = other.step(action)
        np.testing.assert_array_equal(pictures[time], observation, err_msg=f"after step {time}")
        np.testing.assert_array_equal(codes[time] == BRICK, other.grid & (codes[time] < ARM_ON))
        assert rewards[time] == reward
        assert terminals[time] == success
        if success:
            other.reset()


@settings(max_examples=50)
@given(
    size=st.sampled_from(SIZES),
    sticky=st.booleans(),
    actions=st.lists(st.sampled_from([DOWN, DOWN, UP, LEFT, RIGHT, MAGNET_ON, MAGNET_OFF]), max_size=60),
)
def test_any_actions_agree_with_the_numpy_version(size: tuple, sticky: bool, actions: list[int]) -> None:
    arm = MagnetArm(*size, sticky_magnet=sticky)
    other = NumpyMagnetArm(*size, sticky_magnet=sticky)
    other.reset()
    state = example_state(arm)
    for action in actions:
        state = move(arm, state, jnp.int32(action))
        _, _, success, _, _ = other.step(action)
        same_as_numpy(arm, state, other)
        assert bool(arm.terminal(state)) == success


# Pictures

START = """
. r . . . . . . .
. r . . . . . . .
r r r . . . . . .
. . . . . . . . .
. . . . . . . . .
. . . . . . . . .
. . . . . . . . .
. . . . . . . . .
. . . . . . . . .
y y y y y y y y y
y y y y y y y y y
y y y y y y y y y
"""
COLOURS = {".": (0, 0, 0), "r": (204, 0, 0), "b": (51, 153, 255), "y": (230, 200, 150)}


def pixels(drawing: str) -> np.ndarray:
    return np.array([[COLOURS[pixel] for pixel in row.split()] for row in drawing.strip().splitlines()], dtype=np.uint8)


def test_the_start_picture() -> None:
    arm = MagnetArm()
    observation = arm.observe(example_state(arm))
    assert observation.dtype == jnp.uint8
    np.testing.assert_array_equal(observation, pixels(START))


def test_the_arm_is_blue_when_on() -> None:
    arm = MagnetArm()
    state = example_state(arm)._replace(magnet=jnp.array(True))
    np.testing.assert_array_equal(arm.observe(state), pixels(START.replace("r", "b")))


@pytest.mark.parametrize("side", [1, 2, 4, 5])
@pytest.mark.parametrize("size", [(4, 3, 3, 3), (9, 3, 4, 4), (20, 2, 3, 3)])
def test_pictures_of_other_sizes_are_the_cells_enlarged(size: tuple, side: int) -> None:
    """Also where a column's bricks need 16 or 32 bits."""
    arm, other = MagnetArm(*size, pixels_per_cell=side), NumpyMagnetArm(*size, pixels_per_cell=side)
    other.reset()
    state = example_state(arm)
    for action in (DOWN,) * size[0] + (MAGNET_ON, UP, RIGHT, DOWN):
        state = move(arm, state, jnp.int32(action))
        other.step(action)
        same_as_numpy(arm, state, other)


def test_different_states_have_different_pictures() -> None:
    arm = MagnetArm()
    states = reachable_states(arm).states
    pictures = np.asarray(jax.vmap(arm.observe)(states)).reshape(156, -1)
    assert len(np.unique(pictures, axis=0)) == 156


def test_pictures_do_not_depend_on_how_many_are_drawn_at_once() -> None:
    arm = MagnetArm(6, 4, 4, 4)
    states = jax.tree.map(lambda leaf: leaf[:96], reachable_states(arm).states)
    together = np.asarray(jax.jit(jax.vmap(arm.observe))(states))
    nested = jax.tree.map(lambda leaf: leaf.reshape(8, 12, *leaf.shape[1:]), states)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.vmap(arm.observe)))(nested).reshape(together.shape), together)
    alone = np.stack([arm.observe(jax.tree.map(lambda leaf, at=at: leaf[at], states)) for at in range(96)])
    np.testing.assert_array_equal(alone, together)


def test_planes_mark_the_code_of_each_cell() -> None:
    arm = MagnetArm(observation="planes")
    states = reachable_states(arm).states
    planes = np.asarray(jax.vmap(arm.observe)(states))
    assert planes.dtype == np.int8  # a network takes them as they are; uint8 would be a picture's brightness
    np.testing.assert_array_equal(planes.sum(axis=-1), 1)
    np.testing.assert_array_equal(planes.argmax(axis=-1), jax.vmap(arm.cell_codes)(states))


def test_index_is_the_number_of_the_state() -> None:
    arm = MagnetArm(observation="index")
    np.testing.assert_array_equal(jax.jit(jax.vmap(arm.observe))(reachable_states(arm).states), np.arange(156))


@pytest.mark.parametrize("size", [(4, 3, 3, 3), (8, 6, 6, 5), (31, 2, 3, 3)])
def test_the_picture_for_people_shows_every_change(size: tuple) -> None:
    arm = MagnetArm(*size)
    state, frames = example_state(arm), []
    for action in (DOWN, MAGNET_ON, RIGHT):
        frames.append(arm.render(jax.tree.map(np.asarray, state)))
        state = move(arm, state, jnp.int32(action))
    frames.append(arm.render(state))
    assert {frame.shape for frame in frames} == {frames[0].shape}
    assert frames[0].dtype == np.uint8
    assert all((one != other).any() for one, other in pairwise(frames))


def test_the_picture_for_people_is_painted_afresh() -> None:
    arm = MagnetArm()
    first = arm.render(example_state(arm))
    kept = first.copy()
    first[:] = 0
    np.testing.assert_array_equal(arm.render(example_state(arm)), kept)


# Parameters


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"rows": 0}, "rows is 0"),
        ({"rows": 1}, "rows is 1"),
        ({"rows": 32}, "from 2 to 31"),
        ({"columns": 0}, "columns is 0"),
        ({"bricks": 0}, "bricks is 0"),
        ({"bricks": 10}, "10 bricks do not fit"),
        ({"tower_height": 0}, "tower_height is 0"),
        ({"tower_height": 4}, "tower of at most 3"),
        ({"tower_height": 1}, "before the first step"),
        ({"bricks": 4, "tower_height": 2}, "before the first step"),
        ({"pixels_per_cell": 0}, "pixels_per_cell is 0"),
        ({"step_reward": float("nan")}, "finite"),
        ({"tower_reward": float("inf")}, "finite"),
        ({"observation": "smell"}, "'smell'"),
    ],
)
def test_bad_parameters_are_named_in_one_sentence(parameters: dict, message: str) -> None:
    with pytest.raises(InvalidConfig, match=message) as error:
        MagnetArm(**parameters)
    assert "\n" not in str(error.value)


# The training tasks of the options


@pytest.mark.parametrize("size", SIZES)
def test_layouts_are_a_distribution_without_towers(size: tuple) -> None:
    arm = MagnetArm(*size)
    probs, states = random_layouts(arm)
    assert float(jnp.sum(probs)) == pytest.approx(1, abs=1e-5)
    assert bool(jnp.all(probs > 0))
    heights = np.asarray(jax.vmap(tower_heights)(states))
    np.testing.assert_array_equal(heights.sum(axis=1), arm.bricks)
    room = -(-arm.bricks // arm.columns)
    assert heights.max() <= max(arm.tower_height - 1, room)
    assert not np.any(np.asarray(states.row))
    assert not np.any(np.asarray(states.magnet))
    at_column = np.bincount(np.asarray(states.column), weights=np.asarray(probs))
    np.testing.assert_allclose(at_column, 1 / arm.columns, atol=1e-5)
    distinct = np.unique(np.column_stack([heights, states.column]), axis=0)
    assert len(distinct) == len(heights)


def test_layouts_are_those_of_bricks_dropped_one_by_one() -> None:
    """Against the frequencies of dropping them, by a simulation that shares no code."""
    arm, rng, count = MagnetArm(), np.random.default_rng(0), 20_000
    frequency: dict[tuple[int, ...], float] = {}
    for _ in range(count):
        heights = [0, 0, 0]
        for _ in range(arm.bricks):
            heights[rng.choice([column for column in range(3) if heights[column] < 2])] += 1
        frequency[tuple(heights)] = frequency.get(tuple(heights), 0) + 1 / count
    probs, states = random_layouts(arm)
    ours: dict[tuple[int, ...], float] = {}
    for prob, heights in zip(probs.tolist(), np.asarray(jax.vmap(tower_heights)(states)).tolist(), strict=True):
        ours[tuple(heights)] = ours.get(tuple(heights), 0) + prob
    assert ours.keys() == frequency.keys()
    assert all(ours[heights] == pytest.approx(frequency[heights], abs=0.02) for heights in ours)


@pytest.mark.parametrize(
    ("state", "down"),
    [
        ("m.. ... ... bbb", False),
        ("... ... m.. bbb", True),  # over a brick on the floor
        ("... m.. b.. bbb", True),  # over a brick on a brick
        ("... ... ... mbb", True),  # on the floor
        ("... M.. b.. .bb", False),  # the brick below hangs in the air
        ("... ... M.. bbb", True),
    ],
)
def test_the_arm_is_down(state: str, down: bool) -> None:
    arm, state = world(state)
    assert bool(arm_is_down(arm, state)) is down


@pytest.mark.parametrize(
    ("state", "lifted"),
    [
        ("M.. b.. ... .bb", True),
        ("m.. b.. b.. b..", False),  # a tower, not a lifted brick
        ("... M.. b.. .bb", False),  # not at the top yet
        ("M.. ... b.. .bb", False),
        ("M.. b.. ... bbb", True),
    ],
)
def test_the_arm_has_lifted(state: str, lifted: bool) -> None:
    arm, state = world(state)
    assert bool(arm_has_lifted(arm, state)) is lifted


@pytest.mark.parametrize(
    ("task", "before", "action", "reward", "over"),
    [
        (go_down_task, "m.. ... ... bbb", DOWN, -1.0, False),
        (go_down_task, "... m.. ... bbb", DOWN, 99.0, True),
        (lift_task, "m.. ... ... bbb", RIGHT, -11.0, False),
        (lift_task, ".m. ... ... bbb", LEFT, -11.0, False),
        (lift_task, "... M.. b.. .bb", UP, 99.0, True),
        (lift_task, "... m.. b.. .bb", MAGNET_ON, -1.0, False),
    ],
)
def test_what_the_tasks_pay(
    task: Callable[[MagnetArm], Task], before: str, action: int, reward: float, over: bool
) -> None:
    arm, state = world(before)
    task = task(arm)
    after = task.transition(state, jnp.int32(action), jnp.int32(0))
    assert float(task.reward(state, jnp.int32(action), after)) == reward
    assert bool(task.terminal(after)) is over


@pytest.mark.parametrize(
    ("picture", "holding"),
    [
        ("m.. ... ... bbb", []),
        (".M. ... ... bbb", []),  # the magnet touches no brick
        (".M. .b. ... b.b", ["hold-2"]),
        ("... ... M.. bbb", ["hold-2"]),  # gripped is held
        ("... ... m.. bbb", []),
        ("... m.. b.. b.b", ["tower-2"]),
        ("... M.. b.. b.b", ["hold-2"]),  # the tower's own top
        ("..M ..b b.. b..", ["hold-3"]),
        ("M.. b.. b.. b..", []),
        ("m.. b.. b.. b..", ["tower-3"]),
    ],
)
def test_goals_go_brick_by_brick(picture, holding):
    arm, state = world(picture, bricks=3)
    goals = tower_goals(arm)
    assert [goal.name for goal in goals] == ["hold-2", "tower-2", "hold-3", "tower-3"]
    assert [goal.name for goal in goals if goal.terminal(state)] == holding
    assert bool(goals[-1].terminal(state)) == bool(arm.terminal(state))
