"""Options that are made of parameters: their exact values and gradients (Bacon, Harb and Precup 2017, theorems 1, 2).

    pi_o(a|s) = softmax over a of theta(s, o, a) / temperature          beta_o(s) = sigmoid(vartheta(s, o))

Options may start anywhere, run at least one step, and follow a fixed policy over options mu(o|s):

    Q_U(s, o, a) = r(s, a) + gamma sum_x P(x|s, a) U(x, o)              Q(s, o) = sum_a pi_o(a|s) Q_U(s, o, a)
    U(x, o) = (1 - beta_o(x)) Q(x, o) + beta_o(x) V(x)                  V(s) = sum_o mu(o|s) Q(s, o)

Nothing follows a terminal state. From these the two gradients are sums over discounted occupancies, `running` of pairs
(s, o) where o acts in s, `arriving` of pairs where o has arrived in s and has not been asked yet whether it stops:

    d Q / d theta(s, o)    = running(s, o) sum_a d pi_o(a|s) / d theta(s, o) Q_U(s, o, a)
    d U / d vartheta(s, o) = -arriving(s, o) beta_o'(s) (Q(s, o) - V(s))
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import SuperLU
from scipy.special import expit, softmax

from lodestone.errors import InvalidConfig
from lodestone.planning.solve import factorise
from lodestone.planning.tables import Tables


class OptionParameters(NamedTuple):
    """What O options over S states and A actions are made of."""

    preferences: Float[np.ndarray, "S O A"]
    """theta."""
    exits: Float[np.ndarray, "S O"]
    """vartheta."""
    temperature: float = 1.0

    @property
    def policies(self) -> Float[np.ndarray, "S O A"]:
        """pi, in float64."""
        return softmax(np.asarray(self.preferences, dtype=np.float64) / self.temperature, axis=2)

    @property
    def terminations(self) -> Float[np.ndarray, "S O"]:
        """beta, in float64."""
        return expit(np.asarray(self.exits, dtype=np.float64))


class OptionValues(NamedTuple):
    """What the options are worth under a policy over them; 0 where terminal."""

    by_action: Float[np.ndarray, "S O A"]
    """Q_U, of an option and its next action."""
    by_option: Float[np.ndarray, "S O"]
    """Q."""
    values: Float[np.ndarray, " S"]
    """V."""


class SoftOptionProcess(NamedTuple):
    """Options and a policy over them in a process; one factorisation serves all questions."""

    tables: Tables
    parameters: OptionParameters
    policy: Float[np.ndarray, "S O"]
    """mu."""
    discount: float
    steps: tuple[sparse.csr_array, ...]
    """Of each option, the probabilities of a step between states that are not terminal."""
    factors: SuperLU
    """Of the chain from pairs where an option acts to those where it, or the next one, acts; option by option."""

    def values(self) -> OptionValues:
        """Q_U, Q and V."""
        size, count = self.parameters.terminations.shape
        rewards = [self.tables.policy_rewards(self.parameters.policies[:, option]) for option in range(count)]
        by_option = self.factors.solve(np.concatenate(rewards)).reshape(count, size).T
        values = (self.policy * by_option).sum(axis=1)
        arriving = (1.0 - self.parameters.terminations) * by_option + self.parameters.terminations * values[:, None]
        following = (self.tables.matrix() @ arriving).reshape(-1, size, count).transpose(1, 2, 0)
        by_action = self.tables.mean_rewards()[:, None, :] + self.discount * following
        return OptionValues(by_action, by_option, values)

    def running(self, starts: Float[np.ndarray, "S O"]) -> Float[np.ndarray, "S O"]:
        """Discounted time that each option acts in each state, if options begin with these weights."""
        live = np.where(self.tables.terminal[:, None], 0.0, starts)
        return self.factors.solve(live.T.ravel(), trans="T").reshape(live.T.shape).T

    def after_a_step(self, running: Float[np.ndarray, "S O"]) -> Float[np.ndarray, "S O"]:
        """Where options that act with these weights have arrived, discounted; nothing where the episode is over."""
        columns = [step.T @ running[:, option] for option, step in enumerate(self.steps)]
        return self.discount * np.stack(columns, axis=1)

    def arriving(self, arrivals: Float[np.ndarray, "S O"]) -> Float[np.ndarray, "S O"]:
        """Discounted arrivals of each option in each state, if the first ones have these weights."""
        stopped = (self.parameters.terminations * arrivals).sum(axis=1, keepdims=True)
        starts = (1.0 - self.parameters.terminations) * arrivals + self.policy * stopped
        return arrivals + self.after_a_step(self.running(starts))

    def policy_gradient(self, starts: Float[np.ndarray, "S O"]) -> Float[np.ndarray, "S O A"]:
        """Of the sum of `starts` Q, by theta (theorem 1)."""
        by_action, by_option, _ = self.values()
        advantages = self.parameters.policies * (by_action - by_option[:, :, None])
        return self.running(starts)[:, :, None] * advantages / self.parameters.temperature

    def termination_gradient(self, arrivals: Float[np.ndarray, "S O"]) -> Float[np.ndarray, "S O"]:
        """Of the sum of `arrivals` U, by vartheta (theorem 2). That of the sum of `starts` Q is
        `termination_gradient(after_a_step(starts))`."""
        _, by_option, values = self.values()
        slope = self.parameters.terminations * (1.0 - self.parameters.terminations)
        return -self.arriving(arrivals) * slope * (by_option - values[:, None])


def soft_option_process(
    tables: Tables, parameters: OptionParameters, policy: Float[np.ndarray, "S O"], discount: float
) -> SoftOptionProcess:
    """The options in the process. Raises `InvalidConfig` for a discount outside [0, 1)."""
    if not 0.0 <= discount < 1.0:
        raise InvalidConfig(f"discount is {discount}, but must be from 0 to below 1 for these sums to exist.")
    live, stops = sparse.diags_array(1.0 - tables.terminal), parameters.terminations
    acts = parameters.policies.swapaxes(0, 1)
    steps = tuple(live @ tables.policy_matrix(probs) @ live for probs in acts)
    options, blocks = range(len(steps)), []
    for option in options:
        stop = stops[:, option]
        onto = [stop * policy[:, other] + (other == option) * (1.0 - stop) for other in options]
        blocks.append([discount * steps[option] @ sparse.diags_array(share) for share in onto])
    factors = factorise(sparse.block_array(blocks, format="csr"))
    return SoftOptionProcess(tables, parameters, policy, discount, steps, factors)
