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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.agents.q_learning import choose_entry
from lodestone.envs.base import Environment, initial_state, sample_initial
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import Rules, uniforms
from lodestone.planning.enumerated import enumerated, look_up_step
from lodestone.planning.tables import tabulate
from lodestone.subtasks.places import Places, arrange, may_be_running
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


class Stack(NamedTuple):
    """The subtasks that run. Each is known by its place, and a caller's is above that of what it called."""

    subtask: tuple[Int[Array, ""], ...]
    """The subtask that runs at each place; -1 for none."""
    edge: tuple[Int[Array, ""], ...]
    """The call that was made last from each place."""
    called_at: tuple[Int[Array, ""], ...]
    """The step of the episode at which it was made."""


class Lesson(NamedTuple):
    """What is to be learned from the last step: from the calls that ended with it, the lowest first."""

    values: tuple[Float[Array, ""], ...]
    """V of the caller at each place, in the state that was reached; 0 where it has ended."""
    inner_values: tuple[Float[Array, ""], ...]
    """max Q~, or the pseudo-reward."""
    ends_at: tuple[Int[Array, ""], ...]
    """Updates up to and with those of each place."""
    done: Int[Array, ""]
    """Updates that have been made."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learned: Learned
    stack: Stack
    lesson: Lesson
    state: Int[Array, ""]
    visited: Int[Array, " L"]
    """The states of the episode."""
    steps: Int[Array, ""]
    """Steps of the episode."""
    episode_return: Float[Array, ""]
    total_steps: Int[Array, ""]
    key: PRNGKeyArray


FORBIDDEN = -2
"""In place of a slot: there is no such call."""


class Calls(NamedTuple):
    """The calls that the resident of one place may make, W at most in each state; looked up by state."""

    edge: Int[Array, "S W"]
    slot: Int[Array, "S W"]
    """Where the completion is stored; -1 where it is 0, `FORBIDDEN` where there is no call."""
    reward_slot: Int[Array, "S W"]
    """Where the reward of a primitive action is stored."""
    child_place: Int[Array, "S W"]
    """The place of a subtask; -1 for a primitive action."""
    child_places: tuple[frozenset[int], ...]
    """For each of the W, what `child_place` may be."""


class Known(NamedTuple):
    """What is known about the resident of one place in a state."""

    value: Float[Array, ""]
    """V, pseudo-rewards left out."""
    inner_value: Float[Array, ""]
    """max Q~."""
    inner_calls: list[Float[Array, ""]]
    """Q~ of its W calls; -inf where there is none."""
    best: Int[Array, ""]
    """The call with the largest Q~, the first of equals."""


def calls_of(tasks: TaskTables, places: Places) -> list[Calls]:
    """What `values_at` looks up, place by place."""
    states = np.arange(tasks.ends.shape[1])[:, None]
    children = np.array([edge.child for edge in tasks.edges])
    place_of = np.array([-1] * tasks.num_actions + list(places.place_of))
    found = []
    for edge in places.calls:
        child = np.where(edge >= 0, children[edge], -1)
        primitive = np.minimum(child, tasks.num_actions - 1)
        child_place = place_of[child]
        found.append(
            Calls(
                edge=jnp.asarray(edge),
                slot=jnp.asarray(np.where(edge >= 0, tasks.completion_slot[edge, states], FORBIDDEN)),
                reward_slot=jnp.asarray(tasks.reward_slot[primitive, states]),
                child_place=jnp.asarray(child_place, dtype=jnp.int32),
                child_places=tuple(
                    frozenset(place.tolist()) for place in (row[there] for row, there in zip(child_place.T, edge.T >= 0))
                ),
            )
        )
    return found


def values_at(calls: Sequence[Calls], learned: Learned, state: Int[Array, ""]) -> list[Known]:
    """All values of one state, place by place, from the primitive actions up."""
    known: list[Known] = []
    for here in calls:
        slots, reward_slots, child_place = here.slot[state], here.reward_slot[state], here.child_place[state]
        value, inner_value, best, row = jnp.float32(0), jnp.float32(-jnp.inf), jnp.int32(0), []
        # One number at a time rather than rows of them: the compiler makes one loop over seeds of it all.
        for number, child_places in enumerate(here.child_places):
            slot = slots[number]
            completion = inner_completion = jnp.where(slot >= 0, learned.values[slot], 0.0)
            if len(learned.inner):
                inner_completion = jnp.where(slot >= 0, learned.inner[slot], 0.0)
            below = jnp.float32(0)
            for place in sorted(child_places):
                child = learned.values[reward_slots[number]] if place < 0 else known[place].value
                below = jnp.where(child_place[number] == place, child, below) if len(child_places) > 1 else child
            inner = jnp.where(slot == FORBIDDEN, -jnp.inf, below + inner_completion)
            better = inner > inner_value
            inner_value = jnp.where(better, inner, inner_value)
            value = jnp.where(better, below + completion, value)
            best = jnp.where(better, number, best)
            row.append(inner)
        known.append(Known(value, inner_value, row, best))
    return known


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
    world = enumerated(tables, environment.action_names)
    places = arrange(tasks, may_be_running(tasks, tables))
    calls, top = calls_of(tasks, places), len(places.calls) - 1
    resident = jnp.asarray(places.resident)
    completion_slot, reward_slot = jnp.asarray(tasks.completion_slot.T), jnp.asarray(tasks.reward_slot.T)
    stored = jnp.asarray((tasks.completion_slot >= 0).any(axis=1))
    child_of = jnp.asarray([edge.child for edge in tasks.edges], dtype=jnp.int32)
    pseudo_rewards = jnp.asarray(tasks.pseudo_rewards.T, dtype=jnp.float32)
    with_pseudo_rewards = bool(tasks.pseudo_rewards.any())
    powers = jnp.asarray(rules.discount ** np.arange(limit + 1), dtype=jnp.float32)
    nothing = (jnp.int32(0),) * (top + 1)
    only_root = (jnp.int32(-1),) * top + (jnp.int32(0),)
    no_lesson = Lesson((jnp.float32(0),) * (top + 1), (jnp.float32(0),) * (top + 1), nothing, jnp.int32(0))

    def init(key: PRNGKeyArray) -> Carry:
        start_key, key = jax.random.split(key)
        zeros = jnp.zeros(tasks.num_slots)
        return Carry(
            learned=Learned(zeros, zeros if with_pseudo_rewards else jnp.zeros(0)),
            stack=Stack(only_root, nothing, nothing),
            lesson=no_lesson,
            state=sample_initial(world, start_key),
            visited=jnp.zeros(limit, dtype=jnp.int32),
            steps=jnp.int32(0),
            episode_return=jnp.float32(0),
            total_steps=jnp.int32(0),
            key=key,
        )

    def learn(carry: Carry, learning_rate: Float[Array, ""]) -> tuple[Learned, Float[Array, ""]]:
        """Some of the updates that are left."""
        (table, inner), (values, inner_values, ends_at, done), loss = carry.learned, carry.lesson, jnp.float32(0)
        for number in [done + n for n in range(UPDATES_PER_EVENT)]:

            def of_place(options, number=number):
                return reduce(
                    lambda found, here: jnp.where(number < here[0], here[1], found),
                    reversed(list(zip(ends_at[:-1], options[:-1]))),
                    options[-1],
                )

            back = number - of_place((jnp.int32(0), *ends_at[:-1]))
            position = carry.steps - 1 - back if config.all_states else of_place(carry.stack.called_at)
            slot = completion_slot[carry.visited[position], of_place(carry.stack.edge)]
            slot = jnp.where(number < ends_at[-1], slot, -1)
            weight = powers[carry.steps - position]
            table, error = _move(table, slot, weight * of_place(values), learning_rate)
            if with_pseudo_rewards:
                inner, _ = _move(inner, slot, weight * of_place(inner_values), learning_rate)
            loss += jnp.square(error)
        return Learned(table, inner), loss

    def descend(
        stack: Stack, known: list[Known], state: Int[Array, ""], steps: Int[Array, ""], noise, epsilon
    ) -> tuple[Stack, Int[Array, ""]]:
        """Calls from the lowest subtask that runs down to a primitive action; returns the lowest place, too."""
        subtask, edge, called_at = (list(leaf) for leaf in stack)
        at, chance = jnp.int32(top), iter(noise)
        for place in reversed(range(top + 1)):
            at = jnp.where(subtask[place] >= 0, place, at)
        for place in reversed(range(top + 1)):
            here, row = at == place, known[place].inner_calls
            choice = jnp.int32(0)
            if len(row) > 1:
                choice = choose_entry(next(chance), next(chance), row, epsilon)
            call = calls[place].edge[state, choice]
            edge[place] = jnp.where(here, call, edge[place])
            called_at[place] = jnp.where(here, steps, called_at[place])
            for lower in range(place):
                entered = here & (place_of_child[call] == lower)
                subtask[lower] = jnp.where(entered, child_of[call] - tasks.num_actions, subtask[lower])
                at = jnp.where(entered, lower, at)
        return Stack(tuple(subtask), tuple(edge), tuple(called_at)), at

    place_of_child = jnp.asarray([-1] * tasks.num_actions + list(places.place_of), dtype=jnp.int32)[child_of]

    def arrive(
        stack: Stack, at: Int[Array, ""], known: list[Known], state: Int[Array, ""], steps: Int[Array, ""], cut
    ) -> tuple[Stack, Lesson]:
        """What there is to learn from a step, and the stack without what has ended. """
        residents = resident[state]
        running = [subtask >= 0 for subtask in stack.subtask]
        ended = [there & (residents[place] != stack.subtask[place]) for place, there in enumerate(running)]
        values, inner_values, ends_at = [], [], []
        below_ended, updates = jnp.bool_(False), jnp.int32(0)
        for place in range(top + 1):
            values.append(jnp.where(ended[place], 0.0, known[place].value))
            after_end = pseudo_rewards[state, stack.subtask[place]]
            inner_values.append(jnp.where(ended[place], after_end, known[place].inner_value))
            length = steps - stack.called_at[place] if config.all_states else jnp.int32(1)
            learns = (at == place) | (running[place] & below_ended & ~cut)
            updates += jnp.where(learns & stored[stack.edge[place]], length, 0)
            ends_at.append(updates)
            below_ended = jnp.where(running[place], ended[place], below_ended)
        subtask, gone = list(stack.subtask), cut
        for place in reversed(range(top + 1)):
            gone |= ended[place]
            subtask[place] = jnp.where(gone, -1, subtask[place])
        return stack._replace(subtask=tuple(subtask)), Lesson(
            tuple(values), tuple(inner_values), tuple(ends_at), jnp.int32(0)
        )

    def event(
        carry: Carry, noise: Float[Array, " N"], epsilon: Float[Array, ""], learning_rate: Float[Array, ""]
    ) -> tuple[Carry, RoundLog]:
        """Update some states whose calls have ended; if none is left, leave what has ended, and act."""
        state, steps = carry.state, carry.steps
        carry = carry._replace(visited=carry.visited.at[steps].set(state, mode="drop"))
        learned, loss = learn(carry, learning_rate)
        done = carry.lesson.done + UPDATES_PER_EVENT
        over = (done >= carry.lesson.ends_at[-1]) & (carry.stack.subtask[top] < 0)
        acting = (done >= carry.lesson.ends_at[-1]) & ~over

        stack, at = descend(carry.stack, values_at(calls, learned, state), state, steps, noise, epsilon)
        action = child_of[pick(stack.edge, at)]
        step = look_up_step(world, noise[-1], state, action)
        slot = jnp.where(acting, reward_slot[state, action], -1)
        table, error = _move(learned.values, slot, step.reward, learning_rate)
        learned = learned._replace(values=table)
        terminated = resident[step.state, top] < 0  # the root may end before the environment does
        cut = (steps + 1 >= limit) & ~terminated
        popped, lesson = arrive(stack, at, values_at(calls, learned, step.state), step.state, steps + 1, cut)

        total = carry.episode_return + step.reward
        new = carry._replace(
            stack=popped, lesson=lesson, state=step.state, steps=steps + 1, episode_return=total,
            total_steps=carry.total_steps + 1,
        )
        restarted = carry._replace(
            stack=carry.stack._replace(subtask=only_root),
            lesson=no_lesson,
            state=initial_state(world, noise[-1]),
            steps=jnp.int32(0),
            episode_return=jnp.float32(0),
        )
        waiting = carry._replace(lesson=carry.lesson._replace(done=done))
        fixed = dict(learned=0, visited=0, key=jnp.int32(0))
        next_carry = jax.tree.map(
            lambda a, b, c: jnp.where(acting, a, jnp.where(over, b, c)),
            new._replace(**fixed), restarted._replace(**fixed), waiting._replace(**fixed),
        )._replace(learned=learned, visited=carry.visited, key=carry.key)
        log = RoundLog(
            valid=acting,
            option=pick(stack.edge, at),
            steps=jnp.int32(1),
            episode_ended=terminated | cut,
            terminated=terminated,
            episode_return=total,
            episode_steps=steps + 1,
            episode_decisions=steps + 1,
            loss=loss + jnp.square(error),
        )
        return next_carry, log

    num_noise = 1 + 2 * sum(here.edge.shape[1] > 1 for here in calls)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`EVENTS_PER_ROUND` events."""
        del number
        fraction = carry.total_steps.astype(jnp.float32) / steps
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)
        noise = uniforms(noise_key, (EVENTS_PER_ROUND, num_noise))
        carry, log = jax.lax.scan(lambda carry, noise: event(carry, noise, epsilon, learning_rate), carry, noise)
        return carry._replace(key=key), log._replace(loss=jnp.mean(log.loss))

    return Algorithm(init, run_round)


def pick(options: Sequence[Array], number: Int[Array, ""]) -> Array:
    """The option of that number, by comparisons: for a few of them that is faster than a look-up."""
    return reduce(lambda found, one: jnp.where(number == one[0], one[1], found), enumerate(options), options[0])


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
