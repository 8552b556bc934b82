"""Taxi: fetch a passenger from one landmark and set him down at another (Dietterich 2000, section 3.1).

Two conventions of reward go by this name and give different numbers; here each has a name of its own, and so have the
two kinds of chance that Dietterich adds: moves that slip, and a passenger who changes his mind.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, UInt8
from PIL import Image, ImageDraw, ImageFont

from lodestone.envs.base import Environment
from lodestone.envs.state_space import reachable_states
from lodestone.errors import InvalidConfig

SOUTH, NORTH, EAST, WEST, PICKUP, PUTDOWN = range(6)
"""The actions, in Gymnasium's order."""

LANDMARKS = np.array([(0, 0), (0, 4), (4, 0), (4, 3)])
"""Row and column of the red, the green, the yellow and the blue landmark."""
LANDMARK_NAMES = "RGYB"
ABOARD, DELIVERED = 4, 5
"""Where the passenger is, if at no landmark."""

SIDE = 5
"""Rows and columns of the town."""
WALLS = ((0, 1), (1, 1), (3, 0), (4, 0), (3, 2), (4, 2))
"""Row and column of each square that has a wall on its east side."""
STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
"""Row and column by which each move goes: south, north, east, west."""
STAY = 4
"""What PICKUP and PUTDOWN do with the taxi, as a fifth direction."""
DIRECTIONS = np.array(
    [(SOUTH, EAST, WEST), (NORTH, EAST, WEST), (EAST, NORTH, SOUTH), (WEST, NORTH, SOUTH), (STAY,) * 3, (STAY,) * 3]
)
"""Where each action takes the taxi: as intended, or off to one side or the other."""


def _next_squares() -> Int8[np.ndarray, "rows columns 5 2"]:
    """Row and column that each direction leads to; a wall holds the taxi back."""
    squares = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij"), axis=-1)
    ahead = np.clip(squares[:, :, None] + np.vstack([STEPS, (0, 0)]), 0, SIDE - 1)
    for row, column in WALLS:
        ahead[row, column, EAST] = row, column
        ahead[row, column + 1, WEST] = row, column + 1
    return ahead.astype(np.int8)


NEXT_SQUARES = _next_squares()
LANDMARK_AT = np.full((SIDE, SIDE), -1, dtype=np.int8)
LANDMARK_AT[tuple(LANDMARKS.T)] = np.arange(len(LANDMARKS))
"""The landmark of each square; -1 where there is none."""

STEP_REWARD, ILLEGAL_REWARD = -1.0, -10.0
DELIVERY_REWARD = {"gym": 20.0, "jair": 19.0}
"""Rewards of a step, each in place of the others."""


class TaxiState(NamedTuple):
    """Where taxi and passenger are, and where he wants to go."""

    row: Int8[Array, ""]
    column: Int8[Array, ""]
    passenger: Int8[Array, ""]
    """The landmark where he waits, `ABOARD` or `DELIVERED`."""
    destination: Int8[Array, ""]
    """A landmark."""
    may_change: Bool[Array, ""]
    """Whether he was picked up by the last step and may still change his mind; never, if he is not fickle."""


