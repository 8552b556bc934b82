"""Optimal values and the value of a policy, computed from tables.

With a discount of 1, a state is worth something only if the episode can be made to end surely, with probability 1.
Everything else is worth -inf, as if each step that never ends cost something: the stochastic shortest path problem of
Bertsekas and Tsitsiklis (1991), whose assumption is that going on for ever never pays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from lodestone.envs.base import Environment
from lodestone.errors import InvalidConfig, Unbounded
from lodestone.planning.tables import Tables, tabulate

MAX_UNDISCOUNTED_SWEEPS = 100_000
"""Where value iteration without a discount gives up; with one, it always converges."""

CHOICE_TOLERANCE = 1e-6
"""Values closer than this are a tie: above what float32 rewards and value iteration leave open."""


class Solution(NamedTuple):
    """Optimal values."""

    values: Float[np.ndarray, " S"]
    """V*: expected discounted return of each state; 0 where terminal."""
    action_values: Float[np.ndarray, "S A"]
    """Q*: the same after a first action; -inf where that action is not allowed or, without a discount, where after it
    no policy surely ends the episode."""
    sweeps: int
    """Sweeps over all states until the values stood still."""


class Optimum(NamedTuple):
    """What the best policy reaches: the yardstick that learners are held against.

    Means are over the states where episodes begin.
    """

    states: int
    """Reachable states, terminal ones included."""
    goals: int
    """Terminal states among them."""
    optimal_steps: float
    """Fewest expected primitive steps of a policy with the optimal return; inf where no policy surely ends, NaN where
    the optimal return is +inf, because no policy reaches it."""
    optimal_return: float
    """Return of the best policy without a discount; -inf where no policy surely ends, +inf where a cycle of states that
    can be reached pays, so that longer is always better."""
    discounted_value: float
    """Discounted return of the policy that is best under `discount`."""
    discount: float


def value_iteration(
    tables: Tables, discount: float, tolerance: float = 1e-9, allowed: Bool[np.ndarray, "S A"] | None = None
) -> Solution:
    """Optimal values, at most `tolerance` off if there is a discount (without one, sweeps that change less end it).

    `allowed` restricts the actions (default: all). With a discount of 1, states from which no policy ends the episode
    with probability 1 are worth -inf.
    Raises `InvalidConfig` for a discount outside [0, 1], and `Unbounded` where the discount is 1 and a state is
    worth +inf, because a cycle has a gain.
    """
    check_discount(discount)
    matrix, shape = tables.matrix(), (tables.num_actions, tables.num_states)

    def backup(values: Float[np.ndarray, " S"]) -> Float[np.ndarray, "A S"]:
        expected = (matrix @ values).reshape(shape)
        expected *= discount
        return expected

    rewards = np.ascontiguousarray(tables.mean_rewards().T)
    allowed = np.ones(shape, dtype=bool) if allowed is None else np.ascontiguousarray(allowed.T)
    values, action_values, sweeps = iterate_values(backup, rewards, allowed, tables.terminal, discount, tolerance)
    return Solution(values, action_values.T, sweeps)


def optimal_choices(
    choice_values: Float[np.ndarray, "S N"], tolerance: float = CHOICE_TOLERANCE
) -> Bool[np.ndarray, "S N"]:
    """The actions, or options, whose value is within `tolerance` of their state's best; none where all are -inf."""
    best = choice_values.max(axis=1, keepdims=True)
    return (choice_values >= best - tolerance) & (choice_values > -np.inf)


def greedy_choices(
    choice_values: Float[np.ndarray, "S N"], tolerance: float = CHOICE_TOLERANCE
) -> Int[np.ndarray, " S"]:
    """The first best action, or option, of each state; 0 where all are -inf.

    Without a discount, a policy that is greedy may still run in a cycle that costs nothing: value iteration with a
    reward of -1 and `allowed=optimal_choices(...)` finds one that ends.
    """
    return optimal_choices(choice_values, tolerance).argmax(axis=1)


def evaluate_policy(
    tables: Tables, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"], discount: float
) -> Float[np.ndarray, " S"]:
    """Expected discounted return [S] of a policy, given as one action a state or as probabilities: one linear solve.

    With a discount of 1, states from which the policy may go on for ever are worth -inf.
    Raises `InvalidConfig` for a discount outside [0, 1].
    """
    check_discount(discount)
    matrix = tables.policy_matrix(policy)
    ends = matrix @ tables.terminal > 0
    going_on = matrix @ sparse.diags_array(1.0 - tables.terminal)
    return solve_chain(discount * going_on, tables.policy_rewards(policy), ends if discount == 1 else None)


