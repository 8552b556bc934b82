"""Learning a united network: the policies of all options, their terminations and the policy over options at once.

Kuzmin and Panov (2018, section 5) announce it: the lower layers of all networks are the same, so let them be shared.
Three things are learned from experience of primitive steps:

- *policies*: Q of the basic policy on the task itself and of every option on its own task. A task is another reward
  and another end on the same dynamics, so every remembered step teaches all of them, off-policy;
- *terminations*: whether each option has reached its end, classified against the end of the option's task;
- the *manager*: Q over one step of the basic policy, or an option until its termination head stops it, by the
  semi-Markov target. What it remembers counts as long as the head that acted would still begin with the same action:
  as the heads learn, decisions that they would no longer take are of other options than those they are now.

Which of these learn, and when, is a list of stages: one for all together (`JOINT`), one after the other with the trunk
frozen after the first (`SEQUENTIAL`), as the authors intended, or the manager alone over options that are there
(`MANAGER_ONLY`). What is shared is the network's `shared`: with "nothing", the same learner trains separate networks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Num, PRNGKeyArray

from lodestone.envs.base import (
    Environment,
    OutsideEnvironment,
    allowed_actions,
    example_state,
    observation_shape,
    remembered,
)
from lodestone.envs.task import Task, begun_at
from lodestone.errors import InvalidConfig, check_name
from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.policies import greedy
from lodestone.learning.prioritized import Drawn, PrioritizedReplay, draw, empty_prioritized, remember, renew
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.learning.targets import double_semi_markov_target, semi_markov_target
from lodestone.learning.united_execution import (
    Step,
    TaskActor,
    UnitedActor,
    explore,
    look,
    start_task_actor,
    start_united_actor,
    task_tick,
    tick,
)
from lodestone.learning.united_network import (
    BASIC,
    Shared,
    UnitedNetwork,
    each_head,
    init_united_network,
)
from lodestone.learning.updates import run_updates
from lodestone.options.execution import Decision, Rules
from lodestone.types import State, Transition

Part = Literal["trunk", "basic policy", "option policies", "terminations", "manager"]
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class Stage:
    """A part of the run in which some parts of the network learn and the others stand still.

    Where the manager learns, it acts, too; before, the basic policy alone acts on the task.
    """

    share: float
    """Part of the run, from 0 to 1."""
    learns: tuple[Part, ...]

    def __post_init__(self) -> None:
        for part in self.learns:
            check_name("part of the network", part, PARTS)
        if not (math.isfinite(self.share) and self.share > 0) or not self.learns:
            raise InvalidConfig("A stage needs a positive share of the run, and at least one part that learns.")


JOINT = (Stage(1.0, PARTS),)
SEQUENTIAL = (
    Stage(0.4, ("trunk", "basic policy")),
    Stage(0.2, ("option policies",)),
    Stage(0.05, ("terminations",)),
    Stage(0.35, ("manager",)),
)
MANAGER_ONLY = (Stage(1.0, ("basic policy", "manager")),)
TRAINING = {"joint": JOINT, "sequential": SEQUENTIAL, "manager": MANAGER_ONLY}


@dataclass(frozen=True)
class UnitedConfig:
    """Settings of the learner. Lengths are in primitive steps of the environments that the manager acts in, unless they
    say otherwise."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Shape of every head together with what lies below it."""
    shared: Shared = "hidden"
    """What the heads share; `nothing` makes every head a network of its own."""
    training: Literal["joint", "sequential", "manager"] = "joint"
    """All parts together; or one after the other; or only what is not the options': the basic policy and the manager,
    over options that were learned before and stay as they are."""
    max_option_steps: int = 21
    """Steps after which an option is stopped whatever its termination head says."""
    double: bool = True
    """Whether the online network picks what the target network values (double Q-learning)."""
    learning_rate: Knots = ((0.0, 1e-3), (0.6, 1e-3), (1.0, 1e-5))
    """Adam's step size over each stage."""
    adam_epsilon: float = 1e-4
    """Adam's constant under the fraction."""
    max_gradient_norm: float = 1000.0
    """Every weight and bias array's gradient is scaled down to this norm."""
    policy_weight: float = 1.0
    """Of the policies' loss: for every head the Huber loss, summed over the batch."""
    termination_weight: float = 1.0
    """Of the terminations' loss: for every head the cross-entropy, summed over the batch, both classes alike heavy."""
    manager_weight: float = 1.0
    """Of the manager's Huber loss, summed over its batch."""
    trunk_gradient: float = 1.0
    """Factor on what the heads' losses send into the shared layers."""
    batch_size: int = 32
    """Steps, and decisions, per update."""
    huber_delta: float = 20.0
    """Scaled error up to which the losses of values are quadratic, and beyond which they are linear."""
    replay_capacity: int = 1_000_000
    """Steps, and decisions, that are remembered; no more memory is taken than the run can fill."""
    priority: float = 1.0
    """Exponent of the errors by which steps, and decisions, are drawn from what is remembered; 0 draws all alike."""
    correction: float = 0.5
    """Exponent of the factor by which what is drawn more often counts less; 1 undoes the drawing's bias."""
    learning_starts: int = 4000
    """Steps before the first update."""
    target_period: int = 200
    """Updates between two copies of the network to the target network."""
    epsilon: Knots = ((0.05, 1.0), (0.15, 0.1))
    """Over each stage, the probability of a random choice: one of the primitive actions and options, all alike."""
    epsilon_spread: float = 0.0
    """How much less some copies of the environment explore than others: the first with probability epsilon, the last
    with epsilon to the power of 1 + this, those between with powers between (Horgan et al. 2018, section 3)."""
    task_epsilon: Knots = ((0.0, 1.0), (0.4, 0.1))
    """Over each stage, the probability of a random action where an option is trained on its own task."""
    environments: int = 8
    """Copies of the environment, per seed, that the manager acts in."""
    start_environments: int = 0
    """Further copies, per seed, that the manager acts in, for every kind of start that the options' own tasks have:
    their episodes begin there. The run's length does not count their steps, nor those on the options' tasks."""
    task_environments: int = 4
    """Copies of every option's own task, per seed, in which its policy alone acts; with 0, options learn from the steps
    of the environments that the manager acts in."""
    task_step_limit: int = 100
    """Steps after which an episode of an option's own task is truncated."""
    ticks_per_round: int = 2
    """Steps of every environment between two rounds of updates."""
    updates_per_round: int = 8
    """Updates after each round."""
    reward_scale: float = 0.2
    """Factor on rewards inside the learner; values near 10 are learned fastest."""
    decision_cost: float = 0.25
    """Taken from the manager's reward, not from what is reported, once a decision: of equally good ways it then prefers
    the one with fewer decisions."""

    @property
    def steps_per_round(self) -> int:
        """Of the environments that the manager acts in."""
        return self.ticks_per_round * self.environments

    def rounds(self, steps: int) -> int:
        """How many rounds take at least `steps` steps."""
        return -(-steps // self.steps_per_round)

    def __post_init__(self) -> None:
        check_name("part to share", self.shared, get_args(Shared))
        check_name("training", self.training, tuple(TRAINING))
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)
        check_knots("task_epsilon", self.task_epsilon, 0.0, 1.0)
        for name in (
            "max_option_steps",
            "batch_size",
            "replay_capacity",
            "target_period",
            "environments",
            "task_step_limit",
            "ticks_per_round",
            "updates_per_round",
        ):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        for name in (
            "learning_starts",
            "start_environments",
            "task_environments",
            "policy_weight",
            "termination_weight",
            "manager_weight",
            "decision_cost",
            "priority",
            "correction",
            "epsilon_spread",
        ):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must not be negative.")
        for name in ("adam_epsilon", "huber_delta", "max_gradient_norm", "reward_scale", "trunk_gradient"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a positive number.")


class Remembered(NamedTuple):
    """One decision of the manager."""

    transition: Transition
    first_action: Int[Array, "*batch"]
    """The primitive action that what was chosen began with."""


class Learner(NamedTuple):
    """What is learned, and from what."""

    network: UnitedNetwork
    target: UnitedNetwork
    adam: optax.ScaleByAdamState
    steps: PrioritizedReplay[Step]
    decisions: PrioritizedReplay[Remembered]


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learner: Learner
    actors: tuple[UnitedActor, ...]
    """In the environment, and begun at each kind of start of the options' tasks."""
    task_actors: tuple[TaskActor, ...]
    """For every option, its environments."""
    key: PRNGKeyArray


def policy_loss(
    config: UnitedConfig,
    discount: float,
    values: Float[Array, " A"],
    next_values: Float[Array, " N"],
    next_preferences: Float[Array, " N"],
    next_available: Bool[Array, " N"],
    action: Int[Array, ""],
    reward: Float[Array, ""],
    end: Bool[Array, ""],
) -> Float[Array, ""]:
    """One policy head's Huber loss for one step, by its own task's reward and end, against the best available of N
    values of the next state: its own, or those of the manager's choices."""
    kept = jnp.where(end, 0.0, discount)
    target = _target(config, reward * config.reward_scale, kept, next_values, next_preferences, next_available)
    return optax.huber_loss(values[action], jax.lax.stop_gradient(target), delta=config.huber_delta)


def after_basic_step(
    config: UnitedConfig, actions: Float[Array, " A"], choices: Float[Array, " n+1"]
) -> Float[Array, " A+n"]:
    """What may follow a step of the basic policy, for its own target: another such step, which is another decision, or
    an option.

    The manager's value of its first choice would say the same of the next step, but it learns from the manager's
    decisions alone; the basic policy's own values learn from all steps, those on the options' tasks included, so they
    are known far from the ways that are taken now.
    """
    return jnp.concatenate([actions - config.decision_cost * config.reward_scale, choices[1:]])


def _target(
    config: UnitedConfig,
    reward: Float[Array, ""],
    discount: Float[Array, ""],
    next_values: Float[Array, " N"],
    next_preferences: Float[Array, " N"],
    next_available: Bool[Array, " N"],
) -> Float[Array, ""]:
    if config.double:
        return double_semi_markov_target(reward, discount, next_values, next_preferences, next_available)
    return semi_markov_target(reward, discount, next_values, next_available)


def termination_loss(logits: Float[Array, "B n 2"], ended: Bool[Array, "B n"]) -> Float[Array, " n"]:
    """Every termination head's cross-entropy, summed over the batch. Ends are rare: the two classes weigh alike."""
    entropy = optax.softmax_cross_entropy_with_integer_labels(logits, ended.astype(jnp.int32))
    size = ended.shape[0]
    losses = []
    for of_class in (ended, ~ended):
        count = jnp.sum(of_class, axis=0, dtype=jnp.float32)
        losses.append(jnp.sum(jnp.where(of_class, entropy, 0.0), axis=0) / jnp.maximum(count, 1))
    return size / 2 * (losses[0] + losses[1])


def manager_loss(
    config: UnitedConfig,
    values: Float[Array, " n+1"],
    next_values: Float[Array, " n+1"],
    next_preferences: Float[Array, " n+1"],
    transition: Transition,
) -> Float[Array, ""]:
    """Huber loss of one decision against the semi-Markov target."""
    reward = (transition.reward - config.decision_cost) * config.reward_scale
    target = _target(config, reward, transition.discount, next_values, next_preferences, transition.next_available)
    return optax.huber_loss(values[transition.action], jax.lax.stop_gradient(target), delta=config.huber_delta)


class Errors(NamedTuple):
    """How far what was drawn is from what has been learned."""

    steps: Float[Array, "*batch B"]
    """Root of twice the policies' losses: for one policy, and small errors, the size of its temporal difference."""
    decisions: Float[Array, "*batch B"]
    """The same of the manager's; 0 where a decision no longer counts."""


class Renewed(NamedTuple):
    """What one update found."""

    loss: Float[Array, "*batch"]
    """Per item of a batch."""
    slots: tuple[Int[Array, "*batch B"], Int[Array, "*batch B"]]
    """Of the steps and of the decisions that were drawn."""
    errors: Errors


def loss(
    config: UnitedConfig,
    stage: Stage,
    environment: Environment,
    options: Sequence[Task],
    discount: float,
    network: UnitedNetwork,
    target: UnitedNetwork,
    steps_drawn: Drawn[Step],
    decisions_drawn: Drawn[Remembered],
) -> tuple[Float[Array, ""], Errors]:
    """Weighted sum of the losses of what learns in this stage, over B steps and B decisions; and their errors."""
    learns = stage.learns
    steps, decisions = steps_drawn.items, decisions_drawn.items
    observe = jax.vmap(environment.observe)
    size = config.batch_size
    of_steps, of_decisions = jnp.zeros(size), jnp.zeros(size)
    learned = observe(_concatenate(steps.state, steps.next_state, decisions.transition.obs))
    features = jax.vmap(network.features)(learned)
    if network.trunk is not None:
        factor = config.trunk_gradient if "trunk" in learns else 0.0
        features = factor * features + (1 - factor) * jax.lax.stop_gradient(features)
    at_state, at_next, at_decision = features[:size], features[size : 2 * size], features[2 * size :]
    total = jnp.float32(0)

    if "basic policy" in learns or "option policies" in learns:
        seen_next = jax.vmap(target.features)(observe(steps.next_state))
        held = jax.lax.stop_gradient(at_next)
        values = jax.vmap(partial(each_head, network.policies))(at_state)
        next_values = jax.vmap(partial(each_head, target.policies))(seen_next)
        preferences = jax.vmap(partial(each_head, network.policies))(held)
        allowed = jax.vmap(partial(allowed_actions, environment))(steps.next_state)
        for head, task in enumerate((environment, *options)):
            if ("basic policy" if head == BASIC else "option policies") not in learns:
                continue
            rewards = jax.vmap(task.reward)(steps.state, steps.action, steps.next_state)
            ends = jax.vmap(task.terminal)(steps.next_state)
            if isinstance(environment, OutsideEnvironment):  # after whose end nothing is seen, whatever the task
                ends |= jax.vmap(environment.terminal)(steps.next_state)
            after, preferred, available = next_values[:, head], preferences[:, head], allowed
            if head == BASIC and "manager" in learns:
                follows = jax.vmap(partial(after_basic_step, config))
                after = follows(after, jax.vmap(target.manager)(seen_next))
                preferred = follows(preferred, jax.vmap(network.manager)(held))
                available = jnp.concatenate([allowed, jnp.ones((size, len(options)), dtype=bool)], axis=1)
            of_head = jax.vmap(partial(policy_loss, config, discount))
            of_steps += of_head(values[:, head], after, preferred, available, steps.action, rewards, ends)
        total += config.policy_weight * jnp.sum(steps_drawn.weights * of_steps)
    if "terminations" in learns and options:
        logits = jax.vmap(partial(each_head, network.terminations))(at_next)
        ended = _each(options, lambda task: jax.vmap(task.terminal)(steps.next_state))
        total += config.termination_weight * jnp.sum(termination_loss(logits, ended))
    if "manager" in learns:
        transition = decisions.transition
        next_seen = observe(transition.next_obs)
        values = jax.vmap(network.manager)(at_decision)
        next_values = jax.vmap(lambda seen: target.manager(target.features(seen)))(next_seen)
        preferences = jax.vmap(lambda seen: network.manager(network.features(seen)))(next_seen)
        losses = jax.vmap(partial(manager_loss, config))(values, next_values, preferences, transition)
        actions = jax.vmap(partial(each_head, network.policies))(jax.lax.stop_gradient(at_decision))
        chosen = jnp.take_along_axis(actions, transition.action[:, None, None], axis=1)[:, 0]
        would_do = jax.vmap(greedy)(chosen, jax.vmap(partial(allowed_actions, environment))(transition.obs))
        of_decisions = jnp.where(would_do == decisions.first_action, losses, 0.0)
        total += config.manager_weight * jnp.sum(decisions_drawn.weights * of_decisions)
    return total, Errors(jnp.sqrt(2 * of_steps), jnp.sqrt(2 * of_decisions))


def _each(tasks: Sequence[Environment], ask: Callable[[Environment], Array]) -> Num[Array, "B n"]:
    return jnp.stack([ask(task) for task in tasks], axis=1)


def _concatenate(*states: State) -> State:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *states)


