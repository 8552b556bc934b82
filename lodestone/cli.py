"""The command line: builds configurations, calls functions, prints.

Exit codes: 0 done, 2 bad input (one sentence on standard error), 130 interrupted.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Generic, Literal, TypeVar

import jax
import tyro
from rich.console import Console
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional

from lodestone import __version__
from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.maxq import MAXQConfig, as_configured
from lodestone.agents.playing import episodes_to_judge, play_many, record
from lodestone.agents.pretraining import as_options, pretrain
from lodestone.agents.run_folder import POLICY, RunFolder
from lodestone.agents.saved import load_options, load_policy, save_options
from lodestone.agents.training import AGENTS, AgentConfig, check_training, train_policy
from lodestone.console import ConsoleProgress
from lodestone.devices import use_all_cores
from lodestone.envs.base import Environment
from lodestone.envs.registry import ENVIRONMENTS, describe_environment, environment_class
from lodestone.errors import InvalidConfig, InvalidTaskGraph, LodestoneError, TooManyStates, check_name
from lodestone.experiments import magnet_tower
from lodestone.experiments.comparison import Gate
from lodestone.experiments.registry import EXPERIMENTS, experiment
from lodestone.experiments.study import Study
from lodestone.files import json_safe, prepare_folder
from lodestone.learning.history import History
from lodestone.learning.networks import NetworkConfig
from lodestone.machines.catalogue import machines
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.catalogue import named_options, tasks
from lodestone.options.execution import Rules
from lodestone.options.tabular import TabularOptions
from lodestone.planning.joint import hierarchical_optimum
from lodestone.planning.option_models import check_available, fewest_decisions, tabulate_options
from lodestone.planning.solve import optimum
from lodestone.planning.tables import tabulate
from lodestone.subtasks.as_machines import as_machines
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import check_abstraction, recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks

AgentT = TypeVar("AgentT", bound=AgentConfig)
EnvironmentT = TypeVar("EnvironmentT", bound=Environment)

MAGNET_TOWER = "magnet-tower"
"""The experiment that `reproduce` runs unless told otherwise."""
TOWER_SEEDS = 6
"""Its seeds by default."""

USAGE = f"""usage: lodestone COMMAND ...

Hierarchical reinforcement learning with options, each learner beside the exact optimum.

commands:
  reproduce                  the paper's two figures, or another experiment: figures, report, numbers
  train AGENT ENVIRONMENT    train an agent ({", ".join(AGENTS)})
  pretrain ENVIRONMENT       train an environment's options as Q-networks
  watch RUN                  play a saved policy
  plan ENVIRONMENT           the exact optimum

environments: {", ".join(ENVIRONMENTS)}
experiments: {", ".join((MAGNET_TOWER, *EXPERIMENTS))}

Add --help after a command and its names for all settings. lodestone --version prints the version.
"""


@dataclass(frozen=True)
class Plan(Generic[EnvironmentT]):
    """The exact optimum of an environment, by enumeration and value iteration."""

    environment: EnvironmentT
    discount: float = 0.99
    """Discount of the discounted value."""
    options: tuple[str, ...] = ()
    """Ready-made options to plan with beside the primitive actions: adds the fewest decisions."""
    machines: bool = False
    """Add the hierarchical optimum: the best that the environment's ready-made machines allow."""
    subtasks: bool = False
    """Add the recursive and the hierarchical optimum of the environment's ready-made task graph."""
    json: bool = False
    """Print one JSON object."""


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
    out: Path | None = None
    """Folder for config.json, metrics.jsonl and policy.safetensors; without it nothing is saved."""
    json: bool = False
    """Print one JSON object at the end."""


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


@dataclass(frozen=True)
class Watch:
    """Play a saved policy greedily: in the terminal, or as a GIF or an HTML page."""

    run: Positional[Path]
    """A run's folder, or a policy file."""
    position: int = 0
    """Which of the policy's seeds, counted from 0."""
    gif: Path | None = None
    """Write an animation instead of playing in the terminal."""
    html: Path | None = None
    """Write a page with a player instead of playing in the terminal."""
    delay: float = 0.4
    """Seconds per step in the terminal."""


