"""A hierarchy of machines in an environment, exactly: the joint process of Parr and Russell (1997).

A joint state is a state of the environment together with a configuration of the machines, which is a whole call stack.
Kept are those where the configuration is a choice or an action; calls, returns and branches take no time and are
resolved beforehand. The best policy over the choices is the hierarchically optimal one: no policy that the machines
allow is better, but the optimal policy of the environment may be (their theorem 1).

    Q(w, u) = V(w')                                          u leads from choice w to w' in no time
    V(w) = max over the edges u that may be taken of Q(w, u) w is a choice
    V(w) = sum over w' of P(w' | w) [ r(w, w') + gamma V(w') ]   w is an action

Time is discounted by primitive steps alone, however many choices lie between them. The episode ends where the
environment says so, wherever the machines are, and where the root stops.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from lodestone.envs.base import Environment
from lodestone.errors import LodestoneError
from lodestone.machines.configurations import END, Configurations
from lodestone.machines.machine import Hierarchy
from lodestone.planning.landing import Machines, choices_of, land, machines_over, numbers_of, reach
from lodestone.planning.solve import (
    check_discount,
    factorise,
    iterate_values,
    optimal_choices,
    solve_chain,
)
from lodestone.planning.tables import Tables, state_text, tabulate


class JointProcess(NamedTuple):
    """J joint states: first N choices, then M actions, and the end of the episode as the last. Each of the two kinds is
    in the order of the search that found them. The arrays are shared and read-only.

    U is the largest number of edges of a choice, or 1; K the number of nature's draws.
    """

    tables: Tables
    """The environment's."""
    configurations: Configurations
    state: Int[np.ndarray, " J"]
    """The environment's state, as numbered in `tables`; -1 for the end."""
    configuration: Int[np.ndarray, " J"]
    """The configuration, as numbered in `configurations`; -1 for the end."""
    edges: Int[np.ndarray, "N U"]
    """Joint state that each edge of a choice leads to; the end where there is no such edge."""
    available: Bool[np.ndarray, "N U"]
    """Which edges may be taken."""
    names: tuple[str, ...]
    """The different names of edges, in order of first appearance."""
    name: Int[np.ndarray, "N U"]
    """The name of each edge, as a position in `names`; 0 where there is no such edge."""
    actions: Int[np.ndarray, " M"]
    """The primitive action that each of the M actions takes."""
    successors: Int[np.ndarray, "M K"]
    """Joint state that each of nature's draws leads to; the end where the episode is over."""
    probs: Float[np.ndarray, "M K"]
    """Probability of each draw, float64; sums to 1 over K."""
    rewards: Float[np.ndarray, "M K"]
    """Reward of the step, float64."""
    initial_probs: Float[np.ndarray, " J"]
    """Probability that an episode begins in each joint state, float64; sums to 1."""

    @property
    def num_states(self) -> int:
        """J."""
        return len(self.state)

    @property
    def num_choices(self) -> int:
        """N."""
        return len(self.edges)

    @property
    def end(self) -> int:
        """Number of the end of the episode."""
        return self.num_states - 1

    def text(self, number: int) -> str:
        """A joint state for a person to read."""
        if number == self.end:
            return "the end of the episode"
        configuration = self.configurations.text(int(self.configuration[number]))
        return f"{configuration} where {state_text(self.tables.space, int(self.state[number]))}"

    def initial_mean(self, values: Float[np.ndarray, " J"]) -> float:
        """Mean of `values` over the joint states where episodes begin; an infinite value elsewhere does no harm."""
        begins = self.initial_probs > 0
        return float(self.initial_probs[begins] @ values[begins])


class JointSolution(NamedTuple):
    """Hierarchically optimal values."""

    values: Float[np.ndarray, " J"]
    """V_H: best expected discounted return of each joint state; 0 at the end."""
    choice_values: Float[np.ndarray, "N U"]
    """Q_H: the same after taking an edge; -inf where it may not be taken or, without a discount, where after it no
    policy surely ends the episode."""
    sweeps: int
    """Sweeps over all joint states until the values stood still."""


class HierarchicalOptimum(NamedTuple):
    """What the best policy that the machines allow reaches. Means are over the joint states where episodes begin."""

    joint_states: int
    """Reachable joint states, the end left out."""
    choice_states: int
    """Choices among them."""
    optimal_steps: float
    """Fewest expected primitive steps of a policy with the optimal return; inf where no policy surely ends."""
    optimal_choices: float
    """Fewest expected choices of a policy with so many steps."""
    optimal_return: float
    """Return of the best policy without a discount; -inf where no policy surely ends."""
    discounted_value: float
    """Discounted return of the policy that is best under `discount`."""
    discount: float


def joint_process(environment: Environment, hierarchy: Hierarchy) -> JointProcess:
    """The machines in the environment; remembered for the last few.

    Memory: 4 bytes a state of the environment and configuration while it is built, then 9 U bytes a choice and 20 K
    bytes an action.
    Raises `InvalidMachine` as `lodestone.machines.configurations.check` does, and where, in a state that can be
    reached, a branch has no edge for what its predicate answers or no edge of a choice may be taken. Raises
    `TooManyStates`.
    """
    return _joint_process(environment, hierarchy)


