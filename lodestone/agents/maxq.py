"""MAXQ-0 and MAXQ-Q: learning the values of a task graph from experience (Dietterich 2000, sections 3 and 4).

Stored are the expected reward V(a, s) of each primitive action and the completion C(i, s, a) of each call. When the
child a of subtask i ends in s' after N steps,

    C(i, s, a)  <- C + alpha [ gamma^N V(i, s') - C ]
    C~(i, s, a) <- C~ + alpha [ gamma^N (R~_i(s') + max_a' Q~(i, s', a')) - C~ ]
    Q~(i, s, a)  = V(a, s) + C~(i, s, a)

where V(i, s') = V(b, s') + C(i, s', b) for the b with the largest Q~, and 0 if i has ended. C~ with the pseudo-reward
R~ is what a subtask acts by; C without it is what its caller sees. *All-states updating* does the same for every state
that the child went through. MAXQ-0 is the case without pseudo-rewards and without all-states updating.

The recursion is unrolled into events, one at a time in every seed: a few states are updated, and, when none is left to
update, a child is called, which may be a primitive action, or a subtask that has ended is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment, initial_state, next_step, sample_initial
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import Rules
from lodestone.planning.enumerated import enumerated
from lodestone.planning.tables import tabulate
from lodestone.subtasks.recursive import polled_policy
from lodestone.subtasks.task_graph import TaskGraph, TaskTables, tabulate_tasks

EVENTS_PER_ROUND = 32
"""Events between two looks at the schedules."""
UPDATES_PER_EVENT = 4
"""States that one event updates at most: an update costs far less than what else an event does."""


@dataclass(frozen=True)
class MAXQConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.25),)
    """alpha over the run."""
    epsilon: Knots = ((0.0, 0.3), (0.7, 0.02))
    """Probability of a random child over the run."""
    all_states: bool = True
    """Whether every state that a child went through is updated when it ends, or only the one where it was called."""
    abstraction: bool = True
    """Whether states that a child sees alike share a value."""
    pseudo_rewards: bool = True
    """Whether subtasks act by their pseudo-rewards. Without them, and without `all_states`, this is MAXQ-0."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)


class Learned(NamedTuple):
    """What is stored; the slots are those of `TaskTables`."""

    values: Float[Array, " slots"]
    """V of primitive actions and C of calls; all start at 0."""
    inner: Float[Array, " slots"]
    """C~ of the calls of subtasks that have a pseudo-reward; elsewhere it would be the same as C. Empty if there is no
    such subtask."""


