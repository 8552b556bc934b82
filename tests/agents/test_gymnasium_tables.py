"""Tables learned in Gymnasium environments that show a number: what is learned is what is exact."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from lodestone.agents.hamq import HAMQConfig, hamq, process_of
from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.maxq import MAXQConfig
from lodestone.agents.option_critic import OptionCriticConfig
from lodestone.agents.playing import play_many, record
from lodestone.agents.policies import MachinePolicy, OptionCriticPolicy, Policy
from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.sarsa import SarsaConfig
from lodestone.agents.saved import load_policy, save_policy
from lodestone.agents.training import check_training, train_policy
from lodestone.envs.base import Environment
from lodestone.envs.host import FromFunction, Registered
from lodestone.errors import InvalidConfig, InvalidMachine, UnknownName
from lodestone.machines.machine import Action, Branch, Call, Choice, Hierarchy, Machine, Predicate, Stop, Vertex
from lodestone.options.base import NO_CAP, Options, Union, primitives
from lodestone.options.execution import Rules
from lodestone.planning.joint import joint_process, joint_values
from lodestone.planning.tables import tabulate
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph

FIRST_PLACE, FIRST_ACTION = 3, 5


class Walk(gymnasium.Env):
    """Five places; in the last the walk ends and pays a prize. Steps cost 1, after three of them it is cut. Going left
    is forbidden in the first place."""

    prize = 10.0
    observation_space = spaces.Discrete(5, start=FIRST_PLACE)
    action_space = spaces.Discrete(2, start=FIRST_ACTION)

    def _see(self) -> tuple[int, dict[str, Any]]:
        return self.place + FIRST_PLACE, {"action_mask": np.array([self.place > 0, True])}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.time = int(self.np_random.integers(4)), 0
        return self._see()

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.place, self.time = self.place + (1 if action - FIRST_ACTION else -1), self.time + 1
        assert self.place >= 0, "a forbidden action was taken"
        seen, info = self._see()
        return seen, self.prize if self.place == 4 else -1.0, self.place == 4, self.time == 3, info


class DearWalk(Walk):
    """The same without a prize: what was never tried, and is worth 0, would be best wherever it is allowed."""

    prize = -1.0


class BeforeTheEnd(Options):
    """Goes to the place before the last, away from it, and back, for ever."""

    @property
    def names(self):
        return ("before the end",)

    @property
    def max_steps(self):
        return (NO_CAP,)

    def initiation(self, state):
        return jnp.ones(1, dtype=bool)

    def action_probs(self, state):
        return jnp.where(state.seen.observation < 3, jnp.array([[0.0, 1.0]]), jnp.array([[1.0, 0.0]]))

    def termination(self, state):
        return jnp.zeros(1)


DISCOUNT = 0.9
PLACES = (4.58, 6.2, 8.0, 10.0)
DEAR_PLACES = (-3.439, -2.71, -1.9, -1.0)
"""What the first four are worth: from the end, each -1 + 0.9 times the next."""


@pytest.mark.parametrize(
    "config", [QLearningConfig(((0.0, 1.0),)), SarsaConfig(((0.0, 0.5),), ((0.0, 1.0), (0.7, 0.0)))]
)
def test_a_limit_bootstraps_an_end_does_not_and_only_what_is_allowed_is_done(config):
    walk = FromFunction(Walk)
    policy, history = train_policy(config, walk, primitives(walk), Rules(DISCOUNT), 1500, [0, 1])
    assert isinstance(policy, Policy)
    learned = np.asarray(policy.learned)
    np.testing.assert_allclose(learned[:, :4].max(axis=2), [PLACES, PLACES], atol=1e-3)
    if isinstance(config, QLearningConfig):
        left = -1 + DISCOUNT * np.array(PLACES[:3])
        np.testing.assert_allclose(learned[:, 1:4, 0], [left, left], atol=1e-3)
    assert 0 < history.episodes(0).success.mean() < 1, "no episode was cut"
    assert play_many(policy, jax.random.key(0), 5).success.shape == (2, 5)


def test_an_option_that_the_limit_cuts_bootstraps_from_itself_alone():
    """It would have gone on, at a cost of 1 a step: -1 / (1 - 0.9), though one step to the right of it pays 10."""
    walk = FromFunction(Walk)
    both = Union((primitives(walk), BeforeTheEnd()))
    policy, _ = train_policy(QLearningConfig(((0.0, 1.0),), ((0.0, 1.0),)), walk, both, Rules(DISCOUNT), 1500, [0])
    assert isinstance(policy, Policy)
    np.testing.assert_allclose(np.asarray(policy.learned)[0, :4, 2], -10, atol=1e-2)


def test_steps_teach_an_option_that_never_runs():
    walk = FromFunction(Walk)
    both = Union((primitives(walk), BeforeTheEnd()))
    config = IntraOptionConfig(((0.0, 1.0),), ((0.0, 1.0),), "primitives")
    policy, _ = train_policy(config, walk, both, Rules(DISCOUNT), 1500, [0])
    assert isinstance(policy, Policy)
    left, right, forever = np.asarray(policy.learned)[0, :4].T
    np.testing.assert_allclose(right, PLACES, atol=1e-3)
    np.testing.assert_allclose(left[1:], -1 + DISCOUNT * right[:3], atol=1e-3)
    np.testing.assert_allclose(forever, -10, atol=1e-2)


def test_the_cliff_is_learned_to_its_exact_optimum(tmp_path):
    """By what Gymnasium's own tables say; every episode is cut after 20 steps, of which the optimum takes 13."""
    cliff = Registered("CliffWalking-v1", max_episode_steps=20)
    config = QLearningConfig(((0.0, 1.0),), ((0.0, 0.3), (0.7, 0.05)))
    policy, _ = train_policy(config, cliff, primitives(cliff), Rules(DISCOUNT), 4000, [0])
    table = gymnasium.make("CliffWalking-v1").unwrapped.P
    exact = np.zeros((48, 4))
    for _ in range(100):
        for state, action in np.ndindex(exact.shape):
            ((_, following, reward, ended),) = table[state][action]
            exact[state, action] = reward + (0 if ended else DISCOUNT * exact[following].max())
    assert isinstance(policy, Policy)
    learned, state = np.asarray(policy.learned)[0], 36
    for _ in range(13):
        action = int(learned[state].argmax())
        assert learned[state, action] == pytest.approx(exact[state].max(), abs=1e-3)
        ((_, state, _, ended),) = table[state][action]
    assert ended
    save_policy(tmp_path / "policy.safetensors", policy)
    played = play_many(load_policy(tmp_path / "policy.safetensors"), jax.random.key(0), 2)
    np.testing.assert_array_equal(played.total_reward, [[-13, -13]])


