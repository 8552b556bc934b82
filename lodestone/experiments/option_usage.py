"""Options that fall out of use, and what brings them back (Kuzmin and Panov 2018, section 4.3).

The paper sees one drawback: where every step costs, an option's plain sum of rewards is a larger cost than discounting
makes it, so that the learner may end up without options. Its two cures are another reward, and no basic actions where
the options suffice. The third is to discount inside the option: then it is worth exactly what its steps are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from lodestone.agents.playing import play
from lodestone.agents.training import train_policy
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.magnet_tower import OPTION_CAP, WITH_OPTIONS, settings
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import History
from lodestone.learning.progress import Progress
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.catalogue import scripted_options, scripts
from lodestone.options.execution import Rules
from lodestone.options.tabular import as_tabular, chosen
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate

ARM = MagnetArm(rows=4, columns=3, bricks=3, tower_height=3)
TRAINING = settings("2", "fast").agents[WITH_OPTIONS]
DECISIONS = 100_000
DISCOUNT = TRAINING.rules.discount
TEMPORAL = tuple(script.name for script in scripts(ARM))


@dataclass(frozen=True)
class Variant:
    """One way to reward, and to choose."""

    arm: MagnetArm = ARM
    undiscounted: bool = False
    actions: tuple[str, ...] = ARM.action_names
    """Basic actions that may be chosen beside the options."""

    @property
    def options(self) -> Options:
        """What the learner chooses from."""
        temporal = Capped(scripted_options(self.arm, TEMPORAL), OPTION_CAP)
        every = Union((Primitives(self.arm.action_names), temporal))
        if self.actions == self.arm.action_names:
            return every
        return chosen(as_tabular(every, reachable_states(self.arm)), (*self.actions, *TEMPORAL))

    @property
    def rules(self) -> Rules:
        """The paper's sum, or the discounted one."""
        return replace(TRAINING.rules, undiscounted_option_reward=self.undiscounted)


SUM, DISCOUNTED, FEWER, GOAL_ONLY = "plain sum", "discounted sum", "fewer basic actions", "reward at the goal only"
VARIANTS = {
    SUM: Variant(undiscounted=True),
    DISCOUNTED: Variant(),
    FEWER: Variant(actions=("left", "right", "magnet-off")),
    GOAL_ONLY: Variant(arm=MagnetArm(rows=4, columns=3, bricks=3, tower_height=3, step_reward=0.0), undiscounted=True),
}


class Exact(NamedTuple):
    """What the planner says of a variant."""

    steps: float
    """Fewest steps to the tower that its choices allow."""
    loss: float
    """Largest loss of starting with an option instead of the best choice, over states where discounting costs none."""
    worse: int
    """States in which an option is best by the discounted sum and worse than a basic action by this variant's."""


def run(seeds: int, progress: Progress) -> Study:
    """Plan exactly, then train DQN with hand-written options in every variant."""
    exact = {name: _plan(variant) for name, variant in VARIANTS.items()}
    histories, steps = {}, {}
    for name, variant in VARIANTS.items():
        histories[name], steps[name] = _train(name, variant, seeds, progress)
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "The magnet arm, 4x3 with 3 bricks, DQN over the basic actions and two hand-written options. Where rewards "
            "inside an option are summed plainly, a step of an option costs more than the same step taken alone, and "
            "the best policy never calls one that takes longer than a step. Discounting inside the option makes both "
            "worth the same. Without the basic actions that options replace, options must be used, at the price of a "
            "longer way. With a reward at the goal only, the plain sum errs the other way."
        ),
        seeds=seeds,
        panels=(
            _panel("Steps under options", "share of all primitive steps", histories, "steps"),
            _panel("Decisions for options", "share of all decisions", histories, "calls"),
        ),
        tables=(_numbers(exact, steps, histories),),
        gates=tuple(_gates(exact, steps, histories)),
    )


def _option_values(variant: Variant) -> Float[np.ndarray, "S O"]:
    tables = tabulate(variant.arm)
    options = tabulate_options(variant.options, tables.space)
    return option_value_iteration(
        tables, options, DISCOUNT, undiscounted_option_reward=variant.undiscounted
    ).option_values


