"""Playing saved policies: their results, and an episode to look at."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray, PyTree, UInt8

from lodestone.agents.machine_playing import JointEpisode, greedy_edges, play_choices, play_outside
from lodestone.agents.policies import (
    AnyPolicy,
    GoalPolicy,
    MachinePolicy,
    OptionCriticPolicy,
    PlanPolicy,
    Policy,
    UnitedPolicy,
)
from lodestone.envs.base import Environment, OutsideEnvironment
from lodestone.envs.host import HostEnvironment, visit
from lodestone.learning.evaluation import Episode, Trace, play_episode, trace_episode
from lodestone.learning.plan_execution import NEXT_PLAN, play_plans, trace_plans
from lodestone.learning.plan_network import Plan
from lodestone.learning.united_execution import play_united, trace_united
from lodestone.options.base import Options
from lodestone.planning.joint import JointProcess
from lodestone.planning.shown_joint import ShownProcess
from lodestone.types import State

MAX_STEPS = 5000
"""Primitive steps after which an episode is given up where the policy's rules have no limit that ends it sooner."""

EPISODES = 100
"""Episodes by which a policy is judged where there is chance."""


@dataclass(frozen=True)
class Playback:
    """One greedy episode to look at; T primitive steps, O options."""

    agent: str
    seed: int
    option_names: tuple[str, ...]
    action_names: tuple[str, ...]
    pictures: UInt8[np.ndarray, "T+1 height width 3"]
    """Before every step, and after the last."""
    option: Int[np.ndarray, " T"]
    """The option that runs at each step."""
    chosen: Bool[np.ndarray, " T"]
    """Whether it was chosen at this step, rather than continued."""
    action: Int[np.ndarray, " T"]
    """The primitive action that was taken."""
    values: Float[np.ndarray, "T O"]
    """Q(s, .) in units of the environment's reward."""
    available: Bool[np.ndarray, "T O"]
    termination: Float[np.ndarray, "T O"]
    """Probability that each option, had it run until the state before the step, would stop there; not a number where an
    option has none."""
    total_reward: Float[np.ndarray, " T"]
    """Return so far, after each step."""
    ahead: tuple[str, ...] = ()
    """What is planned at each step for those to come, in words; empty where nothing plans."""


def play(policy: AnyPolicy, key: PRNGKeyArray) -> Episode:
    """One greedy episode of every seed, all with the same key; leaves have a leading seed axis."""
    return jax.tree.map(lambda leaf: leaf[:, 0], play_many(policy, key, 1))


def play_many(policy: AnyPolicy, key: PRNGKeyArray, episodes: int) -> Episode:
    """So many greedy episodes of every seed, all seeds with the same keys; leaves have axes for seed and episode."""
    keys = key[None] if episodes == 1 else jax.random.split(key, episodes)
    if isinstance(policy, MachinePolicy):
        seeds = len(policy.seeds)
        with visit(policy.environment):
            played = [_of_machines(policy, position, each) for position in range(seeds) for each in keys]
        return jax.tree.map(lambda *leaves: np.array(leaves).reshape(seeds, episodes), *played)

    def one(learned: PyTree, key: PRNGKeyArray) -> Episode:
        if isinstance(policy, UnitedPolicy):
            return play_united(policy.environment, policy.rules, policy.option_cap, learned, key, MAX_STEPS)
        if isinstance(policy, PlanPolicy):
            return play_plans(policy.environment, policy.rules, learned, key, MAX_STEPS)
        options, values = _options(policy, learned), policy.values_of(learned)
        return play_episode(policy.environment, options, policy.rules, values, key, MAX_STEPS)

    @jax.jit
    def run(learned: PyTree, keys: PRNGKeyArray) -> Episode:
        return jax.vmap(jax.vmap(one, in_axes=(None, 0)))(learned, keys)

    with visit(policy.environment):
        return jax.tree.map(np.asarray, run(_learned(policy), jnp.stack([keys] * len(policy.seeds))))