def expected_steps(tables: Tables, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"]) -> Float[np.ndarray, " S"]:
    """Expected primitive steps [S] until the episode ends; inf where the policy may go on for ever."""
    return 0.0 - evaluate_policy(tables.with_step_reward(-1.0), policy, discount=1.0)


def optimum(environment: Environment, discount: float = 0.99) -> Optimum:
    """The exact answer for an environment. Raises `TooManyStates`, and what `value_iteration` does under `discount`."""
    tables = tabulate(environment)
    try:
        best = value_iteration(tables, discount=1.0)
    except Unbounded:
        optimal_return, optimal_steps = np.inf, np.nan
    else:
        allowed = optimal_choices(best.action_values)
        quickest = value_iteration(tables.with_step_reward(-1.0), discount=1.0, allowed=allowed)
        optimal_return, optimal_steps = tables.initial_mean(best.values), -tables.initial_mean(quickest.values)
    return Optimum(
        states=tables.num_states,
        goals=int(tables.terminal.sum()),
        optimal_steps=optimal_steps,
        optimal_return=optimal_return,
        discounted_value=tables.initial_mean(value_iteration(tables, discount).values),
        discount=discount,
    )


def iterate_values(
    backup: Callable[[Float[np.ndarray, " S"]], Float[np.ndarray, "N S"]],
    rewards: Float[np.ndarray, "N S"],
    allowed: Bool[np.ndarray, "N S"],
    terminal: Bool[np.ndarray, " S"],
    discount: float,
    tolerance: float,
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "N S"], int]:
    """Sweep V(s) <- max over the allowed n of rewards(n, s) + backup(V)(n, s) until it stands still.

    Returns V [S], Q [N, S] and the number of sweeps. `backup` is the expectation of V where choice n leads to, times
    the discount of the time it takes, in a fresh array. It serves actions and options alike. The N choices come first
    because a maximum over the first axis runs over whole columns of memory.
    """
    live = ~terminal
    if discount == 1:
        inside, allowed = surely_ending(backup, allowed, terminal)
        live &= inside
    every_choice = bool(allowed.all())
    threshold = tolerance * (1 - discount) if discount < 1 else tolerance

    values, sweeps, change = np.zeros(len(terminal)), 0, np.inf
    # The second bound is what rounding leaves of values as large as these.
    while change > max(threshold, 4e-16 * np.abs(values).max()):
        if discount == 1 and sweeps == MAX_UNDISCOUNTED_SWEEPS:
            raise Unbounded(
                f"Values did not settle in {MAX_UNDISCOUNTED_SWEEPS:,} sweeps without a discount: some cycle of states "
                "pays, so the optimum is not finite. Use a discount below 1."
            )
        choice_values = backup(values)
        choice_values += rewards
        if not every_choice:
            choice_values[~allowed] = -np.inf
        updated = np.where(live, choice_values.max(axis=0), 0.0)
        values, sweeps, change = updated, sweeps + 1, np.abs(updated - values).max()
    values[~(live | terminal)] = -np.inf
    return values, choice_values, sweeps


def surely_ending(
    backup: Callable[[Float[np.ndarray, " S"]], Float[np.ndarray, "N S"]],
    allowed: Bool[np.ndarray, "N S"],
    terminal: Bool[np.ndarray, " S"],
) -> tuple[Bool[np.ndarray, " S"], Bool[np.ndarray, "N S"]]:
    """The states from which some policy ends the episode with probability 1, and the choices that stay among them.

    The fixed point of Baier and Katoen (2008, algorithm 45): drop the states that cannot get to the end, and the
    choices that risk a dropped state, until none is left to drop.
    """
    inside = np.ones(len(terminal), dtype=bool)
    while True:
        safe = allowed & ~(backup(1.0 - inside) > 0)

        def before(reached: Bool[np.ndarray, " S"], safe: Bool[np.ndarray, "N S"] = safe) -> Bool[np.ndarray, " S"]:
            return np.logical_or.reduce(safe & (backup(reached.astype(np.float64)) > 0), axis=0)

        reached = _closure(terminal, before)
        if np.array_equal(reached, inside):
            return inside, safe
        inside = reached


def ends_surely(going_on: sparse.csr_array, ends: Bool[np.ndarray, " S"]) -> Bool[np.ndarray, " S"]:
    """From which states of a chain the end comes with probability 1.

    `going_on` [S, S] holds the probabilities of a step that is not the last; `ends` tells where one may be the last.
    """

    def before(reached: Bool[np.ndarray, " S"]) -> Bool[np.ndarray, " S"]:
        return np.asarray(going_on @ reached) > 0

    return ~_closure(~_closure(ends, before), before)


def solve_chain(
    going_on: sparse.csr_array, rewards: Float[np.ndarray, " S"], ends: Bool[np.ndarray, " S"] | None
) -> Float[np.ndarray, " S"]:
    """V = rewards + going_on V, where `going_on` [S, S] holds discounted probabilities of a step that is not the last.

    Where the chain is not discounted, `ends` tells from where a step may be the last; states from which the chain may
    never end are worth -inf.
    """
    if ends is None:
        return factorise(going_on).solve(rewards)
    sure = ends_surely(going_on, ends)
    # A state that surely ends is followed by such states only, so the others can be left out.
    values = factorise(sparse.diags_array(sure.astype(np.float64)) @ going_on).solve(np.where(sure, rewards, 0.0))
    return np.where(sure, values, -np.inf)


def factorise(going_on: sparse.csr_array) -> SuperLU:
    """LU factors of I - going_on [S, S], for a chain that ends or is discounted.

    Pivots stay on the diagonal. That is stable, as the matrix is diagonally dominant, and then no step of the
    elimination subtracts two numbers of one sign off the diagonal: solutions for right sides >= 0 are >= 0, and exactly
    0 where nothing leads to what is not 0.
    """
    matrix = sparse.eye_array(going_on.shape[0]) - going_on
    return splu(matrix.tocsc(), permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def check_discount(discount: float) -> None:
    """Raise `InvalidConfig` unless `discount` is in [0, 1]."""
    if not 0.0 <= discount <= 1.0:
        raise InvalidConfig(f"discount is {discount}, but must be from 0 to 1.")


def _closure(
    seed: Bool[np.ndarray, " S"], before: Callable[[Bool[np.ndarray, " S"]], Bool[np.ndarray, " S"]]
) -> Bool[np.ndarray, " S"]:
    """`seed` and all states that lead into it; `before` gives those that may do so in one step."""
    while True:
        grown = seed | before(seed)
        if np.array_equal(grown, seed):
            return seed
        seed = grown
