"""Exact models of options, and planning with them (Sutton, Precup and Singh 1999, sections 2 and 3).

For option o with policy matrix P_o, step reward r_o and termination probabilities B_o = diag(beta_o) on arrival,

    R_o = r_o + gamma P_o (I - B_o) R_o                       reward until it stops, discounted
    F_o = gamma P_o B_o + gamma P_o (I - B_o) F_o             F_o(s, x) = sum_k gamma^k Pr(it stops in x after k steps)
    Q(s, o) = R_o(s) + sum_x F_o(s, x) V(x)                   V(x) = max of Q(x, o) over the options available in x

Three rules: an option runs at least one step; a terminal state stops every option and is worth 0; an option with a cap
of n steps (`max_steps`) stops on arrival after the n-th.

The model of an option is defined in every state, also where it may not start; only the maximum looks at initiation.
Where time is not discounted and an option may go on for ever without reaching a state where it stops, its reward is
-inf, which is the rule of `lodestone.planning.solve` for policies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import sparse

from lodestone.envs.state_space import StateSpace
from lodestone.errors import LodestoneError, NoOptionAvailable
from lodestone.options.base import NO_CAP, Options
from lodestone.planning.solve import check_discount, ends_surely, factorise, iterate_values, solve_chain
from lodestone.planning.tables import Tables, normalised, state_batches, state_text
from lodestone.types import State


class OptionTables(NamedTuple):
    """A set of O options over S numbered states."""

    names: tuple[str, ...]
    initiation: Bool[np.ndarray, "O S"]
    """Where each option may start."""
    action_probs: Float[np.ndarray, "O S A"]
    """Each option's policy, float32 as the options give it; sums to 1 over A."""
    termination: Float[np.ndarray, "O S"]
    """Probability that each option stops on arrival, float32."""
    max_steps: tuple[int, ...]
    """The step after which each option is stopped; `NO_CAP` for never."""

    @property
    def size(self) -> int:
        """O."""
        return len(self.names)


class OptionModel(NamedTuple):
    """What running one option brings."""

    rewards: Float[np.ndarray, " S"]
    """R_o, less the cost of the call; -inf where time is not discounted and the option may never stop."""
    backup: Callable[[Float[np.ndarray, " S *N"]], Float[np.ndarray, " S *N"]]
    """v -> F_o v, for a v [S] or several, [S, N]; `backup(np.eye(S))` is the matrix F_o. Nowhere negative if v is not,
    and exactly 0 where the option cannot stop in a state whose v is not 0."""


class OptionSolution(NamedTuple):
    """Optimal values of the semi-Markov decision process whose actions are options."""

    values: Float[np.ndarray, " S"]
    """V*_O: best expected discounted return of each state; 0 where terminal."""
    option_values: Float[np.ndarray, "S O"]
    """Q*_O: the same after a first option; -inf where it is not available or, without a discount, where after it no
    policy over options surely ends the episode."""
    sweeps: int
    """Sweeps over all states until the values stood still."""


def tabulate_options(options: Options, space: StateSpace) -> OptionTables:
    """What the options are in each state of `space`. Memory: 4 A + 5 bytes a state and option."""
    batches = []
    for rows, states in state_batches(space):
        initiation, action_probs, termination = jax.device_get(_ask(options, states))
        count = rows.stop - rows.start
        batches.append((initiation[:, :count], action_probs[:, :count], termination[:, :count]))
    return OptionTables(
        names=options.names,
        initiation=np.concatenate([initiation for initiation, _, _ in batches], axis=1),
        action_probs=np.concatenate([action_probs for _, action_probs, _ in batches], axis=1),
        termination=np.concatenate([termination for _, _, termination in batches], axis=1),
        max_steps=options.max_steps,
    )


def check_available(tables: Tables, options: OptionTables) -> None:
    """Raise `NoOptionAvailable` if the episode can get to a state where it goes on and no option may start."""
    stuck = ~tables.terminal & ~options.initiation.any(axis=0)
    if stuck.any():
        raise NoOptionAvailable(
            f"No option may start in {stuck.sum():,} of {tables.num_states:,} reachable states, the first of which is "
            f"{state_text(tables.space, int(stuck.argmax()))}; add primitive actions or widen an option's initiation."
        )


