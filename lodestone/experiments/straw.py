"""STRAW (Vezhnevets et al. 2016): plans of many steps, and when the next is made; sequences, a maze, a tower.

A grammar of words that begin alike and end in one of two ways is read symbol by symbol: all there is to know is which
of two symbols came, once a word. In the maze one of four goals is meant, and whoever has seen which, and where it
stands, can go on for steps without a look. The tower is built from pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.agents.playing import MAX_STEPS
from lodestone.agents.policies import PlanPolicy
from lodestone.agents.straw import StrawConfig
from lodestone.agents.training import train_policy
from lodestone.envs.base import Environment
from lodestone.envs.goal_maze import GoalMaze
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments.comparison import Gate, at_least, at_most
from lodestone.experiments.curves import WINDOW, returns_in_training
from lodestone.experiments.study import Experiment, NumberTable, Panel, Series, Study
from lodestone.learning.evaluation import Episode
from lodestone.learning.history import History
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_execution import play_on, start_planning
from lodestone.learning.plan_network import PlanConfig, PlanNetwork
from lodestone.learning.plan_sequences import Reader, SequenceConfig, predict, read_on, start_reader
from lodestone.learning.progress import Progress
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.planning.solve import optimum
from lodestone.types import State

WORDS = ("abcx", "abdy")
"""Each comes with probability 1/2 after each. What follows `c` or `d` is known for three symbols: x a b, or y a b."""
SYMBOLS = "abcdxy"
ENTROPY_RATE = float(np.log(len(WORDS))) / len(WORDS[0])
"""In nats a symbol, exactly."""
GRAMMAR = SequenceConfig()
GRAMMAR_UPDATES = 6_000
GRAMMAR_LOOKS = 40
POSITIONS = ("x, y", "a", "b", "c, d")
"""The symbols in order of their places in a stretch, which begins after a word's last one."""
BRANCH = 3
"""The place where a symbol is seen that could not be known."""

MAZE, MAZE_RULES = GoalMaze(observation="planes"), Rules(discount=0.97, step_limit=50)
MAZE_STEPS = 1_200_000
PLANNING, EVERY_STEP = "STRAW", "STRAW, a new plan at every step"
_MAZE_CONFIG = StrawConfig(
    network=NetworkConfig(kernels=(), strides=(), channels=(), hidden=(64,)),
    commitment_cost=((0.0, 0.0), (0.4, 0.0), (0.6, 0.05)),
    learning_rate=((0.0, 2e-3), (0.6, 2e-3), (1.0, 1e-4)),
    reward_scale=0.1,
)
MAZE_CONFIGS: dict[str, StrawConfig] = {
    PLANNING: _MAZE_CONFIG,
    EVERY_STEP: replace(_MAZE_CONFIG, plan=replace(_MAZE_CONFIG.plan, background=20.0), sharpness=((0.0, 1.0),)),
}

ARM, ARM_RULES = MagnetArm(rows=4, columns=3, bricks=3, tower_height=3), Rules(discount=0.97, step_limit=200)
ARM_STEPS = 800_000
ARM_CONFIG = StrawConfig(
    network=NetworkConfig(kernels=(3,), strides=(3,), channels=(16,), hidden=(128,)),
    plan=PlanConfig(horizon=4, patch=4),
    # While a tower is looked for most steps plan anew; then fewer, to learn what comes second, and that looks cost.
    sharpness=((0.0, 0.3), (0.4, 0.3), (0.55, 0.15), (0.85, 0.15), (0.97, 1.0)),
    commitment_cost=((0.0, 0.0), (0.45, 0.0), (0.65, 0.4)),
    entropy=((0.0, 0.3), (1.0, 0.01)),
    decay=0.9,
    learning_rate=((0.0, 1e-3), (0.85, 1e-3), (1.0, 1e-4)),
    adam_epsilon=1e-4,
    max_gradient_norm=10.0,
    environments=32,
    rollout=8,
    reward_scale=0.2,
)
WORK = {"grammar": 1.0, PLANNING: 1.6, EVERY_STEP: 1.6, "tower": 3.0}
"""What each part takes, about, beside the others."""


# ------------------------------------------------------------------------------------------------------------ grammar


class Reading(NamedTuple):
    """What N seeds have learned of the grammar."""

    updates: Int[np.ndarray, " X"]
    surprise: Float[np.ndarray, "N X"]
    """Negative log-likelihood in nats a symbol, mean of the updates since the last look."""
    judged: Float[np.ndarray, " N"]
    """The same after learning, on as many symbols as `JUDGED`."""
    anew: Float[np.ndarray, "N 4"]
    """After learning: how often a step plans anew, by the place in a word of the symbol that it sees."""
    commitment: Float[np.ndarray, "N T"]
    """c after a plan that was made at the branch."""
    right: Float[np.ndarray, "N T"]
    """Probability that such a plan gives to the symbols that follow, as far as they can be known; at the next branch,
    to both together."""
    seconds: float


