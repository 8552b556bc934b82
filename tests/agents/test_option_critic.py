"""Option-critic against a plain loop fed the same random numbers, exact gradients, and the planner's values."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float
from random_mdp import NUM_ACTIONS, dense, random_mdp, random_tables
from scipy.special import expit, softmax

from lodestone.agents.option_critic import (
    Learned,
    OptionCriticConfig,
    chosen_value,
    improve_policy,
    improve_termination,
    option_critic,
)
from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.envs.random_mdp import RandomMDP
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, train
from lodestone.options.base import NO_CAP
from lodestone.options.execution import Rules, uniforms
from lodestone.planning.enumerated import Enumerated, enumerated
from lodestone.planning.option_gradients import OptionParameters, soft_option_process
from lodestone.planning.option_models import OptionTables, option_value_iteration
from lodestone.planning.solve import evaluate_policy
from lodestone.planning.tables import tabulate

WORLD = RandomMDP(mdp_seed=3)
RULES = Rules(discount=0.9, step_limit=20)
ROUNDS = 20
LIVELY = OptionCriticConfig(
    num_options=3,
    temperature=0.5,
    critic_rate=((0.0, 0.3),),
    policy_rate=((0.0, 0.2),),
    termination_rate=((0.0, 0.4),),
    epsilon=((0.0, 0.3),),
    deliberation_cost=0.05,
)
SETTLING = ((0.0, 0.5), (0.1, 0.1), (0.4, 0.02), (0.7, 0.004), (1.0, 0.001))
"""A learning rate that falls about as 1/n."""


def random_start(num_options: int, seed: int, states: int = 7) -> Learned:
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), dtype=jnp.float32)  # noqa: E731
    pairs = (states, num_options)
    return Learned(draw(*pairs), draw(*pairs, NUM_ACTIONS), draw(*pairs, NUM_ACTIONS), draw(*pairs))


def starting_from(algorithm: Algorithm, learned: Learned) -> Algorithm:
    return algorithm._replace(init=lambda key: algorithm.init(key)._replace(learned=learned))


# -------------------------------------------------------------------------------------------- the same random numbers


def pick(probs: Float[np.ndarray, " N"], uniform: float) -> int:
    edges = np.cumsum(probs)
    return int(np.searchsorted(edges[:-1], uniform * edges[-1], side="right"))


class Plain:
    """The learner in plain Python, one step of one seed after the other, in float64."""

    def __init__(self, config: OptionCriticConfig, world: Enumerated, start: Learned, state: int) -> None:
        self.config, self.world = config, jax.tree.map(np.asarray, world)
        self.values, self.by_action, self.theta, self.vartheta = (np.array(leaf, np.float64) for leaf in start)
        self.critic_rate, self.policy_rate, self.termination_rate, self.epsilon = (
            knots[0][1] for knots in (config.critic_rate, config.policy_rate, config.termination_rate, config.epsilon)
        )
        self.state, self.option, self.steps, self.ended = state, -1, 0, True
        self.lengths: list[int] = []

    def act(self, noise: np.ndarray) -> tuple[int, Float[np.ndarray, " A"]]:
        """Choose an option where one is due; an action, and the probabilities that it was drawn with."""
        if self.ended:
            row = self.values[self.state]
            best = row == row.max() if noise[0] >= self.epsilon else np.ones(len(row), dtype=bool)
            self.option = pick(best, noise[1])
            self.lengths.append(0)
        probs = softmax(self.theta[self.state, self.option] / self.config.temperature)
        return pick(probs, noise[2]), probs

    def anew(self, state: int) -> float:
        row = self.values[state]
        return (1 - self.epsilon) * row.max() + self.epsilon * row.mean()

    def learn_policy(self, action: int, probs: Float[np.ndarray, " A"]) -> None:
        s, o = self.state, self.option
        advantage = self.by_action[s, o, action] - self.values[s, o]
        self.theta[s, o] += self.policy_rate * advantage * (np.eye(len(probs))[action] - probs)

    def learn_termination(self, state: int) -> None:
        beta = expit(self.vartheta[state, self.option])
        worse = self.values[state, self.option] - self.anew(state) + self.config.deliberation_cost
        self.vartheta[state, self.option] -= self.termination_rate * beta * (1 - beta) * worse

    def step(self, noise: np.ndarray) -> None:
        action, probs = self.act(noise)
        s, o, theorem = self.state, self.option, self.config.order == "theorem"
        if not theorem and self.steps > 0:
            self.learn_policy(action, probs)
            self.learn_termination(s)
        outcome = pick(self.world.probs[s, action], noise[4])
        arrived = int(self.world.successors[s, action, outcome])
        over = bool(self.world.ends[arrived])
        target = float(self.world.rewards[s, action, outcome])
        if not over:
            beta = expit(self.vartheta[arrived, o])
            new = self.values[arrived].max() if self.config.critic == "greedy" else self.anew(arrived)
            target += RULES.discount * ((1 - beta) * self.values[arrived, o] + beta * new)
        self.values[s, o] += self.critic_rate * (target - self.values[s, o])
        self.by_action[s, o, action] += self.critic_rate * (target - self.by_action[s, o, action])
        if theorem:
            self.learn_policy(action, probs)
            if not over:
                self.learn_termination(arrived)
        self.ended = noise[3] < expit(self.vartheta[arrived, o])
        self.state, self.steps = arrived, self.steps + 1
        self.lengths[-1] += 1
        if over or self.steps == RULES.step_limit:
            begins = self.world.initial_states
            self.state, self.steps, self.ended = int(begins[int(noise[5] * len(begins))]), 0, True


def both(config: OptionCriticConfig, start: Learned) -> list[int]:
    """Let the learner and the plain loop learn from the same random numbers, and compare; the options' lengths."""
    algorithm = starting_from(option_critic(config, WORLD, RULES, 10_000), start)
    world = enumerated(tabulate(WORLD), WORLD.action_names)
    carry, lengths = algorithm.init(jax.random.key(5)), []
    plain, run_round = Plain(config, world, start, int(carry.actor.state)), jax.jit(algorithm.run_round)
    for number in range(ROUNDS):
        noise_key, _ = jax.random.split(carry.key)
        for noise in np.asarray(uniforms(noise_key, (STEPS_PER_ROUND, 6))):
            plain.step(noise)
        carry, log = run_round(carry, jnp.int32(number))
        lengths += np.asarray(log.steps)[np.asarray(log.valid)].tolist()
    learned = (plain.values, plain.by_action, plain.theta, plain.vartheta)
    for found, wanted in zip(carry.learned, learned, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-4)
    assert lengths == plain.lengths[: len(lengths)]
    return lengths