@dataclass(frozen=True)
class Reproduce:
    """Reproduce the paper: pretrain the options, train DQN with options and DQN, and set both beside the optimum.

    Or run another experiment, by its name."""

    experiment: str = MAGNET_TOWER
    """The paper's towers of a magnet arm, or an experiment that --list names."""
    figure: Literal["2", "3", "all"] = "all"
    """Of magnet-tower. 2: a 4x3 grid with 3 bricks. 3: a 6x4 grid with 4 bricks."""
    seeds: int | None = None
    """Seeds per curve, trained at once. Default: 6 for magnet-tower, otherwise as --list says."""
    preset: Literal["fast", "paper"] = "fast"
    """Of magnet-tower. fast: our tuning of the same algorithms. paper: the authors' protocol."""
    out: Path | None = None
    """Folder for report.html, the figures, results.json and, of magnet-tower, the animation and what was learned.
    Default: out/reproduce for magnet-tower, otherwise out/ and the experiment's name."""
    list: bool = False
    """Print the experiments' names, titles and seeds, and run none."""
    json: bool = False
    """Print results.json on standard output, too."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if words[0] == "--version":
        print(f"lodestone {__version__}")
        return 0
    use_all_cores()
    try:
        _run(words)
    except LodestoneError as error:
        print(f"lodestone: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nlodestone: interrupted.", file=sys.stderr)
        return 130
    return 0


def _run(words: list[str]) -> None:
    command, rest = words[0], words[1:]
    check_name("command", command, ("reproduce", "train", "pretrain", "watch", "plan"))
    match command:
        case "reproduce":
            _reproduce(_parse(Reproduce, "reproduce", rest))
        case "watch":
            _watch(_parse(Watch, "watch", rest))
        case "plan":
            environment, rest = _take_name("environment", tuple(ENVIRONMENTS), command, rest)
            _plan(_parse(_of(Plan, environment_class(environment)), f"plan {environment}", rest))
        case "pretrain":
            environment, rest = _take_name("environment", tuple(ENVIRONMENTS), command, rest)
            _pretrain(_parse(_of(Pretrain, environment_class(environment)), f"pretrain {environment}", rest))
        case "train":
            agent, rest = _take_name("agent", tuple(AGENTS), command, rest)
            environment, rest = _take_name("environment", tuple(ENVIRONMENTS), f"train {agent}", rest)
            settings = _of(Train, AGENTS[agent], environment_class(environment))
            _train(_parse(settings, f"train {agent} {environment}", rest), agent)


def _of(command: Any, *kinds: type) -> Any:
    """A command's settings for an agent and an environment that are known only now."""
    return command[kinds]


def _take_name(kind: str, known: tuple[str, ...], command: str, words: list[str]) -> tuple[str, list[str]]:
    if not words or words[0].startswith("-"):
        raise InvalidConfig(f"`lodestone {command}` needs the name of an {kind}; there are: {', '.join(known)}.")
    check_name(kind, words[0], known)
    return words[0], words[1:]


def _parse(settings: Any, command: str, words: list[str]) -> Any:
    """Parsing errors leave with exit code 2 from inside tyro, after one boxed sentence."""
    return tyro.cli(settings, args=words, prog=f"lodestone {command}", config=(OmitArgPrefixes,))


