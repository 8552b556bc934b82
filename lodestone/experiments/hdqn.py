"""h-DQN against flat learners (Kulkarni et al. 2016): the chain that pays after a visit, and a tower from pixels.

On the chain, goals are positions; h-DQN learns with tables and with networks, beside flat Q-learning, and greedy
policies are judged exactly. On the magnet arm, goals are held bricks and standing towers; h-DQN sees pictures, as do
DQN and DQN with the two hand-written options. All learners of a world take equally many primitive steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lodestone.agents.dqn import DQNConfig
from lodestone.agents.hdqn import HDQNConfig, hdqn
from lodestone.agents.playing import play
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.training import train_policy
from lodestone.envs.base import Environment
from lodestone.envs.chain import Chain
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.task import Task
from lodestone.experiments.comparison import Gate, at_least
from lodestone.experiments.curves import WINDOW, returns_in_training
from lodestone.experiments.following import Followed, follow
from lodestone.experiments.magnet_tower import FLAT, OPTION_CAP, WITH_OPTIONS, settings
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.goal_network import GoalNetwork, GoalOptions
from lodestone.learning.history import History
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Progress
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.catalogue import goals, option_names, scripted_options
from lodestone.options.execution import Rules
from lodestone.options.subgoals import arrival, subgoal_options
from lodestone.planning.option_models import evaluate_options, option_value_iteration, tabulate_options
from lodestone.planning.solve import evaluate_policy, optimum
from lodestone.planning.tables import Tables, tabulate
from lodestone.types import State

CHAIN, CHAIN_RULES = Chain(), Rules(discount=0.99, step_limit=100)
CHAIN_STEPS, CHAIN_LOOKS = 100_000, 12
TABLES, NETWORKS, Q_LEARNING = "h-DQN, tables", "h-DQN, networks", "Q-learning, flat"
_CHAIN_CONFIG = HDQNConfig(
    network=NetworkConfig(kernels=(), strides=(), channels=(), hidden=()),
    max_goal_steps=None,
    learning_rate=((0.0, 5e-3), (0.5, 3e-3), (1.0, 1e-4)),
    goal_replay_capacity=20_000,
    learning_starts=500,
    epsilon=((0.0, 1.0), (0.4, 0.1), (1.0, 0.05)),
    goal_epsilon=((0.0, 1.0), (0.4, 0.1), (1.0, 0.05)),
    ticks_per_round=4,
    updates_per_round=4,
    reward_scale=10.0,
)
CHAIN_CONFIGS: dict[str, HDQNConfig | QLearningConfig] = {
    TABLES: _CHAIN_CONFIG,
    NETWORKS: replace(_CHAIN_CONFIG, network=replace(_CHAIN_CONFIG.network, hidden=(64,))),
    Q_LEARNING: QLearningConfig(learning_rate=((0.0, 0.1), (0.4, 0.05)), epsilon=((0.0, 1.0), (0.4, 0.1), (1.0, 0.05))),
}
HURRY = 0.99
"""Discount of the exact controllers that the learned ones are held against."""
LAST = 0.2
"""Share of a run's episodes whose mean return is the one that training is judged by."""

ARM = MagnetArm(rows=4, columns=3, bricks=3, tower_height=3)
ARM_STEPS = 100_000
HDQN, DQN, DQN_OPTIONS = "h-DQN", "DQN", "DQN, two options"
STEPS_PER_DECISION = 1.2
"""Of DQN with options, rather too few: its schedules are in decisions, and its run ends after as many steps as the
others."""
ARM_WORK = 10.0 * CHAIN_STEPS
"""What a learner of the tower takes, about, beside one of the chain."""


@dataclass(frozen=True)
class OnArm:
    """One learner of the tower."""

    config: HDQNConfig | DQNConfig
    rules: Rules
    length: int
    """Steps, or decisions."""


