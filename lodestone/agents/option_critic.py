"""Option-critic: options learned from the task alone, by gradients (Bacon, Harb and Precup 2017), on tables.

Each option is a softmax policy over theta(s, o, .) and a termination beta_o = sigmoid(vartheta). After every primitive
step (s, a, r, s') of the running option o, in this order:

    critic        g = r + gamma [ (1 - beta_o(s')) Q(s', o) + beta_o(s') max over o' of Q(s', o') ]
                  Q(s, o) <- Q(s, o) + alpha [ g - Q(s, o) ]              Q_U likewise at (s, o, a)
    policy        theta(s, o, .) <- theta(s, o, .) + alpha_pi [ Q_U(s, o, a) - Q(s, o) ] [ 1{. = a} - pi_o(.|s) ]
    termination   vartheta(s', o) <- vartheta(s', o) - alpha_beta beta_o'(s') [ Q(s', o) - V(s') + xi ]

and then the coin is tossed that ends the option with the new beta_o(s'). V is the value of the policy over options that
acts, (1 - epsilon) max Q + epsilon mean Q: against the maximum no option could ever be better than the choice anew, and
terminations would only grow. In expectation the last two are the exact gradients of `planning.option_gradients`, save
for the factor gamma^t, which is dropped as usual, and the temperature, which is part of alpha_pi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.envs.base import Environment, Step, inverse_cdf
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import choose, largest
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import (
    REWARD_SWITCHES,
    Actor,
    Rules,
    after_step,
    deal,
    start_actor,
    take_step,
    uniforms,
)
from lodestone.options.soft import SoftOptions
from lodestone.planning.enumerated import Enumerated, World, num_rows, numbering, row_of, world_of

Critic = Literal["greedy", "on-policy"]
Order = Literal["theorem", "authors"]


@dataclass(frozen=True)
class OptionCriticConfig:
    """Settings of the learner. One option makes it a plain actor-critic: its termination changes nothing."""

    num_options: int = 4
    """How many options there are."""
    temperature: float = 0.01
    """Of the options' policies; in proportion to the rewards, and the default is for a goal that is worth 1."""
    critic_rate: Knots = ((0.0, 0.5),)
    """alpha over the run."""
    policy_rate: Knots = ((0.0, 0.25),)
    """alpha_pi over the run."""
    termination_rate: Knots = ((0.0, 0.25),)
    """alpha_beta over the run."""
    epsilon: Knots = ((0.0, 0.1),)
    """Probability of a random option over the run."""
    deliberation_cost: float = 0.0
    """xi: by how much going on may be worse than choosing anew before a termination grows."""
    critic: Critic = "greedy"
    """What the critic takes a choice anew to be worth. `greedy`: the best option, as in intra-option Q-learning.
    `on-policy`: the option that the policy over options chooses, in the mean."""
    order: Order = "theorem"
    """`theorem`: as above. `authors`: as in the authors' code, where on arrival in s' the coin is tossed first, and the
    policy and termination of the option that acts next are updated there, before its action's reward is known."""

    def __post_init__(self) -> None:
        if self.num_options < 1:
            raise InvalidConfig(f"num_options is {self.num_options}, but must be at least 1.")
        if not 0.0 < self.temperature < math.inf:
            raise InvalidConfig(f"temperature is {self.temperature}, but must be a positive number.")
        if not math.isfinite(self.deliberation_cost):
            raise InvalidConfig(f"deliberation_cost is {self.deliberation_cost}, but must be a finite number.")
        for name in ("critic_rate", "policy_rate", "termination_rate", "epsilon"):
            check_knots(name, getattr(self, name), 0.0, 1.0)
        for name, kind in (("critic", Critic), ("order", Order)):
            if getattr(self, name) not in get_args(kind):
                raise InvalidConfig(
                    f"{name} is {getattr(self, name)!r}, but must be one of {', '.join(get_args(kind))}."
                )


class Learned(NamedTuple):
    """What is learned about O options over S states and A actions."""

    table: Float[Array, "S O"]
    """Q."""
    by_action: Float[Array, "S O A"]
    """Q_U, the value of an option and its next action."""
    preferences: Float[Array, "S O A"]
    """theta."""
    exits: Float[Array, "S O"]
    """vartheta."""

    @property
    def num_options(self) -> int:
        """O."""
        return self.table.shape[-1]


def nothing_learned(shape: tuple[int, ...], num_actions: int) -> Learned:
    """Zeros for [S, O] pairs, or for several seeds of them."""
    of_actions = jnp.zeros((*shape, num_actions))
    return Learned(jnp.zeros(shape), of_actions, of_actions, jnp.zeros(shape))


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learned: Learned
    actor: Actor
    key: PRNGKeyArray


def chosen_value(values: Float[Array, " O"], epsilon: Float[Array, ""]) -> Float[Array, ""]:
    """V, what an epsilon-greedy choice is worth in the mean."""
    return (1.0 - epsilon) * largest(values) + epsilon * jnp.mean(values)


def improve_critic(
    learned: Learned,
    state: Int[Array, ""],
    option: Int[Array, ""],
    action: Int[Array, ""],
    arrived: Step,
    anew: Float[Array, ""],
    discount: float,
    rate: Float[Array, ""],
) -> tuple[Learned, Float[Array, ""]]:
    """Q and Q_U, where a choice in the next state is worth `anew`; returns the squared error, too."""
    stops = jax.nn.sigmoid(learned.exits[arrived.state, option])
    arriving = (1.0 - stops) * learned.table[arrived.state, option] + stops * anew
    target = arrived.reward + jnp.where(arrived.terminated, 0.0, discount * arriving)
    error = target - learned.table[state, option]
    of_action = target - learned.by_action[state, option, action]
    return learned._replace(
        table=learned.table.at[state, option].add(rate * error),
        by_action=learned.by_action.at[state, option, action].add(rate * of_action),
    ), jnp.square(error)