def option_models(
    tables: Tables,
    options: OptionTables,
    discount: float,
    *,
    undiscounted_option_reward: bool = False,
    call_cost: float = 0.0,
) -> tuple[OptionModel, ...]:
    """Exact models of all options. An option without a cap costs one sparse factorisation, or two where its rewards
    are summed undiscounted.

    Two switches reproduce what others do: `undiscounted_option_reward` sums the rewards inside an option without a
    discount (only gamma^k in F_o remains), and `call_cost` is taken from the reward once per call of an option that is
    not a single primitive step (`max_steps` other than 1).
    Raises `InvalidConfig` for a discount outside [0, 1], and `LodestoneError` where rewards inside options are summed
    without a discount although the values have one, and an option may start where it may never stop.
    """
    check_discount(discount)
    reward_discount = 1.0 if undiscounted_option_reward else discount
    models = []
    for option, name in enumerate(options.names):
        cap = options.max_steps[option]
        matrix, stops, going_on = _chain(tables, options, option)
        step_rewards = tables.policy_rewards(_policy(options, option))
        if cap == NO_CAP:
            ends = matrix @ stops > 0
            rewards = solve_chain(reward_discount * going_on, step_rewards, ends if reward_discount == 1 else None)
            never_stops = options.initiation[option] & ~tables.terminal & (rewards == -np.inf)
            if discount < 1 and never_stops.any():
                raise LodestoneError(
                    f"The undiscounted reward of option {name!r} is not finite: it may start, and never stop, in "
                    f"{state_text(tables.space, int(never_stops.argmax()))}. Give it a cap on its steps."
                )
            backup = _uncapped_backup(matrix @ sparse.diags_array(stops), going_on, discount)
        else:
            rewards = np.zeros(tables.num_states)
            for _ in range(cap):
                rewards = step_rewards + reward_discount * (going_on @ rewards)
            backup = _capped_backup(matrix, stops, going_on, discount, cap)
        if cap != 1:
            rewards = rewards - call_cost * ~tables.terminal
        models.append(OptionModel(rewards, backup))
    return tuple(models)


def option_value_iteration(
    tables: Tables,
    options: OptionTables,
    discount: float,
    *,
    undiscounted_option_reward: bool = False,
    call_cost: float = 0.0,
    tolerance: float = 1e-9,
    allowed: Bool[np.ndarray, "S O"] | None = None,
) -> OptionSolution:
    """Semi-Markov value iteration: optimal values over the available options, at most `tolerance` off if there is a
    discount.

    `allowed` restricts the options further (default: all that may start). The two switches are those of
    `option_models`, which also says what is raised; besides, raises `NoOptionAvailable`, and `LodestoneError` where the
    discount is 1 and a cycle has a gain.
    """
    check_available(tables, options)
    models = option_models(
        tables, options, discount, undiscounted_option_reward=undiscounted_option_reward, call_cost=call_cost
    )
    rewards = np.stack([model.rewards for model in models])
    return _iterate(tables, options, models, rewards, discount, tolerance, allowed)


def fewest_decisions(
    tables: Tables, options: OptionTables, allowed: Bool[np.ndarray, "S O"] | None = None
) -> OptionSolution:
    """Fewest expected decisions until the episode ends: values are minus the number of calls, -inf where there is no
    sure end. `allowed` restricts the options, for instance to the optimal ones."""
    check_available(tables, options)
    models = option_models(tables, options, discount=1.0)
    stops = np.isfinite(np.stack([model.rewards for model in models]))
    rewards = np.where(stops, np.where(tables.terminal, 0.0, -1.0), -np.inf)
    return _iterate(tables, options, models, rewards, 1.0, 1e-9, allowed)