def update(
    config: UnitedConfig,
    stage: Stage,
    environment: Environment,
    options: Sequence[Task],
    discount: float,
    learner: Learner,
    key: PRNGKeyArray,
    learning_rate: Float[Array, ""],
) -> tuple[Learner, Renewed]:
    """One gradient step on a batch of steps and one of decisions; the target network and what is remembered stay."""
    steps_key, decisions_key = jax.random.split(key)
    steps = draw(learner.steps, steps_key, config.batch_size, config.priority, config.correction)
    decisions = draw(learner.decisions, decisions_key, config.batch_size, config.priority, config.correction)
    of_network = jax.value_and_grad(partial(loss, config, stage, environment, options, discount), has_aux=True)
    (value, errors), gradient = of_network(learner.network, learner.target, steps, decisions)
    network, adam = adam_step(
        learner.network, gradient, learner.adam, learning_rate, config.adam_epsilon, config.max_gradient_norm
    )
    found = Renewed(value / config.batch_size, (steps.slots, decisions.slots), errors)
    return learner._replace(network=network, adam=adam), found


def with_new_errors(stage: Stage, learner: Learner, found: Renewed, learned: Bool[Array, ""]) -> Learner:
    """What is remembered with the errors of a round's updates, if there were any, where this stage finds such."""

    def renewed(replay: PrioritizedReplay, slots: Int[Array, "U B"], errors: Float[Array, "U B"]) -> PrioritizedReplay:
        nowhere = jnp.iinfo(slots.dtype).max
        return renew(replay, jnp.where(learned, slots, nowhere).reshape(-1), errors.reshape(-1))

    if "basic policy" in stage.learns or "option policies" in stage.learns:
        learner = learner._replace(steps=renewed(learner.steps, found.slots[0], found.errors.steps))
    if "manager" in stage.learns:
        learner = learner._replace(decisions=renewed(learner.decisions, found.slots[1], found.errors.decisions))
    return learner


