"""Every method of discovery by its name, on an environment, from its tables or from trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Int

from lodestone.discovery.betweenness import BetweennessConfig, Bottlenecks, bottlenecks
from lodestone.discovery.covering import Covering, CoveringConfig, covering
from lodestone.discovery.diffusion import diffusion_time
from lodestone.discovery.diverse_density import DenseSubgoals, DiverseDensityConfig, diverse_density
from lodestone.discovery.eigenoptions import Eigenoptions, EigenoptionsConfig, eigenoptions
from lodestone.discovery.experience import Recording, observed, record
from lodestone.discovery.knowledge import Knowledge, everything, everything_without_task, within
from lodestone.discovery.squares import squares_of
from lodestone.envs.base import Environment
from lodestone.envs.state_space import StateSpace, reachable_states
from lodestone.envs.task import endless
from lodestone.options.base import Options, Primitives, Union
from lodestone.options.tabular import TabularOptions
from lodestone.planning.option_models import tabulate_options
from lodestone.planning.tables import tabulate

MethodConfig = DiverseDensityConfig | BetweennessConfig | EigenoptionsConfig | CoveringConfig

METHODS: dict[str, type[MethodConfig]] = {
    "diverse-density": DiverseDensityConfig,
    "betweenness": BetweennessConfig,
    "eigenoptions": EigenoptionsConfig,
    "covering": CoveringConfig,
}
"""Every method's settings, by its name."""

Source = Literal["tables", "trajectories"]
"""What is known: all of the environment, or what was seen."""

Found = DenseSubgoals | Bottlenecks | Eigenoptions | Covering


class Discovery(NamedTuple):
    """Options that were discovered, for any agent, and what of the world they come from."""

    found: Found
    """Over the states of `space`; for each option a sub-goal."""
    space: StateSpace
    """The environment's own `reachable_states`."""
    squares: Int[np.ndarray, "S 2"] | None
    """Row and column of each state, where states are squares of a grid."""
    seen: int
    """How many states were known."""
    steps: int
    """Primitive steps that were recorded; 0 where none were needed."""

    @property
    def options(self) -> TabularOptions:
        """What an agent takes."""
        return self.found.options


def discover(
    environment: Environment, config: MethodConfig, source: Source = "tables", recording: Recording | None = None
) -> Discovery:
    """Discover options of an environment by the method that `config` is of.

    Only diverse density is told of the task, as it compares trajectories that reached the goal; it records some even
    where the ways are planned on the tables. To the others the goal is a state like any other, and nothing ends.
    Raises what the method raises, and `TooManyStates`.
    """
    space = reachable_states(environment)
    squares = squares_of(environment, space)
    recording = recording or Recording()
    if isinstance(config, DiverseDensityConfig):
        trajectories = record(environment, recording)
        known = everything(tabulate(environment)) if source == "tables" else observed(trajectories)
        dense = diverse_density(known, trajectories, config, squares)
        return Discovery(dense, space, squares, int(known.seen.sum()), trajectories.num_steps)
    steps = 0
    if source == "tables":
        known = everything_without_task(environment)
    else:
        trajectories = record(endless(environment), recording)
        known, steps = within(observed(trajectories), space), trajectories.num_steps
    return Discovery(_FIND[type(config)](known, config), space, squares, int(known.seen.sum()), steps)


_FIND: dict[type, Callable[[Knowledge, Any], Found]] = {
    BetweennessConfig: bottlenecks,
    EigenoptionsConfig: eigenoptions,
    CoveringConfig: covering,
}


def diffusion_times(environment: Environment, options: Options) -> tuple[float, float]:
    """Diffusion time of the primitive actions alone and with some options, where nothing ends an episode.

    Raises what `diffusion_time` raises.
    """
    tables = everything_without_task(environment).tables
    primitives = Primitives(environment.action_names)
    chosen_from = (primitives, Union((primitives, options)))
    alone, together = (diffusion_time(tables, tabulate_options(one, tables.space)) for one in chosen_from)
    return alone, together
