"""HAMQ: learning what to choose in a hierarchy of machines (Parr and Russell 1997; Kuzmin and Panov 2018, section 2).

From one choice w, where edge u was taken, to the next choice w', k primitive steps later:

    Q(w, u) <- Q(w, u) + alpha [ r_1 + gamma r_2 + ... + gamma^(k-1) r_k + gamma^k max over u' of Q(w', u') - Q(w, u) ]

with nothing after the last sum where the episode ended. A choice is known by the environment's state and the whole call
stack. HAMQ-INT (Bai and Russell 2017): where w' follows in no time, it surely does, so that Q(w, u) is max Q(w', u') by
substitution, and need not be learned.

It runs on the arrays of the joint process, which are the machines and the environment at once. In a Gymnasium
environment they are the machines alone: its state is the number that it shows, and a step has to be asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment, inverse_cdf, next_step, sample_initial
from lodestone.envs.host import ANEW, HostEnvironment, HostState
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.learning.targets import semi_markov_target
from lodestone.machines.machine import Hierarchy
from lodestone.options.execution import REWARD_SWITCHES, Rules
from lodestone.planning.enumerated import row_of
from lodestone.planning.joint import JointProcess, joint_process
from lodestone.planning.shown_joint import ShownProcess, shown_process

TICKS_PER_ROUND = 32
"""Ticks between two looks at the schedules. A tick is at most one choice and at most one primitive step: only a choice
that leads straight to another choice takes one without a step."""


@dataclass(frozen=True)
class HAMQConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.5),)
    """alpha over the run."""
    epsilon: Knots = ((0.0, 1.0), (0.7, 0.05))
    """Probability of a random edge over the run."""
    internal_transitions: bool = False
    """Whether the value of an edge that leads to another choice in no time is that choice's value by substitution
    (HAMQ-INT), and is not learned."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)


class Runner(NamedTuple):
    """What one run of machines and environment remembers between ticks."""

    joint: Int[Array, ""]
    """The joint state."""
    chosen: Bool[Array, ""]
    """Whether a choice was made in this episode."""
    choice: Int[Array, ""]
    """The last choice, if there was one."""
    edge: Int[Array, ""]
    """The edge taken there."""
    elapsed: Int[Array, ""]
    """Primitive steps since then, or since the episode began if it was the first."""
    reward: Float[Array, ""]
    """Reward since then, discounted to then."""
    discount: Float[Array, ""]
    """gamma^k, for the k steps since then."""
    episode_return: Float[Array, ""]
    """Undiscounted sum of the episode's rewards."""
    episode_steps: Int[Array, ""]
    episode_choices: Int[Array, ""]
    outside: Outside | None = None
    """In a Gymnasium environment, what is to know of it."""


class Outside(NamedTuple):
    """A Gymnasium environment while machines run in it."""

    state: HostState
    allowed: Bool[Array, " A"]
    """The actions that were allowed at the last choice."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    table: Float[Array, "N U"]
    """Q; starts at zero, and is -inf for ever where an edge may not be taken or does not exist."""
    runner: Runner
    key: PRNGKeyArray


class Event(NamedTuple):
    """What a tick has to tell if the consequences of a choice ended on it, at another choice or with the episode."""

    valid: Bool[Array, ""]
    learned: Bool[Array, ""]
    """Whether Q is updated: not where a limit came before the next choice."""
    choice: Int[Array, ""]
    edge: Int[Array, ""]
    reward: Float[Array, ""]
    """Discounted to the choice."""
    discount: Float[Array, ""]
    """gamma^k, or 0 where nothing follows."""
    next_choice: Int[Array, ""]
    """The choice that was reached; any where the discount is 0."""
    steps: Int[Array, ""]
    """k; the steps before an episode's first choice count with the first."""
    episode_ended: Bool[Array, ""]
    terminated: Bool[Array, ""]
    """Whether the environment or the root, not a limit, ended the episode."""
    episode_return: Float[Array, ""]
    episode_steps: Int[Array, ""]
    episode_choices: Int[Array, ""]
    allowed: Bool[Array, " A"] | None
    """The actions that were allowed at the choice, where not all are."""
    next_allowed: Bool[Array, " A"] | None
    """The same where the event came."""