class Outside(gymnasium.Env):
    """A deterministic environment of Lodestone as one that shows the number of its state and draws its starts; cut
    after some steps."""

    render_mode = "rgb_array"

    def __init__(self, environment: Environment, limit: int) -> None:
        self.tables, self.limit = tabulate(environment), limit
        self.observation_space = spaces.Discrete(self.tables.num_states)
        self.action_space = spaces.Discrete(self.tables.num_actions)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.number = int(self.np_random.choice(self.tables.num_states, p=self.tables.initial_probs))
        self.time = 0
        return self.number, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        reward = float(self.tables.rewards[self.number, action, 0])
        self.number, self.time = int(self.tables.successors[self.number, action, 0]), self.time + 1
        return self.number, reward, bool(self.tables.terminal[self.number]), self.time == self.limit, {}

    def render(self) -> np.ndarray:
        return np.full((2, 2, 3), self.number, dtype=np.uint8)


def outside(environment: Environment, limit: int) -> FromFunction:
    return FromFunction(partial(Outside, environment, limit))


def test_option_critic_learns_the_same_outside():
    """From the same random numbers, whether the world is a table or shows a number."""
    corridor, config = Corridor(step_reward=-1.0), OptionCriticConfig(3, temperature=0.5)
    inside, told = train_policy(config, corridor, primitives(corridor), Rules(0.9, 7), 640, [0, 1])
    host = outside(corridor, 7)
    policy, seen = train_policy(config, host, primitives(host), Rules(0.9), 640, [0, 1])
    assert isinstance(policy, OptionCriticPolicy)
    assert isinstance(inside, OptionCriticPolicy)
    for found, wanted in zip(policy.learned, inside.learned, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-5)
    for seed in range(2):
        np.testing.assert_array_equal(seen.episodes(seed).length_steps, told.episodes(seed).length_steps)
        assert 0 < told.episodes(seed).success.mean() < 1, "no episode was cut"
    playback = record(policy, 1, jax.random.key(1), "option-critic")
    assert len(playback.pictures) == len(playback.action) + 1


