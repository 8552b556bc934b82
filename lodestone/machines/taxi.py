"""A machine that fetches the passenger and brings him home (after Bai and Russell 2017)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from lodestone.envs.taxi import LANDMARK_AT, Taxi, TaxiState
from lodestone.machines.machine import Action, Branch, Call, Choice, Hierarchy, Machine, Parameter, Predicate, Stop

PASSENGER, DESTINATION = "passenger", "destination"
"""Where `navigate` may go."""


def arrived(taxi: Taxi, state: TaxiState, to: str) -> Bool[Array, ""]:
    """Whether the taxi is where the passenger waits, or where he wants to go."""
    del taxi
    here = jnp.asarray(LANDMARK_AT)[state.row, state.column]
    return here == (state.passenger if to == PASSENGER else state.destination)


def get_and_put(taxi: Taxi) -> Hierarchy:
    """Go to the passenger, pick him up, go to the destination, put him down. Which way to go is open, and whether to go
    one step or two before looking again.

    One machine goes both ways: what it should do depends on who called it. As one step is always allowed, and nothing
    is gained by passing a landmark, the best policy of this machine is as good as the best of all.
    """
    directions = taxi.action_names[:4]
    turns = {direction: Call("go", then="there?", arguments={"direction": direction}) for direction in directions}
    return Hierarchy(
        "taxi",
        (
            Machine("taxi", "get", {"get": Call("get", then="put"), "put": Call("put", then="stop"), "stop": Stop()}),
            Machine(
                "get",
                start="to the passenger",
                vertices={
                    "to the passenger": Call("navigate", then="pick up", arguments={"to": PASSENGER}),
                    "pick up": Action("pickup", then="stop"),
                    "stop": Stop(),
                },
            ),
            Machine(
                "put",
                start="to the destination",
                vertices={
                    "to the destination": Call("navigate", then="put down", arguments={"to": DESTINATION}),
                    "put down": Action("putdown", then="stop"),
                    "stop": Stop(),
                },
            ),
            Machine(
                "navigate",
                start="there?",
                parameters=("to",),
                vertices={
                    "there?": Branch(Predicate(arrived, {"to": Parameter("to")}), {True: "stop", False: "which way"}),
                    "which way": Choice({direction: direction for direction in directions}),
                    **turns,
                    "stop": Stop(),
                },
            ),
            Machine(
                "go",
                start="how far",
                parameters=("direction",),
                vertices={
                    "how far": Choice({"one step": "last", "two steps": "first"}),
                    "first": Action(Parameter("direction"), then="last"),
                    "last": Action(Parameter("direction"), then="stop"),
                    "stop": Stop(),
                },
            ),
        ),
    )
