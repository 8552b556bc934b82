"""A hierarchy of machines in a Gymnasium environment that shows a number: what is known beforehand.

That is the joint process but for what actions lead to. Joint states are those of `lodestone.planning.joint`, with the
shown number for the environment's state; once a step has shown a number, where the machines then are is looked up.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from lodestone.envs.host import HostEnvironment, Shown
from lodestone.machines.configurations import Configurations
from lodestone.machines.machine import Hierarchy
from lodestone.planning.landing import choices_of, land, machines_over, numbers_of, reach

START = -1
"""In place of an action's configuration: that an episode begins."""


class ShownProcess(NamedTuple):
    """J joint states over S numbers, in the order of `JointProcess`, whose fields these are, save for the last three.
    The arrays are shared and read-only."""

    configurations: Configurations
    state: Int[np.ndarray, " J"]
    configuration: Int[np.ndarray, " J"]
    edges: Int[np.ndarray, "N U"]
    available: Bool[np.ndarray, "N U"]
    names: tuple[str, ...]
    name: Int[np.ndarray, "N U"]
    actions: Int[np.ndarray, " M"]
    landings: Int[np.ndarray, "L S"]
    """The joint state where the machines next choose or act once a number is shown: in the first row as an episode
    begins, in the others after an action."""
    landing: Int[np.ndarray, " M"]
    """The row of each action."""
    firsts: Bool[np.ndarray, "N U A"]
    """The primitive actions that may come next after an edge; all of them where none does."""

    @property
    def num_choices(self) -> int:
        """N."""
        return len(self.edges)

    @property
    def end(self) -> int:
        """Number of the end of the episode."""
        return len(self.state) - 1


def shown_process(environment: HostEnvironment, hierarchy: Hierarchy) -> ShownProcess:
    """The machines in the environment; remembered for the last few.

    As nothing is known of what follows what, episodes may begin with any number, and any may follow any other: there,
    too, a branch needs an edge, and a choice one that may be taken. Raises `InvalidMachine`, `TooManyStates`, and
    `InvalidConfig` for an environment that shows no number.
    """
    return _shown_process(environment, hierarchy)


@lru_cache(maxsize=4)
def _shown_process(environment: HostEnvironment, hierarchy: Hierarchy) -> ShownProcess:
    space = Shown(environment)
    machines = machines_over(environment, hierarchy, space, np.zeros(space.size, dtype=bool))
    everywhere = np.arange(space.size)
    landings = {START: land(machines, everywhere, np.zeros_like(everywhere))}
    """By the action's configuration."""

    def after_action(_: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]) -> Int[np.ndarray, "L S"]:
        """The pairs that follow the actions that were not met before."""
        new = [each for each in np.unique(configuration).tolist() if each not in landings]
        for each in new:
            landings[each] = land(machines, everywhere, np.full(space.size, machines.following[each, 0]))
        return np.stack([landings[each] for each in new]) if new else np.zeros((0, space.size), np.int64)

    pair = reach(machines, landings[START], after_action)
    state, configuration = np.divmod(pair, machines.configurations.size)
    num_choices, number = int(machines.is_choice[configuration].sum()), numbers_of(machines, pair)
    choices = choices_of(machines, state[:num_choices], configuration[:num_choices], number)
    acting = configuration[num_choices:]
    actions = machines.action[acting]

    comes = np.ones((len(pair) + 1, environment.num_actions), dtype=bool)
    comes[:num_choices] = False
    comes[num_choices:-1] = np.eye(environment.num_actions, dtype=bool)[actions]
    for _ in range(machines.configurations.choices_in_a_row):
        firsts = choices.available[:, :, None] & comes[choices.edges]
        comes[:num_choices] = firsts.any(axis=1)

    process = ShownProcess(
        configurations=machines.configurations,
        state=np.append(state, -1).astype(np.int32),
        configuration=np.append(configuration, -1).astype(np.int32),
        edges=choices.edges,
        available=choices.available,
        names=choices.names,
        name=choices.name,
        actions=actions.astype(np.int32),
        landings=number[np.stack(list(landings.values()))],
        landing=np.array([list(landings).index(each) for each in acting.tolist()], dtype=np.int32),
        firsts=firsts,
    )
    for array in process:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return process
