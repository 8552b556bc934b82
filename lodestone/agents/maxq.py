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
update, children are called down to a primitive action, which acts, and what has ended is left.
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

from lodestone.envs.base import Environment, Step, initial_state, next_step, sample_initial
from lodestone.envs.host import ANEW, HostEnvironment, Shown
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog
from lodestone.learning.policies import choose_among, one_for_two
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import REWARD_SWITCHES, Rules, uniforms
from lodestone.planning.enumerated import look_up_step, num_rows, row_of, world_of
from lodestone.planning.tables import tabulate
from lodestone.subtasks.places import arrange, may_be_running
from lodestone.subtasks.recursive import polled_policy
from lodestone.subtasks.task_graph import TaskGraph, TaskTables, tabulate_tasks
from lodestone.subtasks.values import Known, evaluator
from lodestone.types import State

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
    allowed: Bool[Array, "S A"] | None = None
    """In a Gymnasium environment, the actions that were allowed when a number was last shown."""


class Stack(NamedTuple):
    """The subtasks that run, by their places (`Places`): a caller's is above that of what it calls."""

    subtask: tuple[Int[Array, ""], ...]
    """The subtask that runs at each place; -1 for none."""
    edge: tuple[Int[Array, ""], ...]
    """The call that was made last from each place."""
    called_at: tuple[Int[Array, ""], ...]
    """The step of the episode at which it was made."""


class Lesson(NamedTuple):
    """What the last step has to teach: about the calls that ended with it, from the lowest place up."""

    values: tuple[Float[Array, ""], ...]
    """V of the caller at each place where the step led to; 0 if it has ended there."""
    inner_values: tuple[Float[Array, ""], ...]
    """max Q~, or the pseudo-reward; 0 where no subtask acts by one."""
    updates: tuple[Int[Array, ""], ...]
    """Updates of each place and those below."""
    done: Int[Array, ""]
    """Updates that have been made, or more."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learned: Learned
    stack: Stack
    lesson: Lesson
    state: State
    visited: Int[Array, " L"]
    """The rows of the episode's states."""
    steps: Int[Array, ""]
    """Steps of the episode."""
    episode_return: Float[Array, ""]
    total_steps: Int[Array, ""]
    key: PRNGKeyArray


