"""Training any agent on any environment, from settings to policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jaxtyping import PyTree

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig, deep_option_critic
from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.agents.hamq import TICKS_PER_ROUND, HAMQConfig, hamq, process_of
from lodestone.agents.hdqn import HDQNConfig, hdqn
from lodestone.agents.intra_option import IntraOptionConfig, intra_option_q_learning
from lodestone.agents.maxq import MAXQConfig, maxq, polled_values, rounds_for, tasks_of
from lodestone.agents.option_critic import OptionCriticConfig, option_critic
from lodestone.agents.policies import (
    AnyPolicy,
    GoalPolicy,
    MachinePolicy,
    OptionCriticPolicy,
    PlanPolicy,
    Policy,
    UnitedPolicy,
)
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.sarsa import SarsaConfig, sarsa
from lodestone.agents.straw import StrawConfig, straw
from lodestone.agents.united import UnitedConfig, united
from lodestone.envs.base import Environment, OutsideEnvironment, observation_shape
from lodestone.envs.host import visit
from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig
from lodestone.learning.checkpoints import Checkpoints
from lodestone.learning.history import History
from lodestone.learning.loop import Algorithm, carried, train
from lodestone.learning.united_execution import choices
from lodestone.learning.united_network import UnitedNetwork
from lodestone.machines.catalogue import machines
from lodestone.machines.configurations import configurations
from lodestone.machines.machine import Hierarchy
from lodestone.options.base import Options
from lodestone.options.catalogue import goals as ready_made_goals
from lodestone.options.catalogue import tasks as ready_made_tasks
from lodestone.options.execution import Rules
from lodestone.options.soft import numbered_names
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.task_graph import TaskGraph

AgentConfig = (
    DQNConfig
    | UnitedConfig
    | HDQNConfig
    | QLearningConfig
    | SarsaConfig
    | IntraOptionConfig
    | OptionCriticConfig
    | DeepOptionCriticConfig
    | StrawConfig
    | MAXQConfig
    | HAMQConfig
)

AGENTS: dict[str, type[AgentConfig]] = {
    "dqn": DQNConfig,
    "united": UnitedConfig,
    "hdqn": HDQNConfig,
    "q-learning": QLearningConfig,
    "sarsa": SarsaConfig,
    "intra-option": IntraOptionConfig,
    "option-critic": OptionCriticConfig,
    "deep-option-critic": DeepOptionCriticConfig,
    "straw": StrawConfig,
    "maxq": MAXQConfig,
    "hamq": HAMQConfig,
}
"""Every agent's settings, by the agent's name."""

CHUNKS = 100
"""Reports of progress per run, at most."""


def train_policy(
    config: AgentConfig,
    environment: Environment,
    options: Options,
    rules: Rules,
    length: int,
    seeds: Sequence[int],
    on_chunk: Callable[[History, float], bool] = lambda history, fraction: False,
    *,
    hierarchy: Hierarchy | None = None,
    graph: TaskGraph | None = None,
    tasks: Sequence[Task] | None = None,
    start: UnitedPolicy | None = None,
    checkpoints: Checkpoints | None = None,
) -> tuple[AnyPolicy, History]:
    """Train all seeds at once for `length` decisions each (all but DQN: primitive steps).

    HAMQ learns in `hierarchy`, MAXQ in `graph`, a united network the options that `tasks` are for, and h-DQN to choose
    among `tasks` as its goals (default: what the environment has ready-made); option-critic and STRAW make their own:
    the `options` of all these must be the primitive actions. What MAXQ leaves is the policy that asks anew from the
    root down at every step. A united network starts as that of `start`, the first seed as its first one and so on, in
    turn; it may have been trained on another grid if its shape has `pooling`.
    `on_chunk` gets what happened so far and the fraction of the run that is over, and may end the run by returning
    True. With `checkpoints` the run goes on from the newest one, and writes more; the other arguments must be the same
    as before. Processes that `jax.distributed` has joined share the seeds: each has to call this alike, and gets all
    policies.
    Raises `InvalidConfig`, `Diverged`, `TooManyStates`, `NoOptionAvailable`, `EnvironmentFailed`; with `checkpoints`
    `BadFile` and `CannotWrite`, too.
    """
    name = next(name for name, kind in AGENTS.items() if isinstance(config, kind))
    if isinstance(config, HAMQConfig):
        hierarchy = hierarchy or machines(environment)
    if isinstance(config, UnitedConfig | HDQNConfig):
        tasks = _tasks_for(config, environment, tasks)
    if checkpoints is not None and jax.process_count() > 1:
        raise InvalidConfig("Several processes that train together keep no checkpoints.")
    if checkpoints is not None and isinstance(environment, OutsideEnvironment):
        raise InvalidConfig("A Gymnasium environment keeps its state to itself, so there can be no checkpoints.")
    given = () if start is None else (_in_turn(start, len(seeds)),)
    with visit(environment):
        plan = _plan(config, environment, options, rules, length, hierarchy, graph, tasks, start)
        history = History(len(seeds), plan.choices)
        chunks = train(
            plan.algorithm,
            seeds,
            plan.rounds,
            -(-plan.rounds // CHUNKS),
            *given,
            begun=None
            if checkpoints is None
            else checkpoints.newest(carried(plan.algorithm, seeds, *given), history, plan.rounds),
        )
        for carry, chunk in chunks:
            history.add(chunk)
            steps = min(history.taken(position)[1] for position in range(len(seeds)))
            fraction = max(chunk.rounds / plan.rounds, steps / length if plan.ends_by_steps else 0.0)
            if on_chunk(history, min(fraction, 1.0)) or (plan.ends_by_steps and steps >= length):
                break
            if checkpoints is not None and chunk.rounds < plan.rounds:
                checkpoints.after_chunk(carry, history, chunk.rounds)
    every = process_allgather(plan.of_carry(carry), tiled=True)
    learned = plan.learned(jax.tree.map(lambda leaf: leaf[: len(seeds)], every))
    if isinstance(config, HAMQConfig):
        assert hierarchy is not None
        return MachinePolicy(name, environment, hierarchy, rules, learned, tuple(seeds)), history
    if isinstance(config, UnitedConfig | HDQNConfig):
        assert tasks is not None
        united_or_goals = UnitedPolicy if isinstance(config, UnitedConfig) else GoalPolicy
        return (
            united_or_goals(
                agent=name,
                environment=environment,
                tasks=tuple(tasks),
                option_cap=config.max_option_steps if isinstance(config, UnitedConfig) else config.goal_cap,
                rules=rules,
                shape=config.network,
                shared=config.shared,
                networks=learned,
                reward_scale=config.reward_scale,
                seeds=tuple(seeds),
            ),
            history,
        )
    if isinstance(config, OptionCriticConfig | DeepOptionCriticConfig):
        policy = OptionCriticPolicy(
            name, environment, rules, config.temperature, learned, tuple(seeds), plan.reward_scale
        )
        return policy, history
    if isinstance(config, StrawConfig):
        shape = config.network
        return PlanPolicy(name, environment, rules, shape, learned, config.reward_scale, tuple(seeds)), history
    return Policy(name, environment, options, rules, learned, plan.reward_scale, tuple(seeds)), history


def check_training(
    config: AgentConfig, environment: Environment, options: Options, rules: Rules, start: UnitedPolicy | None = None
) -> None:
    """Raise what `train_policy` would raise before it begins to train."""
    _plan(config, environment, options, rules, length=1, start=start)


class _Plan(NamedTuple):
    """How an agent is trained, and what of it is kept."""

    algorithm: Algorithm
    rounds: int
    of_carry: Callable[[Any], PyTree]
    """What a policy is made from, with a leading seed axis."""
    choices: tuple[str, ...]
    learned: Callable[[PyTree], PyTree] = partial(jax.tree.map, jnp.asarray)
    """What a policy keeps."""
    reward_scale: float = 1.0
    ends_by_steps: bool = False
    """Whether `rounds` is only a bound, as a round has no fixed number of steps."""


def _plan(
    config: AgentConfig,
    environment: Environment,
    options: Options,
    rules: Rules,
    length: int,
    hierarchy: Hierarchy | None = None,
    graph: TaskGraph | None = None,
    tasks: Sequence[Task] | None = None,
    start: UnitedPolicy | None = None,
) -> _Plan:
    if start is not None and not isinstance(config, UnitedConfig):
        raise InvalidConfig("Only a united network can start from one that was trained before.")
    if isinstance(environment, OutsideEnvironment) and (rules.step_limit, rules.decision_limit) != (None, None):
        raise InvalidConfig("A Gymnasium environment has a limit of its own, max_episode_steps: rules may have none.")
    match config:
        case DQNConfig():
            return _Plan(
                algorithm=dqn(config, environment, options, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.learner.network,
                choices=options.names,
                reward_scale=config.reward_scale,
            )
        case UnitedConfig():
            _refuse_options("A united network", options, environment)
            tasks = _tasks_for(config, environment, tasks)
            _check_start(config, environment, tasks, start)
            return _Plan(
                algorithm=united(config, environment, tasks, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.learner.network,
                choices=choices(tasks),
            )
        case HDQNConfig():
            _refuse_options("h-DQN", options, environment)
            tasks = _tasks_for(config, environment, tasks)
            return _Plan(
                algorithm=hdqn(config, environment, tasks, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.learner.network,
                choices=tuple(task.name for task in tasks),
            )
        case QLearningConfig():
            return _tables(q_learning(config, environment, options, rules, length), options, length)
        case SarsaConfig():
            return _tables(sarsa(config, environment, options, rules, length), options, length)
        case OptionCriticConfig():
            _refuse_options("Option-critic", options, environment)
            return _Plan(
                algorithm=option_critic(config, environment, rules, length),
                rounds=-(-length // STEPS_PER_ROUND),
                of_carry=lambda carry: carry.learned,
                choices=numbered_names(config.num_options),
            )
        case DeepOptionCriticConfig():
            _refuse_options("Option-critic", options, environment)
            return _Plan(
                algorithm=deep_option_critic(config, environment, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.network,
                choices=numbered_names(config.num_options),
                reward_scale=config.reward_scale,
            )
        case StrawConfig():
            _refuse_options("STRAW", options, environment)
            return _Plan(
                algorithm=straw(config, environment, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.network,
                choices=("plan",),
            )
        case IntraOptionConfig():
            return _tables(intra_option_q_learning(config, environment, options, rules, length), options, length)
        case HAMQConfig():
            _refuse_options("HAMQ", options, environment)
            hierarchy = hierarchy or machines(environment)
            # Every tick takes a step, or is a choice that leads straight to another one, or gives an episode up.
            ticks = length * (configurations(hierarchy).choices_in_a_row + isinstance(environment, OutsideEnvironment))
            return _Plan(
                algorithm=hamq(config, environment, hierarchy, rules, length),
                rounds=-(-ticks // TICKS_PER_ROUND),
                of_carry=lambda carry: carry.table,
                choices=process_of(environment, hierarchy).names,
                learned=np.asarray,
                ends_by_steps=True,
            )
        case MAXQConfig():
            _refuse_options("MAXQ", options, environment)
            graph = graph or task_graph(environment)
            return _Plan(
                algorithm=maxq(config, environment, graph, rules, length),
                rounds=rounds_for(graph, length),
                of_carry=lambda carry: carry.learned,
                choices=tasks_of(config, environment, graph).edge_names,
                learned=lambda learned: jnp.asarray(polled_values(config, environment, graph, learned)),
                ends_by_steps=True,
            )


def _tasks_for(
    config: UnitedConfig | HDQNConfig, environment: Environment, tasks: Sequence[Task] | None
) -> tuple[Task, ...]:
    """The given ones, or the ready-made ones. Raises `InvalidConfig` where there are none."""
    of_options = isinstance(config, UnitedConfig)
    if tasks is None:
        tasks = ready_made_tasks(environment) if of_options else ready_made_goals(environment)
    if not tasks:
        needs = "A united network learns options by their tasks" if of_options else "h-DQN chooses among goals"
        raise InvalidConfig(f"{needs}, and this environment has none; `train_policy` takes others as `tasks`.")
    return tuple(tasks)


def _check_start(
    config: UnitedConfig, environment: Environment, tasks: Sequence[Task], start: UnitedPolicy | None
) -> None:
    if start is None:
        if config.training == "manager":
            raise InvalidConfig(
                "training is 'manager', which needs a trained network to start from: it has the options."
            )
        return
    if start.choices != choices(tasks):
        raise InvalidConfig(
            f"The network to start from has the options {', '.join(start.choices[1:])}, but the new one has "
            f"{', '.join(choices(tasks)[1:])}."
        )
    if (start.shape, start.shared) != (config.network, config.shared):
        raise InvalidConfig(
            f"The network to start from is {start.shape} and shares {start.shared!r}, but the new one would be "
            f"{config.network} and share {config.shared!r}; they have to be the same."
        )
    seen, seen_before = observation_shape(environment), observation_shape(start.environment)
    if config.network.pooling:
        seen, seen_before = seen[2:], seen_before[2:]
    if seen != seen_before:
        raise InvalidConfig(
            "The network to start from was trained on observations of another shape; only one with pooling fits "
            "pictures of several sizes."
        )


def _in_turn(start: UnitedPolicy, seeds: int) -> UnitedNetwork:
    positions = np.arange(seeds) % len(start.seeds)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[positions], start.networks)


def _refuse_options(agent: str, options: Options, environment: Environment) -> None:
    if options.names != environment.action_names:
        raise InvalidConfig(f"{agent} brings its own choices: it takes no options.")


def _tables(algorithm: Algorithm, options: Options, steps: int) -> _Plan:
    """Of a learner of one table of option values."""
    return _Plan(algorithm, -(-steps // STEPS_PER_ROUND), lambda carry: carry.table, options.names)
