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

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import sparse

from lodestone.envs.base import Environment
from lodestone.errors import InvalidMachine, LodestoneError, TooManyStates
from lodestone.machines.configurations import END, Configurations, check, configurations, takes_time
from lodestone.machines.machine import Action, Branch, Choice, Hierarchy, Predicate, pairs
from lodestone.planning.solve import (
    check_discount,
    factorise,
    iterate_values,
    optimal_choices,
    solve_chain,
)
from lodestone.planning.tables import Tables, state_batches, state_text, tabulate
from lodestone.types import State

MAX_PAIRS = 200_000_000
"""Environment states times configurations, reachable or not: four bytes each while the joint states are found."""


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
        return _pair_text(self.tables, self.configurations, self.state[number], self.configuration[number])

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


class _Machines(NamedTuple):
    """The configurations as arrays: C configurations, F edges at most, P lists of answers."""

    configurations: Configurations
    following: Int[np.ndarray, "C F"]
    """What follows along each edge; `END` also where there is no such edge."""
    passes: Bool[np.ndarray, " C"]
    """Which take no time and leave no choice."""
    is_choice: Bool[np.ndarray, " C"]
    branch: Int[np.ndarray, " C"]
    """The row of `answers` that a branch goes by; -1 for what is none."""
    condition: Int[np.ndarray, "C F"]
    """The row of `answers` that tells whether an edge of a choice may be taken; -1 where it always may, and -2 where
    there is no such edge."""
    answers: Int[np.ndarray, "P S"]
    """In each state of the environment, the edge of a branch, or -1 if it has none; or whether a predicate holds."""


@lru_cache(maxsize=4)
def _joint_process(environment: Environment, hierarchy: Hierarchy) -> JointProcess:
    check(hierarchy, environment)
    tables, found = tabulate(environment), configurations(hierarchy)
    if tables.num_states * found.size > MAX_PAIRS:
        raise TooManyStates(
            f"{tables.num_states:,} states times {found.size:,} configurations are more than {MAX_PAIRS:,}, which is "
            "as many as joint states are looked for among."
        )
    machines = _machines(environment, tables, found)
    action_of = np.array(
        [
            environment.action_names.index(vertex.action) if isinstance(vertex, Action) and takes_time(vertex) else -1
            for vertex in found.vertices
        ]
    )

    begins = np.flatnonzero(tables.initial_probs)
    begins_at = _landing(machines, tables, begins, np.zeros_like(begins))
    known = np.zeros(tables.num_states * found.size, dtype=bool)
    levels: list[Int[np.ndarray, " B"]] = []
    frontier = begins_at
    while True:
        frontier = np.unique(frontier[frontier >= 0])
        frontier = frontier[~known[frontier]]
        if not len(frontier):
            break
        known[frontier] = True
        levels.append(frontier)
        state, configuration = np.divmod(frontier, found.size)
        choosing = machines.is_choice[configuration]
        chosen = _after_choice(machines, tables, state[choosing], configuration[choosing])
        acted = _after_action(machines, tables, action_of, state[~choosing], configuration[~choosing])
        frontier = np.concatenate([chosen.ravel(), acted.ravel()])
    return _assemble(machines, tables, action_of, np.concatenate([*levels, np.zeros(0, np.int64)]), begins, begins_at)


def _assemble(
    machines: _Machines,
    tables: Tables,
    action_of: Int[np.ndarray, " C"],
    pair: Int[np.ndarray, " J-1"],
    begins: Int[np.ndarray, " I"],
    begins_at: Int[np.ndarray, " I"],
) -> JointProcess:
    """The process of the joint states that were found, each given as state * C + configuration."""
    found = machines.configurations
    configuration = pair % found.size
    pair = pair[np.argsort(~machines.is_choice[configuration], kind="stable")]
    state, configuration = np.divmod(pair, found.size)
    size, num_choices = len(pair), int(machines.is_choice[configuration].sum())
    number = np.full(tables.num_states * found.size + 1, size, dtype=np.int32)  # the pair -1, the end, is the last
    number[pair] = np.arange(size)

    choosing, acting = slice(0, num_choices), slice(num_choices, size)
    edges = number[_after_choice(machines, tables, state[choosing], configuration[choosing])]
    conditions = machines.condition[configuration[choosing], : edges.shape[1]]
    held = machines.answers[np.maximum(conditions, 0), state[choosing, None]] > 0
    available = (conditions == -1) | ((conditions >= 0) & held)
    if not available.any(axis=1).all():
        stuck = int(np.argmin(available.any(axis=1)))
        raise InvalidMachine(
            f"No edge may be taken in {_pair_text(tables, found, state[stuck], configuration[stuck])}."
        )

    names = dict.fromkeys(
        name for vertex in found.vertices if isinstance(vertex, Choice) for name, _ in pairs(vertex.edges)
    )
    position = {name: index for index, name in enumerate(names)}
    name_of = np.zeros_like(machines.following)
    for each, vertex in enumerate(found.vertices):
        if isinstance(vertex, Choice):
            name_of[each, : len(vertex.edges)] = [position[name] for name, _ in pairs(vertex.edges)]

    actions = action_of[configuration[acting]]
    process = JointProcess(
        tables=tables,
        configurations=found,
        state=np.append(state, -1).astype(np.int32),
        configuration=np.append(configuration, -1).astype(np.int32),
        edges=edges,
        available=available,
        names=tuple(names),
        name=name_of[configuration[choosing], : edges.shape[1]].astype(np.int32),
        actions=actions.astype(np.int32),
        successors=number[_after_action(machines, tables, action_of, state[acting], configuration[acting])],
        probs=tables.probs[state[acting], actions],
        rewards=tables.rewards[state[acting], actions],
        initial_probs=np.bincount(number[begins_at], tables.initial_probs[begins], minlength=size + 1),
    )
    for array in process:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return process