def maxq(config: MAXQConfig, environment: Environment, graph: TaskGraph, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment, or in a Gymnasium environment by
    the number that this shows. Schedules are fractions of `steps`, primitive steps.

    A limit, of steps or of decisions, which are steps here, unwinds the stack without learning from the calls on it;
    only the last action is learned from. Raises `TooManyStates`, `InvalidTaskGraph`, and `InvalidConfig` for rules
    that are about options, where there is no limit, and for a Gymnasium environment that shows no number.
    """
    rules.refuse((*REWARD_SWITCHES, "bootstrap_at_limit"), "MAXQ has no options, and takes no limit for an end")
    limits = [rules.step_limit, rules.decision_limit]
    if isinstance(environment, HostEnvironment):
        limits.append(environment.step_limit)
    limit = min((each for each in limits if each is not None), default=None)
    if limit is None:
        raise InvalidConfig(
            "MAXQ remembers the states of an episode, so it needs a step limit; in Gymnasium its TimeLimit is one."
        )
    tasks, world = tasks_of(config, environment, graph), world_of(environment)
    num_actions, num_edges = tasks.num_actions, len(tasks.edges)
    outside = isinstance(world, HostEnvironment)
    places = arrange(tasks, ~tasks.ends if outside else may_be_running(tasks, tabulate(environment)))
    evaluate, top = evaluator(tasks, places), len(places.calls) - 1
    draws = 1 + sum(edges.shape[1] > 1 for edges in places.calls)

    # What a state and another number look up is flat: one index is put together far faster than two.
    completion_slot = jnp.asarray(tasks.completion_slot.T.ravel())
    reward_slot = jnp.asarray(tasks.reward_slot.T.ravel())
    calls = [jnp.asarray(edges.ravel()) for edges in places.calls]
    resident = jnp.asarray(places.resident)
    pseudo_rewards = jnp.asarray(tasks.pseudo_rewards.T, dtype=jnp.float32)
    stored = jnp.asarray((tasks.completion_slot >= 0).any(axis=1))
    child_of = jnp.asarray([edge.child for edge in tasks.edges], dtype=jnp.int32)
    child_place = jnp.asarray([-1] * num_actions + list(places.place_of), dtype=jnp.int32)[child_of]
    powers = jnp.asarray(rules.discount ** np.arange(limit + 1), dtype=jnp.float32)

    only_root = (jnp.int32(-1),) * top + (jnp.int32(0),)
    no_numbers, no_values = (jnp.int32(0),) * (top + 1), (jnp.float32(0),) * (top + 1)
    no_lesson = Lesson(no_values, no_values, no_numbers, jnp.int32(0))

    def init(key: PRNGKeyArray) -> Carry:
        start_key, key = jax.random.split(key)
        zeros = jnp.zeros(tasks.num_slots)
        allowed = jnp.ones((num_rows(world), num_actions), dtype=bool) if outside else None
        return Carry(
            learned=Learned(zeros, zeros if any(places.otherwise) else jnp.zeros(0), allowed),
            stack=Stack(only_root, no_numbers, no_numbers),
            lesson=no_lesson,
            state=sample_initial(world, start_key),
            visited=jnp.zeros(limit, dtype=jnp.int32),
            steps=jnp.int32(0),
            episode_return=jnp.float32(0),
            total_steps=jnp.int32(0),
            key=key,
        )

    def update(carry: Carry, learning_rate: Float[Array, ""]) -> tuple[Learned, Float[Array, ""]]:
        """The next updates of the lesson, those of the latest states first; returns the sum of squared errors, too."""
        (values, inner, allowed), stack, lesson = carry.learned, carry.stack, carry.lesson
        loss = jnp.float32(0)
        for offset in range(UPDATES_PER_EVENT if config.all_states else 1):
            number = lesson.done + offset
            at_place = partial(_first_above, number, lesson.updates)
            back = number - at_place((0, *lesson.updates[:-1]))
            position = carry.steps - 1 - back if config.all_states else at_place(stack.called_at)
            slot = completion_slot[carry.visited[position] * num_edges + at_place(stack.edge)]
            slot = jnp.where(number < lesson.updates[top], slot, -1)
            weight = powers[carry.steps - position]
            values, error = _move(values, slot, weight * at_place(lesson.values), learning_rate)
            if any(places.otherwise):
                slot = jnp.where(at_place(places.otherwise), slot, -1)
                inner, _ = _move(inner, slot, weight * at_place(lesson.inner_values), learning_rate)
            loss += jnp.square(error)
        return Learned(values, inner, allowed), loss

    def descend(
        carry: Carry, row: Int[Array, ""], known: list[Known], noise: Float[Array, " N"], epsilon: Float[Array, ""]
    ) -> tuple[Stack, Int[Array, ""]]:
        """Calls down to a primitive action; returns the place that calls it, too."""
        subtask, edge, called_at = (list(leaf) for leaf in carry.stack)
        caller, uniform = jnp.int32(top), iter(noise)
        for place in reversed(range(top)):
            caller = jnp.where(subtask[place] >= 0, place, caller)
        for place in reversed(range(top + 1)):
            here, values, choice = caller == place, known[place].inner_calls, jnp.int32(0)
            if len(values) > 1:
                choice = choose_among(*one_for_two(next(uniform), epsilon), values, epsilon)
            call = calls[place][row * len(values) + choice]
            edge[place] = jnp.where(here, call, edge[place])
            called_at[place] = jnp.where(here, carry.steps, called_at[place])
            for lower in range(place):
                entered = here & (child_place[call] == lower)
                subtask[lower] = jnp.where(entered, child_of[call] - num_actions, subtask[lower])
                caller = jnp.where(entered, lower, caller)
        return Stack(tuple(subtask), tuple(edge), tuple(called_at)), caller

    def arrive(
        stack: Stack, caller: Int[Array, ""], steps: Int[Array, ""], arrived: Step, learned: Learned
    ) -> tuple[Stack, Lesson, Bool[Array, ""]]:
        """What is left of the stack after a step, what is learned, and whether the root has ended by itself. `caller`
        is the place that called the action.

        A call is learned from when it has ended by itself, not when a subtask above it has. All values can be known
        before the first update, as none of them depends on it: they are those of callers whose calls have ended.
        """
        state = row_of(world, arrived.state)
        known, residents = evaluate(*learned, state), resident[state]
        limited = steps >= limit
        if outside:  # where only the step tells what has ended
            residents, limited = jnp.where(arrived.terminated, -1, residents), arrived.state.truncated
        cut = limited & (residents[top] >= 0)
        running = [subtask >= 0 for subtask in stack.subtask]
        ended = [runs & (residents[place] != stack.subtask[place]) for place, runs in enumerate(running)]
        values, inner_values, updates, total = [], [], [], jnp.int32(0)
        call_ended = jnp.bool_(False)
        for place in range(top + 1):
            values.append(jnp.where(ended[place], 0.0, known[place].value))
            inner_value = jnp.float32(0)
            if places.otherwise[place]:
                after_end = pseudo_rewards[state, stack.subtask[place]]
                inner_value = jnp.where(ended[place], after_end, known[place].inner_value)
            inner_values.append(inner_value)
            learns = ((caller == place) | (running[place] & call_ended & ~cut)) & stored[stack.edge[place]]
            length = steps - stack.called_at[place] if config.all_states else jnp.int32(1)
            total += jnp.where(learns, length, 0)
            updates.append(total)
            call_ended = jnp.where(running[place], ended[place], call_ended)
        subtask, left = list(stack.subtask), cut
        for place in reversed(range(top + 1)):
            left |= ended[place]
            subtask[place] = jnp.where(left, -1, subtask[place])
        lesson = Lesson(tuple(values), tuple(inner_values), tuple(updates), jnp.int32(0))
        return stack._replace(subtask=tuple(subtask)), lesson, residents[top] < 0

    def remember(learned: Learned, state: State) -> Learned:
        """What is allowed in a state."""
        if learned.allowed is None:
            return learned
        return learned._replace(allowed=learned.allowed.at[row_of(world, state)].set(state.seen.allowed))

    def act(
        state: State, uniform: Float[Array, ""], action: Int[Array, ""], acting: Bool[Array, ""], over: Bool[Array, ""]
    ) -> tuple[Step, State]:
        """A step, to be used where `acting`, and how the next episode begins, to be used where this one is `over`."""
        if not isinstance(world, HostEnvironment):
            return look_up_step(world, uniform, state, action), initial_state(world, uniform)
        # Where only the root has ended, the environment has to be asked for another episode.
        ended = state.terminated | state.truncated
        asked = world.hold(state, ~(acting | (over & ~ended)))
        step = next_step(world, uniform, asked, jnp.where(over, ANEW, action))
        return step, jax.tree.map(partial(jnp.where, ended), world.begin_again(state), step.state)

    def event(
        carry: Carry, noise: Float[Array, " N"], epsilon: Float[Array, ""], learning_rate: Float[Array, ""]
    ) -> tuple[Carry, RoundLog]:
        """Some updates; if none is left, an action, or a new episode where the root has been left."""
        state = row_of(world, carry.state)
        # Written before it is read, or else the compiler copies it all.
        carry = carry._replace(visited=carry.visited.at[carry.steps].set(state, mode="drop"))
        learned, loss = update(carry, learning_rate)
        learned = remember(learned, carry.state)
        done = carry.lesson.done + (UPDATES_PER_EVENT if config.all_states else 1)
        ready = done >= carry.lesson.updates[top]
        # The root has been left, or had ended where the episode began.
        over = (carry.stack.subtask[top] < 0) | (resident[state, top] < 0)
        acting = ready & ~over

        stack, caller = descend(carry, state, evaluate(*learned, state), noise, epsilon)
        edge = _at(caller, stack.edge)
        action = jnp.minimum(child_of[edge], num_actions - 1)
        step, begun = act(carry.state, noise[-1], action, acting, ready & over)
        slot = jnp.where(acting, reward_slot[state * num_actions + action], -1)
        values, error = _move(learned.values, slot, step.reward, learning_rate)
        learned = learned._replace(values=values)
        steps = carry.steps + 1
        if outside:  # what is not a step shows nothing
            learned = remember(learned, jax.tree.map(partial(jnp.where, acting), step.state, carry.state))
        left, lesson, terminated = arrive(stack, caller, steps, step, learned)

        acted = carry._replace(
            stack=left,
            lesson=lesson,
            state=step.state,
            steps=steps,
            episode_return=carry.episode_return + step.reward,
            total_steps=carry.total_steps + 1,
        )
        restarted = carry._replace(
            stack=carry.stack._replace(subtask=only_root),
            lesson=no_lesson,
            state=begun,
            steps=jnp.int32(0),
            episode_return=jnp.float32(0),
        )
        waiting = carry._replace(lesson=carry.lesson._replace(done=done))
        next_carry = _select(acting, acted, _select(ready, restarted, waiting))
        log = RoundLog(
            valid=acting,
            option=edge,
            steps=jnp.int32(1),
            episode_ended=left.subtask[top] < 0,
            terminated=terminated,
            episode_return=acted.episode_return,
            episode_steps=steps,
            episode_decisions=steps,
            loss=loss + jnp.square(error),
        )
        return next_carry._replace(learned=learned), log

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`EVENTS_PER_ROUND` events."""
        del number
        fraction = carry.total_steps.astype(jnp.float32) / steps
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)
        noise = uniforms(noise_key, (EVENTS_PER_ROUND, draws))
        carry, log = jax.lax.scan(lambda carry, noise: event(carry, noise, epsilon, learning_rate), carry, noise)
        return carry._replace(key=key), log._replace(loss=jnp.mean(log.loss))

    return Algorithm(init, run_round)