class ShownArrays(NamedTuple):
    """The machines on the device, and the environment whose numbers they look at; the fields are those of
    `ShownProcess`."""

    environment: HostEnvironment
    edges: Int[Array, "N U"]
    actions: Int[Array, " M"]
    landings: Int[Array, "L S"]
    landing: Int[Array, " M"]
    firsts: Bool[Array, "N U A"]


class Arrays(NamedTuple):
    """The joint process on the device."""

    edges: Int[Array, "N U"]
    successors: Int[Array, "M K"]
    probs: Float[Array, "M K"]
    rewards: Float[Array, "M K"]
    begins: Int[Array, " I"]
    """The joint states where episodes begin."""
    begin_edges: Float[Array, " I"]
    """Their probabilities, summed up; empty if they are all equal."""


def hamq(config: HAMQConfig, environment: Environment, hierarchy: Hierarchy, rules: Rules, ticks: int) -> Algorithm:
    """The algorithm for the training loop. Schedules are fractions of `ticks`.

    A step limit that comes between two choices ends an episode whose last choice is not learned from, as what would
    have followed is not known; where it comes with a choice, that one bootstraps. A decision limit counts choices.
    `RoundLog.option` is the position of the edge's name in `JointProcess.names`.
    Raises what `process_of` raises, and `InvalidConfig` for rules about options and for machines without a choice.
    """
    process = process_of(environment, hierarchy)
    rules.refuse(REWARD_SWITCHES, "HAMQ has no options")
    if process.num_choices == 0:
        raise InvalidConfig("The machines leave no choice open, so there is nothing to learn.")
    if isinstance(process, ShownProcess) and not len(process.actions):
        raise InvalidConfig("The machines never act, so a Gymnasium environment would show nothing.")
    arrays: Arrays | ShownArrays
    if isinstance(process, JointProcess):
        arrays = on_device(process)
        chance = bool(((process.probs > 0) & (process.probs < 1)).any()), len(arrays.begins) > 1
    else:
        assert isinstance(environment, HostEnvironment)
        arrays = ShownArrays(environment, *(jnp.asarray(getattr(process, name)) for name in ShownArrays._fields[1:]))
        chance = (False, False)  # the environment draws for itself
    names = jnp.asarray(process.name)
    into, chain = internal_edges(process)

    def init(key: PRNGKeyArray) -> Carry:
        start_key, key = jax.random.split(key)
        table = jnp.where(jnp.asarray(process.available), 0.0, -jnp.inf).astype(jnp.float32)
        if isinstance(arrays, ShownArrays):
            runner = begin_outside(arrays, sample_initial(arrays.environment, start_key))
        else:
            runner = fresh(begin(arrays, jax.random.uniform(start_key)))
        return Carry(table, runner, key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`TICKS_PER_ROUND` ticks, each with an update if a choice has had its consequences."""
        fraction = number.astype(jnp.float32) * (TICKS_PER_ROUND / ticks)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)

        def step(carry: tuple[Array, Runner], noise: Float[Array, " R"]) -> tuple[tuple[Array, Runner], tuple]:
            table, runner = carry
            allowed = None if runner.outside is None else runner.outside.state.seen.allowed
            row = values_of(table, arrays, jnp.minimum(runner.joint, process.num_choices - 1), allowed)
            edge = epsilon_greedy(noise[:2], row, row > -jnp.inf, epsilon)
            outcome, restart = (noise[2] if chance[0] else jnp.float32(0)), (noise[-1] if chance[1] else jnp.float32(0))
            runner, event = tick(arrays, process.end, rules, outcome, restart, runner, edge)
            if config.internal_transitions:
                # Nothing to learn where no time passed, which leaves no trace but the discount.
                internal = arrays.edges[event.choice, event.edge] < process.num_choices
                event = event._replace(learned=event.learned & ~internal)
            next_row = values_of(table, arrays, event.next_choice, event.next_allowed)
            table, loss = update(table, event, next_row, learning_rate)
            if config.internal_transitions:
                table = substitute(table, arrays, into, chain, event)
            return (table, runner), (event, loss)

        # Random numbers are drawn for all ticks together: one by one they would take longer than the ticks.
        noise = jax.random.uniform(noise_key, (TICKS_PER_ROUND, 2 + sum(chance)))
        (table, runner), (events, losses) = jax.lax.scan(step, (carry.table, carry.runner), noise)
        log = RoundLog(
            valid=events.valid,
            option=names[events.choice, events.edge],
            steps=events.steps,
            episode_ended=events.episode_ended,
            terminated=events.terminated,
            episode_return=events.episode_return,
            episode_steps=events.episode_steps,
            episode_decisions=events.episode_choices,
            loss=jnp.mean(losses),
        )
        return Carry(table, runner, key), log

    return Algorithm(init, run_round)


def tick(
    arrays: Arrays | ShownArrays,
    end: int,
    rules: Rules,
    outcome: Float[Array, ""],
    restart: Float[Array, ""],
    runner: Runner,
    edge: Int[Array, ""],
) -> tuple[Runner, Event]:
    """Take `edge` if the joint state is a choice, and then a primitive step if it is an action. A new episode begins by
    itself; two uniform numbers in [0, 1) pick nature's draw and where that begins."""
    num_choices = len(arrays.edges)
    choosing = runner.joint < num_choices
    choice = jnp.where(choosing, runner.joint, runner.choice)
    edge = jnp.where(choosing, edge, runner.edge)
    chosen = choosing | runner.chosen
    joint = jnp.where(choosing, arrays.edges[choice, edge], runner.joint)
    reward_before, discount = jnp.where(choosing, 0.0, runner.reward), jnp.where(choosing, 1.0, runner.discount)
    elapsed = jnp.where(choosing & runner.chosen, 0, runner.elapsed)
    episode_choices = runner.episode_choices + choosing.astype(jnp.int32)

    acting, outside = (joint >= num_choices) & (joint != end), None
    if isinstance(arrays, ShownArrays):
        assert runner.outside is not None
        allowed = jnp.where(choosing, runner.outside.state.seen.allowed, runner.outside.allowed)
        given_up, outside = runner.joint == end, runner.outside._replace(allowed=allowed)
        outside, arrived, reward = step_outside(arrays, end, outside, joint, acting, given_up)
    else:
        action = jnp.clip(joint - num_choices, 0, len(arrays.successors) - 1)
        draw = inverse_cdf(arrays.probs[action], outcome) if arrays.probs.shape[1] > 1 else jnp.int32(0)
        reward = jnp.where(acting, arrays.rewards[action, draw], 0.0)
        arrived = jnp.where(acting, arrays.successors[action, draw], joint)
    choice_reward = reward_before + discount * reward
    discount = jnp.where(acting, discount * rules.discount, discount)
    elapsed += acting.astype(jnp.int32)
    episode_steps = runner.episode_steps + acting.astype(jnp.int32)
    episode_return = runner.episode_return + reward

    terminated, at_choice = arrived == end, arrived < num_choices
    truncated = jnp.bool_(False) if outside is None else outside.state.truncated
    if rules.step_limit is not None:
        truncated |= episode_steps >= rules.step_limit
    if rules.decision_limit is not None:
        truncated |= at_choice & (episode_choices >= rules.decision_limit)
    truncated &= ~terminated
    over = terminated | truncated
    known = at_choice | terminated
    no_future = terminated
    if not rules.bootstrap_at_limit:
        known, no_future = known | truncated, over
    event = Event(
        valid=(chosen & at_choice) | over,
        learned=chosen & known,
        choice=choice,
        edge=edge,
        reward=choice_reward,
        discount=jnp.where(no_future, 0.0, discount),
        next_choice=jnp.where(at_choice, arrived, 0),
        steps=elapsed,
        episode_ended=over,
        terminated=terminated,
        episode_return=episode_return,
        episode_steps=episode_steps,
        episode_choices=episode_choices,
        allowed=None if outside is None else outside.allowed,
        next_allowed=None if outside is None else outside.state.seen.allowed,
    )
    going_on = Runner(
        joint=arrived,
        chosen=chosen,
        choice=choice,
        edge=edge,
        elapsed=elapsed,
        reward=choice_reward,
        discount=discount,
        episode_return=episode_return,
        episode_steps=episode_steps,
        episode_choices=episode_choices,
        outside=outside,
    )
    # Nothing of an episode is known in the next one: else the last choice would learn from how the next one began.
    if isinstance(arrays, ShownArrays):
        assert outside is not None
        begun = after_episode(arrays, end, outside.state)
    else:
        begun = fresh(begin(arrays, restart))
    return jax.tree.map(lambda new, same: jnp.where(over, new, same), begun, going_on), event


def step_outside(
    arrays: ShownArrays,
    end: int,
    outside: Outside,
    joint: Int[Array, ""],
    acting: Bool[Array, ""],
    given_up: Bool[Array, ""],
) -> tuple[Outside, Int[Array, ""], Float[Array, ""]]:
    """A step of the environment where the machines act, and a new episode where the last one was given up; else nothing
    is asked of it. Returns the joint state and the reward, too."""
    environment = arrays.environment
    place = jnp.clip(joint - len(arrays.edges), 0, len(arrays.actions) - 1)
    action, asks = jnp.where(given_up, ANEW, arrays.actions[place]), acting | given_up
    step = next_step(environment, jnp.float32(0), environment.hold(outside.state, ~asks), action)
    landing = jnp.where(given_up, 0, arrays.landing[place])
    landed = jnp.where(step.terminated, end, arrays.landings[landing, row_of(environment, step.state)])
    state = jax.tree.map(lambda new, same: jnp.where(asks, new, same), step.state, outside.state)
    return outside._replace(state=state), jnp.where(asks, landed, joint), jnp.where(acting, step.reward, 0.0)


def begin_outside(arrays: ShownArrays, state: HostState) -> Runner:
    """A run at the beginning of an episode, in this state of the environment."""
    joint = arrays.landings[0, row_of(arrays.environment, state)]
    return fresh(joint)._replace(outside=Outside(state, state.seen.allowed))


def after_episode(arrays: ShownArrays, end: int, ended: HostState) -> Runner:
    """The run that follows an episode. Where only the root stopped, the environment has to be asked for another one,
    which the next tick does."""
    over = ended.terminated | ended.truncated
    begun = begin_outside(arrays, arrays.environment.begin_again(ended))
    waiting = fresh(jnp.int32(end))._replace(outside=Outside(ended, ended.seen.allowed))
    return jax.tree.map(lambda one, other: jnp.where(over, one, other), begun, waiting)


def values_of(
    table: Float[Array, "N U"],
    arrays: Arrays | ShownArrays,
    choice: Int[Array, "*B"],
    allowed: Bool[Array, " A"] | None,
) -> Float[Array, "*B U"]:
    """Q of the edges of a choice, -inf where one leads to forbidden actions only, as long as another does not."""
    values = table[choice]
    if allowed is None:
        return values
    assert isinstance(arrays, ShownArrays)
    return jnp.where(open_edges(arrays.firsts[choice], allowed), values, -jnp.inf)


def open_edges(firsts: Bool[Array, "*B U A"], allowed: Bool[Array, " A"]) -> Bool[Array, "*B U"]:
    """Which edges lead to an action that is allowed; all of them where none does, as machines have to go on."""
    leads = (firsts & jnp.broadcast_to(allowed, firsts.shape)).any(axis=-1)
    return leads | ~leads.any(axis=-1, keepdims=True)


def update(
    table: Float[Array, "N U"], event: Event, next_row: Float[Array, " U"], learning_rate: Float[Array, ""]
) -> tuple[Float[Array, "N U"], Float[Array, ""]]:
    """One update from the consequences of one choice, where `next_row` is Q of the next; none where they are not known.
    Returns the squared error, too."""
    target = semi_markov_target(event.reward, event.discount, next_row, next_row > -jnp.inf)
    error = jnp.where(event.learned, target - table[event.choice, event.edge], 0.0)
    return table.at[event.choice, event.edge].add(learning_rate * error), jnp.square(error)


def substitute(
    table: Float[Array, "N U"], arrays: Arrays | ShownArrays, into: Int[Array, "N+1 P 2"], chain: int, event: Event
) -> Float[Array, "N U"]:
    """Q of the edges that lead to the event's choice in no time, and of those that lead to their choices, by what is
    known there.

    `into` and `chain` are those of `internal_edges`.
    """
    changed = event.choice[None]
    for _ in range(chain):
        values = jnp.max(values_of(table, arrays, changed, event.allowed), axis=1)
        before = into[changed]
        table = table.at[before[..., 0], before[..., 1]].set(values[:, None], mode="drop")
        changed = before[..., 0].ravel()
    return table


def process_of(environment: Environment, hierarchy: Hierarchy) -> JointProcess | ShownProcess:
    """The machines in the environment. Raises what `joint_process` and `shown_process` raise."""
    if isinstance(environment, HostEnvironment):
        return shown_process(environment, hierarchy)
    return joint_process(environment, hierarchy)


def internal_edges(process: JointProcess | ShownProcess) -> tuple[Int[Array, "N+1 P 2"], int]:
    """The edges, as choice and position, that lead to each choice in no time, filled up with choice N, which is none
    and has none; and how many of them may follow one another."""
    count = process.num_choices
    before, positions = np.nonzero(process.available & (process.edges < count))
    after = process.edges[before, positions]
    order = np.argsort(after, kind="stable")
    before, positions, after = before[order], positions[order], after[order]
    lengths = np.bincount(after, minlength=count)
    into = np.full((count + 1, max(lengths.max(), 1), 2), (count, 0), dtype=np.int32)
    nth = np.arange(len(after)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    into[after, nth, 0], into[after, nth, 1] = before, positions
    return jnp.asarray(into), process.configurations.choices_in_a_row - 1 if len(after) else 0


def fresh(joint: Int[Array, ""]) -> Runner:
    """A run at the beginning of an episode."""
    nothing = jnp.int32(0)
    return Runner(
        joint=joint,
        chosen=jnp.bool_(False),
        choice=nothing,
        edge=nothing,
        elapsed=nothing,
        reward=jnp.float32(0),
        discount=jnp.float32(1),
        episode_return=jnp.float32(0),
        episode_steps=nothing,
        episode_choices=nothing,
    )


def begin(arrays: Arrays, uniform: Float[Array, ""]) -> Int[Array, ""]:
    """Where an episode begins, picked by a uniform number in [0, 1)."""
    count = len(arrays.begins)
    if not len(arrays.begin_edges):
        return arrays.begins[jnp.minimum((uniform * count).astype(jnp.int32), count - 1)]
    return arrays.begins[jnp.searchsorted(arrays.begin_edges, uniform, side="right", method="scan_unrolled")]


def on_device(process: JointProcess) -> Arrays:
    """The arrays that ticks look up. There is an action even if the machines never act."""
    begins = np.flatnonzero(process.initial_probs)
    probs = process.initial_probs[begins]
    edges = np.cumsum(probs) if np.ptp(probs) > 1e-9 else np.zeros(0)
    acts = max(len(process.actions), 1)
    shape = (acts, process.successors.shape[1])
    return Arrays(
        edges=jnp.asarray(process.edges),
        successors=jnp.asarray(np.resize(process.successors, shape) if len(process.actions) else np.zeros(shape, int)),
        probs=jnp.asarray(np.resize(process.probs, shape)),
        rewards=jnp.asarray(np.resize(process.rewards, shape)),
        begins=jnp.asarray(begins, dtype=jnp.int32),
        begin_edges=jnp.asarray(edges / probs.sum(), dtype=jnp.float32),
    )
