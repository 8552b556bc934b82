"""Predicting the next symbol of a sequence by plans: STRAW's supervised mode.

At every step a symbol is seen, and the first column of the plan has the logits of the next one. The plan runs on from
one stretch of a sequence to the next; the gradient runs back to the beginning of its stretch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_network import Plan, PlanConfig, PlanNetwork, init_plan_network
from lodestone.learning.schedules import Knots, piecewise_linear


@dataclass(frozen=True)
class SequenceConfig:
    """Settings of the learner."""

    network: NetworkConfig = field(default_factory=lambda: NetworkConfig((), (), (), (32,)))
    """Shape of what plans are made from."""
    plan: PlanConfig = field(default_factory=lambda: PlanConfig(peak=18.0))
    """Shape of the plans."""
    commitment_cost: float = 0.01
    """lambda: cost of the probability of planning anew, beside nats a symbol."""
    noise_cost: float = 0.0001
    """alpha: cost of the divergence of a noisy code; of no meaning without noise."""
    sharpness: Knots = ((0.0, 0.0), (0.3, 0.0), (0.3, 0.3), (0.5, 0.3), (0.95, 1.0))
    """Over the run, factor on the logits of commitments. With 0, every other step plans anew, and nothing is learned of
    commitments: first what follows is learned."""
    learning_rate: Knots = ((0.0, 3e-3), (0.15, 3e-3), (0.3, 5e-4), (0.8, 5e-4), (1.0, 1e-4))
    """Adam's step size over the run. It falls before commitments are learned: a plan that still errs where it could be
    sure is worth looking again, more than the look costs, and once learned such a look stays."""
    max_gradient_norm: float = 1.0
    """Every weight and bias array's gradient is scaled down to this norm."""
    sequences: int = 16
    """B, how many are read side by side."""
    stretch: int = 24
    """L, symbols of each between two updates."""


class Predicted(NamedTuple):
    """What became of L symbols."""

    surprise: Float[Array, "*batch L"]
    """Negative log-likelihood of the next symbol, in nats."""
    before: Float[Array, "*batch L"]
    """Probability with which the step planned anew."""
    anew: Bool[Array, "*batch L"]
    apart: Float[Array, "*batch L"]
    """Divergence of the noisy code, 0 where no plan was made."""
    commitment: Float[Array, "*batch L"]
    """c^t[0]."""


class Reader(NamedTuple):
    """What one seed carries from update to update."""

    network: PlanNetwork
    adam: optax.ScaleByAdamState
    plan: Plan
    """Leaves have a leading axis of B sequences."""
    last: Int[Array, " B"]
    """The last symbols seen, whose followers come next."""


def predict(
    network: PlanNetwork,
    sharpness: Float[Array, ""],
    plan: Plan,
    symbols: Int[Array, " L+1"],
    uniform: Float[Array, " L"],
    noise: Float[Array, "L D"],
) -> tuple[Plan, Predicted]:
    """Read all but the last of the symbols, each time predicting the next; uniform numbers draw where to plan anew."""

    def step(plan: Plan, now: tuple) -> tuple[Plan, Predicted]:
        features, following, uniform, noise = now
        before = plan.commitment[0]
        anew = uniform < before
        plan, apart = network.step(features, plan, anew, noise, sharpness)
        surprise = -jax.nn.log_softmax(plan.logits[:, 0])[following]
        return plan, Predicted(surprise, before, anew, apart, plan.commitment[0])

    seen = jax.nn.one_hot(symbols[:-1], network.rows)
    return jax.lax.scan(step, plan, (jax.vmap(network.trunk)(seen), symbols[1:], uniform, noise))


def prediction_loss(config: SequenceConfig, predicted: Predicted) -> Float[Array, ""]:
    """The mean over all symbols."""
    return jnp.mean(
        predicted.surprise + config.noise_cost * predicted.apart + config.commitment_cost * predicted.commitment
    )


def start_reader(config: SequenceConfig, symbols: int, first: Int[Array, " B"], key: PRNGKeyArray) -> Reader:
    """Of an alphabet of so many symbols, with the first ones of B sequences."""
    network = init_plan_network(config.network, config.plan, (symbols,), symbols, key)
    plan = jax.tree.map(lambda leaf: jnp.stack([leaf] * config.sequences), network.start())
    return Reader(network, start_adam(network), plan, first)


def read_on(
    config: SequenceConfig,
    draw: Callable[[PRNGKeyArray], Int[Array, "B L"]],
    reader: Reader,
    key: PRNGKeyArray,
    fraction: Float[Array, ""],
) -> tuple[Reader, Predicted]:
    """One update after a fraction of the run, on the next stretch that `draw` gives."""
    draw_key, gate_key, noise_key = jax.random.split(key, 3)
    further = draw(draw_key)
    symbols = jnp.concatenate([reader.last[:, None], further], axis=1)
    uniform = jax.random.uniform(gate_key, further.shape)
    noise = jax.random.normal(noise_key, (*further.shape, reader.network.noise_size))
    sharpness = piecewise_linear(config.sharpness, fraction)

    def of_all(network: PlanNetwork) -> tuple[Float[Array, ""], tuple[Plan, Predicted]]:
        plan, predicted = jax.vmap(partial(predict, network, sharpness))(reader.plan, symbols, uniform, noise)
        return prediction_loss(config, predicted), (plan, predicted)

    gradient, (plan, predicted) = jax.grad(of_all, has_aux=True)(reader.network)
    learning_rate = piecewise_linear(config.learning_rate, fraction)
    network, adam = adam_step(reader.network, gradient, reader.adam, learning_rate, 1e-8, config.max_gradient_norm)
    return Reader(network, adam, plan, further[:, -1]), predicted