def _move(
    values: Float[Array, " slots"], slot: Int[Array, ""], target: Float[Array, ""], learning_rate: Float[Array, ""]
) -> tuple[Float[Array, " slots"], Float[Array, ""]]:
    """The value of a slot moved towards a target, and the error; nothing where the slot is negative."""
    error = jnp.where(slot >= 0, target - values[slot], 0.0)
    return values.at[slot].add(learning_rate * error), error


def _at(place: Int[Array, ""], numbers: Sequence[Array]) -> Array:
    """The number of a place, by comparisons: of a few that is faster than a look-up."""
    return reduce(lambda found, one: jnp.where(place == one[0], one[1], found), enumerate(numbers), numbers[0])


def _first_above(number: Int[Array, ""], bounds: Sequence[Array], options: Sequence[Array | int]) -> Array:
    """The option of the first place whose bound is above a number; of the last place if none is."""
    found = jnp.asarray(options[-1])
    for bound, option in zip(bounds[-2::-1], options[-2::-1], strict=True):
        found = jnp.where(number < bound, option, found)
    return found


def _select(condition: Bool[Array, ""], one: Carry, other: Carry) -> Carry:
    """What differs between two, entry by entry."""
    return jax.tree.map(lambda a, b: a if a is b else jnp.where(condition, a, b), one, other)


