"""What a training run is, in full and in a folder: enough to train it again to the same bits.

config.json has the settings, options.safetensors what the agent chooses from, and start.safetensors what a united
network starts as; nothing outside the folder is needed.
"""

from __future__ import annotations

import math
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lodestone import __version__
from lodestone.agents.policies import AnyPolicy, UnitedPolicy
from lodestone.agents.saved import load_options, load_policy, refuse_bad, save_options, save_policy
from lodestone.agents.training import AGENTS, AgentConfig
from lodestone.envs.base import Environment
from lodestone.envs.host import Registered
from lodestone.envs.registry import GYMNASIUM, describe_environment, environment_class, make_environment
from lodestone.errors import BadFile, InvalidConfig, check_name
from lodestone.files import read_json, write_json
from lodestone.learning.checkpoints import FORMAT
from lodestone.options.base import Options
from lodestone.options.execution import Rules
from lodestone.settings import check_numbers, from_json

CONFIG, OPTIONS, START, POLICY = "config.json", "options.safetensors", "start.safetensors", "policy.safetensors"


@dataclass(frozen=True)
class Versions:
    """Of what decides a run's bits. Default: what is installed."""

    lodestone: str = __version__
    jax: str = jax.__version__
    numpy: str = np.__version__
    python: str = platform.python_version()


@dataclass(frozen=True)
class Run:
    """What is trained."""

    agent: AgentConfig
    environment: Environment
    rules: Rules
    options: Options
    steps: int
    """Primitive steps per seed."""
    seeds: tuple[int, ...]
    start: UnitedPolicy | None = None
    """What a united network starts as."""
    from_run: str | None = None
    """Where that was read."""
    checkpoint_every: float = 60.0
    """Seconds from one checkpoint to the next, at least."""
    versions: Versions = Versions()

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InvalidConfig(f"steps is {self.steps}, but must be at least 1.")
        if not self.seeds:
            raise InvalidConfig("Training needs at least one seed.")
        if len(set(self.seeds)) < len(self.seeds):
            raise InvalidConfig("seeds must differ from one another.")
        if not all(-(2**31) <= seed < 2**31 for seed in self.seeds):
            raise InvalidConfig(f"seeds must be from {-(2**31)} to {2**31 - 1}.")
        if not 0 <= self.checkpoint_every < math.inf:
            raise InvalidConfig(f"checkpoint_every is {self.checkpoint_every}, but must be 0 or more seconds.")

    @property
    def agent_name(self) -> str:
        """As in `AGENTS`."""
        return next(name for name, kind in AGENTS.items() if isinstance(self.agent, kind))


@dataclass(frozen=True)
class _Plain:
    """What JSON says of a run beside its agent and its environment."""

    format: int
    versions: Versions
    rules: Rules
    options: tuple[str, ...]
    from_run: str | None
    steps: int
    seeds: tuple[int, ...]
    checkpoint_every: float


def save_run(folder: Path, run: Run) -> None:
    """Write what is trained; config.json comes last. Raises `CannotWrite`."""
    save_options(folder / OPTIONS, run.options, run.environment)
    if run.start is not None:
        save_policy(folder / START, run.start)
    plain = _Plain(
        format=FORMAT,
        versions=run.versions,
        rules=run.rules,
        options=run.options.names,
        from_run=run.from_run,
        steps=run.steps,
        seeds=run.seeds,
        checkpoint_every=run.checkpoint_every,
    )
    config = {
        "agent": {"name": run.agent_name, **asdict(run.agent)},
        "environment": describe_environment(run.environment),
        **asdict(plain),
    }
    write_json(folder / CONFIG, config)


def read_run(folder: Path) -> Run:
    """What `save_run` wrote. Raises `BadFile`."""
    path = folder / CONFIG
    content = read_json(path)
    agent, environment, plain = refuse_bad(path, lambda: _settings(dict(content)))
    options = load_options(folder / OPTIONS, environment)
    if options.names != plain.options:
        raise BadFile(f"{folder / OPTIONS} has other options than {CONFIG} names.")
    start = None if plain.from_run is None else load_start(folder / START)
    return refuse_bad(
        path,
        lambda: Run(
            agent=agent,
            environment=environment,
            rules=plain.rules,
            options=options,
            steps=plain.steps,
            seeds=plain.seeds,
            start=start,
            from_run=plain.from_run,
            checkpoint_every=plain.checkpoint_every,
            versions=plain.versions,
        ),
    )


def _settings(content: dict[str, Any]) -> tuple[AgentConfig, Environment, _Plain]:
    if content["format"] != FORMAT:
        raise InvalidConfig(f"its format is {content['format']!r}, and version {__version__} reads {FORMAT}.")
    check_numbers(content, "it")
    agent, world = dict(content.pop("agent")), dict(content.pop("environment"))
    name, world_name, parameters = agent.pop("name"), world.pop("name"), world.pop("parameters")
    check_name("agent", name, tuple(AGENTS))
    if world:
        raise InvalidConfig(f"an environment has no {next(iter(world))!r}.")
    kind = Registered if world_name == GYMNASIUM else environment_class(world_name)
    checked = describe_environment(from_json(kind, parameters, world_name))
    environment = make_environment(world_name, **checked["parameters"])  # which imports nothing for a stranger
    return from_json(AGENTS[name], agent, name), environment, from_json(_Plain, content, "a run")


def load_start(path: Path) -> UnitedPolicy:
    """The policy of a united network, of a run or a file. Raises `BadFile`, and `InvalidConfig` for another agent's."""
    policy = load_run(path)
    if not isinstance(policy, UnitedPolicy):
        raise InvalidConfig(f"{path} holds a policy of {policy.agent}; only a united network can be started from.")
    return policy


def load_run(path: Path) -> AnyPolicy:
    """The policy of a run's folder, or of a policy file. Raises `BadFile`, also for a run that is not finished."""
    if (path / CONFIG).exists() and not is_finished(path):
        raise BadFile(unfinished(path))
    return load_policy(path / POLICY if path.is_dir() else path)


def is_finished(path: Path) -> bool:
    """Whether the run in this folder has nothing left to train. Raises `BadFile` where there is no run."""
    if not (path / CONFIG).exists():
        raise BadFile(f"{path} holds no run: there is no {CONFIG}.")
    return (path / POLICY).exists()


def unfinished(path: Path) -> str:
    """What to do with a run that is not finished."""
    return f"{path} holds an unfinished run; `lodestone resume {path}` goes on with it."
