"""On-policy targets from steps in the order they were taken: rewards, bootstrapped where the steps end or are cut.

    G_t = r_t + discount_t * [ (1 - lambda) v_t + lambda G_{t+1} ],    and v_t alone after the last step and at a cut

v_t is the value of where step t led to. With lambda = 0 the targets look one step ahead; with lambda = 1 they look to
the end of the sequence or to the next cut. The targets minus the values of the states before the steps are the
generalised advantages of Schulman et al. (2016).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def lambda_returns(
    reward: Float[Array, " T"],
    discount: Float[Array, " T"],
    next_value: Float[Array, " T"],
    cut: Bool[Array, " T"],
    decay: float,
) -> Float[Array, " T"]:
    """The targets of T steps in order of time.

    discount: gamma, or 0 where the environment terminated. A limit does not make it 0.
    next_value: of the state that the step led to, before any restart.
    cut: where the next step does not continue this one, as at a limit, or should not count, as after an option's end.
    decay: lambda.
    """

    def step(ahead: Array, now: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
        reward, discount, value, cut = now
        ahead = reward + discount * jnp.where(cut, value, (1 - decay) * value + decay * ahead)
        return ahead, ahead

    return jax.lax.scan(step, next_value[-1], (reward, discount, next_value, cut), reverse=True)[1]