class Hierarchy(NamedTuple):
    """The stack of subtasks that run; D levels, the root is level 0."""

    depth: Int[Array, ""]
    """The level that is up."""
    subtask: Int[Array, " D"]
    edge: Int[Array, " D"]
    """The call that each level made last."""
    called_at: Int[Array, " D"]
    """The step of the episode at which it was made."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learned: Learned
    hierarchy: Hierarchy
    state: Int[Array, ""]
    visited: Int[Array, " L"]
    """The states of the episode."""
    steps: Int[Array, ""]
    """Steps of the episode."""
    level: Int[Array, ""]
    """The level whose call has ended and is being learned from."""
    position: Int[Array, ""]
    """The step whose state is updated next; below the step of the call where there is nothing to learn from."""
    cut: Bool[Array, ""]
    """Whether the episode was ended by a limit, and the stack is being left without learning."""
    episode_return: Float[Array, ""]
    total_steps: Int[Array, ""]
    key: PRNGKeyArray


class Values(NamedTuple):
    """What is known about one state."""

    nodes: Float[Array, " A+T"]
    """V of every action and subtask, pseudo-rewards left out."""
    inner_edges: Float[Array, " E"]
    """Q~ of every call; -inf where it is not allowed."""
    inner_subtasks: Float[Array, " T"]
    """max Q~ of every subtask, or its pseudo-reward where it has ended."""
    choices: Int[Array, " T"]
    """The edge with the largest Q~, the first of equals."""


FORBIDDEN = -2
"""In place of a slot: the call is not allowed."""


class Arrays(NamedTuple):
    """`TaskTables` on the device, the state first."""

    completion_slot: Int[Array, "S E"]
    """-1 where the completion is 0, `FORBIDDEN` where the call is not allowed."""
    reward_slot: Int[Array, "S A"]
    ends: Bool[Array, "S T"]
    pseudo_rewards: Float[Array, "S T"]


def on_device(tasks: TaskTables) -> Arrays:
    """The arrays that `values_at` looks up."""
    return Arrays(
        completion_slot=jnp.asarray(np.where(tasks.available, tasks.completion_slot, FORBIDDEN).T),
        reward_slot=jnp.asarray(tasks.reward_slot.T),
        ends=jnp.asarray(tasks.ends.T),
        pseudo_rewards=jnp.asarray(tasks.pseudo_rewards.T, dtype=jnp.float32),
    )


def values_at(tasks: TaskTables, arrays: Arrays, learned: Learned, state: Int[Array, ""]) -> Values:
    """All values of one state, from the primitive actions up."""
    slot, ends = arrays.completion_slot[state], arrays.ends[state]
    completions = jnp.where(slot >= 0, learned.values[slot], 0.0)
    acts_otherwise = [bool(rewards.any()) for rewards in tasks.pseudo_rewards]

    # One number at a time rather than arrays of a subtask's children: the compiler makes one loop over seeds of it all.
    nodes = dict(enumerate(learned.values[arrays.reward_slot[state]]))
    inner_edges: list[Array] = [jnp.float32(-jnp.inf)] * len(tasks.edges)
    inner_subtasks, choices = {}, {}
    for subtask in tasks.bottom_up:
        best_inner, best_value, choice = jnp.float32(-jnp.inf), jnp.float32(0), jnp.int32(0)
        for number in tasks.edges_of(subtask):
            below, inner_completion = nodes[tasks.edges[number].child], completions[number]
            if acts_otherwise[subtask]:
                inner_completion = jnp.where(slot[number] >= 0, learned.inner[slot[number]], 0.0)
            inner = jnp.where(slot[number] != FORBIDDEN, below + inner_completion, -jnp.inf)
            better = inner > best_inner
            best_inner = jnp.where(better, inner, best_inner)
            best_value = jnp.where(better, below + completions[number], best_value)
            choice = jnp.where(better, number, choice)
            inner_edges[number] = inner
        nodes[tasks.num_actions + subtask] = jnp.where(ends[subtask], 0.0, best_value)
        after_end = arrays.pseudo_rewards[state, subtask] if acts_otherwise[subtask] else jnp.float32(0)
        inner_subtasks[subtask] = jnp.where(ends[subtask], after_end, best_inner)
        choices[subtask] = choice

    def ordered(found: dict[int, Array]) -> Array:
        return jnp.stack([found[number] for number in sorted(found)])

    return Values(ordered(nodes), jnp.stack(inner_edges), ordered(inner_subtasks), ordered(choices))


def maxq(config: MAXQConfig, environment: Environment, graph: TaskGraph, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment. Schedules are fractions of
    `steps`, primitive steps.

    A limit, of steps or of decisions, which are steps here, unwinds the stack without learning from the calls on it;
    only the last action is learned from. Raises `TooManyStates`, `InvalidTaskGraph`, and `InvalidConfig` for rules
    without a limit or that are about options.
    """
    if rules.call_cost or rules.undiscounted_option_reward or not rules.bootstrap_at_limit:
        raise InvalidConfig("MAXQ has no call cost, no undiscounted option reward, and takes no limit for an end.")
    limits = [limit for limit in (rules.step_limit, rules.decision_limit) if limit is not None]
    if not limits:
        raise InvalidConfig("MAXQ remembers the states of an episode, so it needs a step limit.")
    limit = min(limits)
    tables = tabulate(environment)
    tasks = tabulate_tasks(as_configured(config, graph), environment, tables)
    world, arrays = enumerated(tables, environment.action_names), on_device(tasks)
    with_pseudo_rewards = bool(tasks.pseudo_rewards.any())
    num_actions, levels = tasks.num_actions, graph.levels
    caller = jnp.asarray([edge.subtask for edge in tasks.edges], dtype=jnp.int32)
    edges_of = _padded([tasks.edges_of(subtask) for subtask in range(len(tasks.ends))])
    child_of = jnp.asarray([edge.child for edge in tasks.edges], dtype=jnp.int32)
    powers = jnp.asarray(rules.discount ** np.arange(limit + 1), dtype=jnp.float32)

    def init(key: PRNGKeyArray) -> Carry:
        start_key, key = jax.random.split(key)
        zeros, none = jnp.zeros(tasks.num_slots), jnp.zeros(levels, dtype=jnp.int32)
        return Carry(
            learned=Learned(zeros, zeros if with_pseudo_rewards else jnp.zeros(0)),
            hierarchy=Hierarchy(jnp.int32(0), none, none, none),
            state=sample_initial(world, start_key),
            visited=jnp.zeros(limit, dtype=jnp.int32),
            steps=jnp.int32(0),
            level=jnp.int32(0),
            position=jnp.int32(-1),
            cut=jnp.bool_(False),
            episode_return=jnp.float32(0),
            total_steps=jnp.int32(0),
            key=key,
        )

    def event(
        carry: Carry, noise: Float[Array, "4"], epsilon: Float[Array, ""], learning_rate: Float[Array, ""]
    ) -> tuple[Carry, RoundLog]:
        """Update some states if a call has ended; if all are done, return from a subtask that has ended; else call a
        child, which, if it is a primitive action, acts."""
        hierarchy, state, steps = carry.hierarchy, carry.state, carry.steps
        known, ends = values_at(tasks, arrays, carry.learned, state), arrays.ends[state]

        edge, first = hierarchy.edge[carry.level], hierarchy.called_at[carry.level]
        value, inner_value = known.nodes[num_actions + caller[edge]], known.inner_subtasks[caller[edge]]
        position, (values, inner), loss = carry.position, carry.learned, jnp.float32(0)
        for _ in range(UPDATES_PER_EVENT if config.all_states else 1):
            due = position >= first
            slot = jnp.where(due, arrays.completion_slot[carry.visited[position], edge], -1)
            weight = powers[steps - position]
            values, error = _move(values, slot, weight * value, learning_rate)
            if with_pseudo_rewards:
                inner, _ = _move(inner, slot, weight * inner_value, learning_rate)
            loss += jnp.square(error)
            position -= due.astype(jnp.int32)

        up, subtask = hierarchy.depth, hierarchy.subtask[hierarchy.depth]
        updating = position >= first
        ended = ends[hierarchy.subtask] & (jnp.arange(levels) <= up)
        returning = ~updating & (jnp.any(ended) | carry.cut)
        calling = ~updating & ~returning
        episode_over = returning & (up == 0)

        edges = edges_of[subtask]
        row = jnp.where(edges >= 0, known.inner_edges[edges], -jnp.inf)
        choice = edges[epsilon_greedy(noise[:2], row, row > -jnp.inf, epsilon)]
        child = child_of[choice]
        acting = calling & (child < num_actions)
        descending = calling & ~acting
        action = jnp.minimum(child, num_actions - 1)
        step = next_step(world, noise[2], state, action)
        terminated = step.terminated | arrays.ends[step.state, 0]  # the root may end before the environment does
        cut = acting & (steps + 1 >= limit) & ~terminated
        values, error = _move(
            values, jnp.where(acting, arrays.reward_slot[state, action], -1), step.reward, learning_rate
        )

        # A call is learned from when it has ended by itself, not when a subtask above it has.
        from_child = returning & ~episode_over & ends[subtask] & ~carry.cut
        level = jnp.where(acting, up, jnp.where(returning, up - 1, carry.level))
        last = jnp.where(acting, steps, steps - 1)
        if not config.all_states:
            last = jnp.where(acting, steps, hierarchy.called_at[jnp.maximum(up - 1, 0)])
        position = jnp.where(acting | from_child, last, jnp.where(updating, position, -1))

        called = jnp.arange(levels) == jnp.where(calling, up, levels)
        entered = jnp.arange(levels) == jnp.where(descending, up + 1, levels)
        after = Hierarchy(
            depth=jnp.where(episode_over, 0, up + descending.astype(jnp.int32) - returning.astype(jnp.int32)),
            subtask=jnp.where(entered, child - num_actions, hierarchy.subtask),
            edge=jnp.where(called, choice, hierarchy.edge),
            called_at=jnp.where(called, steps, hierarchy.called_at),
        )
        moved = jnp.where(acting, step.state, state)
        total = jnp.where(acting, carry.episode_return + step.reward, carry.episode_return)
        taken = steps + acting.astype(jnp.int32)
        next_carry = Carry(
            learned=Learned(values, inner),
            hierarchy=after,
            state=jnp.where(episode_over, initial_state(world, noise[3]), moved),
            visited=carry.visited.at[jnp.where(acting, steps, limit)].set(state, mode="drop"),
            steps=jnp.where(episode_over, 0, taken),
            level=level,
            position=position,
            cut=(carry.cut | cut) & ~episode_over,
            episode_return=jnp.where(episode_over, 0.0, total),
            total_steps=carry.total_steps + acting.astype(jnp.int32),
            key=carry.key,
        )
        log = RoundLog(
            valid=acting,
            option=choice,
            steps=jnp.int32(1),
            episode_ended=terminated | cut,
            terminated=terminated,
            episode_return=total,
            episode_steps=taken,
            episode_decisions=taken,
            loss=loss + jnp.square(error),
        )
        return next_carry, log

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`EVENTS_PER_ROUND` events."""
        del number
        fraction = carry.total_steps.astype(jnp.float32) / steps
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)
        noise = jax.random.uniform(noise_key, (EVENTS_PER_ROUND, 4))
        carry, log = jax.lax.scan(lambda carry, noise: event(carry, noise, epsilon, learning_rate), carry, noise)
        return carry._replace(key=key), log._replace(loss=jnp.mean(log.loss))

    return Algorithm(init, run_round)


def _move(
    values: Float[Array, " slots"], slot: Int[Array, ""], target: Float[Array, ""], learning_rate: Float[Array, ""]
) -> tuple[Float[Array, " slots"], Float[Array, ""]]:
    """The value of a slot moved towards a target, and the error; nothing where the slot is negative."""
    error = jnp.where(slot >= 0, target - values[slot], 0.0)
    return values.at[slot].add(learning_rate * error), error


def as_configured(config: MAXQConfig, graph: TaskGraph) -> TaskGraph:
    """The graph with as much abstraction and as many pseudo-rewards as the learner uses."""
    graph = graph if config.abstraction else graph.without_abstraction()
    return graph if config.pseudo_rewards else graph.without_pseudo_rewards()


def chooser(
    config: MAXQConfig, environment: Environment, graph: TaskGraph
) -> Callable[[Learned], Int[np.ndarray, "N T S"]]:
    """A function from what N seeds have learned to the edge that each subtask takes in each state; -1 where it has
    ended. Compiled once."""
    tasks, everywhere = _everywhere(config, environment, graph)
    ask = jax.jit(jax.vmap(everywhere))
    return lambda learned: np.where(tasks.ends, -1, np.asarray(ask(learned).choices).swapaxes(1, 2))


def polled_values(
    config: MAXQConfig, environment: Environment, graph: TaskGraph, learned: Learned
) -> Float[np.ndarray, "N S A"]:
    """What each of N seeds expects of each primitive action where every step asks anew from the root down: the rewards
    and completions along the best path to the action, -inf where there is none. The maximum of a row is the action that
    polling takes, also where pseudo-rewards choose another path than the best."""
    tasks, everywhere = _everywhere(config, environment, graph)
    values = jax.tree.map(np.asarray, jax.jit(jax.vmap(everywhere))(jax.tree.map(jnp.asarray, learned)))
    seeds = zip(np.asarray(learned.values), values.nodes, values.choices, strict=True)
    return np.stack([_polled_values(tasks, *seed) for seed in seeds])


def _polled_values(
    tasks: TaskTables,
    stored: Float[np.ndarray, " slots"],
    nodes: Float[np.ndarray, "S A+T"],
    choices: Int[np.ndarray, "S T"],
) -> Float[np.ndarray, "S A"]:
    states = np.arange(tasks.ends.shape[1])
    slots = tasks.completion_slot
    completions = np.where(slots >= 0, stored[slots], 0.0)
    paths = {action: np.full((len(states), tasks.num_actions), -np.inf) for action in range(tasks.num_actions)}
    for action, path in paths.items():
        path[:, action] = nodes[:, action]
    for subtask in tasks.bottom_up:
        calls = [
            np.where(tasks.available[number], completions[number], -np.inf)[:, None] + paths[tasks.edges[number].child]
            for number in tasks.edges_of(subtask)
        ]
        paths[tasks.num_actions + subtask] = np.max(calls, axis=0)
    found = np.where(tasks.ends[0][:, None], 0.0, paths[tasks.num_actions])
    polled = polled_policy(tasks, np.where(tasks.ends, -1, choices.T))
    found[states, polled] = np.nextafter(found.max(axis=1).astype(np.float32), np.float32(np.inf))
    return found.astype(np.float32)


def _everywhere(
    config: MAXQConfig, environment: Environment, graph: TaskGraph
) -> tuple[TaskTables, Callable[[Learned], Values]]:
    """The tasks, and a function from what one seed has learned to what it knows about every state."""
    tables = tabulate(environment)
    tasks = tabulate_tasks(as_configured(config, graph), environment, tables)
    arrays = on_device(tasks)

    def everywhere(learned: Learned) -> Values:
        return jax.vmap(partial(values_at, tasks, arrays, learned))(jnp.arange(tables.num_states))

    return tasks, everywhere


def rounds_for(graph: TaskGraph, steps: int) -> int:
    """Rounds that are surely enough for so many primitive steps: an action takes an event to be called and one to be
    learned from, and every level above it at most a call, a return and an update a step."""
    return -(-steps * (2 + 3 * (graph.levels - 1)) // EVENTS_PER_ROUND)


def _padded(rows: list[tuple[int, ...]]) -> Int[Array, "T U"]:
    """Rows of one length, filled up with -1."""
    width = max(map(len, rows))
    return jnp.asarray([row + (-1,) * (width - len(row)) for row in rows], dtype=jnp.int32)
