"""Acting with a united network: one pass of the trunk a tick, whatever the number of options.

`options.execution` asks an option on arrival whether it stops, and where the next step begins for its action: two looks
at the same state. Here a tick begins with the look, so that the running option's end, the manager's choice and every
policy's action come from the same pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import (
    Environment,
    OutsideEnvironment,
    allowed_actions,
    initial_state,
    inverse_cdf,
    next_episode,
    next_step,
    remembered,
)
from lodestone.envs.task import Task
from lodestone.learning.evaluation import Episode, Trace
from lodestone.learning.policies import greedy, mask_unavailable
from lodestone.learning.united_network import BASIC, Outputs, UnitedNetwork
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Decision, Rules, start_actor
from lodestone.types import State, Transition


class Step(NamedTuple):
    """One primitive step, without a reward or an end: every task has its own."""

    state: State
    action: Int[Array, "*batch"]
    next_state: State


class UnitedActor(NamedTuple):
    """One environment that the manager acts in."""

    actor: Actor
    first_action: Int[Array, ""]
    """What the running choice began with."""


class TaskActor(NamedTuple):
    """One environment of an option's own task."""

    state: State
    steps: Int[Array, ""]


class Tick(NamedTuple):
    """What one tick of one environment brought."""

    decision: Decision
    """Valid where what the manager had chosen ended on arrival in this state."""
    first_action: Int[Array, ""]
    """Of that decision."""
    acted: Bool[Array, ""]
    """Whether a step was taken: a tick that ends an episode takes none."""
    step: Step
    choice: Int[Array, ""]
    """What runs after this tick's look."""
    chosen: Bool[Array, ""]
    """Whether it was chosen on this tick."""


def start_united_actor(environment: Environment, key: PRNGKeyArray) -> UnitedActor:
    """An actor at the beginning of its first episode."""
    return UnitedActor(start_actor(environment, key), jnp.int32(0))


def choices(options: Sequence[Task]) -> tuple[str, ...]:
    """Names of the manager's choices."""
    return ("basic policy", *(option.name for option in options))


def look(environment: Environment, network: UnitedNetwork, state: State) -> Outputs:
    """What the heads say of a state: of an action that may not be taken there, that it is worth minus infinity."""
    outputs = network(environment.observe(state))
    allowed = allowed_actions(environment, state)
    return outputs._replace(actions=mask_unavailable(outputs.actions, allowed[None]))


def greedy_decision(outputs: Outputs) -> tuple[Int[Array, ""], Int[Array, " n+1"]]:
    """The manager's best choice, and every policy head's best action."""
    return jnp.argmax(outputs.choices).astype(jnp.int32), jnp.argmax(outputs.actions, axis=1).astype(jnp.int32)


def may_stop(outputs: Outputs) -> Bool[Array, " n+1"]:
    """Whether each choice, if it runs until here, stops here: one step of the basic policy always does."""
    return jnp.concatenate([jnp.ones(1, dtype=bool), outputs.ended])


def explore(
    outputs: Outputs, uniform: Float[Array, " 2"], epsilon: Float[Array, ""], manager_acts: bool
) -> tuple[Int[Array, ""], Int[Array, " n+1"]]:
    """The same with probability 1 - epsilon; otherwise one of the allowed primitive actions and the options, all alike.
    Without the manager the basic policy alone is chosen, and only primitive actions are drawn."""
    heads, _ = outputs.actions.shape
    choice, best = greedy_decision(outputs)
    if not manager_acts:
        choice = jnp.int32(BASIC)
    up_to = jnp.cumsum((outputs.actions[BASIC] > -jnp.inf).astype(jnp.int32))
    actions = up_to[-1]
    candidates = actions + (heads - 1 if manager_acts else 0)
    drawn = jnp.minimum((uniform[1] * candidates.astype(jnp.float32)).astype(jnp.int32), candidates - 1)
    at_random = uniform[0] < epsilon
    choice = jnp.where(at_random, jnp.maximum(drawn - actions + 1, BASIC), choice)
    action = jnp.argmax(up_to > drawn).astype(jnp.int32)
    basic = jnp.where(at_random & (drawn < actions), action, best[BASIC])
    return choice, best.at[BASIC].set(basic)


