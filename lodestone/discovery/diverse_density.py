"""Sub-goals that successful trajectories have in common (McGovern and Barto 2001).

Trajectories are bags of states, positive where the goal was reached. How much a state c is what the positive bags share
and the negative ones lack is its diverse density (Maron and Lozano-Perez 1998),

    DD(c) = product over positive bags of (1 - product over x of (1 - k(x, c)))
          * product over negative bags of      product over x of (1 - k(x, c)),      k(x, c) = exp(-|x - c|^2 / scale^2)

After every successful trajectory rho(c) <- lambda rho(c), and + 1 where c is a peak. The state whose rho is highest in
the end, and above a threshold, becomes a sub-goal; its option starts where a successful trajectory was up to n steps
before. What lies near a sub-goal is left out when the next one is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lodestone.discovery.experience import Trajectories
from lodestone.discovery.graph import InteractionGraph, interaction_graph, steps_to
from lodestone.discovery.knowledge import Knowledge
from lodestone.discovery.reaching import Destination, options_to
from lodestone.errors import CannotDiscover, InvalidConfig
from lodestone.options.tabular import TabularOptions

TIE = 1e-9
"""Logarithms of densities closer than this are one peak."""


@dataclass(frozen=True)
class DiverseDensityConfig:
    """Settings of the method."""

    number: int = 1
    """Options, at most."""
    scale: float = 1.0
    """Width of the kernel in squares. Where states are no squares, only a state itself is close to it."""
    unsuccessful: int = 0
    """Of the trajectories without success, so many are negative bags. They rule out every state on them: a walk at
    random that gets through a door and no further rules out the door."""
    memory: float = 0.8
    """lambda, what rho keeps from one successful trajectory to the next."""
    threshold: float = 4.0
    """What rho must exceed; it stays below 1 / (1 - lambda)."""
    filter_steps: int = 1
    """States this near to where a success ended, to the start if all trajectories have the same, or to an earlier
    sub-goal are no sub-goals."""
    before: int = 50
    """n: an option starts where a successful trajectory was, so many steps or fewer before its sub-goal."""

    def __post_init__(self) -> None:
        if self.number < 1:
            raise InvalidConfig(f"number is {self.number}, but at least 1 option must be asked for.")
        if not self.scale > 0:
            raise InvalidConfig(f"scale is {self.scale}, but must be above 0.")
        if not 0 <= self.memory < 1:
            raise InvalidConfig(f"memory is {self.memory}, but must be from 0 to below 1.")
        if not 0 <= self.threshold * (1 - self.memory) < 1 - 1e-9:
            raise InvalidConfig(
                f"threshold is {self.threshold}, but with a memory of {self.memory:g} rho is between 0 and "
                f"{1 / (1 - self.memory):g}."
            )
        for name, least in (("unsuccessful", 0), ("filter_steps", 0), ("before", 1)):
            if getattr(self, name) < least:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least {least}.")


class DenseSubgoals(NamedTuple):
    """What the method found: G sub-goals, in the order in which they stood out."""

    options: TabularOptions
    subgoals: Int[np.ndarray, " G"]
    """Numbers of states."""
    log_density: Float[np.ndarray, " S"]
    """ln DD by all bags; -inf where it is 0, not a number where no successful trajectory was."""
    successes: int
    """Successful trajectories."""


def kernel(
    squares: Float[np.ndarray, "M F"], others: Float[np.ndarray, "C F"], scale: float
) -> Float[np.ndarray, "M C"]:
    """k of every pair."""
    return np.exp(-np.square(squares[:, None] - others).sum(axis=-1) / scale**2)


def log_densities(closeness: list[Float[np.ndarray, "M C"]], positive: list[bool]) -> Float[np.ndarray, "N C"]:
    """What each of N bags adds to ln DD of each of C states, given k from the bag's states to those."""
    rows = []
    with np.errstate(divide="ignore"):
        for near, success in zip(closeness, positive, strict=True):
            missed = np.log1p(-near).sum(axis=0)
            rows.append(np.log(-np.expm1(missed)) if success else missed)
    return np.stack(rows)