def joint_values(
    process: JointProcess, discount: float, tolerance: float = 1e-9, allowed: Bool[np.ndarray, "N U"] | None = None
) -> JointSolution:
    """Hierarchically optimal values, at most `tolerance` off if there is a discount (without one, sweeps that change
    less end it).

    `allowed` restricts the edges further (default: all that may be taken). With a discount of 1, joint states from
    which no policy surely ends the episode are worth -inf.
    Raises `InvalidConfig` for a discount outside [0, 1], and `LodestoneError` where the discount is 1 and a cycle has a
    gain.
    """
    step_rewards = np.einsum("mk,mk->m", process.probs, process.rewards)
    return _solve(process, discount, tolerance, allowed, step_rewards, choice_reward=0.0)


def fewest_steps(process: JointProcess, allowed: Bool[np.ndarray, "N U"]) -> JointSolution:
    """Values that are minus the fewest expected primitive steps until the episode ends, with these edges."""
    return _solve(process, 1.0, 1e-9, allowed, np.full(len(process.actions), -1.0), choice_reward=0.0)


def fewest_choices(process: JointProcess, allowed: Bool[np.ndarray, "N U"]) -> JointSolution:
    """Values that are minus the fewest expected choices until the episode ends, with these edges."""
    return _solve(process, 1.0, 1e-9, allowed, np.zeros(len(process.actions)), choice_reward=-1.0)


def evaluate_choices(
    process: JointProcess, policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"], discount: float
) -> Float[np.ndarray, " J"]:
    """Expected discounted return [J] of a policy over choices, given as one edge a choice or as probabilities: one
    linear solve.

    With a discount of 1, joint states from which the policy may go on for ever are worth -inf.
    Raises `InvalidConfig` for a discount outside [0, 1], and `LodestoneError` where the policy takes an edge that may
    not be taken.
    """
    step_rewards = np.einsum("mk,mk->m", process.probs, process.rewards)
    return _evaluate(process, policy, discount, step_rewards, choice_reward=0.0)


def expected_joint_steps(
    process: JointProcess, policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"]
) -> Float[np.ndarray, " J"]:
    """Expected primitive steps [J] of a policy until the episode ends; inf where it may go on for ever."""
    return 0.0 - _evaluate(process, policy, 1.0, np.full(len(process.actions), -1.0), choice_reward=0.0)


def expected_choices(
    process: JointProcess, policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"]
) -> Float[np.ndarray, " J"]:
    """Expected choices [J] of a policy until the episode ends; inf where it may go on for ever."""
    return 0.0 - _evaluate(process, policy, 1.0, np.zeros(len(process.actions)), choice_reward=-1.0)


def expected_visits(
    process: JointProcess, policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"]
) -> Float[np.ndarray, "N U"]:
    """How often a policy takes each edge in an episode, expected.

    Raises `LodestoneError` where it may go on for ever, and where it takes an edge that may not be taken.
    """
    steps_left = expected_joint_steps(process, policy)
    if not np.isfinite(process.initial_mean(steps_left)):
        raise LodestoneError("The policy may go on for ever, so it takes some edges without end.")
    weights, steps = _chain(process, policy, 1.0)
    # What is not reached may go on for ever, and is left out; nothing follows the end.
    followed = np.isfinite(steps_left) & (np.arange(process.num_states) != process.end)
    going_on = sparse.diags_array(followed.astype(np.float64)) @ steps
    visits = factorise(going_on).solve(process.initial_probs, "T")
    return visits[: process.num_choices, None] * weights


def hierarchical_optimum(environment: Environment, hierarchy: Hierarchy, discount: float = 0.99) -> HierarchicalOptimum:
    """The exact answer for machines in an environment. Raises what `joint_process` and `joint_values` raise."""
    process = joint_process(environment, hierarchy)
    best = joint_values(process, 1.0)
    optimal = optimal_choices(best.choice_values)
    quickest = fewest_steps(process, optimal)
    fewest = fewest_choices(process, optimal & optimal_choices(quickest.choice_values))
    return HierarchicalOptimum(
        joint_states=process.num_states - 1,
        choice_states=process.num_choices,
        optimal_steps=-process.initial_mean(quickest.values),
        optimal_choices=-process.initial_mean(fewest.values),
        optimal_return=process.initial_mean(best.values),
        discounted_value=process.initial_mean(joint_values(process, discount).values),
        discount=discount,
    )


# ------------------------------------------------------------------------------------------------------------ building