def _learned(policy: Policy | UnitedPolicy | GoalPolicy | OptionCriticPolicy | PlanPolicy) -> PyTree:
    """What it has learned, with a leading seed axis."""
    return policy.networks if isinstance(policy, UnitedPolicy | GoalPolicy | PlanPolicy) else policy.learned


def _options(policy: Policy | GoalPolicy | OptionCriticPolicy, learned: PyTree) -> Options:
    """What one seed chooses from: given, or learned too."""
    return policy.options if isinstance(policy, Policy) else policy.options_of(learned)


def episodes_to_judge(policy: AnyPolicy) -> int:
    """How many episodes tell what a policy is worth: one in a world without chance that begins in one state, if its
    options do not draw their actions."""
    environment = policy.environment
    if isinstance(environment, OutsideEnvironment):
        return EPISODES
    alone = environment.num_outcomes == 1 and environment.initial_distribution()[0].shape[0] == 1
    return 1 if alone and not isinstance(policy, OptionCriticPolicy) else EPISODES


def judge_greedily(policy: AnyPolicy) -> Episode:
    """What every seed's greedy policy reaches: means of `episodes_to_judge` episodes; leaves have an axis for seed."""
    played = play_many(policy, jax.random.key(0), episodes_to_judge(policy))
    return jax.tree.map(lambda leaf: leaf.mean(axis=1), played)


def _of_machines(policy: MachinePolicy, position: int, key: PRNGKeyArray) -> Episode:
    episode = _play_machines(policy, position, key)
    acts = episode.edge < 0
    ended = episode.joint[-1] == policy.process.end
    return Episode(*map(jnp.asarray, (episode.reward.sum(), acts.sum(), (~acts).sum(), ended)))


def _play_machines(policy: MachinePolicy, position: int, key: PRNGKeyArray) -> JointEpisode:
    max_steps, process = min(policy.rules.step_limit or MAX_STEPS, MAX_STEPS), policy.process
    if isinstance(process, ShownProcess):
        assert isinstance(policy.environment, HostEnvironment)
        return play_outside(process, policy.environment, policy.tables[position], key, max_steps)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    edges = greedy_edges(policy.tables[position])
    return play_choices(process, edges, rng, max_steps, policy.rules.decision_limit)


def record(policy: AnyPolicy, position: int, key: PRNGKeyArray, agent: str) -> Playback:
    """One greedy episode of the seed at this position, with its pictures. Of h-DQN the options are its goals; of
    machines they are the edges of their choices: an edge runs until the next choice. Of what plans the only option is
    its plan, which runs until the next one."""
    if isinstance(policy, MachinePolicy):
        return _record_machines(policy, position, key, agent)
    length = int(play(policy, key).steps[position])
    if isinstance(policy, PlanPolicy):
        return _record_plans(policy, position, key, agent, length)

    @jax.jit
    def run(key: PRNGKeyArray) -> Trace:
        environment, rules = policy.environment, policy.rules
        learned = jax.tree.map(lambda leaf: jnp.asarray(leaf[position]), _learned(policy))
        if isinstance(policy, UnitedPolicy):
            return trace_united(environment, rules, policy.option_cap, learned, key, length)
        options, values = _options(policy, learned), policy.values_of(learned)
        return trace_episode(environment, options, rules, values, key, length)

    with visit(policy.environment, film=True) as film:
        trace = jax.tree.map(np.asarray, run(key))
    return Playback(
        agent=agent,
        seed=policy.seeds[position],
        option_names=policy.options.names if isinstance(policy, Policy) else policy.choices,
        action_names=policy.environment.action_names,
        pictures=_pictures(policy.environment, trace.state, trace.next_state, length, film),
        option=trace.option,
        chosen=trace.chosen,
        action=trace.action,
        values=trace.values / policy.reward_scale if isinstance(policy, UnitedPolicy) else trace.values,
        available=trace.available,
        termination=trace.termination,
        total_reward=np.cumsum(trace.reward),
    )