def arm_learners() -> dict[str, OnArm]:
    """The learners, by name. DQN gets the settings that work best for it, with its random phase in proportion."""
    fast = settings("2", "fast").agents
    with_options = fast[WITH_OPTIONS].config
    flat = replace(fast[FLAT].config, learning_starts=ARM_STEPS // 3)
    rules = Rules(discount=0.97, step_limit=200)
    config = HDQNConfig(
        network=flat.network,
        shared="hidden",
        max_goal_steps=21,
        controller_first=0.3,
        learning_rate=flat.learning_rate,
        goal_replay_capacity=20_000,
        learning_starts=4000,
        reward_scale=flat.reward_scale,
    )
    return {
        HDQN: OnArm(config, rules, ARM_STEPS),
        DQN_OPTIONS: OnArm(with_options, rules, round(ARM_STEPS / STEPS_PER_DECISION)),
        DQN: OnArm(flat, rules, ARM_STEPS),
    }


@dataclass(frozen=True)
class Tower:
    """What one learner of the tower reached."""

    history: History
    steps: Int[np.ndarray, " N"]
    """Primitive steps of each seed's greedy policy."""
    success: np.ndarray
    """Whether it builds the tower."""


def run(seeds: int, progress: Progress) -> Study:
    """The chain on all seeds; the tower, which takes a hundred times as long, on half of them."""
    followed = {name: _follow(name, seeds, progress) for name in CHAIN_CONFIGS}
    towers = {name: _build(name, max(1, seeds // 2), progress) for name in arm_learners()}
    best_steps = optimum(ARM).optimal_steps
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "A meta-controller chooses goals, a controller is paid by a critic for reaching them. The chain pays 1 at "
            "its first state after a visit to its last, against the stream, and 0.01 before. Goals are its positions. "
            "Curves of the chain: exact return of the greedy policy. The tower of three bricks is built from pictures; "
            "goals are: a brick in hand beside a tower of one or two, a standing tower of two or three."
        ),
        seeds=seeds,
        panels=(
            _chain_panel(followed),
            returns_in_training(
                "Tower: return in training",
                {name: one.history for name, one in towers.items()},
                ARM_STEPS,
                optimum(ARM).optimal_return,
                (-210.0, 100.0),
            ),
        ),
        tables=(
            _exact_values(),
            NumberTable(
                f"Chain, {seeds} seeds, {CHAIN_STEPS:,} steps",
                ("", "return in training, mean", "worst seed", "greedy return, mean", "worst seed", "seconds"),
                tuple(
                    (
                        name,
                        *(round(float(f(_training_returns(one))), 4) for f in (np.mean, np.min)),
                        *(round(float(f(one.judged[-1])), 4) for f in (np.mean, np.min)),
                        round(one.seconds),
                    )
                    for name, one in followed.items()
                ),
            ),
            NumberTable(
                f"Tower, {max(1, seeds // 2)} seeds, {ARM_STEPS:,} steps",
                ("", "seeds that build it", f"at the optimum of {best_steps:g}", "steps, median", "worst", "seconds"),
                tuple(_tower_row(name, one, best_steps) for name, one in towers.items()),
            ),
        ),
        gates=tuple(_gates(followed, towers)),
    )


def _follow(name: str, seeds: int, progress: Progress) -> Followed:
    """One learner of the chain."""
    config, tables = CHAIN_CONFIGS[name], tabulate(CHAIN)
    progress.begin(f"hdqn: chain, {name}", CHAIN_STEPS)
    looking = partial(
        follow,
        seeds=seeds,
        looks=CHAIN_LOOKS,
        steps=CHAIN_STEPS,
        tell=lambda done, text: progress.advance(done * CHAIN_STEPS, text),
    )
    if isinstance(config, QLearningConfig):
        primitives = Primitives(CHAIN.action_names)
        algorithm = q_learning(config, CHAIN, primitives, CHAIN_RULES, CHAIN_STEPS)

        def judge_flat(carry: Any) -> Float[np.ndarray, " N"]:
            policies = np.asarray(carry.table)[:seeds].argmax(axis=2)
            return np.array([tables.initial_mean(evaluate_policy(tables, policy, 1.0)) for policy in policies])

        return looking(algorithm, CHAIN.action_names, rounds=CHAIN_STEPS // STEPS_PER_ROUND, judge=judge_flat)

    of_chain, cap = goals(CHAIN), config.goal_cap

    def judge(carry: Any) -> Float[np.ndarray, " N"]:
        networks = jax.tree.map(np.asarray, carry.learner.network)
        each = (jax.tree.map(lambda leaf, seed=seed: leaf[seed], networks) for seed in range(seeds))
        return np.array([greedy_return(tables, of_chain, network, cap) for network in each])

    algorithm = hdqn(config, CHAIN, of_chain, CHAIN_RULES, CHAIN_STEPS)
    names = tuple(goal.name for goal in of_chain)
    return looking(algorithm, names, rounds=config.rounds(CHAIN_STEPS), judge=judge)


def greedy_return(tables: Tables, of_goals: tuple[Task, ...], network: GoalNetwork, cap: int) -> float:
    """Exact expected return, undiscounted, of the greedy meta-controller over the greedy controller."""
    options = GoalOptions(of_goals, network, jnp.zeros(len(of_goals)), cap)
    found = tabulate_options(options, tables.space)
    values = _goal_values(of_goals[0], network, tables.space.states)
    choices = np.where(found.initiation.T, values, -np.inf).argmax(axis=1)
    return tables.initial_mean(evaluate_options(tables, found, choices, 1.0))


@jax.jit
def _goal_values(environment: Environment, network: GoalNetwork, states: State) -> Float[Array, "S G"]:
    return jax.vmap(lambda state: network.goal_values(environment.observe(state)))(states)


def _training_returns(one: Followed) -> Float[np.ndarray, " N"]:
    """Mean return of each seed's last episodes, exploration included."""
    returns = [one.history.episodes(seed).total_reward for seed in range(one.judged.shape[1])]
    return np.array([each[-round(LAST * len(each)) :].mean() for each in returns])


def _build(name: str, seeds: int, progress: Progress) -> Tower:
    """One learner of the tower."""
    learner = arm_learners()[name]
    progress.begin(f"hdqn: tower, {name}", ARM_WORK)

    def tell(history: History, fraction: float) -> bool:
        steps = min(history.taken(seed)[1] for seed in range(seeds))
        recent = [history.episodes(seed).total_reward[-WINDOW:] for seed in range(seeds)]
        means = [returns.mean() for returns in recent if len(returns)]
        text = f"mean return {np.mean(means):.0f}" if means else ""
        progress.advance(ARM_WORK * max(fraction, min(1.0, steps / ARM_STEPS)), text)
        return steps >= ARM_STEPS

    options: Options = Primitives(ARM.action_names)
    if name == DQN_OPTIONS:
        options = Union((options, Capped(scripted_options(ARM, option_names(ARM)), OPTION_CAP)))
    policy, history = train_policy(learner.config, ARM, options, learner.rules, learner.length, range(seeds), tell)
    episodes = play(policy, jax.random.key(0))
    return Tower(history, np.asarray(episodes.steps), np.asarray(episodes.success))


def _exact_values() -> NumberTable:
    """What can be reached at all, and what with exact controllers."""
    chain, arm = tabulate(CHAIN), tabulate(ARM)
    steps = arm.with_step_reward(-1.0)
    return NumberTable(
        "Exact values",
        ("", "actions", "goals with exact controllers"),
        (
            ("chain: return", optimum(CHAIN).optimal_return, _best_over_goals(chain, chain, CHAIN)),
            ("tower: steps", optimum(ARM).optimal_steps, -_best_over_goals(arm, steps, ARM)),
        ),
    )


def _best_over_goals(tables: Tables, paid: Tables, environment: Environment) -> float:
    """Best value, undiscounted, of choosing among the exact controllers, which hurry; `paid` has the rewards."""
    subgoals = [arrival(tables, goal, HURRY) for goal in goals(environment)]
    controllers = tabulate_options(subgoal_options(tables, subgoals, HURRY), tables.space)
    return paid.initial_mean(option_value_iteration(paid, controllers, 1.0).values)


def _chain_panel(followed: dict[str, Followed]) -> Panel:
    best = optimum(CHAIN).optimal_return
    x = np.linspace(0, CHAIN_STEPS, 100)
    return Panel(
        "Chain: exact return of the greedy policy",
        "primitive steps",
        "return",
        tuple(Series(name, x, one.at(one.steps, x)) for name, one in followed.items()),
        references=((f"optimum {best:.3f}", best),),
        y_range=(0.0, 0.22),
    )


def _tower_row(name: str, one: Tower, best_steps: float) -> tuple[str | float, ...]:
    built = one.steps[one.success]
    count = len(one.steps)
    middle, worst = (float(f(built)) if len(built) else float("nan") for f in (np.median, np.max))
    return (
        name,
        f"{len(built)} of {count}",
        f"{(built == best_steps).sum()} of {count}",
        middle,
        worst,
        round(one.history.seconds),
    )


def _gates(followed: dict[str, Followed], towers: dict[str, Tower]) -> list[Gate]:
    gates = []
    for name in (TABLES, NETWORKS):
        one = followed[name]
        gates += [
            at_least(f"chain: return in training of the worst seed, {name}", float(_training_returns(one).min()), 0.13),
            at_least(f"chain: greedy return of the worst seed, {name}", float(one.judged[-1].min()), 0.19),
        ]
    gates.append(at_least("tower: share of seeds that build it, h-DQN", float(towers[HDQN].success.mean()), 0.8))
    return gates


EXPERIMENT = Experiment(
    "hdqn",
    "h-DQN: goals, a controller and a critic",
    seeds=20,
    work=float(len(CHAIN_CONFIGS) * CHAIN_STEPS + len(arm_learners()) * ARM_WORK),
    run=run,
)