def _after_choice(
    machines: _Machines, tables: Tables, state: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]
) -> Int[np.ndarray, "B U"]:
    """Pair that every edge of some choices leads to; -1 for the end, where it may not be taken or does not exist."""
    widths = (machines.condition > -2).sum(axis=1)[machines.is_choice]
    width = int(max(widths, default=1))
    conditions = machines.condition[configuration, :width]
    taken = (conditions == -1) | (machines.answers[np.maximum(conditions, 0), state[:, None]] > 0) & (conditions >= 0)
    following = np.where(taken, machines.following[configuration, :width], END)
    states = np.broadcast_to(state[:, None], following.shape)
    return _landing(machines, tables, states.ravel(), following.ravel()).reshape(following.shape)


def _after_action(
    machines: _Machines,
    tables: Tables,
    action_of: Int[np.ndarray, " C"],
    state: Int[np.ndarray, " B"],
    configuration: Int[np.ndarray, " B"],
) -> Int[np.ndarray, "B K"]:
    """Pair that each of nature's draws leads to; -1 for the end."""
    states = tables.successors[state, action_of[configuration]]
    following = np.broadcast_to(machines.following[configuration, :1], states.shape)
    # What has no probability is not reached, and is not asked about.
    following = np.where(tables.probs[state, action_of[configuration]] > 0, following, END)
    return _landing(machines, tables, states.ravel(), following.ravel()).reshape(states.shape)


def _landing(
    machines: _Machines, tables: Tables, state: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]
) -> Int[np.ndarray, " B"]:
    """The pairs, state * C + configuration, where the machines next choose or act in these states; -1 for the end."""
    here = np.where(tables.terminal[state], END, configuration)
    moving = np.flatnonzero((here != END) & machines.passes[here])
    while len(moving):
        at, among = here[moving], state[moving]
        row = machines.branch[at]
        edge = np.where(row >= 0, machines.answers[np.maximum(row, 0), among], 0)
        if (edge < 0).any():
            stuck = int(np.argmax(edge < 0))
            raise InvalidMachine(
                "The predicate of a branch has an answer without an edge in "
                f"{_pair_text(tables, machines.configurations, among[stuck], at[stuck])}."
            )
        here[moving] = machines.following[at, edge]
        moving = moving[(here[moving] != END) & machines.passes[here[moving]]]
    return np.where(here == END, -1, state.astype(np.int64) * machines.configurations.size + here)


def _machines(environment: Environment, tables: Tables, found: Configurations) -> _Machines:
    width = max(map(len, found.followers))
    following = np.full((found.size, width), END)
    branch, condition = np.full(found.size, -1), np.full((found.size, width), -2)
    rows: dict[tuple[Predicate, tuple[int, ...] | None], int] = {}
    for number, vertex in enumerate(found.vertices):
        following[number, : len(found.followers[number])] = found.followers[number]
        if isinstance(vertex, Branch):
            labels = tuple(int(label) for label, _ in pairs(vertex.edges))
            branch[number] = rows.setdefault((vertex.on, labels), len(rows))
        if isinstance(vertex, Choice):
            conditions = dict(pairs(vertex.only_if))
            for edge, (name, _) in enumerate(pairs(vertex.edges)):
                needed = conditions.get(name)
                condition[number, edge] = -1 if needed is None else rows.setdefault((needed, None), len(rows))

    asked = {predicate: _ask_everywhere(environment, tables, predicate) for predicate in {key[0] for key in rows}}
    answers = np.zeros((max(len(rows), 1), tables.num_states), dtype=np.int32)
    for (predicate, edge_labels), row in rows.items():
        if edge_labels is None:
            answers[row] = asked[predicate] != 0
        else:
            answers[row] = -1
            for edge, label in enumerate(edge_labels):
                answers[row][asked[predicate] == label] = edge
    is_choice = np.array([isinstance(vertex, Choice) for vertex in found.vertices])
    passes = np.array([not takes_time(vertex) for vertex in found.vertices]) & ~is_choice
    return _Machines(found, following, passes, is_choice, branch, condition, answers)


def _ask_everywhere(environment: Environment, tables: Tables, predicate: Predicate) -> Int[np.ndarray, " S"]:
    """What a predicate answers in every state. Raises `InvalidMachine` where that is not one bool or integer."""
    arguments = dict(pairs(predicate.arguments))

    @jax.jit
    def ask(states: State) -> Array:
        return jax.vmap(lambda state: jnp.asarray(predicate.function(environment, state, **arguments)))(states)

    answers = []
    for rows, states in state_batches(tables.space):
        answers.append(np.asarray(ask(states))[: rows.stop - rows.start])
    answer = np.concatenate(answers)
    if answer.ndim != 1 or not (answer.dtype == bool or np.issubdtype(answer.dtype, np.integer)):
        raise InvalidMachine(
            f"{predicate.function.__name__} must answer with one bool or integer, but answers with "
            f"{answer.dtype} {list(answer.shape[1:])}."
        )
    return answer.astype(np.int32)


def _pair_text(tables: Tables, found: Configurations, state: int, configuration: int) -> str:
    return f"{found.text(int(configuration))} where {state_text(tables.space, int(state))}"


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
