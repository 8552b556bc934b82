"""`lodestone train AGENT ENVIRONMENT`: train an agent, several seeds at once."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console
from rich.table import Table

from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.maxq import MAXQConfig, as_configured
from lodestone.agents.playing import episodes_to_judge, judge_greedily
from lodestone.agents.policies import AnyPolicy
from lodestone.agents.run import Run, load_start
from lodestone.agents.run_folder import RunFolder
from lodestone.agents.saved import load_options
from lodestone.agents.training import AGENTS, AgentConfig, check_training, train_policy
from lodestone.cli.parsing import check_seeds, parse, settings_of, take_environment, take_name
from lodestone.cli.printing import note, print_json
from lodestone.console import ConsoleProgress
from lodestone.envs.base import Environment, OutsideEnvironment
from lodestone.envs.registry import describe_environment, name_of
from lodestone.errors import InvalidConfig, InvalidTaskGraph, TooManyStates
from lodestone.experiments.magnet_tower import OPTION_CAP
from lodestone.learning.history import History
from lodestone.options.base import Capped, Options, Union, primitives
from lodestone.options.catalogue import named_options
from lodestone.options.execution import Rules
from lodestone.options.tabular import TabularOptions
from lodestone.planning.option_models import check_available, tabulate_options
from lodestone.planning.solve import optimum
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import check_abstraction, recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks

AgentT = TypeVar("AgentT", bound=AgentConfig)
EnvironmentT = TypeVar("EnvironmentT", bound=Environment)


@dataclass(frozen=True)
class Train(Generic[AgentT, EnvironmentT]):
    """Train an agent on an environment, several seeds at once."""

    agent: AgentT
    environment: EnvironmentT
    rules: Rules = dataclasses.field(default_factory=lambda: Rules(decision_limit=200))
    steps: int = 50_000
    """Primitive steps per seed; with options, training ends at the first report after so many."""
    seed: int = 0
    """The first seed."""
    seeds: int = 1
    """How many seeds, trained at once."""
    options: tuple[str, ...] = ()
    """Ready-made options by name, or one file of saved options."""
    option_cap: int | None = None
    """Steps after which an option is stopped. Default: 21 for scripts and networks, none for exact tables; none for
    agents that learn within options, which take no caps."""
    primitives: bool = True
    """Whether the agent may choose primitive actions besides the options."""
    from_run: Path | None = None
    """Of a united network: the run, or policy file, of one to start from. One with pooling may be of another grid."""
    out: Path | None = None
    """Folder for the run, from which `lodestone resume` goes on if it is ended early; without it nothing is saved."""
    checkpoint_every: float = 60.0
    """Seconds from one checkpoint in the folder to the next, at least; 0 for one after every report of progress."""
    json: bool = False
    """Print one JSON object at the end."""


def run(words: list[str]) -> None:
    """Parse the words after `train` and train."""
    _train(parse_train(words))


def parse_train(words: list[str]) -> Train:
    """The settings that the words after `train` stand for."""
    agent, rest = take_name("agent", tuple(AGENTS), "train", words)
    name, environment, rest = take_environment(f"train {agent}", rest)
    if issubclass(environment, OutsideEnvironment):  # which has a limit of its own
        rest = ["--decision-limit", "None", *rest]
    settings: Train = parse(settings_of(Train, AGENTS[agent], environment), f"train {agent} {name}", rest)
    return settings


def _train(train: Train) -> None:
    run = run_of(train)
    if isinstance(train.agent, MAXQConfig):
        _warn_of_unsafe_abstraction(train.agent, train.environment, train.rules.discount)
    if train.out is None:
        _print_result(run, None, *train_run(run, None), train.json)
        return
    with RunFolder(train.out) as folder:
        folder.begin(run)
        finish(run, folder, train.json)


def run_of(train: Train) -> Run:
    """What is to be trained. Raises what training would raise before it begins."""
    check_seeds(train.seeds)
    options = _choose_options(train)
    start = None if train.from_run is None else load_start(train.from_run)
    check_training(train.agent, train.environment, options, train.rules, start)
    return Run(
        agent=train.agent,
        environment=train.environment,
        rules=train.rules,
        options=options,
        steps=train.steps,
        seeds=tuple(range(train.seed, train.seed + train.seeds)),
        start=start,
        from_run=None if train.from_run is None else str(train.from_run),
        checkpoint_every=train.checkpoint_every,
    )


def finish(run: Run, folder: RunFolder, as_json: bool) -> None:
    """Train what is left of a run, save it and print what came of it."""
    try:
        policy, history = train_run(run, folder)
        folder.finish(policy)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; `lodestone resume {folder.path}` goes on.") from None
    _print_result(run, folder.path, policy, history, as_json)


def train_run(run: Run, folder: RunFolder | None) -> tuple[AnyPolicy, History]:
    """Train what is left of a run; its folder, where there is one, grows with it."""
    with ConsoleProgress(1.0) as progress, ExitStack() as stack:
        checkpoints = None
        if folder is not None and not isinstance(run.environment, OutsideEnvironment):
            checkpoints = stack.enter_context(folder.checkpoints(run.checkpoint_every, note))
        elif folder is not None:
            note("A Gymnasium environment keeps its state to itself: there are no checkpoints, a run begins again.")
        progress.begin(f"{run.agent_name} on {name_of(run.environment)}", 1.0)

        def tell(history: History, fraction: float) -> bool:
            seeds = range(len(run.seeds))
            steps = min(history.taken(position)[1] for position in seeds)
            returns = [history.episodes(position).total_reward[-50:] for position in seeds]
            means = " ".join(f"{values.mean():.1f}" if len(values) else "-" for values in returns)
            done = max(fraction, min(1.0, steps / run.steps))
            progress.skip(done * history.restored / len(history.usage))
            progress.advance(done, f"{steps:,} steps, mean return {means}")
            if folder is not None:
                folder.log(history, run.seeds)
            return steps >= run.steps

        return train_policy(
            run.agent,
            run.environment,
            run.options,
            run.rules,
            run.steps,
            run.seeds,
            tell,
            start=run.start,
            checkpoints=checkpoints,
        )


def _print_result(run: Run, out: Path | None, policy: AnyPolicy, history: History, as_json: bool) -> None:
    try:
        best = optimum(run.environment)
    except TooManyStates:
        best = None
    judged, greedy = episodes_to_judge(policy), judge_greedily(policy)
    content: dict[str, Any] = {
        "agent": run.agent_name,
        "environment": describe_environment(run.environment),
        "optimal_return": best.optimal_return if best else None,
        "optimal_steps": best.optimal_steps if best else None,
        "seeds": [
            {
                "seed": seed,
                "decisions": history.taken(position)[0],
                "steps": history.taken(position)[1],
                "episodes": len(history.episodes(position).total_reward),
                "greedy_return": float(greedy.total_reward[position]),
                "greedy_steps": float(greedy.steps[position]),
                "greedy_decisions": float(greedy.decisions[position]),
                "success": float(greedy.success[position]),
                "gap": best.optimal_return - float(greedy.total_reward[position]) if best else None,
            }
            for position, seed in enumerate(run.seeds)
        ],
        "greedy_episodes": judged,
        "seconds": round(history.seconds, 3),
        "out": None if out is None else str(out),
    }
    if as_json:
        print_json(content)
        return
    ended = "terminated" if isinstance(run.environment, OutsideEnvironment) else "reached the goal"
    title = f"Greedy policies after training ({history.seconds:.0f} s)"
    table = Table(title=title if judged == 1 else f"{title}, means of {judged} episodes", title_justify="left")
    for column in ("seed", "steps trained", "return", "optimal return", "steps", "decisions", ended):
        table.add_column(column, justify="right")
    for row in content["seeds"]:
        table.add_row(
            str(row["seed"]),
            f"{row['steps']:,}",
            f"{row['greedy_return']:g}",
            f"{best.optimal_return:g}" if best else "unknown",
            f"{row['greedy_steps']:g}",
            f"{row['greedy_decisions']:g}",
            f"{row['success']:.0%}",
        )
    Console().print(table)
    if out is not None:
        print(f"Saved in {out}; `lodestone watch {out}` plays it.")


def _choose_options(train: Train) -> Options:
    """What the agent chooses from. Raises `NoOptionAvailable` where a reachable state has nothing."""
    environment = train.environment
    if train.option_cap is not None and not train.options:
        raise InvalidConfig("option_cap is given, but no options are.")
    parts: list[Options] = [primitives(environment)] if train.primitives else []
    if train.options:
        first = Path(train.options[0])
        is_file = len(train.options) == 1 and (first.suffix or first.exists())
        temporal = load_options(first, environment) if is_file else named_options(environment, train.options)
        cap = train.option_cap
        if cap is None and not isinstance(train.agent, IntraOptionConfig) and not isinstance(temporal, TabularOptions):
            cap = OPTION_CAP
        parts.append(temporal if cap is None else Capped(temporal, cap))
    options = Union(tuple(parts))
    if not train.primitives:
        tables = tabulate(environment)
        check_available(tables, tabulate_options(options, tables.space))
    return options


def _warn_of_unsafe_abstraction(config: MAXQConfig, environment: Environment, discount: float) -> None:
    tables = tabulate(environment)
    tasks = tabulate_tasks(as_configured(config, task_graph(environment)), environment, tables)
    try:
        check_abstraction(tasks, tables, recursive_optimum(tasks, tables, discount))
    except InvalidTaskGraph as error:
        hint = "try --discount 1 or --no-abstraction"
        note(f"{error} What is learned is not exact; {hint}.")
