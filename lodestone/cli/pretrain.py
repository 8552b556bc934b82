"""`lodestone pretrain ENVIRONMENT`: train an environment's options as Q-networks."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.table import Table

from lodestone.agents.pretraining import as_options, pretrain
from lodestone.agents.saved import save_options
from lodestone.cli.parsing import check_seeds, parse, settings_of, take_environment
from lodestone.cli.printing import print_json
from lodestone.console import ConsoleProgress
from lodestone.envs.base import Environment
from lodestone.envs.registry import describe_environment
from lodestone.errors import InvalidConfig
from lodestone.experiments import magnet_tower
from lodestone.files import prepare_folder
from lodestone.learning.networks import NetworkConfig
from lodestone.options.catalogue import tasks

EnvironmentT = TypeVar("EnvironmentT", bound=Environment)


@dataclass(frozen=True)
class Pretrain(Generic[EnvironmentT]):
    """Train an environment's options as Q-networks on their own tasks, and judge them from every start."""

    environment: EnvironmentT
    out: Path
    """File to write, for `train --options` (.safetensors)."""
    network: NetworkConfig = dataclasses.field(
        default_factory=lambda: NetworkConfig(kernels=(3,), strides=(3,), channels=(32,), hidden=(128,))
    )
    decisions: int = 160_000
    """Budget per option and seed; training ends sooner where an option is good enough."""
    seeds: int = 2
    """Networks per option, of which the best is kept."""
    option_cap: int = magnet_tower.OPTION_CAP
    """Steps within which an option must complete its task."""
    json: bool = False
    """Print one JSON object."""


def run(words: list[str]) -> None:
    """Parse the words after `pretrain` and pretrain."""
    name, environment, rest = take_environment("pretrain", words)
    _pretrain(parse(settings_of(Pretrain, environment), f"pretrain {name}", rest))


def _pretrain(settings: Pretrain) -> None:
    environment = settings.environment
    found = tasks(environment)
    if not found:
        raise InvalidConfig(f"{describe_environment(environment)['name']} has no training tasks for options.")
    check_seeds(settings.seeds)
    prepare_folder(settings.out.parent)
    training = magnet_tower.settings("3", "fast").pretraining["lift"]
    config = dataclasses.replace(training.config, network=settings.network)
    pretrained = []
    with ConsoleProgress(float(len(found))) as progress:
        for task in found:
            progress.begin(task.name, 1.0)

            def tell(taken: int, judgement: Any) -> None:
                progress.advance(taken / settings.decisions, str(judgement))

            pretrained.append(
                pretrain(
                    task,
                    config,
                    training.rules,
                    settings.decisions,
                    range(settings.seeds),
                    settings.option_cap,
                    tell,
                )
            )
    save_options(settings.out, as_options(pretrained), environment)
    rows = [
        {
            "option": one.task.name,
            "success": one.judgement.success,
            "starts": one.judgement.starts,
            "mean_steps": None if math.isnan(one.judgement.mean_steps) else one.judgement.mean_steps,
            "optimal_mean_steps": one.optimal_steps,
            "decisions": one.decisions,
            "seconds": round(one.seconds, 3),
        }
        for one in pretrained
    ]
    if settings.json:
        print_json({"environment": describe_environment(environment), "options": rows, "out": str(settings.out)})
        return
    table = Table(title="Options, judged from every start of their tasks", title_justify="left")
    for column in rows[0]:
        table.add_column(column.replace("_", " "), justify="right")
    for row in rows:
        table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)
    print(f"Saved in {settings.out}; `lodestone train dqn ... --options {settings.out}` uses them.")
