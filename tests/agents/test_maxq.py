"""What MAXQ learns, against the exact values of the task graph."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.agents.maxq import Learned, MAXQConfig, as_configured, chooser, maxq, polled_values, rounds_for
from lodestone.envs.base import Environment
from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig
from lodestone.learning.history import History
from lodestone.learning.loop import train
from lodestone.options.execution import Rules
from lodestone.planning.solve import evaluate_policy
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import evaluate_choices, recursive_optimum
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph, TaskTables, tabulate_tasks

EXPLORING = ((0.0, 0.5), (1.0, 0.3))
DECAYING = ((0.0, 0.5), (0.5, 0.5), (1.0, 0.01))


def learn(config: MAXQConfig, environment: Environment, rules: Rules, steps: int, seeds: int = 5):
    """What each seed has learned after so many steps, and what happened."""
    graph = task_graph(environment)
    algorithm, rounds = maxq(config, environment, graph, rules, steps), rounds_for(graph, steps)
    history = History(seeds, ("",) * 64)
    for carry, chunk in train(algorithm, range(seeds), rounds, -(-rounds // 50)):
        history.add(chunk)
        if min(history.taken(seed)[1] for seed in range(seeds)) >= steps:
            break
    learned = jax.tree.map(np.asarray, carry.learned)
    return [jax.tree.map(lambda leaf, seed=seed: leaf[seed], learned) for seed in range(seeds)], history


def stacked(seeds: list[Learned]) -> Learned:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *seeds)


@pytest.mark.parametrize("pseudo_rewards", [True, False])
@pytest.mark.parametrize("all_states", [True, False])
def test_two_rooms(pseudo_rewards, all_states):
    """-7.75 with the pseudo-reward, the recursive optimum of -8.5 without, in every seed."""
    rooms, config = TwoRooms(), MAXQConfig(((0.0, 0.5),), EXPLORING, all_states, pseudo_rewards=pseudo_rewards)
    seeds, _ = learn(config, rooms, Rules(discount=1.0, step_limit=50), 60_000)
    tables = tabulate(rooms)
    tasks = tabulate_tasks(as_configured(config, task_graph(rooms)), rooms, tables)
    for choices in chooser(config, rooms, task_graph(rooms))(stacked(seeds)):
        found = evaluate_choices(tasks, tables, choices).values[0]
        assert tables.initial_mean(found) == pytest.approx(-7.75 if pseudo_rewards else -8.5)


@pytest.mark.parametrize(
    ("environment", "discount", "steps", "call"),
    [(Taxi(), 1.0, 60_000, "to-R/north"), (TwoRooms(), 0.9, 100_000, "root/exit")],
    ids=["taxi", "two rooms, discounted"],
)
def test_learned_values_are_the_exact_ones(environment, discount, steps, call):
    """The root's value where episodes begin, and completions; exploration fades, as it changes what children do."""
    config = MAXQConfig(((0.0, 0.5), (0.5, 0.25), (1.0, 0.05)), DECAYING)
    graph, tables = task_graph(environment), tabulate(environment)
    seeds, _ = learn(config, environment, Rules(discount=discount, step_limit=200), steps, seeds=3)
    tasks = tabulate_tasks(graph, environment, tables)
    exact, begins = recursive_optimum(tasks, tables, discount), tables.initial_probs > 0
    number = tasks.edge_names.index(call)
    slots = tasks.completion_slot[number]
    polled = polled_values(config, environment, graph, stacked(seeds))
    for learned, root in zip(seeds, polled.max(axis=2), strict=True):
        assert np.median(np.abs(root - exact.values[0])[begins]) < 0.02
        used = (slots >= 0) & (learned.values[slots] != 0)
        assert used.sum() > 20
        assert np.median(np.abs(learned.values[slots] - exact.completions[number])[used]) < 0.05