def tick(
    environment: Environment,
    rules: Rules,
    option_cap: int,
    outputs: Outputs,
    decision: tuple[Int[Array, ""], Int[Array, " n+1"]],
    uniform: Float[Array, " 2"],
    united: UnitedActor,
) -> tuple[UnitedActor, Tick]:
    """Look at the state, settle what ended on arrival in it, choose anew if something ended, take one step.

    `outputs` are the heads' on the actor's state, from one pass of the network: an option ends where its termination
    head says so on arrival, at its cap, or with the episode. `decision` is what is chosen where a choice is due, and
    the action that each policy head takes. On the tick that ends an episode the next one begins, and no step is taken.
    `uniform` holds nature's number and that of the next episode's start.
    """
    actor, first_action = united
    running = ~actor.deciding
    terminated = running & environment.terminal(actor.state)
    capped = (actor.option != BASIC) & (actor.elapsed >= option_cap)
    stops = running & (may_stop(outputs)[actor.option] | capped)
    truncated = jnp.bool_(False)
    if isinstance(environment, OutsideEnvironment):
        truncated = environment.truncated(actor.state)
    if rules.step_limit is not None:
        truncated |= actor.episode_steps >= rules.step_limit
    if rules.decision_limit is not None:
        truncated |= stops & (actor.episode_decisions >= rules.decision_limit)
    truncated &= running & ~terminated
    over = terminated | truncated
    ended = stops | over

    everything = jnp.ones(outputs.choices.shape, dtype=bool)
    cut = truncated & ~stops
    no_future = terminated if rules.bootstrap_at_limit else over
    settled = Decision(
        valid=ended,
        action=first_action,
        transition=Transition(
            obs=actor.start,
            action=actor.option,
            reward=actor.reward,
            discount=jnp.where(no_future, 0.0, rules.discount if rules.discount_per_decision else actor.discount),
            next_obs=remembered(environment, actor.state),
            next_available=jnp.where(cut, jnp.arange(everything.size) == actor.option, everything),
        ),
        steps=actor.elapsed,
        episode_ended=over,
        terminated=terminated,
        episode_return=actor.episode_return,
        episode_steps=actor.episode_steps,
        episode_decisions=actor.episode_decisions,
    )

    fresh = actor.deciding | ended
    choice, actions = decision
    option = jnp.where(fresh, choice, actor.option)
    action = actions[option]
    before = actor.state
    if isinstance(environment, OutsideEnvironment):  # where a step cannot be taken back
        before = environment.hold(before, over)
    moved = next_step(environment, uniform[0], before, action)
    elapsed = jnp.where(fresh, 0, actor.elapsed)
    discount = jnp.where(fresh, 1.0, actor.discount)
    weight = 1.0 if rules.undiscounted_option_reward else discount
    call_cost = jnp.where(fresh & (option != BASIC), rules.call_cost, 0.0)
    onward = Actor(
        state=moved.state,
        deciding=jnp.bool_(False),
        start=_select(fresh, remembered(environment, actor.state), actor.start),
        option=option,
        elapsed=elapsed + 1,
        reward=jnp.where(fresh, 0.0, actor.reward) + weight * moved.reward - call_cost,
        discount=discount * rules.discount,
        episode_return=actor.episode_return + moved.reward,
        episode_steps=actor.episode_steps + 1,
        episode_decisions=actor.episode_decisions + fresh.astype(jnp.int32),
    )
    state = next_episode(environment, uniform[1], actor.state)
    restart = jax.tree.map(jnp.zeros_like, onward)._replace(
        state=state, start=remembered(environment, state), deciding=jnp.bool_(True), discount=jnp.float32(1)
    )
    next_actor = _select(over, restart, onward)
    next_first = jnp.where(fresh, action, first_action)
    step = Step(remembered(environment, actor.state), action, remembered(environment, moved.state))
    brought = Tick(settled, first_action, ~over, step, option, fresh & ~over)
    return UnitedActor(next_actor, next_first), brought


def start_task_actor(task: Task, key: PRNGKeyArray) -> TaskActor:
    """At the beginning of its first episode."""
    return TaskActor(initial_state(task, jax.random.uniform(key)), jnp.int32(0))