def _pictures(
    environment: Environment,
    state: State,
    next_state: State,
    length: int,
    film: list[UInt8[np.ndarray, "height width 3"]],
) -> UInt8[np.ndarray, "T+1 height width 3"]:
    """Before every step, and after the last; of an environment outside, what was filmed on the way."""
    if isinstance(environment, OutsideEnvironment):
        return np.stack(film)
    states = [jax.tree.map(lambda leaf, step=step: leaf[step], state) for step in range(length)]
    states.append(jax.tree.map(lambda leaf: leaf[-1], next_state))
    return np.stack([environment.render(one) for one in states])


def _record_plans(policy: PlanPolicy, position: int, key: PRNGKeyArray, agent: str, length: int) -> Playback:
    environment = policy.environment
    run = jax.jit(lambda key: trace_plans(environment, policy.rules, policy.network(position), key, length))
    with visit(environment, film=True) as film:
        trace = jax.tree.map(np.asarray, run(key))
    return Playback(
        agent=agent,
        seed=policy.seeds[position],
        option_names=("plan",),
        action_names=environment.action_names,
        pictures=_pictures(environment, trace.state, trace.next_state, length, film),
        option=np.zeros(length, dtype=np.int32),
        chosen=trace.anew,
        action=trace.action,
        values=trace.plan.logits[:, -1, :1] / policy.reward_scale,
        available=np.ones((length, 1), dtype=bool),
        termination=trace.before[:, None],
        total_reward=np.cumsum(trace.reward),
        ahead=tuple(
            _in_words(environment.action_names, jax.tree.map(lambda leaf, step=step: leaf[step], trace.plan))
            for step in range(length)
        ),
    )


def _in_words(action_names: tuple[str, ...], plan: Plan) -> str:
    """The likeliest actions after this step's, up to the step for which the next plan is expected, and with which
    probability it is made there."""
    due = np.append(plan.commitment >= NEXT_PLAN, True)
    steps = int(np.argmax(due))
    best = plan.logits[:-1, 1 : steps + 1].argmax(axis=0)
    chance = plan.commitment[steps] if steps < len(plan.commitment) else 1.0
    return ", ".join([*(action_names[action] for action in best), f"a new plan ({chance:.2f})"])


def _record_machines(policy: MachinePolicy, position: int, key: PRNGKeyArray, agent: str) -> Playback:
    process, table = policy.process, policy.tables[position]
    with visit(policy.environment, film=True) as film:
        episode = _play_machines(policy, position, key)
    names = process.names
    option, chosen, action, values, available = [], [], [], [], []
    at, fresh, row, may = 0, False, np.full(len(names), np.nan, np.float32), np.zeros(len(names), dtype=bool)
    for joint, edge in zip(episode.joint, episode.edge, strict=False):
        if edge >= 0:
            allowed = process.available[joint]
            row, may = np.full(len(names), np.nan, np.float32), np.zeros(len(names), dtype=bool)
            row[process.name[joint][allowed]], may[process.name[joint][allowed]] = table[joint][allowed], True
            at, fresh = int(process.name[joint, edge]), True
            continue
        option.append(at)
        chosen.append(fresh)
        action.append(process.actions[joint - process.num_choices])
        values.append(row)
        available.append(may)
        fresh = False
    if isinstance(process, JointProcess):
        states = [process.state[episode.joint[0]], *episode.next_state[episode.edge < 0]]
        every = process.tables.space.states
        film = [policy.environment.render(jax.tree.map(lambda leaf, at=at: leaf[at], every)) for at in states]
    return Playback(
        agent=agent,
        seed=policy.seeds[position],
        option_names=names,
        action_names=policy.environment.action_names,
        pictures=np.stack(film),
        option=np.array(option),
        chosen=np.array(chosen),
        action=np.array(action),
        values=np.stack(values),
        available=np.stack(available),
        termination=np.full((len(option), len(names)), np.nan),
        total_reward=np.cumsum(episode.reward[episode.edge < 0]),
    )
