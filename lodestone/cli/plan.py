"""`lodestone plan ENVIRONMENT`: the exact optimum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from rich.console import Console
from rich.table import Table

from lodestone.cli.parsing import parse, settings_of, take_environment
from lodestone.cli.printing import print_json
from lodestone.envs.base import Environment
from lodestone.envs.registry import describe_environment
from lodestone.machines.catalogue import machines
from lodestone.options.base import Primitives, Union
from lodestone.options.catalogue import named_options
from lodestone.planning.joint import hierarchical_optimum
from lodestone.planning.option_models import fewest_decisions, tabulate_options
from lodestone.planning.solve import optimum
from lodestone.planning.tables import tabulate
from lodestone.subtasks.as_machines import as_machines
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks

EnvironmentT = TypeVar("EnvironmentT", bound=Environment)


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


def run(words: list[str]) -> None:
    """Parse the words after `plan` and plan."""
    name, environment, rest = take_environment("plan", words)
    _plan(parse(settings_of(Plan, environment), f"plan {name}", rest))


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
        print_json(content)
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