def _plan(variant: Variant) -> Exact:
    values, basic = _option_values(variant), len(variant.actions)
    correct = _option_values(replace(variant, undiscounted=False))
    best_options = correct[:, basic:] >= correct.max(axis=1, keepdims=True) - 1e-6
    best_options &= ~tabulate(variant.arm).terminal[:, None]
    lost = np.where(best_options, values.max(axis=1, keepdims=True) - values[:, basic:], 0.0)
    return Exact(_fewest_steps(variant), float(lost.max()), int((lost > 1e-6).any(axis=1).sum()))


def _fewest_steps(variant: Variant) -> float:
    tables = tabulate(variant.arm).with_step_reward(-1.0)
    options = tabulate_options(variant.options, tables.space)
    return -tables.initial_mean(option_value_iteration(tables, options, 1.0).values)


def _train(name: str, variant: Variant, seeds: int, progress: Progress) -> tuple[History, Float[np.ndarray, " N"]]:
    """The history, and each seed's greedy steps to the tower; infinite where it does not get there."""
    progress.begin(f"option-usage: {name}", DECISIONS)

    def tell(history: History, fraction: float) -> bool:
        progress.advance(fraction * DECISIONS, f"{_shares(history, 'steps')[:, -1].mean():.0%} of steps under options")
        return False

    policy, history = train_policy(
        TRAINING.config, variant.arm, variant.options, variant.rules, DECISIONS, range(seeds), tell
    )
    episodes = play(policy, jax.random.key(0))
    return history, np.where(episodes.success, episodes.steps, np.inf)


def _shares(history: History, counted: str) -> Float[np.ndarray, "N C"]:
    """What options have of all steps, or calls, of each seed in each chunk."""
    names = history.choices
    is_option = np.array([name in TEMPORAL for name in names])
    counts = np.stack([getattr(usage, counted) for usage in history.usage], axis=2)
    return counts[:, is_option].sum(axis=1) / np.maximum(counts.sum(axis=1), 1)


def _at_the_end(history: History) -> Float[np.ndarray, " N"]:
    """Each seed's share of steps under options, in the last tenth of the run."""
    return _shares(history, "steps")[:, -max(1, len(history.usage) // 10) :].mean(axis=1)


def _panel(title: str, y_label: str, histories: dict[str, History], counted: str) -> Panel:
    series = []
    for name, history in histories.items():
        x = np.array([usage.decisions[0] for usage in history.usage], dtype=np.float64)
        series.append(Series(name, x, _shares(history, counted)))
    return Panel(title, "decisions", y_label, tuple(series), y_range=(0.0, 1.0))


def _numbers(
    exact: dict[str, Exact], steps: dict[str, Float[np.ndarray, " N"]], histories: dict[str, History]
) -> NumberTable:
    rows = tuple(
        (
            name,
            found.worse,
            found.loss,
            found.steps,
            f"{(steps[name] == found.steps).sum()} of {len(steps[name])}",
            float(np.median(steps[name])),
            float(np.median(_at_the_end(histories[name]))),
        )
        for name, found in exact.items()
    )
    return NumberTable(
        f"Exact, discount {DISCOUNT:g}, and learned in {DECISIONS:,} decisions",
        (
            "",
            "states where a best option looks worse",
            "by at most",
            "fewest steps",
            "seeds that take these",
            "greedy steps, median",
            "share of steps under options at the end, median",
        ),
        rows,
    )


def _gates(
    exact: dict[str, Exact], steps: dict[str, Float[np.ndarray, " N"]], histories: dict[str, History]
) -> list[Gate]:
    at_end = {name: float(np.median(_at_the_end(history))) for name, history in histories.items()}
    return [
        at_least("states where a best option looks worse by the plain sum", exact[SUM].worse, 1),
        at_most("states where a best option looks worse by the discounted sum", exact[DISCOUNTED].worse, 0),
        at_most("fewest steps with fewer basic actions, distance from 15", abs(exact[FEWER].steps - 15), 1e-9),
        at_most("greedy steps of the worst seed, discounted sum", float(steps[DISCOUNTED].max()), 13),
        at_most("greedy steps of the worst seed, fewer basic actions", float(steps[FEWER].max()), 15),
        at_most("steps under options at the end, plain / discounted sum", at_end[SUM] / at_end[DISCOUNTED], 1.0),
    ]


EXPERIMENT = Experiment(
    "option-usage", "Options that fall out of use", seeds=10, work=float(len(VARIANTS) * DECISIONS), run=run
)
