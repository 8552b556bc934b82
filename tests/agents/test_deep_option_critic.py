"""The deep option-critic against the tabular one, exact gradients, finite differences, and a plain Python learner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float
from random_mdp import NUM_ACTIONS, NUM_STATES, dense
from scipy.special import expit, log_softmax, softmax

from lodestone.agents.deep_option_critic import (
    Carry,
    DeepOptionCriticConfig,
    Scheduled,
    Steps,
    deep_option_critic,
    loss,
)
from lodestone.agents.option_critic import (
    Learned,
    chosen_value,
    improve_critic,
    improve_policy,
    improve_termination,
)
from lodestone.envs.base import Step
from lodestone.envs.random_mdp import NumberedState, RandomMDP
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm
from lodestone.learning.networks import Linear, NetworkConfig
from lodestone.learning.option_network import OptionNetwork, init_option_network
from lodestone.learning.returns import lambda_returns
from lodestone.options.execution import Rules, draw_chance
from lodestone.planning.option_gradients import OptionParameters, soft_option_process
from lodestone.planning.tables import tabulate

WORLD = RandomMDP(mdp_seed=1, observation="index")
"""The last of its states is an end."""
PROBS, REWARDS = WORLD.dynamics
LINEAR = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
GAMMA, EPSILON, TEMPERATURE = 0.9, 0.3, 0.5
OPTIONS = 3
LIVELY = DeepOptionCriticConfig(
    network=LINEAR,
    num_options=OPTIONS,
    temperature=TEMPERATURE,
    decay=0.7,
    entropy=((0.0, 0.2),),
    deliberation_cost=0.05,
    epsilon=((0.0, EPSILON),),
    learning_rate=((0.0, 0.02),),
    adam_epsilon=0.01,
    max_gradient_norm=0.05,
    environments=3,
    ticks_per_round=6,
    reward_scale=2.0,
)
RULES = Rules(discount=GAMMA, step_limit=7)
NO_ENTROPY = Scheduled(jnp.float32(1), jnp.float32(0), jnp.float32(EPSILON))


@cache
def lively() -> tuple[Algorithm, Callable]:
    """The learner, and its compiled round."""
    algorithm = deep_option_critic(LIVELY, WORLD, RULES, 1000)
    return algorithm, jax.jit(algorithm.run_round)


def random_network(hidden: tuple[int, ...] = (), num_options: int = OPTIONS, seed: int = 0) -> OptionNetwork:
    """With heads that are not zero, either."""
    config = replace(LINEAR, hidden=hidden)
    network = init_option_network(config, (NUM_STATES,), num_options, NUM_ACTIONS, jax.random.key(seed))
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), network)


def as_tables(network: OptionNetwork) -> Learned:
    """What the network says of every state, in float64; the value of an action is left open."""
    features = np.eye(NUM_STATES)
    for layer in network.trunk.layers:
        features = np.maximum(features @ np.asarray(layer.weight, float) + np.asarray(layer.bias, float), 0)

    def of(head: Linear) -> Float[np.ndarray, "S outputs"]:
        return features @ np.asarray(head.weight, float) + np.asarray(head.bias, float)

    theta = of(network.preferences).reshape(NUM_STATES, -1, NUM_ACTIONS)
    return Learned(of(network.values), np.zeros_like(theta), theta, of(network.exits))


@partial(jax.jit, static_argnums=0)
def gradient(config: DeepOptionCriticConfig, network: OptionNetwork, steps: Steps, weights: Scheduled) -> OptionNetwork:
    """Of what falls."""
    return jax.grad(lambda one: loss(config, WORLD, GAMMA, one, steps, weights)[0])(network)


def random_steps(shape: tuple[int, int], num_options: int = OPTIONS, seed: int = 0) -> Steps:
    """Some of them end the episode, some are cut; not a walk."""
    rng = np.random.default_rng(seed)
    state = rng.integers(0, NUM_STATES - 1, shape)
    next_state = rng.integers(0, NUM_STATES, shape)
    option, action = rng.integers(0, num_options, shape), rng.integers(0, NUM_ACTIONS, shape)
    terminated = next_state == NUM_STATES - 1
    cut = terminated | (rng.random(shape) < 0.2)
    stopped = cut | (rng.random(shape) < 0.5)
    numbers = (jnp.asarray(each, jnp.int32) for each in (state, option, action, next_state))
    s, o, a, x = numbers
    return Steps(
        NumberedState(s), o, a, NumberedState(x), jnp.asarray(terminated), jnp.asarray(cut), jnp.asarray(stopped)
    )


# ---------------------------------------------------------------------------------------------- the tabular learner


def test_one_hot_and_no_layers_is_the_tabular_learner():
    """Each step's update of the tables, with the critic on-policy and the end of an option paid for; targets of one
    step."""
    config = replace(LIVELY, decay=0.0, reward_scale=1.0)
    network, steps = random_network(), random_steps((5, 4))
    found = jax.tree.map(lambda leaf: -20.0 * np.asarray(leaf), gradient(config, network, steps, NO_ENTROPY))
    start = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), as_tables(network))

    def updated(s, o, a, x, over) -> Learned:
        anew = chosen_value(start.table[x], jnp.float32(EPSILON)) - config.deliberation_cost
        arrived = Step(x, jnp.asarray(REWARDS, jnp.float32)[s, a, x], over)
        learned, _ = improve_critic(start, s, o, a, arrived, anew, GAMMA, jnp.float32(1))
        # What the table of action values would be, had it seen this target alone.
        at_once = start._replace(by_action=start.by_action.at[s, o, a].set(learned.table[s, o]))
        probs = jax.nn.softmax(start.preferences[s, o] / TEMPERATURE)
        theta = improve_policy(at_once, s, o, a, probs, jnp.float32(1 / TEMPERATURE)).preferences
        exits = improve_termination(start, x, o, anew, 0.0, jnp.where(over, 0.0, 1.0)).exits
        return Learned(learned.table, start.by_action, theta, exits)

    s, o, a, x, over = (leaf.ravel() for leaf in jax.tree.leaves(steps)[:5])
    each = jax.jit(jax.vmap(updated))(s, o, a, x, over)
    total = jax.tree.map(lambda new, old: np.sum(np.asarray(new - old[None]), axis=0), each, start)
    for head, wanted in (
        (found.values, total.table),
        (found.preferences, total.preferences.reshape(NUM_STATES, -1)),
        (found.exits, total.exits),
    ):
        np.testing.assert_allclose(head.weight, wanted, atol=1e-4)
        np.testing.assert_allclose(head.bias, wanted.sum(axis=0), atol=1e-4)
        assert np.abs(wanted).max() > 0.1


# ------------------------------------------------------------------------------------------------- exact gradients


def exact_critic(network: OptionNetwork) -> tuple[OptionNetwork, np.ndarray]:
    """The network with values that are exact for a policy over options that is epsilon-greedy in them, and it."""
    tables, learned = tabulate(WORLD), as_tables(network)
    parameters = OptionParameters(learned.preferences, learned.exits, TEMPERATURE)
    policy = np.full((NUM_STATES, OPTIONS), 1 / OPTIONS)
    for _ in range(50):
        by_option = soft_option_process(tables, parameters, policy, GAMMA).values().by_option
        policy = (1 - EPSILON) * np.eye(OPTIONS)[by_option.argmax(axis=1)] + EPSILON / OPTIONS
    features = np.asarray(jax.vmap(network.trunk)(jnp.eye(NUM_STATES)), float)
    weight = np.linalg.lstsq(features, by_option, rcond=None)[0]
    values = Linear(jnp.asarray(weight, jnp.float32), jnp.zeros(OPTIONS))
    network = OptionNetwork(network.trunk, values, network.preferences, network.exits)
    np.testing.assert_allclose(as_tables(network).table, by_option, atol=1e-5)
    return network, policy


def expected_gradient(
    config: DeepOptionCriticConfig, network: OptionNetwork, policy: np.ndarray, weigh_arrivals: bool
) -> OptionNetwork:
    """Of what rises: every step (s, o, a, s') weighted by how often it happens, discounted to the start of an episode,
    or to its end."""
    tables, learned = tabulate(WORLD), as_tables(network)
    process = soft_option_process(
        tables, OptionParameters(learned.preferences, learned.exits, TEMPERATURE), policy, GAMMA
    )
    acting = process.running(tables.initial_probs[:, None] * policy)[:, :, None] * process.parameters.policies
    happens = np.einsum("soa,sax->soax", acting, dense(tables)[0])
    s, o, a, x = (
        jnp.asarray(number, jnp.int32) for number in np.moveaxis(np.indices(happens.shape), 0, -1).reshape(-1, 4).T
    )
    over = jnp.asarray(tables.terminal)[x]
    steps = jax.tree.map(
        lambda leaf: leaf[:, None, None], Steps(NumberedState(s), o, a, NumberedState(x), over, over, over)
    )
    each = jax.vmap(partial(gradient, config), in_axes=(None, 0, None))(network, steps, NO_ENTROPY)
    weights = happens.ravel() * (GAMMA if weigh_arrivals else 1.0)
    return jax.tree.map(lambda leaf: -np.tensordot(weights, np.asarray(leaf, float), axes=1), each)


def worth(network: OptionNetwork, policy: np.ndarray, of_tables: Learned | None = None) -> float:
    """Exact value of an episode's start, under a fixed policy over options."""
    learned, tables = of_tables or as_tables(network), tabulate(WORLD)
    parameters = OptionParameters(learned.preferences, learned.exits, TEMPERATURE)
    process = soft_option_process(tables, parameters, policy, GAMMA)
    return tables.initial_mean(process.values().values)


ONE_STEP = replace(LIVELY, decay=0.0, deliberation_cost=0.0, reward_scale=1.0)


def test_the_heads_climb_the_exact_gradients():
    network, policy = exact_critic(random_network(seed=3))
    tables, learned = tabulate(WORLD), as_tables(network)
    process = soft_option_process(
        tables, OptionParameters(learned.preferences, learned.exits, TEMPERATURE), policy, GAMMA
    )
    begin = tables.initial_probs[:, None] * policy
    of_policy = expected_gradient(ONE_STEP, network, policy, weigh_arrivals=False)
    wanted = process.policy_gradient(begin)
    np.testing.assert_allclose(of_policy.preferences.weight, wanted.reshape(NUM_STATES, -1), atol=1e-5)
    np.testing.assert_allclose(of_policy.preferences.bias, wanted.sum(axis=0).ravel(), atol=1e-5)
    np.testing.assert_allclose(of_policy.values.weight, 0.0, atol=1e-5)
    of_ends = expected_gradient(ONE_STEP, network, policy, weigh_arrivals=True)
    wanted = process.termination_gradient(process.after_a_step(begin))
    np.testing.assert_allclose(of_ends.exits.weight, wanted, atol=1e-5)
    assert min(np.abs(of_policy.preferences.weight).max(), np.abs(wanted).max()) > 0.01


def test_the_trunk_climbs_the_exact_gradients():
    """Central differences of the exact value, by weights of the hidden layer: of policies alone, and of terminations
    where they may train the trunk."""
    network, policy = exact_critic(random_network(hidden=(16,), seed=4))
    of_policies = expected_gradient(ONE_STEP, network, policy, weigh_arrivals=False).trunk.layers[0]
    with_ends = replace(ONE_STEP, termination_trains_trunk=True)
    of_ends = jax.tree.map(
        np.subtract,
        expected_gradient(with_ends, network, policy, weigh_arrivals=True).trunk.layers[0],
        expected_gradient(ONE_STEP, network, policy, weigh_arrivals=True).trunk.layers[0],
    )
    fixed = as_tables(network)

    def difference(part: str, place: tuple[int, int]) -> float:
        values = []
        for step in (1e-3, -1e-3):
            weight = np.asarray(network.trunk.layers[0].weight, float).copy()
            weight[place] += step
            layer = Linear(weight, network.trunk.layers[0].bias)
            moved = as_tables(with_layer(network, layer))
            values.append(worth(network, policy, fixed._replace(**{part: getattr(moved, part)})))
        return (values[0] - values[1]) / 2e-3

    largest = 0.0
    for place in [(state, unit) for state in range(0, 6, 2) for unit in range(0, 16, 3)]:
        wanted = difference("preferences", place)
        assert of_policies.weight[place] == pytest.approx(wanted, abs=2e-5)
        largest = max(largest, abs(wanted))
        # The first step of an episode, too, is one after which an option may end.
        assert of_ends.weight[place] == pytest.approx(difference("exits", place), abs=2e-5)
    assert largest > 0.01


def with_layer(network: OptionNetwork, layer: Linear) -> OptionNetwork:
    trunk = type(network.trunk)((), (layer,))
    return OptionNetwork(trunk, network.values, network.preferences, network.exits)


# ------------------------------------------------------------------------------------------------ degenerate cases


def test_one_option_is_a_plain_actor_critic():
    """Whatever its termination says, and whenever it is said to have ended."""
    config = replace(LIVELY, num_options=1, deliberation_cost=0.0)
    network, steps = random_network((5,), num_options=1), random_steps((6, 3), num_options=1)
    weights = Scheduled(jnp.float32(1), jnp.float32(0.2), jnp.float32(EPSILON))

    def actor_critic(network: OptionNetwork) -> jax.Array:
        seen, seen_next = jnp.eye(NUM_STATES)[steps.state.number], jnp.eye(NUM_STATES)[steps.next_state.number]
        features, later = (jax.vmap(jax.vmap(network.trunk))(each) for each in (seen, seen_next))
        values = jax.vmap(jax.vmap(network.values))(features)[..., 0]
        next_values = jax.vmap(jax.vmap(network.values))(later)[..., 0]
        log_probs = jax.nn.log_softmax(jax.vmap(jax.vmap(network.preferences))(features) / TEMPERATURE)
        reward = 2.0 * jnp.asarray(REWARDS, jnp.float32)[steps.state.number, steps.action, steps.next_state.number]
        discount = jnp.where(steps.terminated, 0.0, GAMMA)
        columns = [
            lambda_returns(reward[:, n], discount[:, n], next_values[:, n], steps.cut[:, n], 0.7) for n in range(3)
        ]
        advantage = jax.lax.stop_gradient(jnp.stack(columns, axis=1) - values)
        taken = jnp.take_along_axis(log_probs, steps.action[..., None], axis=2)[..., 0]
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=2)
        return -jnp.mean(advantage * taken + advantage * values + 0.2 * entropy)

    wanted = jax.grad(actor_critic)(network)
    for logit in (-3.0, 3.0):
        exits = Linear(network.exits.weight, jnp.full(1, logit))
        changed = OptionNetwork(network.trunk, network.values, network.preferences, exits)
        for stopped in (steps.cut, ~steps.stopped | steps.cut):
            found = gradient(config, changed, steps._replace(stopped=stopped), weights)
            jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), found, wanted)
            np.testing.assert_allclose(found.exits.weight, 0.0, atol=1e-6)


