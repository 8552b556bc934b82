"""Dietterich's task graph of the taxi (2000, figure 2): get the passenger, put him down, navigate to a landmark."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.taxi import ABOARD, DELIVERED, LANDMARK_AT, LANDMARK_NAMES, SIDE, Taxi, TaxiState
from lodestone.subtasks.task_graph import Child, Feature, Subtask, TaskGraph

WRONG_PLACE_REWARD = -100.0
"""Pseudo-reward of *put* for setting the passenger down where he did not want to go."""


def taxi_tasks(taxi: Taxi) -> TaskGraph:
    """Root{get, put}; get{pickup, navigate}; put{putdown, navigate}; navigate{south, north, east, west}.

    *Get* may only navigate to where the passenger waits, *put* only to his destination. The state abstractions are
    Dietterich's (section 5.5). Those of getting the passenger and of navigating are safe without a discount only, as
    the time that a child takes is not seen.
    """

    def to_each_landmark(bound: Callable[..., Bool[Array, ""]]) -> tuple[Child, ...]:
        """Navigating, to the landmark of which `bound` is true."""
        return tuple(
            Child(f"to-{name}", when=partial(bound, landmark=landmark), sees=_may_change)
            for landmark, name in enumerate(LANDMARK_NAMES)
        )

    moves = tuple(Child(name, sees=_square) for name in taxi.action_names[:4])
    subtasks = (
        Subtask("root", _delivered, (Child("get", sees=_journey), Child("put", final=True))),
        Subtask("get", _not_waiting, (Child("pickup", sees=_square_and_source), *to_each_landmark(_waits_at))),
        Subtask(
            "put",
            _not_aboard,
            (Child("putdown", sees=_square_and_destination), *to_each_landmark(_wants_to)),
            pseudo_reward=_wrong_place,
        ),
        *(
            Subtask(f"to-{name}", partial(_at, landmark=landmark), moves)
            for landmark, name in enumerate(LANDMARK_NAMES)
        ),
    )
    rewards_see: dict[str, Feature] = dict.fromkeys(taxi.action_names[:4], _nothing)
    return TaskGraph(subtasks, rewards_see | {"pickup": _here_is_passenger, "putdown": _what_putdown_does})


def _delivered(state: TaxiState) -> Bool[Array, ""]:
    return state.passenger == DELIVERED


def _not_waiting(state: TaxiState) -> Bool[Array, ""]:
    return state.passenger >= ABOARD


def _not_aboard(state: TaxiState) -> Bool[Array, ""]:
    return state.passenger != ABOARD


def _at(state: TaxiState, landmark: int) -> Bool[Array, ""]:
    return _here(state) == landmark


def _waits_at(state: TaxiState, landmark: int) -> Bool[Array, ""]:
    return state.passenger == landmark


def _wants_to(state: TaxiState, landmark: int) -> Bool[Array, ""]:
    return state.destination == landmark


def _wrong_place(state: TaxiState) -> Float[Array, ""]:
    return jnp.where(_delivered(state), jnp.float32(0), jnp.float32(WRONG_PLACE_REWARD))


def _here(state: TaxiState) -> Int[Array, ""]:
    """The landmark of the taxi's square; -1 for none."""
    return jnp.asarray(LANDMARK_AT)[state.row, state.column]


def _nothing(state: TaxiState) -> Int[Array, ""]:
    del state
    return jnp.int32(0)


def _square(state: TaxiState) -> Int[Array, ""]:
    return state.row.astype(jnp.int32) * SIDE + state.column.astype(jnp.int32)


def _square_and_source(state: TaxiState) -> Int[Array, "2"]:
    return jnp.stack([_square(state), state.passenger.astype(jnp.int32)])


def _square_and_destination(state: TaxiState) -> Int[Array, "3"]:
    return jnp.stack([_square(state), state.destination.astype(jnp.int32), _may_change(state)])


def _may_change(state: TaxiState) -> Int[Array, ""]:
    """Whether the passenger may change his mind, which he never may if he is not fickle."""
    return state.may_change.astype(jnp.int32)


def _journey(state: TaxiState) -> Int[Array, "2"]:
    return jnp.stack([state.passenger, state.destination])


def _here_is_passenger(state: TaxiState) -> Bool[Array, ""]:
    return _here(state) == state.passenger


def _what_putdown_does(state: TaxiState) -> Int[Array, ""]:
    """0 nothing, 1 sets the passenger down in the wrong place, 2 in the right one."""
    somewhere = (state.passenger == ABOARD) & (_here(state) >= 0)
    return somewhere.astype(jnp.int32) + (somewhere & (_here(state) == state.destination)).astype(jnp.int32)