def improve_policy(
    learned: Learned,
    state: Int[Array, ""],
    option: Int[Array, ""],
    action: Int[Array, ""],
    probs: Float[Array, " A"],
    rate: Float[Array, ""],
) -> Learned:
    """The option's policy in a state where it has drawn `action` with these probabilities."""
    advantage = learned.by_action[state, option, action] - learned.table[state, option]
    direction = jax.nn.one_hot(action, probs.size, dtype=probs.dtype) - probs
    return learned._replace(preferences=learned.preferences.at[state, option].add(rate * advantage * direction))


def improve_termination(
    learned: Learned,
    state: Int[Array, ""],
    option: Int[Array, ""],
    anew: Float[Array, ""],
    cost: float,
    rate: Float[Array, ""],
) -> Learned:
    """Whether the option ends on arrival in a state where a choice is worth `anew`."""
    stops = jax.nn.sigmoid(learned.exits[state, option])
    advantage = learned.table[state, option] - anew + cost
    return learned._replace(exits=learned.exits.at[state, option].add(-rate * stops * (1.0 - stops) * advantage))


def refuse_rules(rules: Rules) -> None:
    """Raise `InvalidConfig` for rules that option-critic does not learn under."""
    why = "option-critic takes each step's reward as it comes and a limit for no end"
    rules.refuse((*REWARD_SWITCHES, "bootstrap_at_limit"), why)


def option_critic(config: OptionCriticConfig, environment: Environment, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment, or in a Gymnasium environment by
    the number that this shows. Schedules are fractions of `steps`.

    Raises `TooManyStates` where the tables would be too large, and `InvalidConfig` for rules under which an option's
    reward is not the discounted sum of its steps' rewards or a limit is an end, and for a Gymnasium environment that
    shows no number.
    """
    return option_critic_on_numbers(config, world_of(environment), rules, steps)


def option_critic_on_numbers(config: OptionCriticConfig, world: World, rules: Rules, steps: int) -> Algorithm:
    """The same in a world of numbered states, or in a Gymnasium environment."""
    refuse_rules(rules)
    # The fields of `Chance`: options draw their actions and their ends. A Gymnasium environment draws for itself.
    restarts = isinstance(world, Enumerated) and len(world.initial_states) > 1
    needed, rows = (True, True, world.num_outcomes > 1, restarts), num_rows(world)
    everything = jnp.ones(config.num_options, dtype=bool)

    def options_of(learned: Learned) -> SoftOptions:
        return SoftOptions(numbering(world), learned.preferences, learned.exits, config.temperature)

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        learned = nothing_learned((rows, config.num_options), world.num_actions)
        return Carry(learned, start_actor(world, actor_key), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update of everything."""
        fraction = number.astype(jnp.float32) * (STEPS_PER_ROUND / steps)
        critic_rate, policy_rate, termination_rate, epsilon = (
            piecewise_linear(knots, fraction)
            for knots in (config.critic_rate, config.policy_rate, config.termination_rate, config.epsilon)
        )
        noise_key, key = jax.random.split(carry.key)

        def improved_termination(learned: Learned, state: Array, option: Array, applies: Array) -> Learned:
            anew, rate = chosen_value(learned.table[state], epsilon), jnp.where(applies, termination_rate, 0.0)
            return improve_termination(learned, state, option, anew, config.deliberation_cost, rate)

        def step(carry: tuple[Learned, Actor], noise: Float[Array, " N"]) -> tuple[tuple[Learned, Actor], tuple]:
            learned, actor = carry
            state, chance = row_of(world, actor.state), deal(noise[2:], needed)
            choice = choose(noise[:2], learned.table[state], everything, epsilon)
            option = jnp.where(actor.deciding, choice, actor.option)
            acting = options_of(learned)
            probs = acting.action_probs(actor.state)[option]
            action = inverse_cdf(probs, chance.action)
            taken = take_step(world, chance.outcome, actor.state, action)
            arrived = taken._replace(state=row_of(world, taken.state))

            if config.order == "authors":
                on_the_way = actor.episode_steps > 0
                learned = improve_policy(learned, state, option, action, probs, jnp.where(on_the_way, policy_rate, 0.0))
                learned = improved_termination(learned, state, option, on_the_way)
            next_values = learned.table[arrived.state]
            anew = largest(next_values) if config.critic == "greedy" else chosen_value(next_values, epsilon)
            learned, loss = improve_critic(learned, state, option, action, arrived, anew, rules.discount, critic_rate)
            if config.order == "theorem":
                learned = improve_policy(learned, state, option, action, probs, policy_rate)
                learned = improved_termination(learned, arrived.state, option, ~arrived.terminated)

            # The coin is that of the new termination.
            actor, decision = after_step(world, options_of(learned), rules, chance, actor, option, action, taken)
            return (learned, actor), (decision, loss)

        noise = uniforms(noise_key, (STEPS_PER_ROUND, 2 + sum(needed)))
        (learned, actor), (decisions, losses) = jax.lax.scan(step, (carry.learned, carry.actor), noise)
        return Carry(learned, actor, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