@pytest.mark.parametrize("logit", [60.0, -60.0])
def test_options_that_end_at_once_or_never(logit):
    """beta = 1: every step is a choice of an option and an action; beta = 0: an option is chosen once an episode."""
    algorithm, run_round = lively()
    carry = algorithm.init(jax.random.key(0))
    network = carry.network
    exits = Linear(network.exits.weight, jnp.full(OPTIONS, logit))
    carry = carry._replace(network=OptionNetwork(network.trunk, network.values, network.preferences, exits))
    for number in range(5):
        carry, log = run_round(carry, jnp.int32(number))
        if logit > 0:
            assert log.valid.all()
            np.testing.assert_array_equal(log.steps, 1)
        else:
            np.testing.assert_array_equal(log.valid, log.episode_ended)
            assert max(log.steps[log.valid].tolist(), default=0) <= 7
            assert set(log.episode_decisions.tolist()) == {1}


def test_what_follows_a_limit_counts_and_what_follows_an_end_does_not():
    """One step from state 0 to 1, with values of 1, 2, 3 everywhere, and an option 0 that surely goes on."""
    zero = jax.tree.map(jnp.zeros_like, random_network())
    network = OptionNetwork(
        zero.trunk,
        Linear(zero.values.weight, jnp.array([1.0, 2.0, 3.0])),
        zero.preferences,
        Linear(zero.exits.weight, jnp.full(OPTIONS, -60.0)),
    )
    number = partial(jnp.full, (1, 1), dtype=jnp.int32)
    yes, no = jnp.ones((1, 1), bool), jnp.zeros((1, 1), bool)
    reward = REWARDS[0, 0, 1]
    config = replace(LIVELY, reward_scale=1.0)
    for terminated, future in ((no, GAMMA * 1.0), (yes, 0.0)):
        steps = Steps(NumberedState(number(0)), number(0), number(0), NumberedState(number(1)), terminated, yes, yes)
        # Of the bias of one value, which falls by the error.
        error = -gradient(config, network, steps, NO_ENTROPY).values.bias[0]
        assert float(error) == pytest.approx(reward + future - 1.0, rel=1e-5)