@pytest.mark.parametrize(
    "abstraction", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["abstraction", "whole states"]
)
def test_the_taxi_is_learned_to_the_optimum(abstraction):
    """Deterministic, Gymnasium's rewards: 7.93 over the 300 starts, in every seed."""
    taxi = Taxi()
    config = MAXQConfig(((0.0, 0.25 if abstraction else 0.5),), ((0.0, 0.3), (0.8, 0.02)), abstraction=abstraction)
    seeds, history = learn(config, taxi, Rules(discount=1.0, step_limit=1000), 60_000 if abstraction else 250_000)
    tables = tabulate(taxi)
    policies = polled_values(config, taxi, task_graph(taxi), stacked(seeds)).argmax(axis=2)
    for number, policy in enumerate(policies):
        assert tables.initial_mean(evaluate_policy(tables, policy, 1.0)) == pytest.approx(7.93)
        assert history.episodes(number).success[-100:].all()
        assert history.episodes(number).total_reward[-200:].mean() > 6


def test_an_episode_pays_what_its_steps_pay():
    """Each step costs 1 in the two rooms, so returns are minus lengths; a limit ends what has missed the goal."""
    _, history = learn(MAXQConfig(), TwoRooms(), Rules(discount=1.0, step_limit=30), 2000, seeds=2)
    for seed in range(2):
        episodes = history.episodes(seed)
        np.testing.assert_array_equal(episodes.total_reward, -episodes.length_steps)
        assert (episodes.length_steps[~episodes.success] == 30).all()
        assert 0 < episodes.success.mean() < 1


def test_rules_without_a_limit_are_refused():
    with pytest.raises(InvalidConfig, match="step limit"):
        maxq(MAXQConfig(), TwoRooms(), task_graph(TwoRooms()), Rules(), 100)
    with pytest.raises(InvalidConfig, match=r"call_cost is 1\.0, but MAXQ has no options"):
        maxq(MAXQConfig(), TwoRooms(), task_graph(TwoRooms()), Rules(step_limit=10, call_cost=1.0), 100)


def test_an_episode_ends_where_the_root_does():
    """A root that is over after the left room: its episodes are told, and none of them is cut."""
    rooms = TwoRooms()
    _, leave, _ = task_graph(rooms).subtasks
    root = Subtask("root", leave.ends, (Child("exit"),))
    graph = TaskGraph((root, leave))
    algorithm = maxq(MAXQConfig(), rooms, graph, Rules(discount=1.0, step_limit=100), 2000)
    history = History(1, ("",) * 4)
    for _, chunk in train(algorithm, [0], rounds_for(graph, 2000), rounds_for(graph, 2000)):
        history.add(chunk)
    episodes = history.episodes(0)
    assert len(episodes.success) > 50
    assert episodes.success.all()


def test_a_limit_teaches_nothing_about_the_calls_that_it_cuts():
    """After one step the stack is left: the action's reward is known, and what follows *exit* is not."""
    rooms = TwoRooms()
    [learned], _ = learn(MAXQConfig(), rooms, Rules(discount=1.0, step_limit=1), 500, seeds=1)
    tasks = tabulate_tasks(task_graph(rooms), rooms, tabulate(rooms))
    slots = tasks.completion_slot[tasks.edge_names.index("root/exit")]
    assert (learned.values[slots[slots >= 0]] == 0).all()
    rewards = tasks.reward_slot[rooms.action_names.index("north")]
    assert learned.values[rewards[rewards >= 0]].min() < -0.2