def evaluate_options(
    tables: Tables,
    options: OptionTables,
    policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S O"],
    discount: float,
    *,
    undiscounted_option_reward: bool = False,
    call_cost: float = 0.0,
) -> Float[np.ndarray, " S"]:
    """Expected discounted return [S] of a policy over options, given as one option a state or as probabilities.

    One linear solve over (state, running option). With a discount of 1, states from which the episode may go on for
    ever are worth -inf. The switches, and what is raised, are those of `option_models`; besides, raises
    `LodestoneError` where the policy takes an option that may not start.
    """
    models = option_models(
        tables, options, discount, undiscounted_option_reward=undiscounted_option_reward, call_cost=call_cost
    )
    rewards = np.stack([model.rewards for model in models], axis=1)
    return _evaluate(tables, options, policy, rewards, discount)


def evaluate_option_choices(
    tables: Tables,
    options: OptionTables,
    policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S O"],
    discount: float,
    *,
    undiscounted_option_reward: bool = False,
    call_cost: float = 0.0,
) -> Float[np.ndarray, "S O"]:
    """Q of a policy over options [S, O]: expected discounted return of running each option first, then the policy.

    As the models, it is defined in every state, also where the option may not start: for an option without a cap it is
    there what going on with it is worth. With a discount of 1 it is -inf where the option may never stop, or may stop
    where the policy may go on for ever. The switches, and what is raised, are those of `evaluate_options`.
    """
    models = option_models(
        tables, options, discount, undiscounted_option_reward=undiscounted_option_reward, call_cost=call_cost
    )
    rewards = np.stack([model.rewards for model in models], axis=1)
    values = _evaluate(tables, options, policy, rewards, discount)
    endless = values == -np.inf
    after = [
        np.where(model.backup(endless.astype(np.float64)) > 0, -np.inf, model.backup(np.where(endless, 0.0, values)))
        for model in models
    ]
    return rewards + np.stack(after, axis=1)


def expected_option_steps(
    tables: Tables, options: OptionTables, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S O"]
) -> Float[np.ndarray, " S"]:
    """Expected primitive steps [S] of a policy over options until the episode ends; inf where it may never end."""
    return 0.0 - evaluate_options(tables.with_step_reward(-1.0), options, policy, discount=1.0)


def expected_decisions(
    tables: Tables, options: OptionTables, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S O"]
) -> Float[np.ndarray, " S"]:
    """Expected decisions [S] of a policy over options until the episode ends; inf where it may never end."""
    rewards = np.full((tables.num_states, options.size), -1.0)
    return 0.0 - _evaluate(tables, options, policy, rewards, discount=1.0)


@jax.jit
def _ask(options: Options, states: State) -> tuple[Array, Array, Array]:
    """Initiation [O, B], action probabilities [O, B, A] and termination [O, B] of a batch of states."""
    return (
        jax.vmap(options.initiation, out_axes=1)(states),
        jax.vmap(options.action_probs, out_axes=1)(states),
        jax.vmap(options.termination, out_axes=1)(states),
    )


def _policy(options: OptionTables, option: int) -> Float[np.ndarray, "S A"]:
    probs = options.action_probs[option].astype(np.float64)
    return normalised(probs, f"The action probabilities of option {options.names[option]!r}")


def _chain(
    tables: Tables, options: OptionTables, option: int
) -> tuple[sparse.csr_array, Float[np.ndarray, " S"], sparse.csr_array]:
    """P_o [S, S], the probability of stopping on arrival [S], and P_o (I - B_o), the steps that are not the last."""
    matrix = tables.policy_matrix(_policy(options, option))
    stops = np.where(tables.terminal, 1.0, options.termination[option].astype(np.float64))
    going_on = matrix @ sparse.diags_array(1.0 - stops)
    going_on.eliminate_zeros()
    return matrix, stops, going_on


def _uncapped_backup(stopping: sparse.csr_array, going_on: sparse.csr_array, discount: float) -> Callable:
    """v -> (I - gamma P (I - B))^-1 gamma P B v."""
    if discount == 1:
        # Where the option may never stop, its reward is -inf already: any F_o will do, and I - P (I - B) is singular.
        sure = ends_surely(going_on, stopping.sum(axis=1) > 0)
        going_on = sparse.diags_array(sure.astype(np.float64)) @ going_on
    factors = factorise(discount * going_on)
    return lambda values: factors.solve(discount * (stopping @ values))


