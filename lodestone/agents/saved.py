"""Policies and option sets as files: arrays, and a recipe in JSON from which known kinds are built again.

Nothing else is run on loading: a file from a stranger can at worst be refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lodestone import __version__
from lodestone.agents.deep_option_critic import DeepOptionCriticConfig
from lodestone.agents.option_critic import OptionCriticConfig, nothing_learned
from lodestone.agents.policies import (
    AnyPolicy,
    GoalPolicy,
    MachinePolicy,
    OptionCriticPolicy,
    PlanPolicy,
    Policy,
    UnitedPolicy,
)
from lodestone.envs.base import Environment, example_state, observation_shape
from lodestone.envs.registry import describe_environment, make_environment
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Looks, Task, goal, looks
from lodestone.errors import BadFile, InvalidConfig, LodestoneError, check_name
from lodestone.files import read_arrays, write_arrays
from lodestone.learning.goal_network import init_goal_network
from lodestone.learning.named_arrays import Arrays, fill, named_arrays, take
from lodestone.learning.networks import Convolution, Linear, NetworkConfig, QNetwork, init_q_network
from lodestone.learning.option_network import OptionNetwork, init_option_network, shown_shape
from lodestone.learning.plan_network import PlanConfig, init_plan_network
from lodestone.learning.united_network import init_united_network
from lodestone.machines.catalogue import machines
from lodestone.options.base import Capped, Options, Primitives, Union, primitives
from lodestone.options.catalogue import goals, scripted_options, task_named, tasks
from lodestone.options.execution import Rules
from lodestone.options.networks import NetworkOptions
from lodestone.options.scripted import Scripted
from lodestone.options.tabular import TabularOptions
from lodestone.planning.enumerated import numbering
from lodestone.planning.joint import joint_process
from lodestone.settings import check_numbers

Recipe = dict[str, Any]
T = TypeVar("T")


def save_policy(path: Path, policy: AnyPolicy) -> None:
    """Write one file. Raises `CannotWrite`."""
    if isinstance(policy, MachinePolicy):
        _save_machine_policy(path, policy)
        return
    if isinstance(policy, UnitedPolicy | GoalPolicy):
        _save_heads(path, policy)
        return
    if isinstance(policy, OptionCriticPolicy):
        _save_option_critic_policy(path, policy)
        return
    if isinstance(policy, PlanPolicy):
        _save_plan_policy(path, policy)
        return
    recipe, arrays = _describe_options(policy.options, "options")
    network = _describe_network(policy.learned) if isinstance(policy.learned, QNetwork) else None
    header = {
        "kind": "policy",
        "version": __version__,
        "agent": policy.agent,
        "environment": describe_environment(policy.environment),
        "options": recipe,
        "rules": asdict(policy.rules),
        "network": network,
        "reward_scale": policy.reward_scale,
        "seeds": list(policy.seeds),
    }
    write_arrays(path, arrays | named_arrays(policy.learned, "learned"), header)


def _save_machine_policy(path: Path, policy: MachinePolicy) -> None:
    if policy.hierarchy != machines(policy.environment):
        raise InvalidConfig("Only policies of an environment's ready-made machines can be saved.")
    header = {
        "kind": "policy",
        "version": __version__,
        "agent": policy.agent,
        "environment": describe_environment(policy.environment),
        "machines": policy.process.configurations.hierarchy.root,
        "rules": asdict(policy.rules),
        "seeds": list(policy.seeds),
    }
    write_arrays(path, {"tables": np.asarray(policy.tables)}, header)


class _Heads(NamedTuple):
    """A kind of policy of networks with one head, or more, for each of some tasks."""

    policy: type[UnitedPolicy] | type[GoalPolicy]
    init: Callable[..., PyTree]
    ready_made: Callable[[Environment], tuple[Task, ...]]


HEADS = {
    "united": _Heads(UnitedPolicy, init_united_network, tasks),
    "goals": _Heads(GoalPolicy, init_goal_network, goals),
}
"""By the name of their recipe."""


def _save_heads(path: Path, policy: UnitedPolicy | GoalPolicy) -> None:
    name, kind = next((name, kind) for name, kind in HEADS.items() if isinstance(policy, kind.policy))
    arrays, environment = named_arrays(policy.networks, "learned"), policy.environment
    for position, task in enumerate(policy.tasks):
        if task in kind.ready_made(environment):
            continue
        if not isinstance(task.stop, Looks) or task != goal(environment, task.name, task.stop):
            raise InvalidConfig(
                "Only networks for an environment's ready-made tasks or goals, or for goals that are given by what is "
                "seen there, can be saved."
            )
        arrays[f"looks/{position}"] = task.stop.observation.astype(_seen(environment).dtype)
    header = {
        "kind": "policy",
        "version": __version__,
        "agent": policy.agent,
        "environment": describe_environment(environment),
        name: {
            "tasks": [task.name for task in policy.tasks],
            "option_cap": policy.option_cap,
            "shape": asdict(policy.shape),
            "shared": policy.shared,
        },
        "rules": asdict(policy.rules),
        "reward_scale": policy.reward_scale,
        "seeds": list(policy.seeds),
    }
    write_arrays(path, arrays, header)


def _seen(environment: Environment) -> jax.ShapeDtypeStruct:
    """Shape and dtype of what an agent sees."""
    return jax.eval_shape(environment.observe, example_state(environment))


def _save_option_critic_policy(path: Path, policy: OptionCriticPolicy) -> None:
    recipe: Recipe = {"num_options": policy.learned.num_options, "temperature": policy.temperature}
    if isinstance(policy.learned, OptionNetwork):
        trunk = policy.learned.trunk
        shape = _describe_layers(trunk.convolutions, trunk.layers, trunk.pooling)
        recipe |= {"shape": shape, "reward_scale": policy.reward_scale}
    header = {
        "kind": "policy",
        "version": __version__,
        "agent": policy.agent,
        "environment": describe_environment(policy.environment),
        "option_critic": recipe,
        "rules": asdict(policy.rules),
        "seeds": list(policy.seeds),
    }
    write_arrays(path, named_arrays(policy.learned, "learned"), header)


def _save_plan_policy(path: Path, policy: PlanPolicy) -> None:
    header = {
        "kind": "policy",
        "version": __version__,
        "agent": policy.agent,
        "environment": describe_environment(policy.environment),
        "plans": {"shape": asdict(policy.shape), "plan": asdict(policy.networks.shape)},
        "rules": asdict(policy.rules),
        "reward_scale": policy.reward_scale,
        "seeds": list(policy.seeds),
    }
    write_arrays(path, named_arrays(policy.networks, "learned"), header)


def load_policy(path: Path) -> AnyPolicy:
    """Raises `BadFile`."""
    arrays, header = _read(path, "policy")

    def build() -> AnyPolicy:
        environment = make_environment(header["environment"]["name"], **header["environment"]["parameters"])
        if "machines" in header:
            return _build_machine_policy(environment, header, arrays)
        for name, kind in HEADS.items():
            if name in header:
                return _build_heads(kind, header[name], environment, header, arrays)
        if "option_critic" in header:
            return _build_option_critic_policy(environment, header, arrays)
        if "plans" in header:
            return _build_plan_policy(environment, header, arrays)
        options = _build_options(header["options"], arrays, "options", environment)
        seeds = tuple(int(seed) for seed in header["seeds"])
        if header["network"] is None:
            shape = (len(seeds), numbering(environment).size, options.size)
            template: PyTree = jax.ShapeDtypeStruct(shape, jnp.float32)
        else:
            template = _network_template(header["network"], environment, options.size, len(seeds))
        learned = fill(template, arrays, "learned")
        rules = Rules(**header["rules"])
        return Policy(header["agent"], environment, options, rules, learned, float(header["reward_scale"]), seeds)

    return refuse_bad(path, build)


def _build_machine_policy(environment: Environment, header: Recipe, arrays: Arrays) -> MachinePolicy:
    seeds = tuple(int(seed) for seed in header["seeds"])
    hierarchy = machines(environment)
    process = joint_process(environment, hierarchy)
    template = {"tables": jax.ShapeDtypeStruct((len(seeds), *process.edges.shape), jnp.float32)}
    tables = np.asarray(fill(template, {"['tables']": arrays["tables"]}, "")["tables"])
    if not np.array_equal(np.isneginf(tables), np.broadcast_to(~process.available, tables.shape)):
        raise BadFile("its values are of other machines.")
    return MachinePolicy(str(header["agent"]), environment, hierarchy, Rules(**header["rules"]), tables, seeds)


def _build_heads(
    kind: _Heads, recipe: Recipe, environment: Environment, header: Recipe, arrays: Arrays
) -> UnitedPolicy | GoalPolicy:
    seeds = tuple(int(seed) for seed in header["seeds"])
    known = {task.name: task for task in kind.ready_made(environment)}
    shape, shared = _build_shape(recipe["shape"]), recipe["shared"]
    seen = _seen(environment)

    def task(position: int, name: str) -> Task:
        if f"looks/{position}" in arrays:
            return goal(environment, str(name), looks(take(arrays, f"looks/{position}", seen.shape, seen.dtype)))
        check_name("task", name, tuple(known))
        return known[name]

    chosen = tuple(task(position, name) for position, name in enumerate(recipe["tasks"]))
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), len(seeds)))
    template = jax.eval_shape(
        jax.vmap(lambda key: kind.init(shape, shared, seen.shape, environment.num_actions, len(chosen), key)), keys
    )
    return kind.policy(
        agent=str(header["agent"]),
        environment=environment,
        tasks=chosen,
        option_cap=int(recipe["option_cap"]),
        rules=Rules(**header["rules"]),
        shape=shape,
        shared=shared,
        networks=fill(template, arrays, "learned"),
        reward_scale=float(header["reward_scale"]),
        seeds=seeds,
    )


def _build_option_critic_policy(environment: Environment, header: Recipe, arrays: Arrays) -> OptionCriticPolicy:
    recipe, seeds = dict(header["option_critic"]), tuple(int(seed) for seed in header["seeds"])
    actions = environment.num_actions
    if "shape" in recipe:
        deep = DeepOptionCriticConfig(network=_build_shape(recipe.pop("shape")), **recipe)
        seen, reward_scale = shown_shape(environment), deep.reward_scale
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), len(seeds)))
        template: PyTree = jax.eval_shape(
            jax.vmap(lambda key: init_option_network(deep.network, seen, deep.num_options, actions, key)), keys
        )
        temperature = deep.temperature
    else:
        config = OptionCriticConfig(**recipe)
        shape = (len(seeds), numbering(environment).size, config.num_options)
        template = jax.eval_shape(lambda: nothing_learned(shape, actions))
        temperature, reward_scale = config.temperature, 1.0
    return OptionCriticPolicy(
        agent=str(header["agent"]),
        environment=environment,
        rules=Rules(**header["rules"]),
        temperature=temperature,
        learned=fill(template, arrays, "learned"),
        seeds=seeds,
        reward_scale=reward_scale,
    )


def _build_plan_policy(environment: Environment, header: Recipe, arrays: Arrays) -> PlanPolicy:
    recipe, seeds = header["plans"], tuple(int(seed) for seed in header["seeds"])
    shape, plan = _build_shape(recipe["shape"]), PlanConfig(**recipe["plan"])
    seen, rows = observation_shape(environment), environment.num_actions + 1
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), len(seeds)))
    template = jax.eval_shape(jax.vmap(lambda key: init_plan_network(shape, plan, seen, rows, key)), keys)
    return PlanPolicy(
        agent=str(header["agent"]),
        environment=environment,
        rules=Rules(**header["rules"]),
        shape=shape,
        networks=fill(template, arrays, "learned"),
        reward_scale=float(header["reward_scale"]),
        seeds=seeds,
    )


def save_options(path: Path, options: Options, environment: Environment) -> None:
    """Write one file. Raises `CannotWrite`."""
    recipe, arrays = _describe_options(options, "options")
    header = {
        "kind": "options",
        "version": __version__,
        "environment": describe_environment(environment),
        "options": recipe,
    }
    write_arrays(path, arrays, header)


def load_options(path: Path, environment: Environment) -> Options:
    """Options for `environment`. Raises `BadFile`, also where they were made for observations of another shape."""
    arrays, header = _read(path, "options")
    return refuse_bad(path, lambda: _build_options(header["options"], arrays, "options", environment))


def _read(path: Path, kind: str) -> tuple[Arrays, Recipe]:
    arrays, header = read_arrays(path)
    if header.get("kind") != kind:
        raise BadFile(f"{path} holds {header.get('kind', 'something else')!s:.60}, but {kind} were expected.")
    refuse_bad(path, lambda: check_numbers(header, "it"))
    return arrays, header


def refuse_bad(path: Path, build: Callable[[], T]) -> T:
    """`build()`, with whatever is wrong with a recipe turned into one sentence."""
    try:
        return build()
    except BadFile as error:
        raise BadFile(f"{path}: {error}") from None
    except LodestoneError as error:
        raise BadFile(f"{path} does not fit: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError):
        raise BadFile(f"{path} is damaged, or from another version than {__version__}.") from None


def _describe_options(options: Options, prefix: str) -> tuple[Recipe, Arrays]:
    match options:
        case Primitives():
            return {"kind": "primitives"}, {}
        case Scripted():
            return {"kind": "scripted", "names": list(options.names)}, {}
        case NetworkOptions():
            network = _describe_network(cast(QNetwork, options.networks))
            return {
                "kind": "networks",
                "names": list(options.names),
                "network": network,
            }, named_arrays(options.networks, prefix)
        case TabularOptions():
            tables = named_arrays({name: getattr(options, name) for name in TABLES}, prefix)
            return {"kind": "tabular", "names": list(options.names), "caps": list(options.caps)}, tables
        case Capped():
            recipe, arrays = _describe_options(options.options, prefix)
            return {"kind": "capped", "cap": options.cap, "options": recipe}, arrays
        case Union():
            parts = [_describe_options(part, f"{prefix}/{index}") for index, part in enumerate(options.parts)]
            merged = {name: array for _, arrays in parts for name, array in arrays.items()}
            return {"kind": "union", "parts": [recipe for recipe, _ in parts]}, merged
    raise InvalidConfig(f"Options of the kind {type(options).__name__} cannot be saved.")


TABLES = ("initiation_table", "policy_table", "termination_table")
"""The arrays of tabular options."""


def _build_options(recipe: Recipe, arrays: Arrays, prefix: str, environment: Environment) -> Options:
    match recipe["kind"]:
        case "primitives":
            return primitives(environment)
        case "scripted":
            return scripted_options(environment, recipe["names"])
        case "networks":
            tasks = tuple(task_named(environment, name) for name in recipe["names"])
            template = _network_template(recipe["network"], environment, environment.num_actions, len(tasks))
            return NetworkOptions(tasks, fill(template, arrays, prefix))
        case "tabular":
            space = reachable_states(environment)
            names, caps = tuple(recipe["names"]), tuple(recipe["caps"])
            shape = (space.size, len(names))
            tables = {
                "initiation_table": jax.ShapeDtypeStruct(shape, bool),
                "policy_table": jax.ShapeDtypeStruct((*shape, environment.num_actions), jnp.float32),
                "termination_table": jax.ShapeDtypeStruct(shape, jnp.float32),
            }
            return TabularOptions(space, names, caps, **fill(tables, arrays, prefix))
        case "capped":
            return Capped(_build_options(recipe["options"], arrays, prefix, environment), int(recipe["cap"]))
        case "union":
            parts = enumerate(recipe["parts"])
            return Union(tuple(_build_options(part, arrays, f"{prefix}/{index}", environment) for index, part in parts))
    raise BadFile(f"options of an unknown kind, {recipe['kind']!r:.60}.")


def _describe_network(network: QNetwork) -> Recipe:
    """The shape of a network whose arrays have one leading axis."""
    return _describe_layers(network.convolutions, network.layers[:-1], network.pooling)


def _describe_layers(convolutions: Sequence[Convolution], hidden: Sequence[Linear], pooling: bool) -> Recipe:
    """The same of its layers, without the last one."""
    return asdict(
        NetworkConfig(
            kernels=tuple(layer.weight.shape[1] for layer in convolutions),
            strides=tuple(layer.stride for layer in convolutions),
            channels=tuple(layer.weight.shape[-1] for layer in convolutions),
            hidden=tuple(layer.weight.shape[-1] for layer in hidden),
            pooling=pooling,
        )
    )


def _build_shape(recipe: Recipe) -> NetworkConfig:
    widths = {name: tuple(int(number) for number in recipe[name]) for name in WIDTHS}
    return NetworkConfig(**widths, pooling=bool(recipe["pooling"]))


WIDTHS = ("kernels", "strides", "channels", "hidden")
"""The numbers of a network's shape."""


def _network_template(recipe: Recipe, environment: Environment, outputs: int, count: int) -> QNetwork:
    """Shapes and dtypes of `count` stacked networks for this environment's observations."""
    config, seen = _build_shape(recipe), observation_shape(environment)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), count))
    return jax.eval_shape(jax.vmap(lambda key: init_q_network(config, seen, outputs, key)), keys)