@lru_cache(maxsize=4)
def _joint_process(environment: Environment, hierarchy: Hierarchy) -> JointProcess:
    tables = tabulate(environment)
    machines = machines_over(environment, hierarchy, tables.space, tables.terminal)
    begins = np.flatnonzero(tables.initial_probs)
    begins_at = land(machines, begins, np.zeros_like(begins))
    pair = reach(machines, begins_at, partial(_after_action, machines, tables))

    state, configuration = np.divmod(pair, machines.configurations.size)
    size, num_choices = len(pair), int(machines.is_choice[configuration].sum())
    choosing, acting = slice(0, num_choices), slice(num_choices, size)
    number = numbers_of(machines, pair)
    choices = choices_of(machines, state[choosing], configuration[choosing], number)
    actions = machines.action[configuration[acting]]
    process = JointProcess(
        tables=tables,
        configurations=machines.configurations,
        state=np.append(state, -1).astype(np.int32),
        configuration=np.append(configuration, -1).astype(np.int32),
        edges=choices.edges,
        available=choices.available,
        names=choices.names,
        name=choices.name,
        actions=actions.astype(np.int32),
        successors=number[_after_action(machines, tables, state[acting], configuration[acting])],
        probs=tables.probs[state[acting], actions],
        rewards=tables.rewards[state[acting], actions],
        initial_probs=np.bincount(number[begins_at], tables.initial_probs[begins], minlength=size + 1),
    )
    for array in process:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return process


def _after_action(
    machines: Machines, tables: Tables, state: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]
) -> Int[np.ndarray, "B K"]:
    """Pair that each of nature's draws leads to; -1 for the end."""
    action = machines.action[configuration]
    states = tables.successors[state, action]
    following = np.broadcast_to(machines.following[configuration, :1], states.shape)
    # What has no probability is not reached, and is not asked about.
    following = np.where(tables.probs[state, action] > 0, following, END)
    return land(machines, states.ravel(), following.ravel()).reshape(states.shape)


# ------------------------------------------------------------------------------------------------------------- solving


def _solve(
    process: JointProcess,
    discount: float,
    tolerance: float,
    allowed: Bool[np.ndarray, "N U"] | None,
    step_rewards: Float[np.ndarray, " M"],
    choice_reward: float,
) -> JointSolution:
    """Value iteration over all joint states; an action is a state with one choice."""
    check_discount(discount)
    num_choices, end = process.num_choices, process.end
    shape = (process.edges.shape[1], process.num_states)
    matrix = _action_matrix(process)
    edges = np.ascontiguousarray(process.edges.T)

    def backup(values: Float[np.ndarray, " J"]) -> Float[np.ndarray, "U J"]:
        expected = np.zeros(shape)
        expected[:, :num_choices] = values[edges]
        expected[0, num_choices:end] = discount * (matrix @ values)
        return expected

    rewards, may = np.zeros(shape), np.zeros(shape, dtype=bool)
    rewards[:, :num_choices] = choice_reward
    rewards[0, num_choices:end] = step_rewards
    may[:, :num_choices] = process.available.T if allowed is None else (process.available & allowed).T
    may[0, num_choices:] = True
    terminal = np.arange(process.num_states) == end
    # A choice is not discounted: only so many sweeps together surely are, and the last of them may each add its change.
    sharper = tolerance / (process.configurations.choices_in_a_row + 1)
    values, choice_values, sweeps = iterate_values(backup, rewards, may, terminal, discount, sharper)
    return JointSolution(values, np.ascontiguousarray(choice_values[:, :num_choices].T), sweeps)


def _evaluate(
    process: JointProcess,
    policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"],
    discount: float,
    step_rewards: Float[np.ndarray, " M"],
    choice_reward: float,
) -> Float[np.ndarray, " J"]:
    check_discount(discount)
    _, steps = _chain(process, policy, discount)
    going = np.arange(process.num_states) != process.end
    ends = np.asarray(steps @ (~going).astype(np.float64)) > 0
    ends[process.end] = True
    going_on = steps @ sparse.diags_array(going.astype(np.float64))
    going_on.eliminate_zeros()
    rewards = np.concatenate([np.full(process.num_choices, choice_reward), step_rewards, [0.0]])
    return solve_chain(going_on, rewards, ends if discount == 1 else None)


def _chain(
    process: JointProcess, policy: Int[np.ndarray, " N"] | Float[np.ndarray, "N U"], discount: float
) -> tuple[Float[np.ndarray, "N U"], sparse.csr_array]:
    """The policy as probabilities, and what follows each joint state under it, [J, J], discounted where time passes;
    nothing follows the end."""
    num_choices, width = process.edges.shape
    weights = np.eye(width)[policy] if policy.ndim == 1 else policy.astype(np.float64)
    if (weights[~process.available] > 0).any():
        raise LodestoneError("The policy takes an edge of a choice where it may not be taken.")
    starts = np.arange(num_choices + 1) * width
    choosing = sparse.csr_array((weights.ravel(), process.edges.ravel(), starts), (num_choices, process.num_states))
    last = sparse.csr_array((1, process.num_states))
    steps = sparse.vstack([choosing, discount * _action_matrix(process), last], format="csr")
    steps.sum_duplicates()
    return weights, steps


def _action_matrix(process: JointProcess) -> sparse.csr_array:
    """P of the actions, float64 [M, J]."""
    count, draws = process.successors.shape
    starts = np.arange(count + 1) * draws
    return sparse.csr_array((process.probs.ravel(), process.successors.ravel(), starts), (count, process.num_states))