class Recursion:
    """MAXQ-Q as it is written down, for one seed, on the experience of another learner.

    `calls` holds the edge that a subtask took at a step, `states` the states of the episode.
    """

    def __init__(self, tasks: TaskTables, discount: float, learning_rate: float, all_states: bool) -> None:
        self.tasks, self.discount, self.learning_rate, self.all_states = tasks, discount, learning_rate, all_states
        self.values, self.inner = np.zeros(tasks.num_slots), np.zeros(tasks.num_slots)

    def best(self, subtask: int, state: int) -> tuple[float, float]:
        """(Q~, Q) of the child with the largest Q~."""
        found = []
        for number in self.tasks.edges_of(subtask):
            if self.tasks.available[number, state]:
                child, slot = self.tasks.edges[number].child, self.tasks.completion_slot[number, state]
                below = child - self.tasks.num_actions
                value = self.values[self.tasks.reward_slot[child, state]] if below < 0 else self.best(below, state)[1]
                completion, inner = (self.values[slot], self.inner[slot]) if slot >= 0 else (0.0, 0.0)
                found.append((value + inner, value + completion))
        return max(found, key=lambda pair: pair[0])

    def run(self, subtask: int, step: int, calls: dict, states: list[int], rewards: list[float], cut: bool) -> int:
        """From a step until the subtask, or one above it, has ended; the step at which it has."""
        tasks = self.tasks
        while step < len(rewards) and not tasks.ends[subtask, states[step]]:
            edge, began = calls[subtask, step], step
            child = tasks.edges[edge].child - tasks.num_actions
            if child < 0:
                slot = tasks.reward_slot[tasks.edges[edge].child, states[step]]
                self.values[slot] += self.learning_rate * (rewards[step] - self.values[slot])
                step += 1
            else:
                step = self.run(child, step, calls, states, rewards, cut)
                if (cut and step == len(rewards)) or not tasks.ends[child, states[step]]:
                    return step
            inner, value = tasks.pseudo_rewards[subtask, states[step]], 0.0
            if not tasks.ends[subtask, states[step]]:
                inner, value = self.best(subtask, states[step])
            for visited in reversed(range(began, step)) if self.all_states else [began]:
                slot, weight = tasks.completion_slot[edge, states[visited]], self.discount ** (step - visited)
                if slot >= 0:
                    self.values[slot] += self.learning_rate * (weight * value - self.values[slot])
                    self.inner[slot] += self.learning_rate * (weight * inner - self.inner[slot])
        return step


@pytest.mark.parametrize("all_states", [True, False], ids=["all states", "one state"])
@pytest.mark.parametrize("environment", [Taxi(move_success=0.8), TwoRooms()], ids=["taxi", "two rooms"])
def test_the_recursion_learns_the_same(monkeypatch, environment, all_states):
    """Every value, over 50 episodes, from the same steps; some are cut after 40, so that stacks are unwound."""
    monkeypatch.setattr("lodestone.agents.maxq.EVENTS_PER_ROUND", 1)
    config, graph = MAXQConfig(((0.0, 0.5),), ((0.0, 0.3),), all_states=all_states), task_graph(environment)
    tables = tabulate(environment)
    tasks = tabulate_tasks(graph, environment, tables)
    plain = Recursion(tasks, 0.9, 0.5, all_states)
    algorithm = maxq(config, environment, graph, Rules(discount=0.9, step_limit=40), 1000)
    run_event = jax.jit(algorithm.run_round)
    carry = algorithm.init(jax.random.key(1))
    calls, states, rewards, episodes, cuts = {}, [int(carry.state)], [], 0, 0
    while episodes < 50:
        step, before = int(carry.steps), float(carry.episode_return)
        carry, log = run_event(carry, jnp.int32(0))
        if log.valid[0]:
            for edge, called_at in zip(carry.stack.edge, carry.stack.called_at, strict=True):
                if called_at == step:
                    calls[tasks.edges[int(edge)].subtask, step] = int(edge)
            states.append(int(carry.state))
            rewards.append(float(log.episode_return[0]) - before)
            over, terminated = bool(log.episode_ended[0]), bool(log.terminated[0])
        elif rewards and not carry.steps:
            assert over
            plain.run(0, 0, calls, states, rewards, cut=not terminated)
            episodes, cuts = episodes + 1, cuts + (not terminated)
            np.testing.assert_allclose(carry.learned.values, plain.values, atol=1e-4)
            calls, states, rewards = {}, [int(carry.state)], []
    assert 0 < cuts < episodes
    begins_otherwise = tasks.completion_slot[[tasks.pseudo_rewards[edge.subtask].any() for edge in tasks.edges]]
    slots = np.unique(begins_otherwise[begins_otherwise >= 0])
    np.testing.assert_allclose(carry.learned.inner[slots], plain.inner[slots], atol=1e-4)
    assert np.abs(plain.inner[slots] - plain.values[slots]).max() > 1