def test_what_option_critic_has_learned_takes_only_what_is_allowed():
    """It is worth what walking to the end is, but for the steps to the left that its soft policies still take."""
    walk = FromFunction(Walk)
    config = OptionCriticConfig(2, temperature=0.1, policy_rate=((0.0, 0.5),), epsilon=((0.0, 0.2),))
    policy, history = train_policy(config, walk, primitives(walk), Rules(DISCOUNT), 3200, [0, 1])
    assert isinstance(policy, OptionCriticPolicy)
    np.testing.assert_allclose(policy.learned.table[:, :4].max(axis=2), [PLACES, PLACES], atol=0.2)
    np.testing.assert_array_equal(policy.learned.preferences[:, 0], 0)  # with one action there is nothing to prefer
    assert 0 < history.episodes(0).success.mean() < 1, "no episode was cut"
    assert play_many(policy, jax.random.key(0), 5).success.shape == (2, 5)


def test_option_critic_plays_from_a_file(tmp_path):
    cliff = Registered("CliffWalking-v1", max_episode_steps=20)
    policy, _ = train_policy(OptionCriticConfig(2), cliff, primitives(cliff), Rules(), 64, [0, 1])
    save_policy(tmp_path / "policy.safetensors", policy)
    loaded = load_policy(tmp_path / "policy.safetensors")
    assert isinstance(loaded, OptionCriticPolicy)
    for found, saved in zip(loaded.learned, policy.learned, strict=True):
        np.testing.assert_array_equal(found, saved)
    assert play_many(loaded, jax.random.key(1), 2).steps.max() <= 20


def beyond(environment, state, place):
    del environment
    return (state if isinstance(state, jax.Array) else state.seen.observation) >= place


BEYOND = Predicate(beyond, {"place": 2})
"""Asked of a state of the corridor, or of the number that is shown."""
IN_THE_CORRIDOR = Hierarchy(
    "root",
    (
        Machine(
            "root",
            "first",
            {
                "first": Action("right", then="which"),
                "which": Choice({"one": "one", "far": "far", "give up": "stop"}, only_if={"give up": BEYOND}),
                "one": Call("one", then="which"),
                "far": Branch(BEYOND, {True: "left", False: "right"}),
                "left": Action("left", then="again"),
                "again": Action("left", then="which"),
                "right": Action("right", then="which"),
                "stop": Stop(),
            },
        ),
        Machine(
            "one",
            "way",
            {
                "way": Choice({"left": "left", "right": "right"}),
                "left": Action("left", then="stop"),
                "right": Action("right", then="stop"),
                "stop": Stop(),
            },
        ),
    ),
)


def named_as(actions: tuple[str, ...], hierarchy: Hierarchy) -> Hierarchy:
    """The same where left and right have other names."""
    names = dict(zip(("left", "right"), actions, strict=True))

    def renamed(vertex: Vertex) -> Vertex:
        return replace(vertex, action=names[str(vertex.action)]) if isinstance(vertex, Action) else vertex

    machines = (
        replace(machine, vertices={name: renamed(vertex) for name, vertex in machine.vertices})
        for machine in hierarchy.machines
    )
    return Hierarchy(hierarchy.root, tuple(machines))


def test_machines_learn_the_exact_values():
    """Their root may stop before the episode is over, their choices follow one another in no time, and a limit comes
    between two of them."""
    corridor, config = Corridor(step_reward=-4.0), HAMQConfig(((0.0, 1.0),), ((0.0, 1.0),))
    inside = joint_process(corridor, IN_THE_CORRIDOR)
    exact = joint_values(inside, DISCOUNT).choice_values
    wanted = {(inside.state[at], inside.configuration[at]): row for at, row in enumerate(exact)}

    host = outside(corridor, 6)
    hierarchy = named_as(host.action_names, IN_THE_CORRIDOR)
    policy, history = train_policy(config, host, primitives(host), Rules(DISCOUNT), 3000, [0, 1], hierarchy=hierarchy)
    assert isinstance(policy, MachinePolicy)
    process, learned = policy.process, {}
    for at in range(process.num_choices):
        learned[process.state[at], process.configuration[at]] = policy.tables[:, at]
    for pair, row in wanted.items():
        np.testing.assert_allclose(learned[pair], [row, row], atol=1e-3)
    assert 0 < history.episodes(0).success.mean() < 1, "no episode was cut"

    with pytest.raises(InvalidConfig, match="no ready-made machines"):
        save_policy(Path("nowhere"), policy)
    best = joint_values(inside, 1.0)
    played = play_many(policy, jax.random.key(0), 2)
    np.testing.assert_allclose(played.total_reward, inside.initial_mean(best.values), atol=1e-3)
    playback = record(policy, 1, jax.random.key(0), "hamq")
    assert len(playback.pictures) == len(playback.action) + 1 == played.steps[1, 0] + 1
    np.testing.assert_array_equal(playback.total_reward[-1], played.total_reward[1, 0])


