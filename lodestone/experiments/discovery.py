"""Options that nobody wrote: exact numbers of discovery, and learners that choose from what was discovered.

In the four rooms, all that the methods compute stands beside independent computations. On the magnet arm, options are
discovered from a walk at random that is told of no task, and a DQN that may choose them looks for its first tower; it
stands beside a DQN with two options written by hand, and one without options. The steps of the walk count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.training import train_policy
from lodestone.discovery.betweenness import BetweennessConfig, Bottlenecks
from lodestone.discovery.catalogue import MethodConfig, diffusion_times, discover
from lodestone.discovery.covering import Covering, CoveringConfig
from lodestone.discovery.eigenoptions import Eigenoptions, EigenoptionsConfig
from lodestone.discovery.experience import Recording
from lodestone.discovery.graph import interaction_graph, mean_hitting_steps
from lodestone.discovery.knowledge import everything_without_task
from lodestone.envs.four_rooms import SQUARES, FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments import magnet_tower
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.following import Followed, follow
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.history import Episodes, History, running_mean
from lodestone.learning.progress import Progress
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.options.execution import Rules
from lodestone.planning.option_models import option_models, tabulate_options
from lodestone.planning.solve import optimum
from lodestone.planning.tables import tabulate

HOUSE = FourRooms("deterministic")
HOUSE_RULES = Rules(discount=0.95, step_limit=1000)
HOUSE_STEPS, EPISODES = 40_000, 200
HOUSE_LEARNER = QLearningConfig(learning_rate=((0.0, 0.25),), epsilon=((0.0, 0.1),))

MAXIMA = {
    (3, 7): 0.2901,
    (3, 5): 0.2860,
    (6, 9): 0.2771,
    (8, 9): 0.2735,
    (5, 2): 0.2335,
    (7, 2): 0.2281,
    (10, 7): 0.2247,
    (10, 5): 0.2230,
}
"""Local maxima of the betweenness; this and what follows are from independent computations."""
EIGENVALUES = (0.00701, 0.00850, 0.01741, 0.09398, 0.11929)
CONNECTIVITY = (0.0229, 0.02714, 0.05079, 0.05465, 0.06464)
"""lambda_2 before the first pair of covering options and after each."""
HITTING = (501.39, 300.67)
"""Mean hitting time of the random walk along the edges, without and with an edge for each pair."""
DIFFUSION = {0: 620.77, 1: 607_789, 2: 13_525, 4: 1_789, 8: 667.47, 16: 234.31, 32: 218.43}
"""Diffusion time with the eigenoptions of so many vectors."""
COVERING_DIFFUSION = 4362.68
"""With eight options to the ends of the pairs that may start everywhere."""

ACTIONS = "actions"
HOUSE_METHODS: dict[str, MethodConfig] = {
    "8 covering options": CoveringConfig(number=8),
    "8 bottleneck options": BetweennessConfig(number=8, nearest=30),
    "32 eigenoptions": EigenoptionsConfig(number=32),
}
FIRST_EPISODES = {"8 covering options": 0.7, "8 bottleneck options": 0.5, "32 eigenoptions": 0.25}
"""What part of the steps without options the first ten episodes may take, at most."""

ARM_METHOD = EigenoptionsConfig(number=8, basis="differences")
WALK = Recording(trajectories=10, steps=2000)
DISCOVERED, BY_HAND, FLAT = "DQN, discovered options", "DQN, options by hand", "DQN"
ARM_SHARE = 2
"""The arm is learned by one for so many seeds: each run takes a minute."""
WORK = 1_000_000.0


def run(seeds: int, progress: Progress) -> Study:
    """The numbers of the house, tabular learners in it, then the arm."""
    progress.begin("discovery: exact numbers", 0.02 * WORK)
    numbers = _house_numbers()
    followed = {name: _follow(name, seeds, progress) for name in (ACTIONS, *HOUSE_METHODS)}
    arm = _learn_arm(max(1, seeds // ARM_SHARE), progress)
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "In the four rooms without chance, discovery is told of no goal; numbers stand beside independent ones. "
            "Few eigenoptions hold a walk at random back, more speed it up. On the magnet arm, they are discovered "
            f"from {WALK.trajectories * WALK.steps:,} random steps, of every seed its own and told of no tower, and "
            "planned in what these steps have shown. A DQN that may choose them finds its first tower far sooner than "
            "one without options, with the steps of discovery counted; options written by hand are better still."
        ),
        seeds=seeds,
        panels=(_lengths(followed), *_arm_panels(arm)),
        tables=(
            NumberTable("Four rooms, exact", ("", "computed", "independent"), tuple(numbers)),
            _arm_table(arm),
        ),
        gates=(*_house_gates(numbers), *_learning_gates(followed), *_arm_gates(arm)),
    )


# ------------------------------------------------------------------------------------------------------- four rooms


def _house_numbers() -> list[tuple[str, float, float]]:
    """What is computed, and what it should be."""
    between = discover(HOUSE, BetweennessConfig(number=100))
    eigen = discover(HOUSE, EigenoptionsConfig(number=10))
    cover = discover(HOUSE, CoveringConfig(number=8))
    assert isinstance(between.found, Bottlenecks)
    assert isinstance(eigen.found, Eigenoptions)
    assert isinstance(cover.found, Covering)
    squares = SQUARES[np.asarray(between.space.states.cell)]
    found = {tuple(int(number) for number in squares[state]): state for state in between.found.subgoals}
    rows: list[tuple[str, float, float]] = [
        ("betweenness: local maxima that are not among the expected, or missing", len(found.keys() ^ MAXIMA), 0)
    ]
    for square, value in MAXIMA.items():
        state = int(np.flatnonzero((squares == square).all(axis=1))[0])
        rows.append((f"betweenness of {square}", float(between.found.centrality[state]), value))
    for number, (value, wanted) in enumerate(zip(eigen.found.eigenvalues, EIGENVALUES, strict=True), start=1):
        rows.append((f"eigenvalue {number} of the normalised Laplacian", float(value), wanted))
    for number, (value, wanted) in enumerate(zip(cover.found.connectivity, CONNECTIVITY, strict=True)):
        rows.append((f"lambda_2 with {number} pairs of covering options", value, wanted))
    graph = interaction_graph(everything_without_task(HOUSE)).undirected()
    for name, edges, wanted in zip(("no pair", "4 pairs"), (graph, cover.found.edges), HITTING, strict=True):
        rows.append((f"mean hitting time along edges, {name}", mean_hitting_steps(edges), wanted))
    for vectors, wanted in DIFFUSION.items():
        options = discover(HOUSE, EigenoptionsConfig(number=2 * max(vectors, 1))).options
        rows.append(
            (f"diffusion time, {2 * vectors} eigenoptions", diffusion_times(HOUSE, options)[vectors > 0], wanted)
        )
    everywhere = discover(HOUSE, CoveringConfig(number=8, initiation="everywhere")).options
    _, together = diffusion_times(HOUSE, everywhere)
    rows.append(("diffusion time, 8 covering options from everywhere", together, COVERING_DIFFUSION))
    return rows


def _house_gates(numbers: list[tuple[str, float, float]]) -> list[Gate]:
    off = [(abs(value - wanted), wanted) for _, value, wanted in numbers[1:]]
    return [
        at_most("four rooms: wrong or missing maxima of the betweenness", numbers[0][1], 0),
        at_most("four rooms: largest distance, numbers below 1", max(far for far, wanted in off if wanted < 1), 5.1e-5),
        at_most(
            "four rooms: largest relative distance, numbers above 1",
            max(far / wanted for far, wanted in off if wanted > 1),
            2.5e-4,
        ),
    ]


def _follow(name: str, seeds: int, progress: Progress) -> Followed:
    """Q-learning, judged by its mean reward of late, which nobody looks at: what counts is how long episodes take."""
    progress.begin(f"discovery: four rooms, {name}", 0.02 * WORK)
    primitives = Primitives(HOUSE.action_names)
    options: Options = primitives
    if name in HOUSE_METHODS:
        options = Union((primitives, discover(HOUSE, HOUSE_METHODS[name]).options))

    def judge(carry: Any) -> Float[np.ndarray, " N"]:
        return np.asarray(carry.table)[:seeds].max(axis=2).mean(axis=1)

    return follow(
        q_learning(HOUSE_LEARNER, HOUSE, options, HOUSE_RULES, HOUSE_STEPS),
        options.names,
        seeds,
        HOUSE_STEPS // STEPS_PER_ROUND,
        10,
        judge,
        HOUSE_STEPS,
        lambda done, text: progress.advance(done * 0.02 * WORK, text),
    )


def _lengths(followed: dict[str, Followed]) -> Panel:
    best, x = optimum(HOUSE).optimal_steps, np.arange(1.0, EPISODES + 1)
    return Panel(
        "Four rooms, Q-learning with options",
        "episode",
        "steps, mean of the last 10 episodes",
        tuple(Series(name, x, one.episode_lengths(EPISODES)) for name, one in followed.items()),
        references=((f"optimum {best:.1f}", best),),
        log_x=True,
        y_range=(0.0, 500.0),
    )


def _learning_gates(followed: dict[str, Followed]) -> list[Gate]:
    first = {name: float(np.nanmean(one.episode_lengths(EPISODES)[:, 9])) for name, one in followed.items()}
    return [
        at_most(f"four rooms: steps of the first 10 episodes, {name} / {ACTIONS}", first[name] / first[ACTIONS], limit)
        for name, limit in FIRST_EPISODES.items()
        if name in first
    ]


# ------------------------------------------------------------------------------------------------------- magnet arm


class _Learned(NamedTuple):
    """What one learner did on the arm, N seeds."""

    walked: int
    """Primitive steps of discovery before."""
    budget: int
    """Decisions that each seed had."""
    episodes: tuple[Episodes, ...]
    chances: tuple[float, ...]
    """Exact probability that an episode of choices at random builds the tower; once where all seeds share options."""

    def first_successes(self) -> list[float]:
        """Decisions until the first tower of each seed, discovery counted; the whole budget where there is none."""
        found = []
        for one in self.episodes:
            decisions = one.decisions[one.success]
            found.append(self.walked + float(decisions[0] if len(decisions) else self.budget))
        return found

    @property
    def succeeded(self) -> int:
        """Seeds that built a tower at least once."""
        return sum(bool(one.success.any()) for one in self.episodes)


def arm_settings() -> tuple[MagnetArm, magnet_tower.Training]:
    """The arm of figure 3 and the settings of its `fast` preset, the same for all learners."""
    chosen = magnet_tower.settings("3", "fast")
    return chosen.environment, chosen.agents[magnet_tower.FLAT]


def chance_of_success(environment: MagnetArm, options: Options, decisions: int) -> float:
    """Probability that an episode of so many decisions, each drawn uniformly from the options that may start, ends
    where the environment ends it. Exact."""
    tables = tabulate(environment)
    tabulated = tabulate_options(options, tables.space)
    models = option_models(tables, tabulated, 1.0)
    share = tabulated.initiation / tabulated.initiation.sum(axis=0)
    chance = tables.terminal.astype(np.float64)
    for _ in range(decisions):
        after = sum(share[option] * model.backup(chance) for option, model in enumerate(models))
        chance = np.where(tables.terminal, 1.0, after)
    return tables.initial_mean(chance)


def _learn_arm(seeds: int, progress: Progress) -> dict[str, _Learned]:
    arm, training = arm_settings()
    primitives = Primitives(arm.action_names)
    share = (WORK - 0.02 * WORK * (2 + len(HOUSE_METHODS))) / 3
    progress.begin(f"discovery: arm, {DISCOVERED}", share)
    episodes, chances = [], []
    for seed in range(seeds):
        found = discover(arm, ARM_METHOD, "trajectories", replace(WALK, seed=seed))
        options = Union((primitives, found.options))

        def tell(fraction: float, seed: int = seed) -> None:
            progress.advance((seed + fraction) / seeds * share, f"discovery {seed + 1} of {seeds}")

        episodes += _train(arm, training, options, [seed], tell)
        chances.append(chance_of_success(arm, options, training.rules.decision_limit or 0))
    steps = WALK.trajectories * WALK.steps
    learned = {DISCOVERED: _Learned(steps, training.decisions, tuple(episodes), tuple(chances))}
    scripts = Capped(scripted_options(arm, ("go-down", "lift")), magnet_tower.OPTION_CAP)
    others: tuple[tuple[str, Options], ...] = ((BY_HAND, Union((primitives, scripts))), (FLAT, primitives))
    for name, chosen_from in others:
        progress.begin(f"discovery: arm, {name}", share)
        found_by = _train(
            arm, training, chosen_from, range(seeds), lambda fraction: progress.advance(fraction * share, "training")
        )
        chance = chance_of_success(arm, chosen_from, training.rules.decision_limit or 0)
        learned[name] = _Learned(0, training.decisions, tuple(found_by), (chance,))
    return learned


def _train(
    arm: MagnetArm,
    training: magnet_tower.Training,
    options: Options,
    seeds: Any,
    tell: Callable[[float], None],
) -> list[Episodes]:
    def on_chunk(history: History, fraction: float) -> bool:
        tell(fraction)
        return False

    _, history = train_policy(training.config, arm, options, training.rules, training.decisions, seeds, on_chunk)
    return [history.episodes(position) for position in range(len(seeds))]


def _arm_panels(learned: dict[str, _Learned]) -> tuple[Panel, Panel]:
    """Mean returns, and the share of seeds that have built a tower, over decisions and the steps of discovery."""
    arm, _ = arm_settings()
    best = optimum(arm).optimal_return
    ends = {name: one.walked + one.budget for name, one in learned.items()}
    grids = {name: np.linspace(0, end, 200) for name, end in ends.items()}
    returns, built = [], []
    for name, one in learned.items():
        rows = []
        for episodes in one.episodes:
            means = np.insert(running_mean(episodes.total_reward, 50), 0, np.nan)
            rows.append(means[np.searchsorted(one.walked + episodes.decisions, grids[name], side="right")])
        returns.append(Series(name, grids[name], np.stack(rows)))
        # A share is one curve for all seeds.
        firsts = np.array([first if first < ends[name] else np.inf for first in one.first_successes()])
        built.append(Series(name, grids[name], (firsts[:, None] <= grids[name]).mean(axis=0)[None]))
    label = "decisions, and steps of discovery"
    return (
        Panel(
            "Magnet arm, 6 x 4, 4 bricks",
            label,
            "return, mean of 50 episodes",
            tuple(returns),
            references=((f"optimum {best:g}", best),),
        ),
        Panel("Seeds that have built a tower", label, "share", tuple(built), y_range=(0.0, 1.05)),
    )


def _arm_table(learned: dict[str, _Learned]) -> NumberTable:
    rows = []
    for name, one in learned.items():
        firsts = one.first_successes()
        middle = median(firsts)
        least = "at least " if middle >= one.walked + one.budget else ""
        rows.append(
            (
                name,
                float(one.walked),
                f"{least}{middle:,.0f}",
                f"{one.succeeded} of {len(firsts)}",
                f"{median(one.chances):.2g}",
            )
        )
    return NumberTable(
        "Magnet arm: the first tower, medians over seeds",
        (
            "",
            "steps of discovery",
            "steps of discovery and decisions to the first tower",
            "seeds with a tower",
            "chance of an episode at random",
        ),
        tuple(rows),
    )


def _arm_gates(learned: dict[str, _Learned]) -> list[Gate]:
    firsts = {name: median(one.first_successes()) for name, one in learned.items()}
    return [
        at_most(
            "arm: median steps of discovery and decisions to the first tower, discovered / flat (its budget at least)",
            firsts[DISCOVERED] / firsts[FLAT],
            0.5,
        ),
        at_least(
            "arm: share of seeds with discovered options that build a tower",
            learned[DISCOVERED].succeeded / len(learned[DISCOVERED].episodes),
            0.7,
        ),
    ]


EXPERIMENT = Experiment(
    "discovery",
    "Discovered options in the four rooms and on the magnet arm",
    seeds=20,
    work=WORK,
    run=run,
)