def _plan(plan: Plan) -> None:
    found = optimum(plan.environment, plan.discount)
    content = describe_environment(plan.environment) | found._asdict()
    if plan.options:
        tables = tabulate(plan.environment)
        options = tabulate_options(
            Union((Primitives(plan.environment.action_names), named_options(plan.environment, plan.options))),
            tables.space,
        )
        content["optimal_decisions"] = -tables.initial_mean(fewest_decisions(tables, options).values)
    if plan.machines:
        content["machines"] = hierarchical_optimum(plan.environment, machines(plan.environment), plan.discount)
    if plan.subtasks:
        content["subtasks"] = _plan_subtasks(plan.environment)
    if plan.json:
        _print_json(content)
        return
    parameters = ", ".join(f"{name} {value}" for name, value in content["parameters"].items())
    table = Table(title=f"{content['name']} ({parameters})", show_header=False, title_justify="left")
    table.add_row("reachable states", f"{found.states:,}")
    table.add_row("terminal states among them", f"{found.goals:,}")
    table.add_row("optimal steps", f"{found.optimal_steps:g}")
    table.add_row("optimal return", f"{found.optimal_return:g}")
    table.add_row(f"optimal value, discount {found.discount:g}", f"{found.discounted_value:.4f}")
    if plan.options:
        table.add_row(f"fewest decisions with {', '.join(plan.options)}", f"{content['optimal_decisions']:g}")
    if plan.machines:
        best = content["machines"]
        table.add_row(
            "with machines: joint states, choices among them", f"{best.joint_states:,}, {best.choice_states:,}"
        )
        table.add_row("with machines: optimal return", f"{best.optimal_return:g}")
        table.add_row("with machines: steps, choices", f"{best.optimal_steps:g}, {best.optimal_choices:g}")
    if plan.subtasks:
        found_subtasks = content["subtasks"]
        table.add_row("with subtasks: values stored", f"{found_subtasks['values_stored']:,}")
        table.add_row("with subtasks: recursively optimal return", f"{found_subtasks['recursive_return']:g}")
        plain = found_subtasks["recursive_return_without_pseudo_rewards"]
        table.add_row("the same without pseudo-rewards", f"{plain:g}")
        table.add_row("with subtasks: hierarchically optimal return", f"{found_subtasks['hierarchical_return']:g}")
    Console().print(table)


def _plan_subtasks(environment: Environment) -> dict[str, float]:
    """Without a discount."""
    graph, tables = task_graph(environment), tabulate(environment)
    tasks = tabulate_tasks(graph, environment, tables)
    plain = tabulate_tasks(graph.without_pseudo_rewards(), environment, tables)
    return {
        "values_stored": tasks.num_slots,
        "recursive_return": tables.initial_mean(recursive_optimum(tasks, tables).values[0]),
        "recursive_return_without_pseudo_rewards": tables.initial_mean(recursive_optimum(plain, tables).values[0]),
        "hierarchical_return": hierarchical_optimum(environment, as_machines(graph)).optimal_return,
    }


def _choose_options(train: Train) -> Options:
    """What the agent chooses from. Raises `NoOptionAvailable` where a reachable state has nothing."""
    environment = train.environment
    parts: list[Options] = [Primitives(environment.action_names)] if train.primitives else []
    if train.options:
        first = Path(train.options[0])
        is_file = len(train.options) == 1 and (first.suffix or first.exists())
        temporal = load_options(first, environment) if is_file else named_options(environment, train.options)
        cap = train.option_cap
        if cap is None and not isinstance(train.agent, IntraOptionConfig) and not isinstance(temporal, TabularOptions):
            cap = magnet_tower.OPTION_CAP
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
        print(f"lodestone: note: {error} What is learned is not exact; {hint}.", file=sys.stderr)