@pytest.mark.parametrize("order", ["theorem", "authors"])
@pytest.mark.parametrize("critic", ["greedy", "on-policy"])
def test_every_update_is_that_of_a_plain_loop(order, critic):
    lengths = both(replace(LIVELY, order=order, critic=critic), random_start(3, seed=1))
    assert len(set(lengths)) > 5


# ------------------------------------------------------------------------------------------------- degenerate cases


class ActorCritic:
    """A plain actor-critic: a policy, its value and that of its actions; no options."""

    def __init__(self, config: OptionCriticConfig, world: Enumerated, start: Learned, state: int) -> None:
        self.config, self.world, self.state, self.steps = config, jax.tree.map(np.asarray, world), state, 0
        self.values, self.by_action, self.theta = (np.array(leaf, np.float64)[:, 0] for leaf in start[:3])

    def step(self, noise: np.ndarray) -> None:
        s = self.state
        probs = softmax(self.theta[s] / self.config.temperature)
        a = pick(probs, noise[2])
        k = pick(self.world.probs[s, a], noise[4])
        x = int(self.world.successors[s, a, k])
        over = bool(self.world.ends[x])
        target = self.world.rewards[s, a, k] + (0.0 if over else RULES.discount * self.values[x])
        rate = self.config.critic_rate[0][1]
        self.values[s] += rate * (target - self.values[s])
        self.by_action[s, a] += rate * (target - self.by_action[s, a])
        advantage = self.by_action[s, a] - self.values[s]
        self.theta[s] += self.config.policy_rate[0][1] * advantage * (np.eye(len(probs))[a] - probs)
        self.state, self.steps = x, self.steps + 1
        if over or self.steps == RULES.step_limit:
            self.state, self.steps = int(self.world.initial_states[int(noise[5] * len(self.world.initial_states))]), 0