def test_machines_choose_nothing_that_leads_to_what_is_forbidden_alone():
    walk = FromFunction(DearWalk)
    back, on = walk.action_names
    one_way = {"which": Choice({"go": "go"}), "go": Action(back, then="stop"), "stop": Stop()}
    either = {"which": Choice({"go": "go", "turn": "turn"}), "go": Action(on, then="stop"), "stop": Stop()}
    root = {
        "way": Choice({"back": "back", "on": "on"}),
        "back": Call("back", then="way"),
        "on": Call("on", then="way"),
    }
    hierarchy = Hierarchy(
        "root",
        (
            Machine("root", "way", root),
            Machine("back", "which", one_way),
            Machine("on", "which", either | {"turn": Action(back, then="stop")}),
        ),
    )
    config = HAMQConfig(((0.0, 1.0),), ((0.0, 1.0),), internal_transitions=True)
    policy, _ = train_policy(config, walk, primitives(walk), Rules(DISCOUNT), 1500, [0, 1], hierarchy=hierarchy)
    assert isinstance(policy, MachinePolicy)
    process = policy.process
    at = [row for row in range(process.num_choices) if process.configuration[row] == 0 and process.state[row] < 4]
    back, on = policy.tables[:, at][:, np.argsort(process.state[at])].transpose(2, 0, 1)
    np.testing.assert_allclose(on, [DEAR_PLACES, DEAR_PLACES], atol=1e-3)
    np.testing.assert_allclose(back[:, 1:], -1 + DISCOUNT * on[:, :3], atol=1e-3)
    assert play_many(policy, jax.random.key(0), 5).success.shape == (2, 5)


def test_machines_have_to_go_on_whatever_is_shown():
    corridor = outside(Corridor(), 6)
    vertices = {"ask": Branch(BEYOND, {True: "go"}), "go": Action("0", then="ask")}
    with pytest.raises(InvalidMachine, match=r"without an edge in root\.ask where seen\.observation=0"):
        process_of(corridor, Hierarchy("root", (Machine("root", "ask", vertices),)))
    idle = {"whether": Choice({"at all": "stop"}), "stop": Stop()}
    with pytest.raises(InvalidConfig, match="never act"):
        hamq(HAMQConfig(), corridor, Hierarchy("root", (Machine("root", "whether", idle),)), Rules(), 100)


def never(state):
    del state
    return jnp.bool_(False)


@pytest.mark.parametrize("goal", [4, None], ids=["the root ends", "the episode ends"])
def test_subtasks_learn_the_exact_values(goal, tmp_path):
    """Each of them ends in one place only, so that without a discount no exploration changes what they are worth. The
    pseudo-reward changes nothing either. Entering a place of the corridor pays its number less 6."""
    ends = never if goal is None else lambda state: state.seen.observation >= goal
    corridor = FromFunction(lambda: TimeLimit(Outside(Corridor(6, -6.0), NO_CAP), 9))
    moves = tuple(map(Child, corridor.action_names))
    graph = TaskGraph(
        (
            Subtask("root", ends, (Child("half"), Child("rest"))),
            Subtask(
                "half", lambda state: state.seen.observation >= 3, moves, pseudo_reward=lambda state: jnp.float32(1)
            ),
            Subtask("rest", ends, moves),
        )
    )
    config = MAXQConfig(((0.0, 1.0),), ((0.0, 1.0),))
    policy, history = train_policy(config, corridor, primitives(corridor), Rules(1.0), 1500, [0, 1], graph=graph)
    assert isinstance(policy, Policy)
    last = goal or 5
    worth = np.append(np.cumsum(np.arange(last, 0, -1) - 6.0)[::-1], 0)
    onward = np.arange(1, last + 1) - 6 + worth[1:]
    backward = np.maximum(np.arange(last) - 1, 0) - 6 + worth[np.maximum(np.arange(last) - 1, 0)]
    for learned in np.asarray(policy.learned):
        np.testing.assert_allclose(learned[:last], np.stack([backward, onward], axis=1), atol=1e-4)
    episodes = history.episodes(0)
    assert 0 < episodes.success.mean() < 1, "no episode was cut"
    assert (episodes.length_steps[~episodes.success] == 9).all()
    with pytest.raises(UnknownName, match="FromFunction"):
        save_policy(tmp_path / "policy.safetensors", policy)
    if goal is None:
        np.testing.assert_allclose(play_many(policy, jax.random.key(0), 1).total_reward, [[-15], [-15]])


