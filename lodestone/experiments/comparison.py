"""What an experiment that compares learners on one environment has to show."""

from __future__ import annotations

from dataclasses import dataclass

from lodestone.agents.playing import Playback
from lodestone.learning.history import Episodes, Usage


@dataclass(frozen=True)
class GreedyResult:
    """One seed's final greedy policy, from the start of an episode."""

    seed: int
    steps: int
    """Primitive steps; of no meaning without success."""
    decisions: int
    total_reward: float
    success: bool
    gap: float
    """The optimal return minus this return."""


@dataclass(frozen=True)
class AgentRun:
    """One learner, trained on several seeds at once."""

    name: str
    option_names: tuple[str, ...]
    """What the learner chooses from, primitives first."""
    primitives: int
    """How many of these are primitive actions."""
    seeds: tuple[int, ...]
    episodes: tuple[Episodes, ...]
    """Per seed."""
    usage: tuple[Usage, ...]
    """Chunk by chunk."""
    greedy: tuple[GreedyResult, ...]
    """Per seed."""
    seconds: float
    """Wall-clock time of training all seeds, compilation included."""


@dataclass(frozen=True)
class OptionRun:
    """One option's pretraining, judged from every start of its task."""

    name: str
    success: float
    """Share of the starts from which the task is completed."""
    mean_steps: float
    optimal_mean_steps: float
    """Of the policy with the best return, which may charge for more than time."""
    starts: int
    decisions: int
    seconds: float


@dataclass(frozen=True)
class Comparison:
    """One figure: several learners on one environment, beside the exact optimum."""

    name: str
    """Short, fit for a file name: figure-2."""
    title: str
    optimal_return: float
    optimal_steps: float
    optimal_decisions: float
    """Fewest decisions that reach the goal with the learner's options."""
    thresholds: tuple[float, ...]
    """Mean returns whose first crossing is reported."""
    options: tuple[OptionRun, ...]
    agents: tuple[AgentRun, ...]
    playback: Playback | None
    """None as long as no learner has finished."""


@dataclass(frozen=True)
class Gate:
    """A number that must come out."""

    name: str
    measured: float
    required: str
    """In words: "<= 13", ">= 0.9"."""
    passed: bool


def at_most(name: str, measured: float, limit: float) -> Gate:
    """measured <= limit."""
    return Gate(name, float(measured), f"<= {limit:g}", bool(measured <= limit))


def at_least(name: str, measured: float, limit: float) -> Gate:
    """measured >= limit."""
    return Gate(name, float(measured), f">= {limit:g}", bool(measured >= limit))