def test_one_option_is_a_plain_actor_critic():
    config, start = replace(LIVELY, num_options=1), random_start(1, seed=2)
    algorithm = starting_from(option_critic(config, WORLD, RULES, 10_000), start)
    carry, run_round = algorithm.init(jax.random.key(6)), jax.jit(algorithm.run_round)
    plain = ActorCritic(config, enumerated(tabulate(WORLD), WORLD.action_names), start, int(carry.actor.state))
    for number in range(ROUNDS):
        noise_key, _ = jax.random.split(carry.key)
        for noise in np.asarray(uniforms(noise_key, (STEPS_PER_ROUND, 6))):
            plain.step(noise)
        carry, _ = run_round(carry, jnp.int32(number))
        for found, wanted in zip(carry.learned, (plain.values, plain.by_action, plain.theta), strict=False):
            np.testing.assert_allclose(found[:, 0], wanted, atol=2e-4)


def test_options_that_end_at_once_or_never():
    """beta = 1: every step is a choice of an option and an action; beta = 0: an option is chosen once an episode."""
    frozen = replace(LIVELY, termination_rate=((0.0, 0.0),))
    for logit in (40.0, -100.0):
        start = random_start(3, seed=3)
        start = start._replace(exits=jnp.full_like(start.exits, logit))
        lengths = both(frozen, start)
        if logit > 0:
            assert set(lengths) == {1}
        else:
            algorithm = starting_from(option_critic(frozen, WORLD, RULES, 10_000), start)
            _, log = algorithm.run_round(algorithm.init(jax.random.key(0)), jnp.int32(0))
            np.testing.assert_array_equal(log.valid, log.episode_ended & log.valid)
            assert max(lengths) > 3


# -------------------------------------------------------------------------------------------------- exact answers


