"""One united network against separate networks on the towers of the magnet arm (Kuzmin and Panov 2018, section 5).

The same learner trains three forms: every head a network of its own; one trunk under all heads, trained in stages with
the trunk frozen after the first; one trunk, all heads together. Nothing is given but the tasks of the two options:
their policies, their terminations and the policy over options are learned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import median
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from lodestone.agents.playing import play
from lodestone.agents.policies import UnitedPolicy
from lodestone.agents.pretraining import judge
from lodestone.agents.training import train_policy
from lodestone.agents.united import UnitedConfig
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import History, first_above, running_mean
from lodestone.learning.networks import NetworkConfig, count_parameters
from lodestone.learning.progress import Progress
from lodestone.learning.united_network import Shared, UnitedNetwork
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.planning.solve import optimum

RULES = Rules(discount=0.97, decision_limit=200)
WINDOW = 50
"""Episodes whose mean return is shown, and compared with the thresholds."""


@dataclass(frozen=True)
class Size:
    """One tower."""

    name: str
    arm: MagnetArm
    config: UnitedConfig
    steps: int
    """Primitive steps of the manager's environments, per seed."""
    threshold: float
    """Mean return whose first crossing is compared."""


_CONFIG = UnitedConfig(
    network=NetworkConfig(kernels=(3,), strides=(3,), channels=(8,), hidden=(256,)),
    start_environments=8,
)
SIZES = (
    Size(
        "4x3",
        MagnetArm(rows=4, columns=3, bricks=3, tower_height=3),
        replace(_CONFIG, epsilon=((0.3, 1.0), (0.6, 0.1)), learning_starts=10_000, updates_per_round=8),
        150_000,
        70.0,
    ),
    # The best tower stands two columns away, the next best, a step longer, in the next: all ways have to be known well.
    Size(
        "6x4",
        MagnetArm(rows=6, columns=4, bricks=4, tower_height=4),
        replace(
            _CONFIG,
            epsilon=((0.1, 1.0), (0.2, 0.5), (0.8, 0.5), (1.0, 0.05)),
            epsilon_spread=2.0,
            learning_rate=((0.0, 1e-3), (0.7, 1e-3), (0.85, 3e-4), (0.95, 5e-5), (1.0, 1e-5)),
            learning_starts=60_000,
            target_period=100,
            ticks_per_round=24,
            updates_per_round=12,
        ),
        1_600_000,
        50.0,
    ),
)

SEPARATE, STAGED, UNITED = "separate networks", "united, in stages", "united, together"
FORMS: dict[str, tuple[Shared, Literal["joint", "sequential"]]] = {
    SEPARATE: ("nothing", "joint"),
    STAGED: ("hidden", "sequential"),
    UNITED: ("hidden", "joint"),
}
WORK = {SEPARATE: 3.0, STAGED: 1.0, UNITED: 1.0}
"""What a step costs, about, in multiples of the cheapest."""


class Learned(NamedTuple):
    """One form on one tower, all seeds."""

    history: History
    parameters: int
    """Of one seed."""
    updates_per_second: float
    """Of all seeds together, in the second half of the run."""
    gaps: Float[np.ndarray, " N"]
    """Optimal return minus that of the greedy policy."""
    steps: Int[np.ndarray, " N"]
    decisions: Int[np.ndarray, " N"]
    option_success: Float[np.ndarray, "N options"]
    """Share of all layouts from which each option's policy does its task."""
    wrong_terminations: Int[np.ndarray, " N"]
    """Reachable states in which a termination head errs, summed over the heads."""


def run(seeds: int, progress: Progress) -> Study:
    """Train every form on every tower."""
    learned = {(size.name, form): _train(size, form, seeds, progress) for size in SIZES for form in FORMS}
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "The magnet arm learns its two options, their terminations and the policy over them. Separate: each of the "
            "six heads is a network of its own. United: the heads share all but their last layer, trained in "
            "stages (basic policy and trunk, then, with the trunk frozen, option policies, terminations, manager) or "
            "together, from one stream of experience that teaches every head. Greedy policies are judged beside the "
            "exact optimum, options on every layout, terminations in every reachable state."
        ),
        seeds=seeds,
        panels=tuple(
            learning_curves(
                f"Learning, {size.name}", size.arm, {form: learned[size.name, form].history for form in FORMS}
            )
            for size in SIZES
        ),
        tables=(*(_numbers(size, learned) for size in SIZES),),
        gates=tuple(_gates(learned)),
    )


def _train(size: Size, form: str, seeds: int, progress: Progress) -> Learned:
    shared, training = FORMS[form]
    config = replace(size.config, shared=shared, training=training)
    work = size.steps * WORK[form]
    progress.begin(f"united: {size.name}, {form}", work)

    def tell(history: History, fraction: float) -> bool:
        recent = [history.episodes(seed).total_reward[-WINDOW:] for seed in range(seeds)]
        means = [returns.mean() for returns in recent if len(returns)]
        progress.advance(fraction * work, f"mean return {np.mean(means):.0f}" if means else "")
        return False

    primitives = Primitives(size.arm.action_names)
    policy, history = train_policy(config, size.arm, primitives, RULES, size.steps, range(seeds), tell)
    assert isinstance(policy, UnitedPolicy)
    networks = [policy.network(seed) for seed in range(seeds)]
    episodes = play(policy, jax.random.key(0))
    return Learned(
        history=history,
        parameters=count_parameters(networks[0]),
        updates_per_second=_rate(history, config.rounds(size.steps) * config.updates_per_round * seeds),
        gaps=optimum(size.arm).optimal_return - np.asarray(episodes.total_reward),
        steps=np.asarray(episodes.steps),
        decisions=np.asarray(episodes.decisions),
        option_success=np.array([_option_success(policy, network) for network in networks]),
        wrong_terminations=np.array([wrong_terminations(policy, network) for network in networks]),
    )