def task_tick(
    task: Task,
    step_limit: int,
    values: Float[Array, " A"],
    epsilon: Float[Array, ""],
    uniform: Float[Array, " 4"],
    actor: TaskActor,
) -> tuple[TaskActor, Step]:
    """One epsilon-greedy step on an option's own task, which begins anew by itself."""
    every = jnp.ones(values.shape)
    action = jnp.where(uniform[0] < epsilon, inverse_cdf(every, uniform[1]), greedy(values, every > 0))
    moved = next_step(task, uniform[2], actor.state, action)
    over = moved.terminated | (actor.steps + 1 >= step_limit)
    restart = TaskActor(initial_state(task, uniform[3]), jnp.int32(0))
    onward = TaskActor(moved.state, actor.steps + 1)
    return _select(over, restart, onward), Step(actor.state, action, moved.state)


class UnitedOptions(Options):
    """A united network's choices as a set of options, for the planner and for whoever runs options one by one: the
    basic policy for one step, then every option."""

    environment: Environment
    network: UnitedNetwork
    choice_names: tuple[str, ...] = eqx.field(static=True)
    option_cap: int = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return self.choice_names

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (1, *[self.option_cap] * (len(self.choice_names) - 1))

    def initiation(self, state: State) -> Bool[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        _, actions = greedy_decision(look(self.environment, self.network, state))
        return jax.nn.one_hot(actions, self.environment.num_actions)

    def termination(self, state: State) -> Float[Array, " O"]:
        return may_stop(self.network(self.environment.observe(state))).astype(jnp.float32)


def play_united(
    environment: Environment, rules: Rules, option_cap: int, network: UnitedNetwork, key: PRNGKeyArray, max_steps: int
) -> Episode:
    """One greedy episode, of at most `max_steps` primitive steps."""

    def unfinished(carry: tuple) -> Array:
        _, _, _, over, ticks = carry
        return ~over & (ticks <= max_steps)

    def step(carry: tuple) -> tuple:
        key, united, _, _, ticks = carry
        key, tick_key = jax.random.split(key)
        united, _, brought = _greedy_tick(environment, rules, option_cap, network, tick_key, united)
        settled = brought.decision
        episode = Episode(settled.episode_return, settled.episode_steps, settled.episode_decisions, settled.terminated)
        return key, united, episode, settled.episode_ended, ticks + 1

    start_key, key = jax.random.split(key)
    united = start_united_actor(environment, start_key)
    nothing = Episode(jnp.float32(0), jnp.int32(0), jnp.int32(0), jnp.bool_(False))
    return jax.lax.while_loop(unfinished, step, (key, united, nothing, jnp.bool_(False), jnp.int32(0)))[2]


def trace_united(
    environment: Environment, rules: Rules, option_cap: int, network: UnitedNetwork, key: PRNGKeyArray, max_steps: int
) -> Trace:
    """One greedy episode of at most `max_steps` primitive steps, remembered step by step."""

    def step(carry: tuple[UnitedActor, Array, Array], _: None) -> tuple[tuple[UnitedActor, Array, Array], Trace]:
        united, live, key = carry
        key, tick_key = jax.random.split(key)
        next_united, outputs, brought = _greedy_tick(environment, rules, option_cap, network, tick_key, united)
        trace = Trace(
            live=live & brought.acted,
            state=brought.step.state,
            next_state=brought.step.next_state,
            option=brought.choice,
            chosen=brought.chosen,
            action=brought.step.action,
            values=outputs.choices,
            available=jnp.ones(outputs.choices.shape, dtype=bool),
            reward=next_united.actor.episode_return - united.actor.episode_return,
            termination=jnp.concatenate([jnp.ones(1), outputs.termination]),
        )
        return (next_united, live & brought.acted, key), trace

    start_key, key = jax.random.split(key)
    carry = (start_united_actor(environment, start_key), jnp.bool_(True), key)
    return jax.lax.scan(step, carry, None, length=max_steps)[1]


def _greedy_tick(
    environment: Environment,
    rules: Rules,
    option_cap: int,
    network: UnitedNetwork,
    key: PRNGKeyArray,
    united: UnitedActor,
) -> tuple[UnitedActor, Outputs, Tick]:
    outputs = look(environment, network, united.actor.state)
    decision, uniform = greedy_decision(outputs), jax.random.uniform(key, (2,))
    next_united, brought = tick(environment, rules, option_cap, outputs, decision, uniform, united)
    return next_united, outputs, brought


def _select(condition: Bool[Array, ""], if_true: State, if_false: State) -> State:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
