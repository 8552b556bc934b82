"""Option-critic from pictures: a tower of three bricks, by options that nobody wrote.

The network of option-critic learns on the magnet arm of figure 2, from reward that comes once, at the end. The flat
actor-critic is the same learner with one option, whose termination changes nothing. Two more learners are made to
collapse, one to options of a single step, one to an option that never ends.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import expit

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig, deep_option_critic
from lodestone.agents.playing import EPISODES, play_many
from lodestone.agents.policies import OptionCriticPolicy
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.following import at_looks
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import History, running_mean
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.option_network import OptionNetwork
from lodestone.learning.progress import Progress
from lodestone.options.execution import Rules
from lodestone.options.soft import numbered_names
from lodestone.planning.option_gradients import OptionParameters, soft_option_process
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate
from lodestone.types import State

ARM = MagnetArm(rows=4, columns=3, bricks=3, tower_height=3)
RULES = Rules(discount=0.97, step_limit=200)
STEPS = 600_000
"""Of each seed."""
FOUR, FLAT, GREEDY, COSTLY = "4 options", "actor-critic", "4 options, epsilon 0", "4 options, deliberation cost"
_FOUR = DeepOptionCriticConfig(
    network=NetworkConfig(kernels=(3,), strides=(3,), channels=(16,), hidden=(128,)),
    reward_scale=0.2,
)
CONFIGS = {
    FOUR: _FOUR,
    FLAT: replace(_FOUR, num_options=1),
    GREEDY: replace(_FOUR, epsilon=((0.0, 0.0),)),
    COSTLY: replace(_FOUR, deliberation_cost=1.0),
}
COLLAPSES = (FOUR, GREEDY, COSTLY)
"""Whose options are watched."""
LOOKS = 60
WINDOW = 50
"""Episodes whose mean return is shown."""
RELIABLY = 0.99
"""Share of the episodes that a policy has to succeed in to be said to build the tower."""


class Run(NamedTuple):
    """One learner, N seeds, looked at C times."""

    history: History
    steps: Int[np.ndarray, "C N"]
    """Primitive steps that each seed had taken."""
    length: Float[np.ndarray, "C N"]
    """Mean steps of an option since the last look."""
    share: Float[np.ndarray, "C N"]
    """Share of the steps since then under the option that had most of them."""
    stops: Float[np.ndarray, "C N"]
    """Mean of beta over states and options."""
    least_stop: float
    """The smallest beta of all seeds in the end."""
    stops_on_arrival: Float[np.ndarray, " N"]
    """Mean of beta where options arrive in the end, exact."""
    gaps: Float[np.ndarray, " N"]
    """Optimal discounted value minus that of the greedy choice among the options, exact."""
    success: Float[np.ndarray, " N"]
    """Share of greedy episodes in which the tower is built."""
    greedy_steps: Float[np.ndarray, " N"]
    """Mean steps of a greedy episode."""


def run(seeds: int, progress: Progress) -> Study:
    """Train every learner."""
    runs = {name: _learn(name, seeds, progress) for name in CONFIGS}
    best = optimum(ARM)
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "A network learns options, their terminations and the choice among them at once, from pictures and the "
            "reward of a finished tower. Beside it the same learner with one option, a plain actor-critic.\n\n"
            "Terminations collapse in two ways. Against a greedy choice (epsilon 0) no option is ever worth more than "
            "choosing anew: terminations only grow, towards options of one step. Where a choice costs as much as a "
            "step (deliberation cost 1), one option runs for the whole episode."
        ),
        seeds=seeds,
        panels=(_returns(runs, best.optimal_return), *_over_training(runs)),
        tables=(_towers(runs, best.optimal_steps), _ends(runs)),
        gates=tuple(_gates(runs)),
    )


# ---------------------------------------------------------------------------------------------------------- learning


def _learn(name: str, seeds: int, progress: Progress) -> Run:
    config = CONFIGS[name]
    rounds = config.rounds(STEPS)
    algorithm = deep_option_critic(config, ARM, RULES, STEPS)
    history, looked = History(seeds, numbered_names(config.num_options)), []
    progress.begin(f"option-critic-arm: {name}", STEPS)
    for carry, chunk in train(algorithm, range(seeds), rounds, -(-rounds // LOOKS)):
        history.add(chunk)
        network = jax.tree.map(lambda leaf: np.asarray(leaf)[:seeds], carry.network)
        stops = expit(np.asarray(in_every_state(network)[2]))
        usage, taken = history.usage[-1], np.array([history.taken(seed)[1] for seed in range(seeds)])
        calls, steps = np.maximum(usage.calls.sum(axis=1), 1), usage.steps.sum(axis=1)
        share = usage.steps.max(axis=1) / np.maximum(steps, 1)
        looked.append((taken, steps / calls, share, stops.mean(axis=(1, 2))))
        returns = [history.episodes(seed).total_reward[-WINDOW:] for seed in range(seeds)]
        means = [values.mean() for values in returns if len(values)]
        progress.advance(STEPS * chunk.rounds / rounds, f"mean return {np.mean(means):.0f}" if means else "")
    taken, length, share, mean_stops = (np.stack(column) for column in zip(*looked, strict=True))
    policy = OptionCriticPolicy(name, ARM, RULES, config.temperature, network, tuple(range(seeds)), config.reward_scale)
    played = play_many(policy, jax.random.key(0), EPISODES)
    gaps, on_arrival = exactly(network, config.temperature)
    return Run(
        history=history,
        steps=taken,
        length=length,
        share=share,
        stops=mean_stops,
        least_stop=float(stops.min()),
        stops_on_arrival=on_arrival,
        gaps=gaps,
        success=np.asarray(played.success).mean(axis=1),
        greedy_steps=np.asarray(played.steps).mean(axis=1),
    )


@jax.jit
def in_every_state(
    networks: OptionNetwork,
) -> tuple[Float[Array, "N S O"], Float[Array, "N S O A"], Float[Array, "N S O"]]:
    """Q, theta and vartheta of N networks."""

    def one(network: OptionNetwork, state: State) -> tuple[Array, Array, Array]:
        features = network.trunk(ARM.observe(state))
        return network.values(features), network.theta(features), network.exits(features)

    states = reachable_states(ARM).states
    return jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(networks, states)


def exactly(networks: OptionNetwork, temperature: float) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Of the greedy choice among the options of each network: how far its discounted value is from the optimum, and the
    mean of beta where options arrive."""
    tables = tabulate(ARM)
    best = tables.initial_mean(value_iteration(tables, RULES.discount).values)
    gaps, stops = [], []
    for values, theta, exits in zip(*map(np.asarray, in_every_state(networks)), strict=True):
        parameters = OptionParameters(theta, exits, temperature)
        policy = np.eye(values.shape[1])[values.argmax(axis=1)]
        process = soft_option_process(tables, parameters, policy, RULES.discount)
        gaps.append(best - tables.initial_mean(process.values().values))
        arriving = process.arriving(process.after_a_step(tables.initial_probs[:, None] * policy))
        stops.append((arriving * parameters.terminations).sum() / arriving.sum())
    return np.array(gaps), np.array(stops)