def _rate(history: History, updates: int) -> float:
    """Chunks are equally long; the first ones hold the compilation, and rounds without updates."""
    seconds = [usage.seconds for usage in history.usage]
    half = len(seconds) // 2
    return updates * (1 - half / len(seconds)) / (seconds[-1] - seconds[half - 1]) if half else float("nan")


def _option_success(policy: UnitedPolicy, network: UnitedNetwork) -> list[float]:
    return [
        judge(task, network.policy(head), policy.option_cap).success for head, task in enumerate(policy.tasks, start=1)
    ]


def wrong_terminations(policy: UnitedPolicy, network: UnitedNetwork) -> int:
    """Reachable states in which a termination head differs from its task's end, summed over the heads."""
    states = reachable_states(policy.environment).states
    said = jax.vmap(lambda state: network(policy.environment.observe(state)).ended)(states)
    true = np.stack([np.asarray(jax.vmap(task.terminal)(states)) for task in policy.tasks], axis=1)
    return int((np.asarray(said) != true).sum())


def decisions_to(history: History, threshold: float) -> list[float]:
    """Of each seed, until the mean return exceeds the threshold; infinite where it never does."""
    found = []
    for seed in range(history.seeds):
        episodes = history.episodes(seed)
        position = first_above(episodes, threshold, WINDOW)
        found.append(float("inf") if position is None else float(episodes.decisions[position]))
    return found


def learning_curves(title: str, arm: MagnetArm, histories: dict[str, History]) -> Panel:
    """Mean returns over decisions, beside the optimum."""
    most = max(history.taken(seed)[0] for history in histories.values() for seed in range(history.seeds))
    x = np.linspace(0, most, 150)

    def rows(history: History) -> Float[np.ndarray, "N X"]:
        curves = []
        for seed in range(history.seeds):
            episodes = history.episodes(seed)
            means = np.insert(running_mean(episodes.total_reward, WINDOW), 0, np.nan)
            row = means[np.searchsorted(episodes.decisions, x, side="right")]
            row[x > history.taken(seed)[0]] = np.nan
            curves.append(row)
        return np.stack(curves)

    best = optimum(arm).optimal_return
    return Panel(
        title,
        "decisions",
        f"return, mean of {WINDOW} episodes",
        tuple(Series(name, x, rows(history)) for name, history in histories.items()),
        references=((f"optimum {best:g}", best),),
        y_range=(-300.0, 100.0),
    )


def _numbers(size: Size, learned: dict[tuple[str, str], Learned]) -> NumberTable:
    rows: list[tuple[str | float, ...]] = []
    for form in FORMS:
        one = learned[size.name, form]
        rows.append(
            (
                form,
                one.parameters,
                round(one.updates_per_second),
                median(decisions_to(one.history, size.threshold)),
                f"{(one.gaps == 0).sum()} of {len(one.gaps)}",
                float(np.median(one.gaps)),
                float(one.gaps.max()),
                float(np.median(one.decisions)),
                *(float(success) for success in one.option_success.min(axis=0)),
                int(one.wrong_terminations.max()),
                round(one.history.seconds),
            )
        )
    return NumberTable(
        f"{size.name}: {reachable_states(size.arm).size} states",
        (
            "",
            "parameters",
            "updates/s, all seeds",
            f"decisions to return {size.threshold:g}, median",
            "seeds at the optimum",
            "gap, median",
            "gap, worst",
            "decisions, greedy, median",
            "go-down: layouts done, worst seed",
            "lift: layouts done, worst seed",
            "termination errors, worst seed",
            "seconds",
        ),
        tuple(rows),
    )


def _gates(learned: dict[tuple[str, str], Learned]) -> list[Gate]:
    small = learned["4x3", UNITED]
    gates = [
        at_least("4x3: both options on all layouts, worst seed", float(small.option_success.min()), 1.0),
        at_most("4x3: termination errors over all states, worst seed", int(small.wrong_terminations.max()), 0),
        at_most("4x3: gap of the greedy policy, worst seed", float(small.gaps.max()), 0.0),
        at_most("4x3: decisions of the greedy policy, worst seed", int(small.decisions.max()), 10),
    ]
    for size in SIZES:
        united, separate = learned[size.name, UNITED], learned[size.name, SEPARATE]
        gates += [
            at_least(
                f"{size.name}: share of seeds whose gap is no larger than with separate networks",
                float((united.gaps <= separate.gaps).mean()),
                0.9,
            ),
            at_most(f"{size.name}: parameters, united / separate", united.parameters / separate.parameters, 0.4),
            at_least(
                f"{size.name}: updates per second, united / separate",
                united.updates_per_second / separate.updates_per_second,
                1.5,
            ),
        ]
    return gates


EXPERIMENT = Experiment(
    "united",
    "One united network against separate networks",
    seeds=10,
    work=float(sum(size.steps for size in SIZES) * sum(WORK.values())),
    run=run,
)