# ------------------------------------------------------------------------------------------ the same random numbers


def pick(probs: Float[np.ndarray, " N"], uniform: float) -> int:
    edges = np.cumsum(probs)
    return int(np.searchsorted(edges[:-1], uniform * edges[-1], side="right"))


class Plain:
    """The learner in plain Python on tables and what is added to each of their columns, in float64."""

    def __init__(self, config: DeepOptionCriticConfig, carry: Carry) -> None:
        self.config, network = config, carry.network
        heads = (network.values, network.preferences, network.exits)
        self.parameters = [np.asarray(leaf, float) for head in heads for leaf in (head.weight, head.bias)]
        self.moments = [[np.zeros_like(leaf) for leaf in self.parameters] for _ in range(2)]
        self.state = np.asarray(carry.actors.state.number).copy()
        self.option, self.elapsed = np.zeros(3, int), np.zeros(3, int)
        self.choosing, self.updates, self.key = np.ones(3, bool), 0, carry.key
        self.lengths: list[int] = []
        self.running = np.zeros(3, int)

    def tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Q, theta, vartheta."""
        value, value_bias, theta, theta_bias, exits, exits_bias = self.parameters
        return value + value_bias, (theta + theta_bias).reshape(NUM_STATES, OPTIONS, NUM_ACTIONS), exits + exits_bias

    def anew(self, row: np.ndarray) -> float:
        return (1 - EPSILON) * row.max() + EPSILON * row.mean() - self.cost

    @property
    def cost(self) -> float:
        return self.config.reward_scale * self.config.deliberation_cost

    def walk(self) -> list[list[tuple]]:
        """A round of steps: of every environment (s, o, a, r, s', terminated, cut, stopped)."""
        table, theta, exits = self.tables()
        steps_key, self.key = jax.random.split(self.key)
        walks: list[list[tuple]] = [[] for _ in range(3)]
        for tick_key in jax.random.split(steps_key, self.config.ticks_per_round):
            *keys, choice_key = jax.random.split(tick_key, 4)
            choices = np.asarray(jax.random.uniform(choice_key, (3, 2)))
            for n, key in enumerate(keys):
                chance, s = draw_chance(key), self.state[n]
                if self.choosing[n]:
                    row = table[s]
                    best = row == row.max() if choices[n, 0] >= EPSILON else np.ones(OPTIONS, bool)
                    self.option[n], self.running[n] = pick(best, choices[n, 1]), 0
                o = self.option[n]
                a = pick(softmax(theta[s, o] / TEMPERATURE), float(chance.action))
                x = pick(PROBS[s, a], float(chance.outcome))
                self.elapsed[n] += 1
                self.running[n] += 1
                terminated = x == NUM_STATES - 1
                cut = terminated or self.elapsed[n] == RULES.step_limit
                stopped = cut or float(chance.termination) < expit(exits[x, o])
                reward = self.config.reward_scale * REWARDS[s, a, x]
                walks[n].append((s, o, a, reward, x, terminated, cut, stopped))
                if stopped:
                    self.lengths.append(int(self.running[n]))
                self.choosing[n], self.state[n] = stopped, x
                if cut:
                    self.state[n] = int(float(chance.restart) * (NUM_STATES - 1))
                    self.elapsed[n] = 0
        return walks

    def learn(self) -> None:
        config, (table, theta, exits) = self.config, self.tables()
        falls = [np.zeros_like(leaf) for leaf in (table, theta, exits)]
        for walk in self.walk():
            ahead = None
            for s, o, a, reward, x, terminated, cut, stopped in reversed(walk):
                beta, worse = expit(exits[x, o]), table[x, o] - self.anew(table[x])
                arriving = (1 - beta) * table[x, o] + beta * self.anew(table[x])
                if terminated:
                    future = 0.0
                elif cut or ahead is None:
                    future = arriving
                else:
                    further = ahead - self.cost if stopped else ahead
                    future = (1 - config.decay) * arriving + config.decay * further
                ahead = reward + GAMMA * future
                error = ahead - table[s, o]
                probs, log_probs = softmax(theta[s, o] / TEMPERATURE), log_softmax(theta[s, o] / TEMPERATURE)
                entropy = -(probs * log_probs).sum()
                falls[0][s, o] -= error
                falls[1][s, o] -= error * (np.eye(NUM_ACTIONS)[a] - probs) / TEMPERATURE
                falls[1][s, o] -= 0.2 * -probs * (log_probs + entropy) / TEMPERATURE
                if not terminated:
                    falls[2][x, o] += beta * (1 - beta) * worse
        rows = [fall.reshape(NUM_STATES, -1) / (3 * config.ticks_per_round) for fall in falls]
        self.adam([leaf for row in rows for leaf in (row, row.sum(axis=0))])

    def adam(self, gradients: list[np.ndarray]) -> None:
        self.updates += 1
        for index, fall in enumerate(gradients):
            norm = np.sqrt((fall**2).sum())
            fall = fall * min(1.0, self.config.max_gradient_norm / max(norm, 1e-12))
            for moment, rate, new in zip(self.moments, (0.9, 0.999), (fall, fall**2), strict=True):
                moment[index] = rate * moment[index] + (1 - rate) * new
            first, second = (
                moment[index] / (1 - rate**self.updates)
                for moment, rate in zip(self.moments, (0.9, 0.999), strict=True)
            )
            self.parameters[index] = self.parameters[index] - 0.02 * first / (np.sqrt(second) + 0.01)


def test_every_update_is_that_of_a_plain_loop():
    algorithm, run_round = lively()
    carry = algorithm.init(jax.random.key(5))._replace(network=random_network(seed=2))
    plain, lengths = Plain(LIVELY, carry), []
    for number in range(25):
        plain.learn()
        carry, log = run_round(carry, jnp.int32(number))
        lengths += np.asarray(log.steps)[np.asarray(log.valid)].tolist()
        heads = (carry.network.values, carry.network.preferences, carry.network.exits)
        found = [leaf for head in heads for leaf in (head.weight, head.bias)]
        for one, wanted in zip(found, plain.parameters, strict=True):
            np.testing.assert_allclose(one, wanted, atol=5e-4)
    assert sorted(lengths) == sorted(plain.lengths)
    assert len(set(lengths)) > 4


# --------------------------------------------------------------------------------------------------------- settings


def test_bad_settings_are_refused():
    for settings, words in (
        ({"num_options": 0}, "num_options is 0"),
        ({"environments": 0}, "environments is 0"),
        ({"temperature": 0.0}, "temperature is 0.0"),
        ({"reward_scale": float("inf")}, "reward_scale is inf"),
        ({"decay": 1.5}, "decay is 1.5"),
        ({"deliberation_cost": float("nan")}, "deliberation_cost is nan"),
        ({"entropy": ((0.0, -1.0),)}, "entropy has the value -1.0"),
        ({"epsilon": ((0.0, 2.0),)}, "epsilon has the value 2.0"),
    ):
        with pytest.raises(InvalidConfig, match=words):
            DeepOptionCriticConfig(**settings)
    for rules in (Rules(undiscounted_option_reward=True), Rules(call_cost=0.5), Rules(bootstrap_at_limit=False)):
        with pytest.raises(InvalidConfig, match="takes each step's reward"):
            deep_option_critic(DeepOptionCriticConfig(), WORLD, rules, 100)