def tasks_of(config: MAXQConfig, environment: Environment, graph: TaskGraph) -> TaskTables:
    """The graph as the learner uses it, in every state of the environment, or for every number that it shows."""
    tables = Shown(environment) if isinstance(environment, HostEnvironment) else tabulate(environment)
    return tabulate_tasks(as_configured(config, graph), environment, tables)


def as_configured(config: MAXQConfig, graph: TaskGraph) -> TaskGraph:
    """The graph with as much abstraction and as many pseudo-rewards as the learner uses."""
    graph = graph if config.abstraction else graph.without_abstraction()
    return graph if config.pseudo_rewards else graph.without_pseudo_rewards()


def chooser(
    config: MAXQConfig, environment: Environment, graph: TaskGraph
) -> Callable[[Learned], Int[np.ndarray, "N T S"]]:
    """A function from what N seeds have learned to the edge that each subtask takes in each state; -1 where it has
    ended. Compiled once."""
    tasks = tasks_of(config, environment, graph)
    places = arrange(tasks, ~tasks.ends)
    evaluate, states = evaluator(tasks, places), np.arange(tasks.ends.shape[1])

    @jax.jit
    def best(learned: Learned) -> list[Int[Array, "N S"]]:
        def of_state(learned: Learned, state: Int[Array, ""]) -> list[Int[Array, ""]]:
            return [known.best for known in evaluate(*learned, state)]

        each_state = jax.vmap(of_state, in_axes=(None, 0))
        return jax.vmap(each_state, in_axes=(0, None))(learned, jnp.asarray(states))

    def choose_edges(learned: Learned) -> Int[np.ndarray, "N T S"]:
        found = best(jax.tree.map(jnp.asarray, learned))
        chosen = [places.calls[place][states, np.asarray(found[place])] for place in places.place_of]
        return np.where(tasks.ends, -1, np.stack(chosen, axis=1))

    return choose_edges