# ----------------------------------------------------------------------------------------------------------- showing


def _returns(runs: dict[str, Run], best: float) -> Panel:
    x = np.linspace(0, STEPS, 150)

    def rows(one: Run) -> Float[np.ndarray, "N X"]:
        episodes = [one.history.episodes(seed) for seed in range(len(one.gaps))]
        means = [np.insert(running_mean(each.total_reward, WINDOW), 0, np.nan) for each in episodes]
        at = [np.searchsorted(each.steps, x, side="right") for each in episodes]
        return np.stack([mean[index] for mean, index in zip(means, at, strict=True)])

    return Panel(
        "Return in training",
        "primitive steps",
        f"return, mean of {WINDOW} episodes",
        tuple(Series(name, x, rows(one)) for name, one in runs.items()),
        references=((f"optimum {best:g}", best),),
        y_range=(-210.0, 100.0),
    )


def _over_training(runs: dict[str, Run]) -> list[Panel]:
    """What becomes of the options."""
    x = np.linspace(0, STEPS, 101)

    def panel(title: str, label: str, field: str, y_range: tuple[float, float]) -> Panel:
        series = tuple(Series(name, x, at_looks(runs[name].steps, getattr(runs[name], field), x)) for name in COLLAPSES)
        return Panel(title, "primitive steps", label, series, y_range=y_range)

    return [
        panel("Length of an option", "steps, mean", "length", (0.0, 30.0)),
        panel("Terminations", "beta, mean of states and options", "stops", (0.0, 1.0)),
        panel("The most used option", "share of the steps", "share", (0.0, 1.05)),
    ]