class Taxi(Environment):
    """A town of 5 x 5 squares, six actions; the episode ends when the passenger is where he wanted to go."""

    rewards: Literal["gym", "jair"] = eqx.field(static=True, default="gym")
    """Every step costs 1 and an illegal pickup or putdown 10 instead. `gym`: delivery pays 20 instead, and a putdown at
    another landmark sets the passenger down there (Gymnasium). `jair`: delivery pays 20 besides the cost of the step,
    and a putdown at another landmark is illegal (Dietterich)."""
    move_success: float = eqx.field(static=True, default=1.0)
    """Probability that a move goes where it should; else it goes to one side or the other, with equal chance. 0.8 is
    Dietterich's."""
    fickle: float = eqx.field(static=True, default=0.0)
    """Probability that the passenger changes his destination for one of the other landmarks, in the first step after
    he was picked up. 0.3 is Dietterich's."""
    starts: Literal["apart", "any"] = eqx.field(static=True, default="apart")
    """Where episodes begin: the taxi anywhere, the passenger at a landmark, his destination another one (`apart`, 300
    states) or any (`any`, 400 states)."""
    observation: Literal["planes", "index"] = eqx.field(static=True, default="planes")
    """What the agent sees: 0/1 planes over the squares, or the number of the state."""

    def __check_init__(self) -> None:
        for name, known in (("rewards", ("gym", "jair")), ("starts", ("apart", "any"))):
            if getattr(self, name) not in known:
                raise InvalidConfig(f"{name} is {getattr(self, name)!r}, but must be {known[0]!r} or {known[1]!r}.")
        if self.observation not in ("planes", "index"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'planes' or 'index'.")
        for name in ("move_success", "fickle"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a probability from 0 to 1.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("south", "north", "east", "west", "pickup", "putdown")

    @property
    def num_outcomes(self) -> int:
        """Where a move goes (3, or 1 if it never slips) times what the passenger wants (4, or 1 if he is not fickle):
        the latter counts fastest, 0 for no change."""
        return self._slips * self._wishes

    @property
    def _slips(self) -> int:
        return 1 if self.move_success == 1 else 3

    @property
    def _wishes(self) -> int:
        return 1 if self.fickle == 0 else len(LANDMARKS)

    def initial_distribution(self) -> tuple[Float[Array, " I"], TaxiState]:
        shape = (SIDE, SIDE, len(LANDMARKS), len(LANDMARKS))
        starts = np.argwhere(np.ones(shape, dtype=bool))
        if self.starts == "apart":
            starts = starts[starts[:, 2] != starts[:, 3]]
        probs = jnp.full(len(starts), 1 / len(starts), dtype=jnp.float32)
        row, column, passenger, destination = jnp.asarray(starts.T, dtype=jnp.int8)
        return probs, TaxiState(row, column, passenger, destination, may_change=jnp.zeros(len(starts), dtype=bool))

    def outcome_probs(self, state: TaxiState, action: Int[Array, ""]) -> Float[Array, " K"]:
        slips, wishes = jnp.ones(1), jnp.ones(1)
        if self._slips > 1:
            aside = (1 - self.move_success) / 2
            moves = jnp.array([self.move_success, aside, aside], dtype=jnp.float32)
            slips = jnp.where(action < PICKUP, moves, jnp.array([1, 0, 0], dtype=jnp.float32))
        if self._wishes > 1:
            changes = jnp.full(3, self.fickle / 3, dtype=jnp.float32) * state.may_change.astype(jnp.float32)
            wishes = jnp.concatenate([1 - jnp.sum(changes)[None], changes])
        return jnp.ravel(slips[:, None] * wishes[None, :])

    def transition(self, state: TaxiState, action: Int[Array, ""], outcome: Int[Array, ""]) -> TaxiState:
        slip, change = outcome // self._wishes, (outcome % self._wishes).astype(jnp.int8)
        direction = jnp.asarray(DIRECTIONS.astype(np.int32))[action, slip]
        row, column = jnp.asarray(NEXT_SQUARES)[state.row, state.column, direction]

        here = jnp.asarray(LANDMARK_AT)[state.row, state.column]
        aboard, at_destination = state.passenger == ABOARD, here == state.destination
        picks_up = (action == PICKUP) & (here == state.passenger)
        puts_down = (action == PUTDOWN) & aboard & (at_destination if self.rewards == "jair" else here >= 0)
        put_down = jnp.where(at_destination, jnp.int8(DELIVERED), here)
        passenger = jnp.where(picks_up, jnp.int8(ABOARD), jnp.where(puts_down, put_down, state.passenger))
        changed = (state.destination + change) % jnp.int8(len(LANDMARKS))
        return TaxiState(
            row=row,
            column=column,
            passenger=passenger,
            # Whoever is set down at once has no more time to change his mind.
            destination=jnp.where(passenger == ABOARD, changed, state.destination),
            may_change=picks_up & (self._wishes > 1),
        )

    def reward(self, state: TaxiState, action: Int[Array, ""], next_state: TaxiState) -> Float[Array, ""]:
        # Whatever is legal with a passenger changes where he is.
        illegal = (action >= PICKUP) & (next_state.passenger == state.passenger)
        otherwise = jnp.where(illegal, jnp.float32(ILLEGAL_REWARD), jnp.float32(STEP_REWARD))
        return jnp.where(self.terminal(next_state), jnp.float32(DELIVERY_REWARD[self.rewards]), otherwise)

    def terminal(self, state: TaxiState) -> Bool[Array, ""]:
        """The passenger is delivered."""
        return state.passenger == DELIVERED

    def observe(self, state: TaxiState) -> Int8[Array, "5 5 planes"] | Int[Array, ""]:
        """`planes`: int8 [5, 5, 4], where the empty taxi is, the taxi with the passenger, the waiting passenger, his
        destination; with a fickle passenger a fifth, the taxi while he may still change his mind. `index`: int32 [],
        the state's number in `reachable_states`."""
        if self.observation == "index":
            return reachable_states(self).index_of(state)
        row, column = jnp.arange(SIDE, dtype=jnp.int8)[:, None], jnp.arange(SIDE, dtype=jnp.int8)[None, :]
        taxi, aboard = (row == state.row) & (column == state.column), state.passenger == ABOARD
        landmarks = jnp.asarray(LANDMARK_AT)
        planes = [taxi & ~aboard, taxi & aboard, landmarks == state.passenger, landmarks == state.destination]
        if self._wishes > 1:
            planes.append(taxi & state.may_change)
        return jnp.stack(planes, axis=-1).astype(jnp.int8)

    def render(self, state: TaxiState) -> UInt8[np.ndarray, "height width 3"]:
        """The town from above: landmarks with their letters, a flag at the destination, the passenger at his landmark
        or in the taxi."""
        picture = Image.new("RGB", (SIDE * SQUARE + 2 * MARGIN,) * 2, PAPER)
        draw = ImageDraw.Draw(picture)
        for index in range(len(LANDMARKS)):
            _draw_landmark(draw, index)
        _draw_town(draw)
        _draw_flag(draw, *_corner(*LANDMARKS[int(state.destination)]))
        passenger = int(state.passenger)
        _draw_taxi(draw, *_corner(int(state.row), int(state.column)), passenger == ABOARD)
        if passenger != ABOARD:
            x, y = _corner(*LANDMARKS[passenger if passenger < ABOARD else int(state.destination)])
            _draw_person(draw, x + SQUARE * 5 // 6, y + SQUARE * 5 // 8, SQUARE // 6)
        return np.asarray(picture.reduce(SMOOTH))


SMOOTH = 3
"""Pictures for people are painted this many times larger and then reduced, for smooth edges."""
SQUARE, MARGIN = 72 * SMOOTH, 12 * SMOOTH
"""Side of a square and width of the frame around the town, in painted pixels."""
PAPER, GRID, WALL, INK = (246, 246, 242), (220, 222, 226), (70, 76, 86), (40, 44, 52)
LANDMARK_COLOURS = ((226, 110, 96), (110, 190, 120), (240, 214, 96), (110, 156, 222))
TAXI_COLOUR, GLASS, SKIN, COAT = (250, 178, 32), (222, 238, 248), (236, 188, 150), (150, 70, 150)


def _corner(row: int, column: int) -> tuple[int, int]:
    """x and y of a square's top left corner."""
    return MARGIN + int(column) * SQUARE, MARGIN + int(row) * SQUARE


def _draw_landmark(draw: ImageDraw.ImageDraw, index: int) -> None:
    x, y = _corner(*LANDMARKS[index])
    draw.rectangle((x, y, x + SQUARE, y + SQUARE), LANDMARK_COLOURS[index])
    font = ImageFont.load_default(SQUARE // 4)
    draw.text((x + SQUARE // 8, y + SQUARE // 20), LANDMARK_NAMES[index], INK, font)


def _draw_town(draw: ImageDraw.ImageDraw) -> None:
    """The lines between squares, the walls among them, and the wall around."""
    near, far = MARGIN, MARGIN + SIDE * SQUARE
    for line in range(near, far, SQUARE):
        draw.line((line, near, line, far), GRID, SMOOTH)
        draw.line((near, line, far, line), GRID, SMOOTH)
    half = MARGIN // 2
    draw.rectangle((near - half, near - half, far + half, far + half), outline=WALL, width=half)
    for row, column in WALLS:
        x, y = _corner(row, column + 1)
        draw.rounded_rectangle((x - half, y - half, x + half, y + SQUARE + half), half, WALL)


def _draw_flag(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    """A flag of two colours, in the top right of a square."""
    pole, top, part = x + SQUARE * 5 // 8, y + SQUARE // 14, SQUARE // 12
    draw.line((pole, top, pole, top + SQUARE // 3), INK, 2 * SMOOTH)
    for row in range(2):
        for column in range(3):
            left, upper = pole + column * part, top + row * part
            colour = INK if (row + column) % 2 == 0 else (255, 255, 255)
            draw.rectangle((left, upper, left + part, upper + part), colour)


def _draw_person(draw: ImageDraw.ImageDraw, x: int, y: int, size: int) -> None:
    """Head and shoulders; `size` is the width of the head, (x, y) its middle."""
    half = size // 2
    draw.pieslice((x - size, y + half, x + size, y + half + 2 * size), 180, 360, COAT, INK, SMOOTH)
    draw.ellipse((x - half, y - half, x + half, y + half), SKIN, INK, SMOOTH)


def _draw_taxi(draw: ImageDraw.ImageDraw, x: int, y: int, with_passenger: bool) -> None:
    """A cab in the lower part of a square, the passenger's head in its window if he is aboard."""

    def box(left: float, top: float, right: float, bottom: float) -> tuple[float, float, float, float]:
        return x + left * SQUARE, y + top * SQUARE, x + right * SQUARE, y + bottom * SQUARE

    draw.rounded_rectangle(box(0.20, 0.36, 0.66, 0.72), SQUARE // 10, TAXI_COLOUR, INK, SMOOTH)
    draw.rounded_rectangle(box(0.07, 0.58, 0.80, 0.84), SQUARE // 12, TAXI_COLOUR, INK, SMOOTH)
    draw.rounded_rectangle(box(0.25, 0.41, 0.61, 0.60), SQUARE // 20, GLASS, INK, SMOOTH)
    if with_passenger:
        _draw_person(draw, x + round(0.43 * SQUARE), y + round(0.48 * SQUARE), SQUARE // 10)
    for part in range(9):
        colour = INK if part % 2 == 0 else (255, 255, 255)
        draw.rectangle(box(0.12 + part * 0.07, 0.65, 0.19 + part * 0.07, 0.70), colour)
    for left in (0.16, 0.53):
        draw.ellipse(box(left, 0.74, left + 0.18, 0.92), INK)
        draw.ellipse(box(left + 0.06, 0.80, left + 0.12, 0.86), GRID)