def learn(config: OptionCriticConfig, start: Learned, mdp, steps: int, seeds: int) -> Float[np.ndarray, "S O"]:
    """The mean of Q over seeds, with policies and terminations as in `start`."""
    fixed = replace(config, critic_rate=SETTLING, policy_rate=((0.0, 0.0),), termination_rate=((0.0, 0.0),))
    algorithm = starting_from(option_critic(fixed, mdp, Rules(discount=0.9, step_limit=50), steps), start)
    rounds = -(-steps // STEPS_PER_ROUND)
    for carry, _ in train(algorithm, range(seeds), rounds, rounds):
        pass
    np.testing.assert_array_equal(carry.learned.preferences[0], start.preferences)
    return np.asarray(carry.learned.table)[:seeds].mean(axis=0)


@pytest.mark.parametrize("critic", ["greedy", "on-policy"])
def test_the_critic_learns_the_planners_values(critic):
    """Of options that stay as they are: the best policy over them, or the one that chooses at random."""
    mdp, start = random_mdp(seed=1, goals=1), random_start(3, seed=4)
    tables = tabulate(mdp)
    parameters = OptionParameters(np.asarray(start.preferences), np.asarray(start.exits), 0.5)
    config = replace(LIVELY, epsilon=((0.0, 1.0),), critic=critic)
    learned = learn(config, start, mdp, 100_000, seeds=32)
    if critic == "on-policy":
        wanted = soft_option_process(tables, parameters, np.full((7, 3), 1 / 3), 0.9).values().by_option
    else:
        stops, policies = parameters.terminations.T, parameters.policies.swapaxes(0, 1)
        described = OptionTables(("a", "b", "c"), np.ones((3, 7), bool), policies, stops, (NO_CAP,) * 3)
        wanted = option_value_iteration(tables, described, 0.9).option_values
    live = ~tables.terminal
    np.testing.assert_allclose(learned[live], wanted[live], atol=0.05)
    assert np.ptp(wanted[live], axis=1).max() > 0.3


def test_an_option_that_never_ends_is_worth_its_policy():
    mdp, start = random_mdp(seed=2, goals=1), random_start(2, seed=5)
    start = start._replace(exits=jnp.full_like(start.exits, -100.0))
    learned = learn(replace(LIVELY, num_options=2, epsilon=((0.0, 1.0),)), start, mdp, 100_000, seeds=32)
    tables = tabulate(mdp)
    parameters = OptionParameters(np.asarray(start.preferences), np.asarray(start.exits), 0.5)
    for option in range(2):
        wanted = evaluate_policy(tables, parameters.policies[:, option], 0.9)
        np.testing.assert_allclose(learned[~tables.terminal, option], wanted[~tables.terminal], atol=0.05)


@pytest.mark.parametrize(("seed", "goals"), [(0, 0), (1, 1), (2, 2)])
def test_expected_updates_are_the_exact_gradients(seed, goals):
    """Every step (s, o, a, s') weighted by how often it happens, discounted to the start; the critic exact."""
    tables, epsilon, temperature = random_tables(seed, goals), 0.3, 0.5
    start = random_start(3, seed + 10)
    parameters = OptionParameters(np.asarray(start.preferences, float), np.asarray(start.exits, float), temperature)
    policy = np.full((7, 3), 1 / 3)
    for _ in range(50):  # until it is epsilon-greedy in its own values
        process = soft_option_process(tables, parameters, policy, 0.9)
        by_option = process.values().by_option
        policy = (1 - epsilon) * np.eye(3)[by_option.argmax(axis=1)] + epsilon / 3
    exact = process.values()
    begin = tables.initial_probs[:, None] * policy
    probs, _ = dense(tables)
    probs[:, :, tables.terminal] = 0.0  # no termination is updated there
    acting = process.running(begin)[:, :, None] * parameters.policies
    steps = np.einsum("soa,sax->soax", acting, 0.9 * probs)

    with jax.enable_x64(True):
        learned = Learned(
            *map(jnp.asarray, (exact.by_option, exact.by_action, parameters.preferences, parameters.exits))
        )
        pairs = np.moveaxis(np.indices(acting.shape), 0, -1).reshape(-1, 3)
        drawn = jnp.asarray(parameters.policies[pairs[:, 0], pairs[:, 1]])
        better = jax.vmap(improve_policy, in_axes=(None, 0, 0, 0, 0, 0))(
            learned, *jnp.asarray(pairs).T, drawn, jnp.asarray(acting.ravel())
        )
        of_policy = (np.asarray(better.preferences) - np.asarray(learned.preferences)).sum(axis=0)

        _, o, _, x = np.moveaxis(np.indices(steps.shape), 0, -1).reshape(-1, 4).T
        anew = jax.vmap(chosen_value, in_axes=(0, None))(learned.table[x], epsilon)
        better = jax.vmap(improve_termination, in_axes=(None, 0, 0, 0, None, 0))(
            learned, jnp.asarray(x), jnp.asarray(o), anew, 0.0, jnp.asarray(steps.ravel())
        )
        of_termination = (np.asarray(better.exits) - np.asarray(learned.exits)).sum(axis=0)
    np.testing.assert_allclose(of_policy, temperature * process.policy_gradient(begin), atol=1e-12, rtol=0)
    wanted = process.termination_gradient(process.after_a_step(begin))
    np.testing.assert_allclose(of_termination, wanted, atol=1e-12, rtol=0)
    assert min(np.abs(of_policy).max(), np.abs(of_termination).max()) > 1e-3


def test_bad_settings_are_refused():
    for settings, words in (
        ({"num_options": 0}, "num_options is 0"),
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"deliberation_cost": float("nan")}, "deliberation_cost is nan"),
        ({"epsilon": ((0.0, 2.0),)}, "epsilon has the value 2.0"),
        ({"critic": "best"}, "critic is 'best'"),
        ({"order": "any"}, "order is 'any'"),
    ):
        with pytest.raises(InvalidConfig, match=words):
            OptionCriticConfig(**settings)
    for rules in (Rules(undiscounted_option_reward=True), Rules(call_cost=0.5), Rules(bootstrap_at_limit=False)):
        with pytest.raises(InvalidConfig, match="takes each step's reward"):
            option_critic(OptionCriticConfig(), WORLD, rules, 100)
