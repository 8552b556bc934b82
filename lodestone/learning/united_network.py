"""The united network (announced in Kuzmin and Panov 2018, section 5): one trunk under the policies of all options,
their terminations, and the policy over options.

For n options it has n + 1 policy heads (head 0 is the basic policy, on the task itself), n termination heads and one
manager head over n + 1 choices: one step of the basic policy, or an option.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num, PRNGKeyArray

from lodestone.errors import InvalidConfig, check_name
from lodestone.learning.networks import NetworkConfig, QNetwork, Trunk, build_layers, draw_weights, weight_shapes
from lodestone.types import Observation

Shared = Literal["nothing", "convolutions", "hidden"]
"""What the heads share: no layer (every head is a network of its own), the convolutions, or all but the last layer."""

BASIC = 0
"""The choice of one step of the basic policy, and the position of that policy's head."""


class UnitedNetwork(eqx.Module):
    """Observation -> what every head says of it."""

    trunk: Trunk | None
    """None where nothing is shared."""
    manager: QNetwork
    """Features -> values of the n + 1 choices. Features are the trunk's, or the observation where there is none."""
    policies: QNetwork
    """Features -> values of the A actions; arrays have a leading axis of n + 1 heads."""
    terminations: QNetwork
    """Features -> logits of going on and of having ended; arrays have a leading axis of n heads."""

    def features(self, observation: Observation) -> Num[Array, "..."]:
        """What the heads work on."""
        return observation if self.trunk is None else self.trunk(observation)

    def policy(self, position: int) -> PolicyHead:
        """One of the policies by itself: the basic one, or an option's."""
        return PolicyHead(self.trunk, one_head(self.policies, position))

    def __call__(self, observation: Observation) -> Outputs:
        """One pass of the trunk, then every head."""
        features = self.features(observation)
        return Outputs(
            choices=self.manager(features),
            actions=each_head(self.policies, features),
            termination=jax.nn.softmax(each_head(self.terminations, features), axis=1)[:, -1],
        )


class PolicyHead(eqx.Module):
    """Observation -> values of the A actions, by one policy head and the trunk below it."""

    trunk: Trunk | None
    head: QNetwork

    def __call__(self, observation: Observation) -> Float[Array, " A"]:
        return self.head(observation if self.trunk is None else self.trunk(observation))


class Outputs(NamedTuple):
    """What the heads say of one state."""

    choices: Float[Array, " n+1"]
    """Values of the manager's choices."""
    actions: Float[Array, "n+1 A"]
    """Action values of the basic policy and of every option's policy."""
    termination: Float[Array, " n"]
    """Probability that each option has reached its end, as its termination head has learned it."""

    @property
    def ended(self) -> Bool[Array, " n"]:
        """Whether each option is taken to have reached its end: the heads judge, they do not draw."""
        return self.termination > 0.5


def each_head(heads: QNetwork, features: Num[Array, "..."]) -> Float[Array, "heads outputs"]:
    """What each of some stacked heads makes of the same features."""
    count = heads.layers[-1].bias.shape[0]
    if count == 0:
        return jnp.zeros(heads.layers[-1].bias.shape)
    return jax.vmap(lambda head: head(features))(heads)


def one_head(heads: QNetwork, position: int) -> QNetwork:
    """One of some stacked heads."""
    return jax.tree.map(lambda leaf: leaf[position], heads)


def init_united_network(
    config: NetworkConfig,
    shared: Shared,
    observation_shape: tuple[int, ...],
    num_actions: int,
    num_options: int,
    key: PRNGKeyArray,
) -> UnitedNetwork:
    """A network with Glorot-uniform weights and zero biases.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures, and `UnknownName`.
    """
    outputs = [num_options + 1, *[num_actions] * (num_options + 1), *[2] * num_options]
    trunk, heads = init_trunk_and_heads(config, shared, observation_shape, outputs, key)
    policies, terminations = heads[1 : num_options + 2], heads[num_options + 2 :]
    return UnitedNetwork(
        trunk=trunk,
        manager=heads[0],
        policies=stack_heads(policies),
        terminations=stack_heads(terminations) if terminations else _none_of(heads[0]),
    )


def init_trunk_and_heads(
    config: NetworkConfig,
    shared: Shared,
    observation_shape: tuple[int, ...],
    outputs: Sequence[int],
    key: PRNGKeyArray,
) -> tuple[Trunk | None, list[QNetwork]]:
    """What the heads share, and one head for each number of outputs, with Glorot-uniform weights and zero biases.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures, and `UnknownName`.
    """
    check_name("part to share", shared, get_args(Shared))
    deep = len(config.kernels)
    split = {"nothing": 0, "convolutions": deep, "hidden": deep + len(config.hidden)}[shared]
    if split == 0 and shared != "nothing":
        raise InvalidConfig(f"The networks cannot share their part {shared!r}: they have no such layers.")
    of_trunk = replace(config, hidden=config.hidden[: max(0, split - deep)])
    of_head = config if split == 0 else NetworkConfig((), (), (), config.hidden[max(0, split - deep) :])

    shapes = [weight_shapes(config, observation_shape, count) for count in outputs]
    drawn = iter(draw_weights(key, [*shapes[0][:split], *(shape for head in shapes for shape in head[split:])]))

    def take(count: int) -> list[Array]:
        return [next(drawn) for _ in range(count)]

    trunk = Trunk(*build_layers(of_trunk, take(split)), config.pooling) if split else None
    per_head = len(shapes[0]) - split
    heads = [QNetwork(*build_layers(of_head, take(per_head)), of_head.pooling) for _ in outputs]
    return trunk, heads


def stack_heads(heads: Sequence[QNetwork]) -> QNetwork:
    """Heads of one shape as one, whose arrays have a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *heads)


def _none_of(head: QNetwork) -> QNetwork:
    """A stack of no heads."""
    return jax.tree.map(lambda leaf: jnp.zeros((0, *leaf.shape), leaf.dtype), head)