def test_subtasks_do_only_what_is_allowed():
    graph = TaskGraph((Subtask("root", never, (Child("walk"),)), Subtask("walk", never, (Child("0"), Child("1")))))
    config, walk = MAXQConfig(((0.0, 1.0),), ((0.0, 1.0),)), FromFunction(Walk)
    with pytest.raises(InvalidConfig, match="needs a step limit"):
        train_policy(config, walk, primitives(walk), Rules(DISCOUNT), 1500, [0, 1], graph=graph)
    walk = FromFunction(lambda: TimeLimit(DearWalk(), 3))
    policy, _ = train_policy(config, walk, primitives(walk), Rules(DISCOUNT), 1500, [0, 1], graph=graph)
    assert isinstance(policy, Policy)
    for learned in np.asarray(policy.learned):
        np.testing.assert_allclose(learned[:4, 1], DEAR_PLACES, atol=1e-3)
        np.testing.assert_allclose(learned[1:4, 0], -1 + DISCOUNT * np.array(DEAR_PLACES[:3]), atol=1e-3)
    assert play_many(policy, jax.random.key(0), 5).success.shape == (2, 5)


LANDMARKS = (0, 4, 20, 23)
"""Squares, row by row."""
ABOARD = 4


def taxi(state):
    """Square, passenger and destination of Gymnasium's number."""
    number = state.seen.observation
    return jnp.stack([number // 20, number // 4 % 5, number % 4])


def taxi_at(state, landmark):
    return taxi(state)[0] == LANDMARKS[landmark]


def taxi_has(state, what, value):
    return taxi(state)[what] == value


def taxi_graph() -> TaskGraph:
    """Dietterich's (2000, figure 2), with his abstractions, of the numbers that Gymnasium's taxi shows."""

    def nothing(state):
        return 0 * state.seen.observation

    def to_each(what: int) -> tuple[Child, ...]:
        return tuple(
            Child(f"to-{landmark}", when=partial(taxi_has, what=what, value=landmark), sees=nothing)
            for landmark in range(4)
        )

    pickup = Child("4", sees=lambda state: taxi(state)[:2])
    putdown = Child("5", sees=lambda state: taxi(state)[::2])
    moves = tuple(Child(str(move), sees=lambda state: taxi(state)[0]) for move in range(4))
    return TaskGraph(
        (
            Subtask("root", never, (Child("get", sees=lambda state: taxi(state)[1:]), Child("put"))),
            Subtask("get", partial(taxi_has, what=1, value=ABOARD), (pickup, *to_each(1))),
            Subtask("put", lambda state: taxi(state)[1] != ABOARD, (putdown, *to_each(2))),
            *(Subtask(f"to-{landmark}", partial(taxi_at, landmark=landmark), moves) for landmark in range(4)),
        ),
        dict.fromkeys(map(str, range(4)), nothing),
    )


@pytest.mark.slow
def test_the_taxi_is_learned_to_its_exact_optimum(tmp_path):
    """From each of its 300 starts, by what Gymnasium's own tables say; also when it is read from a file."""
    host = Registered("Taxi-v4")
    config = MAXQConfig(((0.0, 0.5),), ((0.0, 0.5), (0.8, 0.05)))
    policy, _ = train_policy(config, host, primitives(host), Rules(1.0), 40_000, [0], graph=taxi_graph())
    save_policy(tmp_path / "policy.safetensors", policy)
    loaded = load_policy(tmp_path / "policy.safetensors")
    assert isinstance(loaded, Policy)
    learned, inner = np.asarray(loaded.learned)[0], gymnasium.make("Taxi-v4").unwrapped
    exact = np.zeros(500)
    for _ in range(40):
        for state in range(500):
            steps = [inner.P[state][action][0] for action in range(6)]
            exact[state] = max(reward + (0 if ended else exact[after]) for _, after, reward, ended in steps)
    for start in np.flatnonzero(inner.initial_state_distrib):
        state, total, ended = int(start), 0.0, False
        for _ in range(30):
            action = int(np.where(inner.action_mask(state), learned[state], -np.inf).argmax())
            _, state, reward, ended = inner.P[state][action][0]
            total += reward
            if ended:
                break
        assert ended
        assert total == exact[start]


def test_observations_that_are_no_number_are_refused():
    pole = Registered("CartPole-v1")
    with pytest.raises(InvalidConfig, match="one number out of n"):
        check_training(QLearningConfig(), pole, primitives(pole), Rules())
