"""A network that plans: from what it sees and the plan so far to the plan from now on (STRAW and STRAWe)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lodestone.errors import InvalidConfig
from lodestone.learning.networks import Linear, NetworkConfig, Trunk, build_layers, draw_weights, weight_shapes
from lodestone.learning.plans import (
    attention,
    commitment,
    divergence,
    perturb,
    read,
    shift,
    shift_commitment,
    straight_through,
    write,
)
from lodestone.types import Observation

LONGEST = 10_000
"""Columns that a plan may have: a file could ask for any number."""


@dataclass(frozen=True)
class PlanConfig:
    """The shape of plans."""

    horizon: int = 8
    """T, steps that a plan reaches ahead."""
    patch: int = 8
    """K, columns that are read and written at once."""
    peak: float = 12.0
    """Height, as a logit, of the commitment at the step for which the next plan is meant."""
    background: float = -6.0
    """The logit of planning anew at any other step; with 20 every step does."""
    noisy: bool = False
    """Whether plans are made from a noisy code (STRAWe) instead of the code itself (STRAW)."""

    def __post_init__(self) -> None:
        for name in ("horizon", "patch"):
            if not 1 <= getattr(self, name) <= LONGEST:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be from 1 to {LONGEST}.")
        for name in ("peak", "background"):
            if not math.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")


class Plan(NamedTuple):
    """What is carried from step to step."""

    logits: Float[Array, "R T"]
    """A: of every action, then the value, for this step and those to come."""
    commitment: Float[Array, " T"]
    """c: probability of planning anew at the next step and those to come."""


class PlanNetwork(eqx.Module):
    """Features of what is seen, and what makes plans of them."""

    trunk: Trunk
    """Observation -> features z."""
    focus: Linear
    """z -> where and how widely to read and write."""
    encoder: tuple[Linear, Linear]
    """What was read, and z -> the code xi."""
    noise: Linear | None
    """xi -> mean and log of the variance of the noisy code; None where there is no noise."""
    patch: Linear
    """Code and z -> the patch. (By the bounded code alone, as in the paper, rare rewards were learned far later.)"""
    schedule: Linear
    """Focus and code -> when to plan anew."""
    shape: PlanConfig = eqx.field(static=True)

    @property
    def rows(self) -> int:
        """R, rows of a plan."""
        return self.patch.bias.size // self.shape.patch

    @property
    def noise_size(self) -> int:
        """D, numbers of noise that a plan takes: 0 where there is none."""
        return self.encoder[1].bias.size if self.shape.noisy else 0

    def start(self) -> Plan:
        """Before the first step: nothing is planned, so that the first step plans for sure."""
        return Plan(jnp.zeros((self.rows, self.shape.horizon)), jnp.ones(self.shape.horizon))

    def renew(
        self, features: Float[Array, " F"], plan: Plan, noise: Float[Array, " D"], sharpness: Float[Array, ""]
    ) -> tuple[Float[Array, "R T"], Float[Array, " T"], Float[Array, ""]]:
        """What a new plan adds to the old one, the new commitment, and how far its code is from mere noise (the
        divergence of STRAWe, or 0)."""
        focus = self.focus(features)
        filters = attention(focus, self.shape.horizon, self.shape.patch)
        code = jnp.concatenate([read(plan.logits, filters).ravel(), features])
        # Bounded, so that a plan that is read and written at every step cannot grow without bounds.
        code = jnp.tanh(self.encoder[1](jax.nn.relu(self.encoder[0](code))))
        apart = jnp.float32(0)
        if self.noise is not None:
            mean, log_variance = jnp.split(self.noise(code), 2)
            code, apart = perturb(mean, log_variance, noise), divergence(mean, log_variance)
        added = write(self.patch(jnp.concatenate([code, features])).reshape(self.rows, self.shape.patch), filters)
        when = self.schedule(jnp.concatenate([focus, code]))
        return added, commitment(when, self.shape.horizon, self.shape.peak, self.shape.background, sharpness), apart

    def step(
        self,
        features: Float[Array, " F"],
        plan: Plan,
        anew: Bool[Array, ""],
        noise: Float[Array, " D"],
        sharpness: Float[Array, ""],
    ) -> tuple[Plan, Float[Array, ""]]:
        """The plan of this step, for learning: `anew` is what was drawn with probability `plan.commitment[0]`.

        The gradient passes through the draw to that probability, and to the features only where a plan was made.
        Returns the divergence, 0 where no plan was made, too.
        """
        gate = straight_through(plan.commitment[0], anew)
        added, renewed, apart = self.renew(features, plan, noise, sharpness)
        kept = shift_commitment(plan.commitment)
        return Plan(shift(plan.logits) + gate * added, (1 - gate) * kept + gate * renewed), gate * apart

    def act(
        self,
        observation: Observation,
        plan: Plan,
        anew: Bool[Array, ""],
        noise: Float[Array, " D"],
        sharpness: Float[Array, ""],
    ) -> Plan:
        """The same plan, for acting: where none is made, the observation is not looked at. (Under vmap both ways are
        computed, and one is taken.)"""

        def renewed() -> Plan:
            return self.step(self.trunk(observation), plan, anew, noise, sharpness)[0]

        def kept() -> Plan:
            return Plan(shift(plan.logits), shift_commitment(plan.commitment))

        return jax.lax.cond(anew, renewed, kept)


def init_plan_network(
    config: NetworkConfig, shape: PlanConfig, observation_shape: tuple[int, ...], rows: int, key: PRNGKeyArray
) -> PlanNetwork:
    """A network with Glorot-uniform weights and zero biases, save that it begins by writing column by column, with
    small numbers, and by committing itself to about half a plan. (A wide bell of commitment learns to cover many steps
    sooner than to move to the right one.)

    The code is as wide as the last hidden layer. Raises `InvalidConfig` if there is none, or if convolutions are asked
    for where observations are no pictures.
    """
    if not config.hidden:
        raise InvalidConfig("A network that plans needs at least one hidden layer.")
    size, patch_size = config.hidden[-1], rows * shape.patch
    of_trunk = weight_shapes(config, observation_shape, outputs=1)[:-1]
    planning: list[tuple[int, ...]] = [
        (size, 3),
        (patch_size + size, size),
        (size, size),
        (2 * size, patch_size),
        (size + 3, 2),
    ]
    if shape.noisy:
        planning.append((size, 2 * size))
    weights = draw_weights(key, of_trunk + planning)
    convolutions, layers = build_layers(config, weights[: len(of_trunk)])
    focus, first, second, patch, schedule, *noise = (
        Linear(weight, jnp.zeros(weight.shape[1])) for weight in weights[len(of_trunk) :]
    )
    return PlanNetwork(
        trunk=Trunk(convolutions, layers, config.pooling),
        focus=Linear(0.1 * focus.weight, jnp.array([0.0, 0.0, -2.0])),
        encoder=(first, second),
        noise=noise[0] if noise else None,
        patch=Linear(0.1 * patch.weight, patch.bias),
        schedule=Linear(0.1 * schedule.weight, jnp.array([0.0, -1.0])),
        shape=shape,
    )