def _capped_backup(
    matrix: sparse.csr_array, stops: Float[np.ndarray, " S"], going_on: sparse.csr_array, discount: float, cap: int
) -> Callable:
    """v -> F v by the steps that are left: the last stops everywhere, each earlier one with probability beta."""
    stopping = matrix @ sparse.diags_array(stops)

    def backup(values: Float[np.ndarray, " S *N"]) -> Float[np.ndarray, " S *N"]:
        stopped = discount * (stopping @ values)
        result = discount * (matrix @ values)
        for _ in range(cap - 1):
            result = stopped + discount * (going_on @ result)
        return result

    return backup


def _iterate(
    tables: Tables,
    options: OptionTables,
    models: tuple[OptionModel, ...],
    rewards: Float[np.ndarray, "O S"],
    discount: float,
    tolerance: float,
    allowed: Bool[np.ndarray, "S O"] | None,
) -> OptionSolution:
    def backup(values: Float[np.ndarray, " S"]) -> Float[np.ndarray, "O S"]:
        return np.stack([model.backup(values) for model in models])

    available = options.initiation & np.isfinite(rewards)
    if allowed is not None:
        available &= allowed.T
    values, option_values, sweeps = iterate_values(backup, rewards, available, tables.terminal, discount, tolerance)
    return OptionSolution(values, option_values.T, sweeps)


def _evaluate(
    tables: Tables,
    options: OptionTables,
    policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S O"],
    rewards: Float[np.ndarray, "S O"],
    discount: float,
) -> Float[np.ndarray, " S"]:
    """Value of a policy over options that is paid `rewards` for each call.

    The chain has a block of S nodes where a decision is due, and for each option that runs on a block of S nodes per
    step that it may have run (one in all if it has no cap). Its matrix is sparse, which that of F_o would not be.
    """
    check_discount(discount)
    size, live = tables.num_states, ~tables.terminal
    choice = np.eye(options.size)[policy] if policy.ndim == 1 else policy.astype(np.float64)
    choice = choice * live[:, None]
    if (choice[~options.initiation.T] > 0).any():
        raise LodestoneError("The policy over options takes an option in a state where it may not start.")

    # The blocks of the matrix by row and column; number 0 is where a decision is due.
    blocks: list[dict[int, sparse.csr_array]] = [{}]
    for option in map(int, np.flatnonzero(choice.any(axis=0))):
        chosen = sparse.diags_array(choice[:, option])
        matrix, stops, going_on = _chain(tables, options, option)
        cap = options.max_steps[option]
        if cap == 1:
            blocks[0][0] = blocks[0].get(0, 0.0 * matrix) + discount * (chosen @ matrix)
            continue
        stopping = discount * (matrix @ sparse.diags_array(stops))
        first = len(blocks)
        blocks[0][first] = chosen
        if cap == NO_CAP:
            blocks.append({0: stopping, first: discount * going_on})
        else:
            blocks += [{0: stopping, block + 1: discount * going_on} for block in range(first, first + cap - 1)]
            blocks.append({0: discount * matrix})
    columns = range(len(blocks))
    blocks[0].setdefault(0, sparse.csr_array((size, size)))
    chain = sparse.block_array([[row.get(column) for column in columns] for row in blocks], format="csr")

    is_terminal = np.zeros(chain.shape[0], dtype=bool)
    is_terminal[:size] = tables.terminal
    ends = is_terminal | (chain @ is_terminal > 0)
    paid = np.zeros(chain.shape[0])
    paid[:size] = np.multiply(choice, rewards, out=np.zeros_like(choice), where=choice > 0).sum(axis=1)
    going_on = chain @ sparse.diags_array(1.0 - is_terminal)
    return solve_chain(going_on, paid, ends if discount == 1 else None)[:size]
