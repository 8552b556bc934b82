"""Training any agent on any environment, from settings to policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.agents.hamq import TICKS_PER_ROUND, HAMQConfig, hamq
from lodestone.agents.intra_option import IntraOptionConfig, intra_option_q_learning
from lodestone.agents.maxq import MAXQConfig, as_configured, maxq, polled_values, rounds_for
from lodestone.agents.option_critic import OptionCriticConfig, option_critic
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.sarsa import SarsaConfig, sarsa
from lodestone.agents.saved import AnyPolicy, MachinePolicy, OptionCriticPolicy, Policy, UnitedPolicy
from lodestone.agents.united import UnitedConfig, united
from lodestone.envs.base import Environment
from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig
from lodestone.learning.history import History
from lodestone.learning.loop import Algorithm, train
from lodestone.learning.united_execution import choices
from lodestone.machines.catalogue import machines
from lodestone.machines.configurations import configurations
from lodestone.machines.machine import Hierarchy
from lodestone.options.base import Options
from lodestone.options.catalogue import tasks as ready_made_tasks
from lodestone.options.execution import Rules
from lodestone.options.soft import numbered_names
from lodestone.planning.joint import joint_process
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.task_graph import TaskGraph, tabulate_tasks

AgentConfig = (
    DQNConfig
    | UnitedConfig
    | QLearningConfig
    | SarsaConfig
    | IntraOptionConfig
    | OptionCriticConfig
    | MAXQConfig
    | HAMQConfig
)

AGENTS: dict[str, type[AgentConfig]] = {
    "dqn": DQNConfig,
    "united": UnitedConfig,
    "q-learning": QLearningConfig,
    "sarsa": SarsaConfig,
    "intra-option": IntraOptionConfig,
    "option-critic": OptionCriticConfig,
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
) -> tuple[AnyPolicy, History]:
    """Train all seeds at once for `length` decisions each (tabular agents and united networks: primitive steps).

    HAMQ learns in `hierarchy`, MAXQ in `graph`, and a united network the options that `tasks` are for (default: what
    the environment has ready-made); option-critic makes its own: their `options` must be the primitive actions. What
    MAXQ leaves is the policy that asks anew from the root down at every step.
    `on_chunk` gets what happened so far and the fraction of the run that is over, and may end the run by returning
    True.
    Raises `InvalidConfig`, `Diverged`, `TooManyStates`, `NoOptionAvailable`.
    """
    name = next(name for name, kind in AGENTS.items() if isinstance(config, kind))
    if isinstance(config, HAMQConfig):
        hierarchy = hierarchy or machines(environment)
    if isinstance(config, UnitedConfig):
        tasks = tuple(ready_made_tasks(environment) if tasks is None else tasks)
    plan = _plan(config, environment, options, rules, length, hierarchy, graph, tasks)
    history = History(len(seeds), plan.choices)
    for carry, chunk in train(plan.algorithm, seeds, plan.rounds, -(-plan.rounds // CHUNKS)):
        history.add(chunk)
        steps = min(history.taken(position)[1] for position in range(len(seeds)))
        fraction = max(chunk.rounds / plan.rounds, steps / length if plan.ends_by_steps else 0.0)
        if on_chunk(history, min(fraction, 1.0)) or (plan.ends_by_steps and steps >= length):
            break
    learned = plan.learned(jax.tree.map(lambda leaf: np.asarray(leaf)[: len(seeds)], plan.of_carry(carry)))
    if isinstance(config, HAMQConfig):
        assert hierarchy is not None
        return MachinePolicy(name, environment, hierarchy, rules, learned, tuple(seeds)), history
    if isinstance(config, UnitedConfig):
        assert tasks is not None
        return (
            UnitedPolicy(
                agent=name,
                environment=environment,
                tasks=tuple(tasks),
                option_cap=config.max_option_steps,
                rules=rules,
                shape=config.network,
                shared=config.shared,
                networks=learned,
                reward_scale=config.reward_scale,
                seeds=tuple(seeds),
            ),
            history,
        )
    if isinstance(config, OptionCriticConfig):
        return OptionCriticPolicy(name, environment, rules, config.temperature, learned, tuple(seeds)), history
    return Policy(name, environment, options, rules, learned, plan.reward_scale, tuple(seeds)), history


def check_training(config: AgentConfig, environment: Environment, options: Options, rules: Rules) -> None:
    """Raise what `train_policy` would raise before it begins to train."""
    _plan(config, environment, options, rules, length=1)


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
) -> _Plan:
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
            tasks = ready_made_tasks(environment) if tasks is None else tasks
            if not tasks:
                raise InvalidConfig("A united network learns options by their tasks, and this environment has none.")
            return _Plan(
                algorithm=united(config, environment, tasks, rules, length),
                rounds=config.rounds(length),
                of_carry=lambda carry: carry.learner.network,
                choices=choices(tasks),
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
        case IntraOptionConfig():
            return _tables(intra_option_q_learning(config, environment, options, rules, length), options, length)
        case HAMQConfig():
            _refuse_options("HAMQ", options, environment)
            hierarchy = hierarchy or machines(environment)
            return _Plan(
                algorithm=hamq(config, environment, hierarchy, rules, length),
                # Every tick takes a step, or is a choice that leads straight to another one.
                rounds=-(-length * configurations(hierarchy).choices_in_a_row // TICKS_PER_ROUND),
                of_carry=lambda carry: carry.table,
                choices=joint_process(environment, hierarchy).names,
                learned=np.asarray,
                ends_by_steps=True,
            )
        case MAXQConfig():
            _refuse_options("MAXQ", options, environment)
            graph = graph or task_graph(environment)
            tables = tabulate_tasks(as_configured(config, graph), environment, tabulate(environment))
            return _Plan(
                algorithm=maxq(config, environment, graph, rules, length),
                rounds=rounds_for(graph, length),
                of_carry=lambda carry: carry.learned,
                choices=tables.edge_names,
                learned=lambda learned: jnp.asarray(polled_values(config, environment, graph, learned)),
                ends_by_steps=True,
            )


def _refuse_options(agent: str, options: Options, environment: Environment) -> None:
    if options.names != environment.action_names:
        raise InvalidConfig(f"{agent} brings its own choices: it takes no options.")


def _tables(algorithm: Algorithm, options: Options, steps: int) -> _Plan:
    """Of a learner of one table of option values."""
    return _Plan(algorithm, -(-steps // STEPS_PER_ROUND), lambda carry: carry.table, options.names)