JUDGED = 4000
"""Words by which what was learned is judged."""


def draw_words(key: PRNGKeyArray, sequences: int, words: int) -> Int[Array, "B L"]:
    """So many words for each of B sequences, symbol by symbol."""
    spelled = jnp.array([[SYMBOLS.index(symbol) for symbol in word] for word in WORDS], dtype=jnp.int32)
    return spelled[jax.random.randint(key, (sequences, words), 0, len(WORDS))].reshape(sequences, -1)


def read(seeds: int, updates: int, tell: Callable[[float, str], None]) -> Reading:
    """Learn the grammar, all seeds at once."""
    draw = partial(draw_words, sequences=GRAMMAR.sequences, words=GRAMMAR.stretch // len(WORDS[0]))
    per_look = max(1, updates // GRAMMAR_LOOKS)

    def start(key: PRNGKeyArray) -> Reader:
        first_key, network_key = jax.random.split(key)
        return start_reader(GRAMMAR, len(SYMBOLS), draw(first_key)[:, -1], network_key)

    def learn(reader: Reader, key: PRNGKeyArray, first: Int[Array, ""]) -> tuple[Reader, Float[Array, ""]]:
        def update(reader: Reader, number: Int[Array, ""]) -> tuple[Reader, Float[Array, ""]]:
            fraction = (first + number).astype(jnp.float32) / updates
            reader, predicted = read_on(GRAMMAR, draw, reader, jax.random.fold_in(key, first + number), fraction)
            return reader, jnp.mean(predicted.surprise)

        reader, surprise = jax.lax.scan(update, reader, jnp.arange(per_look, dtype=jnp.int32))
        return reader, jnp.mean(surprise)

    started = perf_counter()
    keys = jnp.stack([jax.random.key(seed) for seed in range(seeds)])
    readers = jax.jit(jax.vmap(start))(keys)
    learn_all = jax.jit(jax.vmap(learn, in_axes=(0, 0, None)))
    looks = []
    for first in range(0, updates, per_look):
        readers, surprise = learn_all(readers, keys, jnp.int32(first))
        looks.append(np.asarray(surprise))
        done = min(1.0, (first + per_look) / updates)
        tell(done, f"{looks[-1].mean():.4f} nats a symbol, at best {ENTROPY_RATE:.4f}")
    judged, anew, commitment, right = jax.tree.map(np.asarray, jax.jit(jax.vmap(judge_reader))(readers, keys))
    return Reading(
        updates=per_look * (1 + np.arange(len(looks))),
        surprise=np.stack(looks, axis=1),
        judged=judged,
        anew=anew,
        commitment=commitment,
        right=right,
        seconds=perf_counter() - started,
    )


def judge_reader(reader: Reader, key: PRNGKeyArray) -> tuple[Array, Array, Array, Array]:
    """`judged`, `anew`, `commitment` and `right` of a `Reading`, for one seed."""
    word_key, gate_key, noise_key = jax.random.split(jax.random.fold_in(key, GRAMMAR_UPDATES), 3)
    network, plan = reader.network, jax.tree.map(lambda leaf: leaf[0], reader.plan)
    symbols = jnp.concatenate([reader.last[:1], draw_words(word_key, 1, JUDGED)[0]])
    length = symbols.size - 1
    uniform = jax.random.uniform(gate_key, (length,))
    noise = jax.random.normal(noise_key, (length, network.noise_size))
    one = jnp.float32(1)
    _, predicted = predict(network, one, plan, symbols, uniform, noise)
    anew = jnp.mean(predicted.anew.reshape(-1, len(WORDS[0])), axis=0, dtype=jnp.float32)

    # A plan made where `c` is seen, a few words on; the last symbol is only predicted.
    story = jnp.concatenate(
        [reader.last[:1], draw_words(word_key, 1, 8)[0, :-2], jnp.array([SYMBOLS.index(s) for s in "cx"])]
    )
    count = story.size - 1
    sees = jnp.where(jnp.arange(count) == count - 1, 0.0, uniform[:count])  # there it plans anew for sure
    made, _ = predict(network, one, plan, story, sees, noise[:count])
    probs = jax.nn.softmax(made.logits, axis=0)
    following = [[SYMBOLS.index(symbol) for symbol in both] for both in ("x", "a", "b", "cd", "xy", "a", "b", "cd")]
    right = jnp.stack([jnp.sum(probs[jnp.array(each), column]) for column, each in enumerate(following)])
    return jnp.mean(predicted.surprise), anew, made.commitment, right


# --------------------------------------------------------------------------------------------- the maze and the tower


@dataclass(frozen=True)
class Trained:
    """What one learner has reached."""

    history: History
    policy: PlanPolicy
    total_reward: Float[np.ndarray, " N"]
    """Mean return of each seed's greedy policy over all starts, exactly: nothing is drawn."""
    steps: Float[np.ndarray, " N"]
    """Its mean steps."""
    plans: Float[np.ndarray, " N"]
    """Its mean number of plans."""
    success: Float[np.ndarray, " N"]
    """The share of starts from which it gets there."""


def judge(policy: PlanPolicy) -> Episode:
    """Every seed's greedy episodes from all starts, in a world without chance; leaves have axes for seed and start."""
    environment, rules, key = policy.environment, policy.rules, jax.random.key(0)
    _, starts = environment.initial_distribution()

    def play(network: PlanNetwork, start: State) -> Episode:
        planning = start_planning(environment, network, key)
        planning = planning._replace(actor=planning.actor._replace(state=start))
        return play_on(environment, rules, network, key, planning, rules.step_limit or MAX_STEPS)

    run = jax.jit(jax.vmap(jax.vmap(play, in_axes=(None, 0)), in_axes=(0, None)))
    return jax.tree.map(np.asarray, run(policy.networks, starts))


def learn(
    name: str,
    config: StrawConfig,
    environment: Environment,
    rules: Rules,
    steps: int,
    seeds: int,
    work: float,
    progress: Progress,
) -> Trained:
    """Train and judge one learner."""
    progress.begin(f"straw: {name}", work)

    def tell(history: History, fraction: float) -> bool:
        recent = [history.episodes(seed).total_reward[-WINDOW:] for seed in range(seeds)]
        means = [returns.mean() for returns in recent if len(returns)]
        progress.advance(work * fraction, f"mean return {np.mean(means):.1f}" if means else "")
        return False

    primitives = Primitives(environment.action_names)
    policy, history = train_policy(config, environment, primitives, rules, steps, range(seeds), tell)
    assert isinstance(policy, PlanPolicy)
    episodes = judge(policy)
    return Trained(history, policy, *(np.asarray(leaf).mean(axis=1) for leaf in episodes))


def plan_lengths(history: History) -> tuple[Int[np.ndarray, " X"], Float[np.ndarray, "N X"]]:
    """(steps taken, mean length of plans in between) of every seed."""
    steps = np.stack([usage.steps.sum(axis=1) for usage in history.usage], axis=1)
    plans = np.stack([usage.calls.sum(axis=1) for usage in history.usage], axis=1)
    return np.cumsum(steps.mean(axis=0)).astype(int), steps / plans


def run(seeds: int, progress: Progress) -> Study:
    """The grammar and the maze on all seeds; the tower, too."""
    progress.begin("straw: grammar", WORK["grammar"])
    reading = read(seeds, GRAMMAR_UPDATES, lambda done, text: progress.advance(WORK["grammar"] * done, text))
    mazes = {
        name: learn(name, config, MAZE, MAZE_RULES, MAZE_STEPS, seeds, WORK[name], progress)
        for name, config in MAZE_CONFIGS.items()
    }
    tower = learn("tower", ARM_CONFIG, ARM, ARM_RULES, ARM_STEPS, seeds, WORK["tower"], progress)
    best_maze, best_arm = optimum(MAZE), optimum(ARM)
    return Study(
        name=EXPERIMENT.name,
        title=EXPERIMENT.title,
        summary=(
            "A plan has the next steps' actions and values, and says for which step the next plan is due; in between "
            "nothing is seen. A grammar of two words, abcx and abdy, has one surprise a word: a new plan is due where "
            "it is seen. In a maze one of four goals is meant. A tower of three bricks is built from pictures."
        ),
        seeds=seeds,
        panels=(
            _surprise_panel(reading),
            _gates_panel(reading),
            _plan_panel(reading),
            returns_in_training(
                "Maze: return in training", _histories(mazes), MAZE_STEPS, best_maze.optimal_return, (-50.0, 20.0)
            ),
            _length_panel(mazes),
            returns_in_training(
                "Tower: return in training",
                _histories({PLANNING: tower}),
                ARM_STEPS,
                best_arm.optimal_return,
                (-210.0, 100.0),
            ),
        ),
        tables=(
            NumberTable(
                f"Grammar, {seeds} seeds, {GRAMMAR_UPDATES:,} updates",
                ("seed", "nats a symbol", "over the entropy rate", *(f"new plan at {place}" for place in POSITIONS)),
                tuple(
                    (
                        f"{seed}",
                        round(float(nats), 5),
                        f"{nats / ENTROPY_RATE - 1:.2%}",
                        *(round(float(share), 3) for share in shares),
                    )
                    for seed, (nats, shares) in enumerate(zip(reading.judged, reading.anew, strict=True))
                ),
            ),
            _trained_table(f"Maze, {seeds} seeds, {MAZE_STEPS:,} steps", mazes, best_maze.optimal_return),
            _trained_table(f"Tower, {seeds} seeds, {ARM_STEPS:,} steps", {PLANNING: tower}, best_arm.optimal_return),
        ),
        gates=(*grammar_gates(reading), *_gates(mazes, tower)),
    )


def _surprise_panel(reading: Reading) -> Panel:
    return Panel(
        "Grammar: surprise in learning",
        "updates",
        "nats a symbol",
        (Series(PLANNING, reading.updates, reading.surprise),),
        references=((f"entropy rate {ENTROPY_RATE:.4f}", ENTROPY_RATE),),
        y_range=(0.1, 0.4),
    )


def _gates_panel(reading: Reading) -> Panel:
    return Panel(
        "Grammar: where it plans anew (1: x or y is seen, 2: a, 3: b, 4: c or d)",
        "place in the word",
        "share of steps",
        (Series(PLANNING, np.arange(1, 5), reading.anew),),
        y_range=(0.0, 1.0),
    )


def _plan_panel(reading: Reading) -> Panel:
    ahead = np.arange(1, reading.commitment.shape[1] + 1)
    return Panel(
        "Grammar: a plan made at c, column by column",
        "symbols ahead",
        "probability",
        (
            Series("of a new plan after it", ahead, reading.commitment),
            Series("of the right symbol", ahead, reading.right),
        ),
        y_range=(0.0, 1.0),
    )


def _histories(learners: dict[str, Trained]) -> dict[str, History]:
    return {name: one.history for name, one in learners.items()}


def _length_panel(mazes: dict[str, Trained]) -> Panel:
    return Panel(
        "Maze: steps a plan is carried out",
        "primitive steps",
        "steps",
        tuple(Series(name, *plan_lengths(one.history)) for name, one in mazes.items()),
    )


def _trained_table(title: str, learners: dict[str, Trained], best: float) -> NumberTable:
    columns = ("", "seed", "gets there", "return", "optimum", "steps", "plans", "steps a plan", "seconds, all seeds")
    return NumberTable(
        title,
        columns,
        tuple(
            (
                name,
                f"{one.policy.seeds[seed]}",
                f"{one.success[seed]:.0%}",
                round(float(one.total_reward[seed]), 3),
                round(best, 3),
                round(float(one.steps[seed]), 2),
                round(float(one.plans[seed]), 2),
                round(float(one.steps[seed] / one.plans[seed]), 2),
                round(one.history.seconds),
            )
            for name, one in learners.items()
            for seed in range(len(one.steps))
        ),
    )


def grammar_gates(reading: Reading) -> list[Gate]:
    """What must come out of the grammar."""
    tails = np.delete(reading.anew, BRANCH, axis=1)
    return [
        at_most("grammar: nats a symbol over the entropy rate, worst seed", reading.judged.max() / ENTROPY_RATE, 1.02),
        at_least("grammar: new plans at the branch, worst seed", reading.anew[:, BRANCH].min(), 0.9),
        at_most("grammar: new plans at any place of a tail, worst seed", tails.max(), 0.2),
    ]


def _gates(mazes: dict[str, Trained], tower: Trained) -> list[Gate]:
    planning, every_step = mazes[PLANNING], mazes[EVERY_STEP]
    best = optimum(MAZE).optimal_return
    return [
        *(
            at_least(f"maze: return beside the optimum, {of}, {name}", reached / best, 0.95)
            for name, one in mazes.items()
            for of, reached in (("mean of seeds", one.total_reward.mean()), ("worst seed", one.total_reward.min()))
        ),
        at_least("maze: steps a plan, worst seed", (planning.steps / planning.plans).min(), 1.5),
        at_most("maze: steps a plan where every step plans anew", (every_step.steps / every_step.plans).max(), 1.0),
        at_least("tower: share of seeds that build it", tower.success.mean(), 0.8),
    ]


EXPERIMENT = Experiment(
    "straw",
    "STRAW: plans, and when to make the next",
    seeds=10,
    work=sum(WORK.values()),
    run=run,
)