def _towers(runs: dict[str, Run], best_steps: float) -> NumberTable:
    return NumberTable(
        f"Tower, {STEPS:,} steps; optimum {best_steps:g} steps",
        (
            "",
            "seeds that build it",
            "within half a step of the optimum",
            "steps, mean of a greedy episode",
            "worst seed that builds it",
            "gap in discounted value, mean",
            "seconds",
        ),
        tuple(_tower(name, one, best_steps) for name, one in runs.items()),
    )


def _tower(name: str, one: Run, best_steps: float) -> tuple[str | float, ...]:
    built = one.greedy_steps[builds(one)]
    count = len(one.gaps)
    mean, worst = (float(f(built)) if len(built) else float("nan") for f in (np.mean, np.max))
    return (
        name,
        f"{len(built)} of {count}",
        f"{(built < best_steps + 0.5).sum()} of {count}",
        mean,
        worst,
        float(one.gaps.mean()),
        round(one.history.seconds),
    )


def builds(one: Run) -> Bool[np.ndarray, " N"]:
    """Whether each seed's greedy policy builds the tower."""
    return one.success >= RELIABLY


def _ends(runs: dict[str, Run]) -> NumberTable:
    return NumberTable(
        "Options in the end",
        (
            "",
            "beta, mean of states and options",
            "where options arrive",
            "smallest",
            "option length, steps",
            "share of the most used",
        ),
        tuple(
            (
                name,
                float(one.stops[-1].mean()),
                float(one.stops_on_arrival.mean()),
                one.least_stop,
                float(one.length[-1].mean()),
                float(one.share[-1].mean()),
            )
            for name in COLLAPSES
            for one in [runs[name]]
        ),
    )


def _gates(runs: dict[str, Run]) -> list[Gate]:
    four = runs[FOUR]
    over = four.greedy_steps[builds(four)].mean() - optimum(ARM).optimal_steps if builds(four).any() else np.inf
    return [
        at_least(f"share of seeds that build the tower, {FOUR}", builds(four).mean(), 0.8),
        at_least(f"share of seeds that build the tower, {FLAT}", builds(runs[FLAT]).mean(), 0.8),
        at_most(f"steps above the optimum, mean of the seeds that build it, {FOUR}", over, 2.0),
        at_most(f"{GREEDY}: by how much a beta has fallen", 0.5 - runs[GREEDY].least_stop, 0.0),
        at_most(f"{GREEDY}: option length", runs[GREEDY].length[-1].mean(), 2.0),
        at_least(f"{COSTLY}: option length", runs[COSTLY].length[-1].mean(), 10.0),
    ]


EXPERIMENT = Experiment(
    "option-critic-arm",
    "Option-critic from pictures: the tower of figure 2",
    seeds=10,
    work=float(STEPS * len(CONFIGS)),
    run=run,
)