def _train(train: Train, agent: str) -> None:
    if train.seeds < 1:
        raise InvalidConfig(f"seeds is {train.seeds}, but must be at least 1.")
    if train.steps < 1:
        raise InvalidConfig(f"steps is {train.steps}, but must be at least 1.")
    environment, rules = train.environment, train.rules
    options = _choose_options(train)
    check_training(train.agent, environment, options, rules)
    if isinstance(train.agent, MAXQConfig):
        _warn_of_unsafe_abstraction(train.agent, environment, rules.discount)
    seeds = tuple(range(train.seed, train.seed + train.seeds))
    folder = None
    if train.out is not None:
        config = {
            "agent": {"name": agent, **dataclasses.asdict(train.agent)},
            "environment": describe_environment(environment),
            "rules": dataclasses.asdict(rules),
            "options": list(options.names),
            "steps": train.steps,
            "seeds": list(seeds),
        }
        folder = RunFolder(train.out, config)
    with ConsoleProgress(1.0) as progress:
        progress.begin(f"{agent} on {describe_environment(environment)['name']}", 1.0)

        def tell(history: History, fraction: float) -> bool:
            steps = min(history.taken(position)[1] for position in range(len(seeds)))
            returns = [history.episodes(position).total_reward[-50:] for position in range(len(seeds))]
            means = " ".join(f"{values.mean():.1f}" if len(values) else "-" for values in returns)
            progress.advance(max(fraction, min(1.0, steps / train.steps)), f"{steps:,} steps, mean return {means}")
            if folder is not None:
                folder.log(history, seeds)
            return steps >= train.steps

        policy, history = train_policy(train.agent, environment, options, rules, train.steps, seeds, tell)
    if folder is not None:
        folder.finish(policy)

    try:
        best = optimum(environment)
    except TooManyStates:
        best = None
    judged = episodes_to_judge(environment)
    greedy = jax.tree.map(lambda leaf: leaf.mean(axis=1), play_many(policy, jax.random.key(0), judged))
    content: dict[str, Any] = {
        "agent": agent,
        "environment": describe_environment(environment),
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
            for position, seed in enumerate(seeds)
        ],
        "greedy_episodes": judged,
        "seconds": round(history.seconds, 3),
        "out": str(train.out) if train.out else None,
    }
    if train.json:
        _print_json(content)
        return
    title = f"Greedy policies after training ({history.seconds:.0f} s)"
    table = Table(title=title if judged == 1 else f"{title}, means of {judged} episodes", title_justify="left")
    for column in ("seed", "steps trained", "return", "optimal return", "steps", "decisions", "reached the goal"):
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
    if train.out is not None:
        print(f"Saved in {train.out}; `lodestone watch {train.out}` plays it.")


def _pretrain(settings: Pretrain) -> None:
    environment = settings.environment
    found = tasks(environment)
    if not found:
        raise InvalidConfig(f"{describe_environment(environment)['name']} has no training tasks for options.")
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
        _print_json({"environment": describe_environment(environment), "options": rows, "out": str(settings.out)})
        return
    table = Table(title="Options, judged from every start of their tasks", title_justify="left")
    for column in rows[0]:
        table.add_column(column.replace("_", " "), justify="right")
    for row in rows:
        table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)
    print(f"Saved in {settings.out}; `lodestone train dqn ... --options {settings.out}` uses them.")


def _watch(watch: Watch) -> None:
    from lodestone.report import animation, html, terminal  # pictures are only needed here and in `reproduce`

    path = watch.run / POLICY if watch.run.is_dir() else watch.run
    policy = load_policy(path)
    if not 0 <= watch.position < len(policy.seeds):
        raise InvalidConfig(
            f"position is {watch.position}, but {path} holds {len(policy.seeds)} seeds, counted from 0."
        )
    playback = record(policy, watch.position, jax.random.key(0), policy.agent)
    for target, write in ((watch.gif, animation.write_gif), (watch.html, html.write_player)):
        if target is not None:
            prepare_folder(target.parent)
            write(playback, target)
            print(f"Wrote {target}.")
    if watch.gif is None and watch.html is None:
        terminal.show(playback, watch.delay)


