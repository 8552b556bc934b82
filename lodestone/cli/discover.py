"""`lodestone discover ENVIRONMENT --method METHOD`: find options without being told where to look."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from lodestone.agents.saved import save_options
from lodestone.cli.parsing import parse, settings_of, take_environment, take_setting
from lodestone.cli.printing import print_json
from lodestone.discovery.betweenness import Bottlenecks
from lodestone.discovery.catalogue import (
    METHODS,
    Discovery,
    Found,
    MethodConfig,
    Source,
    diffusion_times,
    discover,
)
from lodestone.discovery.covering import Covering
from lodestone.discovery.diverse_density import DenseSubgoals
from lodestone.discovery.eigenoptions import Eigenoptions
from lodestone.discovery.experience import Recording
from lodestone.envs.base import Environment
from lodestone.envs.registry import describe_environment
from lodestone.errors import InvalidConfig
from lodestone.files import prepare_folder
from lodestone.planning.tables import state_text

MethodT = TypeVar("MethodT", bound=MethodConfig)
EnvironmentT = TypeVar("EnvironmentT", bound=Environment)

FEW_STATES = 500
"""Up to so many states the diffusion time is computed unasked: it takes about a second."""


@dataclass(frozen=True)
class Discover(Generic[MethodT, EnvironmentT]):
    """Discover options of an environment: --method diverse-density, betweenness, eigenoptions or covering."""

    method_settings: MethodT
    environment: EnvironmentT
    source: Annotated[Source, tyro.conf.arg(name="from")] = "tables"
    """What is known of the world: everything, or only what random trajectories have shown."""
    trajectories: int = 100
    """How many are recorded, where any are."""
    steps: int = 1000
    """Primitive steps of each trajectory, unless the environment ends it sooner."""
    seed: int = 0
    """Of the trajectories."""
    diffusion_time: bool = False
    """Compute the diffusion time also where there are many states; it takes memory for two dense matrices an option."""
    out: Path | None = None
    """File to write, for `train --options` (.safetensors)."""
    picture: Path | None = None
    """Draw what the sub-goals are the peaks of (.png), where states are squares of a grid."""
    json: bool = False
    """Print one JSON object."""


def run(words: list[str]) -> None:
    """Parse the words after `discover` and discover."""
    name, environment, rest = take_environment("discover", words)
    method, rest = take_setting("method", tuple(METHODS), f"discover {name}", rest)
    settings = settings_of(Discover, METHODS[method], environment)
    _discover(parse(settings, f"discover {name} --method {method}", rest), method)


def _discover(settings: Discover, method: str) -> None:
    environment = settings.environment
    recording = Recording(settings.trajectories, settings.steps, settings.seed)
    for path in (settings.out, settings.picture):
        if path is not None:
            prepare_folder(path.parent)
    found = discover(environment, settings.method_settings, settings.source, recording)
    if settings.picture is not None and found.squares is None:
        raise InvalidConfig("A picture can only be drawn where states are squares of a grid; leave --picture out.")
    heading, numbers = _by_option(found.found)
    sizes = np.sum(found.options.initiation_table, axis=0)
    content = {
        "environment": describe_environment(environment),
        "method": method,
        "from": settings.source,
        "states": found.space.size,
        "states_seen": found.seen,
        "steps_recorded": found.steps,
        "subgoals": [_readable(found, int(subgoal)) for subgoal in found.found.subgoals],
        "options": [
            {"name": name, "initiation_states": int(size), heading: number}
            for name, size, number in zip(found.options.names, sizes, numbers, strict=True)
        ],
        **_in_all(found),
    }
    if settings.diffusion_time or found.space.size <= FEW_STATES:
        alone, together = diffusion_times(environment, found.options)
        content |= {"diffusion_time_of_primitives": alone, "diffusion_time": together}
    content |= {"out": settings.out, "picture": settings.picture}
    if settings.out is not None:
        save_options(settings.out, found.options, environment)
    if settings.picture is not None:
        from lodestone.report.discovery_picture import write_picture  # matplotlib is only needed here

        write_picture(found, settings.picture)
    if settings.json:
        print_json(content)
        return
    _print(content, settings)


def _readable(discovery: Discovery, state: int) -> list[int] | str:
    """[row, column], or the state in words."""
    if discovery.squares is not None:
        return [int(number) for number in discovery.squares[state]]
    return state_text(discovery.space, state)


def _by_option(found: Found) -> tuple[str, list[float]]:
    """What the method has to say of each option."""
    match found:
        case DenseSubgoals():
            return "log_density", [float(found.log_density[subgoal]) for subgoal in found.subgoals]
        case Bottlenecks():
            return "betweenness", [float(found.centrality[subgoal]) for subgoal in found.subgoals]
        case Eigenoptions():
            return "eigenvalue", [float(value) for value in np.repeat(found.eigenvalues, 2)]
        case Covering():
            return "lambda_2", [found.connectivity[pair + 1] for pair in found.pair_of]


def _in_all(discovery: Discovery) -> dict[str, Any]:
    """What it has to say of all."""
    found = discovery.found
    match found:
        case DenseSubgoals():
            return {"successful_trajectories": found.successes}
        case Eigenoptions():
            return {"eigenvalues": found.eigenvalues}
        case Covering():
            pairs = [[_readable(discovery, end) for end in pair] for pair in found.pairs]
            return {"pairs": pairs, "lambda_2": found.connectivity}
    return {}


def _print(content: dict[str, Any], settings: Discover) -> None:
    name = content["environment"]["name"]
    known = f"{content['states_seen']:,} of {content['states']:,} states known"
    if content["steps_recorded"]:
        known += f", {content['steps_recorded']:,} steps recorded"
    number = next(key for key in content["options"][0] if key not in ("name", "initiation_states"))
    table = Table(title=f"{content['method']} on {name} ({known})", title_justify="left")
    table.add_column("option")
    table.add_column("goes to")
    table.add_column("may start in states", justify="right")
    table.add_column(number.replace("_", " "), justify="right")
    for one, subgoal in zip(content["options"], content["subgoals"], strict=True):
        table.add_row(one["name"], str(subgoal), f"{one['initiation_states']:,}", f"{one[number]:.5g}")
    Console().print(table)
    if "lambda_2" in content:
        print(f"lambda_2 without options: {content['lambda_2'][0]:.5g}.")
    if "diffusion_time" in content:
        alone, together = content["diffusion_time_of_primitives"], content["diffusion_time"]
        print(f"Diffusion time: {alone:.2f} steps by primitive actions, {together:.2f} with the options.")
    for path in (settings.out, settings.picture):
        if path is not None:
            print(f"Wrote {path}.")
    if settings.out is not None:
        print(f"`lodestone train AGENT {name} --options {settings.out}` takes the options, with the same parameters.")