def polled_values(
    config: MAXQConfig, environment: Environment, graph: TaskGraph, learned: Learned
) -> Float[np.ndarray, "N S A"]:
    """What each of N seeds expects of each primitive action where every step asks anew from the root down: the rewards
    and completions along the best path to the action, -inf where there is none. The maximum of a row is the action that
    polling takes, also where pseudo-rewards choose another path than the best."""
    tasks = tasks_of(config, environment, graph)
    choices = chooser(config, environment, graph)(learned)
    everything = np.ones((len(choices), tasks.ends.shape[1], tasks.num_actions), dtype=bool)
    allowed = everything if learned.allowed is None else np.asarray(learned.allowed)
    seeds = zip(np.asarray(learned.values), choices, allowed, strict=True)
    return np.stack([_polled_values(tasks, *seed) for seed in seeds])


def _polled_values(
    tasks: TaskTables,
    stored: Float[np.ndarray, " slots"],
    choices: Int[np.ndarray, "T S"],
    allowed: Bool[np.ndarray, "S A"],
) -> Float[np.ndarray, "S A"]:
    states = np.arange(tasks.ends.shape[1])
    slots = tasks.completion_slot
    completions = np.where(slots >= 0, stored[slots], 0.0)
    paths = {action: np.full((len(states), tasks.num_actions), -np.inf) for action in range(tasks.num_actions)}
    for action, path in paths.items():
        path[:, action] = stored[tasks.reward_slot[action]]
    for subtask in tasks.bottom_up:
        calls = [
            np.where(tasks.available[number], completions[number], -np.inf)[:, None] + paths[tasks.edges[number].child]
            for number in tasks.edges_of(subtask)
        ]
        paths[tasks.num_actions + subtask] = np.max(calls, axis=0)
    found = np.where(tasks.ends[0][:, None], 0.0, np.where(allowed, paths[tasks.num_actions], -np.inf))
    polled = polled_policy(tasks, choices)
    found[states, polled] = np.nextafter(found.max(axis=1).astype(np.float32), np.float32(np.inf))
    return found.astype(np.float32)


def rounds_for(graph: TaskGraph, steps: int) -> int:
    """Rounds that are surely enough for so many primitive steps: an event acts, begins an episode, or makes an update,
    of which a step brings at most one a level."""
    return -(-steps * (2 + graph.levels) // EVENTS_PER_ROUND)