def _reproduce(settings: Reproduce) -> None:
    if settings.list:
        _list_experiments(settings.json)
        return
    check_name("experiment", settings.experiment, (MAGNET_TOWER, *EXPERIMENTS))
    if settings.seeds is not None and settings.seeds < 1:
        raise InvalidConfig(f"seeds is {settings.seeds}, but must be at least 1.")
    if settings.experiment == MAGNET_TOWER:
        _reproduce_towers(settings, settings.seeds or TOWER_SEEDS, settings.out or Path("out/reproduce"))
        return
    for flag, value, default in (("figure", settings.figure, "all"), ("preset", settings.preset, "fast")):
        if value != default:
            raise InvalidConfig(f"--{flag} belongs to {MAGNET_TOWER}; {settings.experiment} has no such choice.")
    _reproduce_study(settings)


def _list_experiments(as_json: bool) -> None:
    rows = [
        {"name": MAGNET_TOWER, "title": "Towers of a magnet arm: figures 2 and 3 of the paper", "seeds": TOWER_SEEDS},
        *({"name": one.name, "title": one.title, "seeds": one.seeds} for one in EXPERIMENTS.values()),
    ]
    if as_json:
        _print_json(rows)
        return
    width = max(len(str(row["name"])) for row in rows)
    for row in rows:
        print(f"{row['name']:{width}}  {row['title']} ({row['seeds']} seeds)")


def _reproduce_towers(settings: Reproduce, seeds: int, out: Path) -> None:
    from lodestone.report.reproduction import Reproduction  # matplotlib is only needed here

    figures = magnet_tower.FIGURES if settings.figure == "all" else (settings.figure,)
    chosen = [magnet_tower.settings(figure, settings.preset) for figure in figures]
    reproduction = Reproduction(prepare_folder(out), settings.preset, seeds, settings.figure)
    try:
        with ConsoleProgress(magnet_tower.total_work(chosen, seeds)) as progress:
            for one in chosen:
                magnet_tower.run(one, range(seeds), progress, reproduction.save)
    except KeyboardInterrupt:
        finished = ", ".join(reproduction.finished) or "nothing yet"
        print(f"\nInterrupted. Finished and kept in {out}: {finished}.", file=sys.stderr)
        raise
    if settings.json:
        _print_json(reproduction.results())
        return
    _print_gates(reproduction.gates())
    print(f"Wrote {out / 'report.html'} and, beside it: {', '.join(reproduction.files)}.")


def _reproduce_study(settings: Reproduce) -> None:
    from lodestone.report.reproduction import provenance  # matplotlib is only needed here
    from lodestone.report.studies import save_study, study_json

    chosen = experiment(settings.experiment)
    seeds, folder = settings.seeds or chosen.seeds, prepare_folder(settings.out or Path("out") / chosen.name)
    started = perf_counter()
    with ConsoleProgress(chosen.work) as progress:
        study = chosen.run(seeds, progress)
    told = provenance(f"lodestone reproduce --experiment {chosen.name} --seeds {seeds} --out {folder}")
    told |= {"seeds": seeds, "seconds": perf_counter() - started}
    written = save_study(folder, study, told)
    if settings.json:
        _print_json(study_json(study, told))
        return
    _print_tables(study)
    _print_gates(study.gates)
    others = [name for name in written if name != "report.html"]
    print(f"Wrote {folder / 'report.html'} and, beside it: {', '.join(others)}.")


def _print_tables(study: Study) -> None:
    from lodestone.report.page import number_text

    for numbers in study.tables:
        table = Table(*numbers.columns, title=numbers.title, title_justify="left")
        for row in numbers.rows:
            table.add_row(*(value if isinstance(value, str) else number_text(value, 4) for value in row))
        Console().print(table)


def _print_gates(gates: Sequence[Gate]) -> None:
    table = Table("", "measured", "required", "", title="What must come out", title_justify="left")
    for gate in gates:
        table.add_row(gate.name, f"{gate.measured:.4g}", gate.required, "passed" if gate.passed else "MISSED")
    Console().print(table)


def _print_json(content: Any) -> None:
    """One JSON object; infinities and NaN, which JSON lacks, become null."""
    print(json.dumps(json_safe(content), indent=2, allow_nan=False))


if __name__ == "__main__":
    raise SystemExit(main())