def diverse_density(
    knowledge: Knowledge,
    trajectories: Trajectories,
    config: DiverseDensityConfig,
    squares: Int[np.ndarray, "S 2"] | None = None,
) -> DenseSubgoals:
    """Sub-goals from the trajectories, options from what is known. `squares` are where the states are, if they are
    somewhere. Raises `CannotDiscover` where there was no success, or nothing stood out."""
    if not trajectories.success.any():
        raise CannotDiscover(
            f"None of {len(trajectories.lengths):,} trajectories of at most {trajectories.actions.shape[1]:,} steps "
            "reached the goal, and diverse density compares those that do: record more, or longer ones."
        )
    graph = interaction_graph(knowledge)
    bags, positive = _bags(trajectories, config.unsuccessful)
    states = np.unique(np.concatenate([bag for bag, success in zip(bags, positive, strict=True) if success]))

    def near(bag: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M C"]:
        if squares is None:
            return (bag[:, None] == states).astype(np.float64)
        return kernel(squares[bag].astype(np.float64), squares[states].astype(np.float64), config.scale)

    by_bag = log_densities([near(bag) for bag in bags], positive)
    allowed = ~_near_any(graph, _ends(trajectories), config.filter_steps)[states]
    totals = np.cumsum(by_bag, axis=0)
    subgoals: list[int] = []
    while len(subgoals) < config.number:
        standing_out = _stand_out(totals[positive], allowed, config)
        if not standing_out.any():
            break
        subgoals.append(_middle(graph, states[standing_out]))
        allowed &= ~_near_any(graph, np.array(subgoals[-1:]), config.filter_steps)[states]
    if not subgoals:
        raise CannotDiscover(
            f"No state stood out among {trajectories.success.sum():,} successful trajectories: record more, or lower "
            "the threshold."
        )
    destinations = []
    for position, subgoal in enumerate(subgoals, start=1):
        region = _before(trajectories, subgoal, config.before)
        destinations.append(Destination(f"dense-{position}", subgoal, region, region))
    log_density = np.full(graph.num_states, np.nan)
    log_density[states] = totals[-1]
    return DenseSubgoals(
        options_to(knowledge, destinations), np.array(subgoals), log_density, int(trajectories.success.sum())
    )


def _stand_out(
    totals: Float[np.ndarray, "N C"], allowed: Bool[np.ndarray, " C"], config: DiverseDensityConfig
) -> Bool[np.ndarray, " C"]:
    """The states with the highest rho after the last success, if it is above the threshold. `totals` is ln DD after
    each success."""
    rho = np.zeros(len(allowed))
    for total in np.where(allowed, totals, -np.inf):
        best = total.max(initial=-np.inf)
        rho = config.memory * rho + ((total >= best - TIE) & (best > -np.inf))
    return (rho > config.threshold) & (rho >= rho.max() - TIE)


def _bags(trajectories: Trajectories, unsuccessful: int) -> tuple[list[Int[np.ndarray, " M"]], list[bool]]:
    """The different states on each trajectory that counts, and whether it reached the goal."""
    counted = trajectories.success | (np.cumsum(~trajectories.success) <= unsuccessful)
    numbers = np.flatnonzero(counted)
    bags = [np.unique(trajectories.states[number, : trajectories.lengths[number] + 1]) for number in numbers]
    return bags, [bool(success) for success in trajectories.success[numbers]]


def _ends(trajectories: Trajectories) -> Int[np.ndarray, " M"]:
    """Where successes ended, and the start if there is only one."""
    goals = np.unique(trajectories.states[trajectories.success, -1])
    starts = np.unique(trajectories.states[:, 0])
    return np.concatenate([goals, starts]) if len(starts) == 1 else goals


def _near_any(graph: InteractionGraph, states: Int[np.ndarray, " M"], steps: int) -> Bool[np.ndarray, " S"]:
    near = np.zeros(graph.num_states, dtype=bool)
    for state in states:
        near[graph.states] |= steps_to(graph.undirected(), graph.vertex_of(int(state))) <= steps
    return near


def _middle(graph: InteractionGraph, states: Int[np.ndarray, " M"]) -> int:
    """The one with the fewest steps to the others: every way through a door leads over the cells beside it, too."""
    undirected = graph.undirected()
    vertices = np.searchsorted(graph.states, states)
    far = [steps_to(undirected, int(vertex))[vertices].sum() for vertex in vertices]
    return int(states[np.argmin(far)])


def _before(trajectories: Trajectories, subgoal: int, steps: int) -> Bool[np.ndarray, " S"]:
    """States in which a successful trajectory was, at most so many steps before it first came to the sub-goal."""
    region = np.zeros(trajectories.space.size, dtype=bool)
    for states in trajectories.states[trajectories.success]:
        there = np.flatnonzero(states == subgoal)[:1]
        for time in there:
            region[states[max(0, time - steps) : time]] = True
    return region