def united(
    config: UnitedConfig,
    environment: Environment,
    options: Sequence[Task],
    rules: Rules,
    steps: int,
    stages: tuple[Stage, ...] | None = None,
) -> Algorithm:
    """The algorithm for the training loop: options are given by their tasks, which are learned too.

    `steps`, the run's length, is what schedules and stages are fractions of; it bounds the replays' memory, too.
    `stages` replaces what `config.training` says. `init` takes a network to start from, too.
    Raises `InvalidConfig` for an environment outside that would have to begin where the options' tasks do.
    """
    if isinstance(environment, OutsideEnvironment) and (config.start_environments or config.task_environments):
        raise InvalidConfig(
            "A Gymnasium environment begins where it wants: start_environments and task_environments must be 0."
        )
    stages = stages or TRAINING[config.training]
    rounds = config.rounds(steps)
    in_all = sum(stage.share for stage in stages)
    ends = [round(rounds * total / in_all) for total in accumulate(stage.share for stage in stages)]
    starts = [0, *ends[:-1]]
    starts_of_tasks = dict.fromkeys(option.start for option in options) if config.start_environments else {}
    places = (environment, *(begun_at(environment, start) for start in starts_of_tasks))
    copies = (config.environments, *[config.start_environments] * len(starts_of_tasks))
    decided_per_round = config.ticks_per_round * sum(copies)
    on_tasks = tuple(options) if config.task_environments else ()  # those that act on their own tasks
    seen_per_round = decided_per_round + config.ticks_per_round * len(on_tasks) * config.task_environments
    learning_starts = config.rounds(config.learning_starts)
    powers = [1 + config.epsilon_spread * jnp.linspace(0.0, 1.0, count) for count in copies]

    def init(key: PRNGKeyArray, start: UnitedNetwork | None = None) -> Carry:
        network_key, actor_key, key = jax.random.split(key, 3)
        state = remembered(environment, example_state(environment))
        if start is None:
            seen, actions = observation_shape(environment), environment.num_actions
            start = init_united_network(config.network, config.shared, seen, actions, len(options), network_key)
        real, whole = jnp.float32(0), jnp.int32(0)
        everything = jnp.zeros(len(options) + 1, dtype=bool)
        transition = Transition(state, whole, real, real, state, everything)
        learner = Learner(
            network=start,
            target=start,
            adam=start_adam(start),
            steps=empty_prioritized(
                Step(state, whole, state), _capacity(config.replay_capacity, seen_per_round, rounds)
            ),
            decisions=empty_prioritized(
                Remembered(transition, whole), _capacity(config.replay_capacity, decided_per_round, rounds)
            ),
        )
        actor_keys, task_keys = jax.random.split(actor_key)
        return Carry(
            learner=learner,
            actors=tuple(
                jax.vmap(partial(start_united_actor, place))(jax.random.split(place_key, count))
                for place, count, place_key in zip(
                    places, copies, jax.random.split(actor_keys, len(places)), strict=True
                )
            ),
            task_actors=tuple(
                jax.vmap(partial(start_task_actor, option))(jax.random.split(option_key, config.task_environments))
                for option, option_key in zip(on_tasks, jax.random.split(task_keys, len(on_tasks)), strict=True)
            ),
            key=key,
        )

    def collect(
        stage: Stage, key: PRNGKeyArray, carry: Carry, epsilon: Float[Array, ""], task_epsilon: Float[Array, ""]
    ) -> tuple[Carry, Decision]:
        """The round's ticks. Returns the manager's decisions in the environment, in order of time, too."""
        network = carry.learner.network

        def act(actors: tuple, tick_key: PRNGKeyArray) -> tuple[tuple, tuple]:
            united_actors, task_actors = actors
            key, task_key = jax.random.split(tick_key)
            next_actors, ticked = [], []
            keys = jax.random.split(key, len(places))
            for place, count, power, actor, place_key in zip(places, copies, powers, united_actors, keys, strict=True):
                uniform = jax.random.uniform(place_key, (count, 4))
                outputs = jax.vmap(partial(look, environment, network))(actor.actor.state)
                decisions = jax.vmap(explore, in_axes=(0, 0, 0, None))(
                    outputs, uniform[:, :2], epsilon**power, "manager" in stage.learns
                )
                actor, ticks = jax.vmap(partial(tick, place, rules, config.max_option_steps))(
                    outputs, decisions, uniform[:, 2:], actor
                )
                next_actors.append(actor)
                ticked.append(ticks)
            ticks = _concatenate(*ticked)
            stepped, next_task_actors = [ticks.step], []
            of_tasks = jax.random.uniform(task_key, (len(on_tasks), config.task_environments, 4))
            for position, (option, actor) in enumerate(zip(on_tasks, task_actors, strict=True)):
                head = network.policy(BASIC + 1 + position)
                values = jax.vmap(lambda state, head=head: head(environment.observe(state)))(actor.state)
                actor, step = jax.vmap(partial(task_tick, option, config.task_step_limit), in_axes=(0, None, 0, 0))(
                    values, task_epsilon, of_tasks[position], actor
                )
                next_task_actors.append(actor)
                stepped.append(step)
            return (tuple(next_actors), tuple(next_task_actors)), (ticks, _concatenate(*stepped))

        keys = jax.random.split(key, config.ticks_per_round)
        (actors, task_actors), (ticks, stepped) = jax.lax.scan(act, (carry.actors, carry.task_actors), keys)
        acted = jnp.ones(stepped.action.shape, dtype=bool).at[:, : sum(copies)].set(ticks.acted)
        of_environment = jax.tree.map(
            lambda leaf: leaf[:, : config.environments].reshape(-1, *leaf.shape[2:]), ticks.decision
        )
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (ticks, stepped, acted))
        ticks, stepped, acted = flat
        learner = carry.learner._replace(
            steps=remember(carry.learner.steps, stepped, acted),
            decisions=remember(
                carry.learner.decisions,
                Remembered(ticks.decision.transition, ticks.first_action),
                ticks.decision.valid,
            ),
        )
        return carry._replace(learner=learner, actors=actors, task_actors=task_actors), of_environment

    def run_stage(index: int, carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        stage, start, end = stages[index], starts[index], ends[index]
        collect_key, update_key, key = jax.random.split(carry.key, 3)
        fraction = (number - start).astype(jnp.float32) / max(1, end - start)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        carry, decisions = collect(
            stage,
            collect_key,
            carry._replace(key=key),
            piecewise_linear(config.epsilon, fraction),
            piecewise_linear(config.task_epsilon, fraction),
        )
        adam = jax.lax.cond(number == start, lambda: start_adam(carry.learner.network), lambda: carry.learner.adam)
        keys = jax.random.split(update_key, config.updates_per_round)

        def learn(learner: Learner, index: Int[Array, ""]) -> tuple[Learner, Renewed]:
            return update(config, stage, environment, options, rules.discount, learner, keys[index], learning_rate)

        learner, found = run_updates(
            carry.learner._replace(adam=adam),
            learn,
            number - learning_starts,
            config.updates_per_round,
            config.target_period,
        )
        learner = with_new_errors(stage, learner, found, number >= learning_starts)
        log = log_round(decisions, jnp.mean(found.loss))
        return carry._replace(learner=learner), log

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        if len(stages) == 1:
            return run_stage(0, carry, number)
        stage = jnp.sum(number >= jnp.asarray(ends[:-1]))
        return jax.lax.switch(stage, [partial(run_stage, index) for index in range(len(stages))], carry, number)

    return Algorithm(init, run_round)


def _capacity(most: int, per_round: int, rounds: int) -> int:
    """Never less than a round brings, never more than the run does."""
    return max(per_round, min(most, per_round * rounds))
