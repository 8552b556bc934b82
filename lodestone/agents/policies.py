"""What agents have learned, ready to play: for every kind of policy its networks or tables, of one or more seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lodestone.agents.hamq import process_of
from lodestone.agents.option_critic import Learned
from lodestone.envs.base import Environment
from lodestone.envs.task import Task
from lodestone.learning.goal_network import GoalNetwork, GoalOptions
from lodestone.learning.networks import NetworkConfig, QNetwork
from lodestone.learning.option_network import OptionNetwork, SoftNetworkOptions
from lodestone.learning.plan_network import PlanNetwork
from lodestone.learning.united_execution import UnitedOptions, choices
from lodestone.learning.united_network import Shared, UnitedNetwork
from lodestone.machines.machine import Hierarchy
from lodestone.options.base import Options
from lodestone.options.execution import Rules
from lodestone.options.soft import SoftOptions, numbered_names
from lodestone.planning.enumerated import numbering
from lodestone.planning.joint import JointProcess
from lodestone.planning.shown_joint import ShownProcess
from lodestone.types import State


@dataclass(frozen=True)
class Policy:
    """A trained policy over options, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    options: Options
    rules: Rules
    learned: QNetwork | Float[Array, "seeds S O"]
    """A Q-network with a leading seed axis, or a table of option values per seed."""
    reward_scale: float
    """Factor by which the learned values are larger than the environment's rewards."""
    seeds: tuple[int, ...]

    def values(self, position: int) -> Callable[[State], Float[Array, " O"]]:
        """Q(s, .) of the seed at this position, in units of the environment's reward."""
        return self.values_of(jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), self.learned))

    def values_of(self, learned: QNetwork | Float[Array, "S O"]) -> Callable[[State], Float[Array, " O"]]:
        """The same of what one seed has learned."""
        if isinstance(learned, QNetwork):
            return lambda state: learned(self.environment.observe(state)) / self.reward_scale
        space = numbering(self.environment)
        return lambda state: learned[space.index_of(state)] / self.reward_scale


@dataclass(frozen=True)
class MachinePolicy:
    """A trained policy over the choices of machines, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    hierarchy: Hierarchy
    rules: Rules
    tables: Float[np.ndarray, "seeds N U"]
    """Q of every edge of every choice of `process`; -inf where it may not be taken."""
    seeds: tuple[int, ...]

    @property
    def process(self) -> JointProcess | ShownProcess:
        """The machines in the environment."""
        return process_of(self.environment, self.hierarchy)


@dataclass(frozen=True)
class UnitedPolicy:
    """A trained united network, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    tasks: tuple[Task, ...]
    """What the options are for, in order."""
    option_cap: int
    """Steps after which an option is stopped."""
    rules: Rules
    shape: NetworkConfig
    shared: Shared
    networks: UnitedNetwork
    """With a leading seed axis."""
    reward_scale: float
    """Factor by which the learned values are larger than the environment's rewards."""
    seeds: tuple[int, ...]

    @property
    def choices(self) -> tuple[str, ...]:
        """Names of what the manager chooses from."""
        return choices(self.tasks)

    def network(self, position: int) -> UnitedNetwork:
        """Of the seed at this position."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), self.networks)

    def options(self, position: int) -> UnitedOptions:
        """What that seed's manager chooses from, as a set of options."""
        return UnitedOptions(self.environment, self.network(position), self.choices, self.option_cap)


@dataclass(frozen=True)
class GoalPolicy:
    """A trained meta-controller and controller, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    tasks: tuple[Task, ...]
    """The goals, in order."""
    option_cap: int
    """Steps after which a goal is given up; `NO_CAP` for never."""
    rules: Rules
    shape: NetworkConfig
    shared: Shared
    networks: GoalNetwork
    """With a leading seed axis."""
    reward_scale: float
    """Factor by which the meta-controller's values are larger than the environment's rewards."""
    seeds: tuple[int, ...]

    @property
    def choices(self) -> tuple[str, ...]:
        """Names of the goals."""
        return tuple(task.name for task in self.tasks)

    def network(self, position: int) -> GoalNetwork:
        """Of the seed at this position."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), self.networks)

    def options(self, position: int) -> GoalOptions:
        """What that seed's meta-controller chooses from, as a set of options."""
        return self.options_of(self.network(position))

    def options_of(self, network: GoalNetwork) -> GoalOptions:
        """The same of what one seed has learned."""
        return GoalOptions(self.tasks, network, jnp.zeros(len(self.tasks)), self.option_cap)

    def values_of(self, network: GoalNetwork) -> Callable[[State], Float[Array, " G"]]:
        """Its Q2(s, .), in units of the environment's reward."""
        return lambda state: network.goal_values(self.environment.observe(state)) / self.reward_scale


@dataclass(frozen=True)
class OptionCriticPolicy:
    """Options that option-critic has learned with the policy over them, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    rules: Rules
    temperature: float
    """Of the options' policies."""
    learned: Learned | OptionNetwork
    """Tables or networks, with a leading seed axis."""
    seeds: tuple[int, ...]
    reward_scale: float = 1.0
    """Factor by which the learned values are larger than the environment's rewards."""

    @property
    def choices(self) -> tuple[str, ...]:
        """Names of the options."""
        return numbered_names(self.learned.num_options)

    def of_seed(self, position: int) -> Learned | OptionNetwork:
        """What the seed at this position has learned."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), self.learned)

    def options_of(self, learned: Learned | OptionNetwork) -> SoftOptions | SoftNetworkOptions:
        """The options of one seed."""
        if isinstance(learned, OptionNetwork):
            return SoftNetworkOptions(self.environment, learned, self.temperature)
        space = numbering(self.environment)
        return SoftOptions(space, learned.preferences, learned.exits, self.temperature)

    def values_of(self, learned: Learned | OptionNetwork) -> Callable[[State], Float[Array, " O"]]:
        """Q(s, .) of one seed."""
        if isinstance(learned, OptionNetwork):
            values = SoftNetworkOptions(self.environment, learned, self.temperature).values
            return lambda state: values(state) / self.reward_scale
        space = numbering(self.environment)
        return lambda state: learned.table[space.index_of(state)]


@dataclass(frozen=True)
class PlanPolicy:
    """Trained networks that plan, of one or more seeds."""

    agent: str
    """Name of the algorithm."""
    environment: Environment
    rules: Rules
    shape: NetworkConfig
    networks: PlanNetwork
    """With a leading seed axis."""
    reward_scale: float
    """Factor by which the planned values are larger than the environment's rewards."""
    seeds: tuple[int, ...]

    def network(self, position: int) -> PlanNetwork:
        """Of the seed at this position."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), self.networks)


AnyPolicy = Policy | MachinePolicy | UnitedPolicy | GoalPolicy | OptionCriticPolicy | PlanPolicy
