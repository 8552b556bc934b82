"""What a comparison came to, in numbers: one seed, one agent, everything as JSON.

The tables of the HTML report print the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lodestone.experiments.comparison import AgentRun, Comparison, Gate
from lodestone.files import json_safe
from lodestone.learning.history import Episodes, first_above
from lodestone.report.statistics import estimate

THRESHOLD_WINDOW = 50
"""Episodes whose mean return must exceed a threshold."""


@dataclass(frozen=True)
class Moment:
    """When something happened, counted from the start of training."""

    decisions: int
    steps: int
    """Primitive steps."""


@dataclass(frozen=True)
class Summary:
    """One number over the seeds of an agent; infinite where too few seeds reached it."""

    iqm: float
    low: float
    """Lower end of the 95 % confidence interval."""
    high: float
    reached: int
    """Seeds that have this number."""
    seeds: int


@dataclass(frozen=True)
class Row:
    """One line of an agent's table."""

    label: str
    unit: str
    summary: Summary


def _moment(episodes: Episodes, position: int | None) -> Moment | None:
    if position is None:
        return None
    return Moment(int(episodes.decisions[position]), int(episodes.steps[position]))


def first_success(episodes: Episodes) -> Moment | None:
    """The end of the first episode that reached the goal."""
    return _moment(episodes, int(np.argmax(episodes.success)) if episodes.success.any() else None)


def first_reached(episodes: Episodes, threshold: float) -> Moment | None:
    """The end of the first episode with which the mean return of the last 50 exceeds `threshold`."""
    return _moment(episodes, first_above(episodes, threshold, THRESHOLD_WINDOW))


def summarise(values: Sequence[float | None]) -> Summary:
    """Interquartile mean over seeds with its interval; None counts as infinitely late."""
    reached = np.array([math.inf if value is None else value for value in values])
    iqm, low, high = (float(each) for each in estimate(reached))
    return Summary(iqm, low, high, int(np.isfinite(reached).sum()), len(values))


def agent_rows(agent: AgentRun, thresholds: Sequence[float]) -> tuple[Row, ...]:
    """The agent's table. Greedy lengths count the seeds whose final greedy policy reaches the goal."""
    moments = [("First success", [first_success(episodes) for episodes in agent.episodes])]
    for threshold in thresholds:
        reached = [first_reached(episodes, threshold) for episodes in agent.episodes]
        moments.append((f"Mean return above {threshold:g}", reached))
    rows = []
    for label, per_seed in moments:
        decisions = [moment.decisions if moment else None for moment in per_seed]
        steps = [moment.steps if moment else None for moment in per_seed]
        rows += [Row(label, "decisions", summarise(decisions)), Row(label, "primitive steps", summarise(steps))]
    greedy = agent.greedy
    rows += (
        Row("Greedy episode", "primitive steps", summarise([each.steps if each.success else None for each in greedy])),
        Row("Greedy episode", "decisions", summarise([each.decisions if each.success else None for each in greedy])),
        Row("Greedy episode", "return", summarise([each.total_reward for each in greedy])),
        Row("Gap to the optimum", "return", summarise([each.gap for each in greedy])),
    )
    return tuple(rows)


def results_json(
    comparisons: Sequence[Comparison], gates: Sequence[Gate], settings: Mapping[str, object]
) -> dict[str, Any]:
    """Everything that was measured, fit for JSON: what is not a finite number is None."""
    return json_safe(
        {
            "figures": [_figure(comparison) for comparison in comparisons],
            "gates": [vars(gate) for gate in gates],
            "settings": settings,
        }
    )


def _figure(comparison: Comparison) -> dict[str, object]:
    return {
        "name": comparison.name,
        "title": comparison.title,
        "optimum": {
            "return": comparison.optimal_return,
            "steps": comparison.optimal_steps,
            "decisions": comparison.optimal_decisions,
        },
        "options": [vars(option) for option in comparison.options],
        "agents": [_agent(agent, comparison.thresholds) for agent in comparison.agents],
    }


def _agent(agent: AgentRun, thresholds: Sequence[float]) -> dict[str, object]:
    return {
        "name": agent.name,
        "option_names": agent.option_names,
        "seconds": agent.seconds,
        "summary": [
            {"label": row.label, "unit": row.unit, **vars(row.summary)} for row in agent_rows(agent, thresholds)
        ],
        "seeds": [
            {
                "seed": greedy.seed,
                "first_success": first_success(episodes),
                "thresholds": {f"{threshold:g}": first_reached(episodes, threshold) for threshold in thresholds},
                "final": {
                    "steps": greedy.steps,
                    "decisions": greedy.decisions,
                    "return": greedy.total_reward,
                    "success": greedy.success,
                },
                "gap": greedy.gap,
            }
            for episodes, greedy in zip(agent.episodes, agent.greedy, strict=True)
        ],
    }
