"""Running options in lock-step primitive time.

Every tick takes one primitive step in one environment. An option that ends on the tick yields one decision: the
semi-Markov transition from where the option was chosen to where it ended. Environments never wait for one another's
options. Written for one environment; the training loop vmaps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import (
    Environment,
    OutsideEnvironment,
    Step,
    inverse_cdf,
    next_episode,
    next_step,
    remembered,
    sample_initial,
)
from lodestone.errors import InvalidConfig
from lodestone.options.base import Options
from lodestone.planning.enumerated import Enumerated, look_up_step
from lodestone.types import State, Transition


@dataclass(frozen=True)
class Rules:
    """How time, reward and limits are counted."""

    discount: float = 0.99
    """gamma, per primitive step."""
    step_limit: int | None = None
    """Primitive steps after which an episode is truncated; None for never."""
    decision_limit: int | None = None
    """Decisions after which an episode is truncated; None for never."""
    bootstrap_at_limit: bool = True
    """Whether a truncated episode's last transition bootstraps. False treats a limit as an end, as the authors' code
    does: a switch for reproduction only."""
    undiscounted_option_reward: bool = False
    """Whether an option's reward is the plain sum of its steps' rewards (the paper's "accumulated reward"): for
    reproduction only, as the values then depend on the options."""
    discount_per_decision: bool = False
    """Whether what follows an option is discounted by gamma once, however long it ran (Kulkarni et al. 2016): for
    reproduction only, for the same reason."""
    call_cost: float = 0.0
    """Taken from the reward of every option that may run longer than one step, once a call."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.discount <= 1.0:
            raise InvalidConfig(f"discount is {self.discount}, but must be from 0 to 1.")
        for name in ("step_limit", "decision_limit"):
            limit = getattr(self, name)
            if limit is not None and limit < 1:
                raise InvalidConfig(f"{name} is {limit}, but must be at least 1.")

    def refuse(self, switches: Sequence[str], why: str) -> None:
        """Raise `InvalidConfig` if one of these is not as it is by default."""
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in switches and value != field.default:
                raise InvalidConfig(f"{field.name} is {value}, but {why}.")


REWARD_SWITCHES = ("undiscounted_option_reward", "discount_per_decision", "call_cost")
"""What makes an option's value something else than the discounted sum of its steps' rewards and of what follows."""


class Actor(NamedTuple):
    """What one environment's run remembers between ticks."""

    state: State
    deciding: Bool[Array, ""]
    """Whether the next tick begins with a choice."""
    start: State
    """Where the running option was chosen."""
    option: Int[Array, ""]
    elapsed: Int[Array, ""]
    """k, steps that the option has run."""
    reward: Float[Array, ""]
    """Reward of the option so far, discounted to its start."""
    discount: Float[Array, ""]
    """gamma^k."""
    episode_return: Float[Array, ""]
    """Undiscounted sum of the episode's primitive rewards."""
    episode_steps: Int[Array, ""]
    episode_decisions: Int[Array, ""]


class Decision(NamedTuple):
    """What a tick has to tell if an option ended on it."""

    valid: Bool[Array, ""]
    """Whether an option ended; where it did not, only `action` means anything."""
    action: Int[Array, ""]
    """The primitive action taken on this tick."""
    transition: Transition
    """From the state of the choice to the state of the end."""
    steps: Int[Array, ""]
    """k, how long the option ran."""
    episode_ended: Bool[Array, ""]
    terminated: Bool[Array, ""]
    """Whether the environment, not a limit, ended the episode."""
    episode_return: Float[Array, ""]
    episode_steps: Int[Array, ""]
    episode_decisions: Int[Array, ""]


def start_actor(environment: Environment, key: PRNGKeyArray) -> Actor:
    """An actor at the beginning of its first episode."""
    state = sample_initial(environment, key)
    return Actor(
        state=state,
        deciding=jnp.bool_(True),
        start=remembered(environment, state),
        option=jnp.int32(0),
        elapsed=jnp.int32(0),
        reward=jnp.float32(0),
        discount=jnp.float32(1),
        episode_return=jnp.float32(0),
        episode_steps=jnp.int32(0),
        episode_decisions=jnp.int32(0),
    )


class Chance(NamedTuple):
    """The random numbers of one tick, uniform in [0, 1)."""

    action: Float[Array, ""]
    """Picks the action under an option that draws it."""
    termination: Float[Array, ""]
    outcome: Float[Array, ""]
    """Nature's."""
    restart: Float[Array, ""]
    """Picks the next episode's first state."""


def draw_chance(key: PRNGKeyArray) -> Chance:
    """The random numbers of one tick. Those of the environment are only computed where it needs them."""
    action, termination = jax.random.uniform(key, (2,))
    outcome, restart = (jax.random.uniform(jax.random.fold_in(key, number)) for number in (0, 1))
    return Chance(action, termination, outcome, restart)


def uniforms(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "*shape"]:
    """The numbers of `jax.random.uniform(key, shape)`, for a loop that draws them over and over on a CPU.

    There JAX compiles the rounds of its generator, Threefry-2x32 (Salmon et al. 2011), to a loop over memory, to be
    compiled soon; written out they are one pass over registers, which takes half the time.
    """
    first, second = jax.random.key_data(key)
    words = (first, second, first ^ second ^ jnp.uint32(0x1BD11BDA))
    counter = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    x, y = jnp.broadcast_to(words[0], shape), counter + words[1]
    for group in range(5):
        for rotation in ((13, 15, 26, 6), (17, 29, 16, 24))[group % 2]:
            x += y
            y = ((y << rotation) | (y >> (32 - rotation))) ^ x
        x += words[(group + 1) % 3]
        y += words[(group + 2) % 3] + jnp.uint32(group + 1)
    mantissa = (x ^ y) >> 9
    return jax.lax.bitcast_convert_type(mantissa | jnp.uint32(0x3F800000), jnp.float32) - 1.0


def deal(uniform: Float[Array, " N"], needed: tuple[bool, ...]) -> Chance:
    """The random numbers of one tick out of N, where `needed` tells for each field of `Chance` whether it takes one."""
    numbers = iter(uniform)
    return Chance(*(next(numbers) if wanted else jnp.float32(0) for wanted in needed))


def tick(
    environment: Environment,
    options: Options,
    rules: Rules,
    chance: Chance,
    actor: Actor,
    choice: Int[Array, ""],
) -> tuple[Actor, Decision]:
    """One primitive step under the running option, or under `choice` where a new option begins.

    The environment restarts by itself after an episode's end; `Decision.transition.next_obs` is the state before that.
    """
    option = jnp.where(actor.deciding, choice, actor.option)
    action = inverse_cdf(options.action_probs(actor.state)[option], chance.action)
    step = take_step(environment, chance.outcome, actor.state, action)
    return after_step(environment, options, rules, chance, actor, option, action, step)


def take_step(environment: Environment, uniform: Float[Array, ""], state: State, action: Int[Array, ""]) -> Step:
    """What `next_step` does, by a look-up where there are tables."""
    if isinstance(environment, Enumerated):
        return look_up_step(environment, uniform, state, action)
    return next_step(environment, uniform, state, action)


def after_step(
    environment: Environment,
    options: Options,
    rules: Rules,
    chance: Chance,
    actor: Actor,
    option: Int[Array, ""],
    action: Int[Array, ""],
    step: Step,
) -> tuple[Actor, Decision]:
    """The rest of a tick: whether `option` stops where its `action` has led, and what there is to tell then."""
    fresh, (state, reward, terminated) = actor.deciding, step
    start = _select(fresh, remembered(environment, actor.state), actor.start)
    reward_before = jnp.where(fresh, 0.0, actor.reward)
    discount_before = jnp.where(fresh, 1.0, actor.discount)

    elapsed = jnp.where(fresh, 0, actor.elapsed) + 1
    caps = jnp.asarray(options.max_steps, dtype=jnp.int32)
    reward_weight = 1.0 if rules.undiscounted_option_reward else discount_before
    call_cost = jnp.where(fresh & (caps[option] != 1), rules.call_cost, 0.0)
    option_reward = reward_before + reward_weight * reward - call_cost
    discount = discount_before * rules.discount
    episode_steps = actor.episode_steps + 1
    episode_decisions = actor.episode_decisions + fresh.astype(jnp.int32)

    beta = options.termination(state)[option]
    stops = (chance.termination < beta) | (elapsed >= caps[option])
    truncated = jnp.bool_(False)
    if isinstance(environment, OutsideEnvironment):
        truncated = environment.truncated(state)
    if rules.step_limit is not None:
        truncated |= episode_steps >= rules.step_limit
    if rules.decision_limit is not None:
        truncated |= stops & (episode_decisions >= rules.decision_limit)
    truncated &= ~terminated
    ended = stops | terminated | truncated

    # Cut by a limit before its own end: the option would have gone on, so only its own value may be bootstrapped from.
    available = options.initiation(state)
    if rules.step_limit is not None or isinstance(environment, OutsideEnvironment):
        cut = truncated & ~stops
        available = jnp.where(cut, jnp.arange(options.size) == option, available)
    no_future = terminated if rules.bootstrap_at_limit else terminated | truncated
    episode_return = actor.episode_return + reward
    decision = Decision(
        valid=ended,
        action=action,
        transition=Transition(
            obs=start,
            action=option,
            reward=option_reward,
            discount=jnp.where(no_future, 0.0, rules.discount if rules.discount_per_decision else discount),
            next_obs=remembered(environment, state),
            next_available=available,
        ),
        steps=elapsed,
        episode_ended=terminated | truncated,
        terminated=terminated,
        episode_return=episode_return,
        episode_steps=episode_steps,
        episode_decisions=episode_decisions,
    )

    over = terminated | truncated
    next_actor = Actor(
        state=_select(over, next_episode(environment, chance.restart, state), state),
        deciding=ended,
        start=start,
        option=option,
        elapsed=elapsed,
        reward=option_reward,
        discount=discount,
        episode_return=jnp.where(over, 0.0, episode_return),
        episode_steps=jnp.where(over, 0, episode_steps),
        episode_decisions=jnp.where(over, 0, episode_decisions),
    )
    return next_actor, decision


def _select(condition: Bool[Array, ""], if_true: State, if_false: State) -> State:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
