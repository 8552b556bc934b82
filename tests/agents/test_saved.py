"""Files: what is saved comes back; what is damaged or foreign is refused in one sentence."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from lodestone.agents.option_critic import nothing_learned
from lodestone.agents.playing import play, record
from lodestone.agents.policies import GoalPolicy, OptionCriticPolicy, PlanPolicy, Policy, UnitedPolicy
from lodestone.agents.saved import load_options, load_policy, save_options, save_policy
from lodestone.envs.base import example_state
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm, arm_is_down, go_down_task, random_layouts
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Task, goal, looks
from lodestone.errors import BadFile, InvalidConfig
from lodestone.files import read_arrays, write_arrays
from lodestone.learning.goal_network import init_goal_network
from lodestone.learning.networks import NetworkConfig, init_q_network
from lodestone.learning.option_network import init_option_network
from lodestone.learning.plan_network import PlanConfig, init_plan_network
from lodestone.learning.united_network import init_united_network
from lodestone.options.base import Capped, Primitives, Union
from lodestone.options.catalogue import goals, scripted_options, tasks
from lodestone.options.execution import Rules
from lodestone.options.networks import NetworkOptions
from lodestone.options.tabular import as_tabular

ARM = MagnetArm()
SMALL = NetworkConfig(kernels=(3,), strides=(3,), channels=(4,), hidden=(8,))


def networks(count: int, outputs: int):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(lambda key: init_q_network(SMALL, (12, 9, 3), outputs, key))(keys)


def every_kind() -> Union:
    """One set with every kind of options in it, under different names."""
    learned = NetworkOptions(tasks(ARM), networks(2, 6))
    tables = as_tabular(Primitives(tuple(f"table {name}" for name in ARM.action_names)), reachable_states(ARM))
    return Union((Primitives(ARM.action_names), Capped(learned, 21), tables))


@pytest.fixture
def policy() -> Policy:
    return Policy("dqn", ARM, every_kind(), Rules(decision_limit=50), networks(3, 14), 0.1, (4, 5, 6))


def test_a_policy_comes_back_whole(policy, tmp_path):
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    assert (found.agent, found.environment, found.rules, found.seeds) == ("dqn", ARM, policy.rules, (4, 5, 6))
    assert found.options.names == policy.options.names
    assert found.options.max_steps == policy.options.max_steps
    for state_number in (0, 17, 155):
        state = reachable_states(ARM).state(state_number)
        for name in ("initiation", "action_probs", "termination"):
            np.testing.assert_array_equal(getattr(found.options, name)(state), getattr(policy.options, name)(state))
        for position in range(3):
            np.testing.assert_array_equal(found.values(position)(state), policy.values(position)(state))


def test_a_table_comes_back(tmp_path):
    table = jax.random.normal(jax.random.key(1), (2, 156, 6))
    policy = Policy("q-learning", ARM, Primitives(ARM.action_names), Rules(), table, 1.0, (0, 1))
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    np.testing.assert_array_equal(found.values(1)(example_state(ARM)), table[1, 0])


def policy_with_heads(kind, for_tasks) -> UnitedPolicy | GoalPolicy:
    init = {UnitedPolicy: init_united_network, GoalPolicy: init_goal_network}[kind]
    keys = jax.random.split(jax.random.key(0), 2)
    made = jax.vmap(lambda key: init(SMALL, "hidden", (12, 9, 3), 6, len(for_tasks), key))(keys)
    return kind("agent", ARM, for_tasks, 5, Rules(decision_limit=50), SMALL, "hidden", made, 0.1, (4, 5))


HEADS = [(UnitedPolicy, tasks(ARM)), (GoalPolicy, goals(ARM))]


SEEN = (
    goal(ARM, "start", looks(ARM.observe(example_state(ARM)))),
    goal(ARM, "dark", looks(np.zeros((12, 9, 3), "u1"))),
)


@pytest.mark.parametrize(("kind", "for_tasks"), [*HEADS, *((kind, (*others, *SEEN)) for kind, others in HEADS)])
def test_networks_of_heads_come_back(kind, for_tasks, tmp_path):
    policy = policy_with_heads(kind, for_tasks)
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    assert isinstance(found, kind)
    for name in ("agent", "environment", "tasks", "option_cap", "rules", "shape", "shared", "reward_scale", "seeds"):
        assert getattr(found, name) == getattr(policy, name)
    jax.tree.map(np.testing.assert_array_equal, found.network(1), policy.network(1))
    assert found.options(1).names == policy.choices
    assert set(found.options(1).max_steps[1:]) == {5}


ROOMS = FourRooms("code")


def option_critic_policy() -> OptionCriticPolicy:
    keys = iter(jax.random.split(jax.random.key(3), 4))
    zeros = nothing_learned((2, 104, 3), 4)
    learned = jax.tree.map(lambda leaf: jax.random.normal(next(keys), leaf.shape), zeros)
    return OptionCriticPolicy("option-critic", ROOMS, Rules(step_limit=90), 0.5, learned, (4, 5))


def test_learned_options_come_back(tmp_path):
    policy = option_critic_policy()
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    for name in ("agent", "environment", "rules", "temperature", "seeds", "choices"):
        assert getattr(found, name) == getattr(policy, name)
    state, (one, other) = example_state(ROOMS), (each.of_seed(1) for each in (found, policy))
    np.testing.assert_array_equal(found.values_of(one)(state), other.table[0])
    for name in ("action_probs", "termination"):
        answers = [getattr(each, name)(state) for each in (found.options_of(one), policy.options_of(other))]
        np.testing.assert_array_equal(*answers)
    np.testing.assert_allclose(found.options_of(one).termination(state), jax.nn.sigmoid(other.exits[0]))
    np.testing.assert_array_equal(play(found, jax.random.key(0)).steps, play(policy, jax.random.key(0)).steps)


def deep_option_critic_policy() -> OptionCriticPolicy:
    keys = jax.random.split(jax.random.key(0), 2)
    made = jax.vmap(lambda key: init_option_network(SMALL, (12, 9, 3), 3, 6, key))(keys)
    learned = jax.tree.map(lambda leaf: leaf + jax.random.normal(jax.random.key(1), leaf.shape), made)
    return OptionCriticPolicy("deep-option-critic", ARM, Rules(step_limit=90), 0.5, learned, (4, 5), 0.1)


def test_networks_of_learned_options_come_back(tmp_path):
    policy = deep_option_critic_policy()
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    for name in ("agent", "environment", "rules", "temperature", "seeds", "choices", "reward_scale"):
        assert getattr(found, name) == getattr(policy, name)
    jax.tree.map(np.testing.assert_array_equal, found.learned, policy.learned)
    network, state = found.of_seed(1), example_state(ARM)
    features = network.trunk(ARM.observe(state))
    np.testing.assert_allclose(found.values_of(network)(state), network.values(features) / 0.1, rtol=1e-5)
    options = found.options_of(network)
    probs = jax.nn.softmax(network.preferences(features).reshape(3, 6) / 0.5)
    np.testing.assert_allclose(options.action_probs(state), probs, rtol=1e-5)
    np.testing.assert_allclose(options.termination(state), jax.nn.sigmoid(network.exits(features)), rtol=1e-5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_options": 4},
        {"num_options": "x"},
        {"temperature": -1.0},
        {"reward_scale": 0.0},
        {"shape": 3},
        {"shape": {"kernels": [3], "strides": [3], "channels": [4], "hidden": [9], "pooling": False}},
        {"shape": {"kernels": [], "strides": [], "channels": [], "hidden": [], "pooling": True}},
        {"heat": 1},
        {"environments": 0},
    ],
)
def test_hostile_recipes_of_learned_options_are_refused(wrong, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, deep_option_critic_policy())
    arrays, header = read_arrays(path)
    write_arrays(path, arrays, header | {"option_critic": header["option_critic"] | wrong})
    with pytest.raises(BadFile):
        load_policy(path)
    write_arrays(path, {name: array for name, array in arrays.items() if "exits" not in name}, header)
    with pytest.raises(BadFile, match="is missing"):
        load_policy(path)


@pytest.mark.parametrize(
    "recipe",
    [{"num_options": 4, "temperature": 0.5}, {"num_options": 3, "temperature": 0.0}, {"num_options": 3, "heat": 1}, 7],
)
def test_learned_options_of_another_recipe_are_refused(recipe, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, option_critic_policy())
    arrays, header = read_arrays(path)
    write_arrays(path, arrays, header | {"option_critic": recipe})
    with pytest.raises(BadFile):
        load_policy(path)
    write_arrays(path, {name: array for name, array in arrays.items() if "exits" not in name}, header)
    with pytest.raises(BadFile, match="exits is missing"):
        load_policy(path)


def plan_policy() -> PlanPolicy:
    plan = PlanConfig(horizon=5, patch=3, peak=7.5, background=-3.5, noisy=True)
    keys = jax.random.split(jax.random.key(0), 2)
    made = jax.vmap(lambda key: init_plan_network(SMALL, plan, (12, 9, 3), 7, key))(keys)
    return PlanPolicy("straw", ARM, Rules(step_limit=30), SMALL, made, 0.1, (4, 5))


def test_networks_that_plan_come_back(tmp_path):
    policy = plan_policy()
    save_policy(tmp_path / "policy.safetensors", policy)
    found = load_policy(tmp_path / "policy.safetensors")
    assert isinstance(found, PlanPolicy)
    for name in ("agent", "environment", "rules", "shape", "reward_scale", "seeds"):
        assert getattr(found, name) == getattr(policy, name)
    assert found.networks.shape == policy.networks.shape
    jax.tree.map(np.testing.assert_array_equal, found.network(1), policy.network(1))
    one, other = (record(each, 1, jax.random.key(0), "straw") for each in (found, policy))
    np.testing.assert_array_equal(one.values, other.values)
    assert one.ahead == other.ahead
    assert len(one.ahead) == len(one.option) == 30


@pytest.mark.parametrize(
    "wrong",
    [
        {"horizon": 0},
        {"horizon": 10**30},
        {"horizon": "five"},
        {"patch": 4},
        {"peak": "high"},
        {"peak": None},
        {"colour": "red"},
    ],
)
def test_hostile_recipes_of_plans_are_refused(wrong, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, plan_policy())
    arrays, header = read_arrays(path)
    header["plans"]["plan"] |= wrong
    write_arrays(path, arrays, header)
    with pytest.raises(BadFile):
        load_policy(path)


@pytest.mark.parametrize("kind", [UnitedPolicy, GoalPolicy])
def test_networks_for_tasks_of_ones_own_are_not_saved(kind, tmp_path):
    own = Task(ARM, "own", random_layouts, arm_is_down, go_down_task(ARM).pay)
    with pytest.raises(InvalidConfig, match="ready-made tasks or goals"):
        save_policy(tmp_path / "policy.safetensors", policy_with_heads(kind, (own,)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "wrong", [{"tasks": ["moon"]}, {"tasks": []}, {"option_cap": "x"}, {"shared": "all"}, {"shape": 3}, {"tasks": 7}]
)
@pytest.mark.parametrize(("kind", "for_tasks"), HEADS)
def test_hostile_recipes_of_heads_are_refused(kind, for_tasks, wrong, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy_with_heads(kind, for_tasks))
    arrays, header = read_arrays(path)
    name = "united" if kind is UnitedPolicy else "goals"
    for recipe in (header[name] | wrong, None):
        write_arrays(path, arrays, header | {name: recipe})
        with pytest.raises(BadFile):
            load_policy(path)
    write_arrays(path, dict(list(arrays.items())[1:]), header)
    with pytest.raises(BadFile, match="missing"):
        load_policy(path)


def test_values_are_in_units_of_the_environments_reward(policy):
    state = example_state(ARM)
    network = jax.tree.map(lambda leaf: leaf[0], policy.learned)
    np.testing.assert_allclose(policy.values(0)(state), network(ARM.observe(state)) / 0.1, rtol=1e-5)


def test_scripted_options_come_back(tmp_path):
    options = scripted_options(ARM, ["lift"])
    save_options(tmp_path / "options.safetensors", options, ARM)
    assert load_options(tmp_path / "options.safetensors", ARM) == options


def test_options_for_another_shape_are_refused(tmp_path):
    save_options(tmp_path / "options.safetensors", NetworkOptions(tasks(ARM), networks(2, 6)), ARM)
    with pytest.raises(BadFile, match=r"needs float32 \[2, 96, 8\]"):
        load_options(tmp_path / "options.safetensors", MagnetArm(rows=6, columns=4, bricks=4, tower_height=4))


def test_a_file_of_another_kind_is_refused(policy, tmp_path):
    save_policy(tmp_path / "policy.safetensors", policy)
    with pytest.raises(BadFile, match="holds policy, but options were expected"):
        load_options(tmp_path / "policy.safetensors", ARM)


def test_every_truncation_is_refused(policy, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    whole = path.read_bytes()
    for length in [0, 1, 7, 8, 9, 100, 1000, *range(2000, len(whole), 5003), len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(BadFile):
            load_policy(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"\x80\x04K\x01.", b"\xff" * 64, b"{}", b"PK\x03\x04" + bytes(60)])
def test_foreign_files_are_refused(content, tmp_path):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(BadFile, match="truncated, or no safetensors"):
        load_policy(tmp_path / "file")


def test_a_file_that_may_not_be_read_is_not_said_to_be_missing(tmp_path, monkeypatch):
    path = tmp_path / "policy.safetensors"
    path.touch()

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "open", refuse)  # nobody refuses the root that tests may run as
    with pytest.raises(BadFile, match="cannot be read: Permission denied"):
        load_policy(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(BadFile, match="nowhere"):
        load_policy(tmp_path / "nowhere.safetensors")


HOSTILE = [
    ("environment", {"name": "__import__('os')", "parameters": {}}),
    ("environment", {"name": "magnet-arm", "parameters": {"rows": 10**9}}),
    ("environment", {"name": "magnet-arm", "parameters": {"rows": "4"}}),
    ("environment", {"name": "magnet-arm", "parameters": {"unknown": 1}}),
    ("environment", None),
    ("options", {"kind": "eval", "code": "1"}),
    ("options", {"kind": "capped", "cap": 0, "options": {"kind": "primitives"}}),
    ("options", {"kind": "union", "parts": []}),
    ("options", {"kind": "scripted", "names": ["no such option"]}),
    ("options", []),
    ("rules", {"discount": 7}),
    ("rules", {"surprise": 1}),
    ("seeds", ["x"]),
    ("seeds", 3),
    ("reward_scale", "much"),
    ("network", {"kernels": [3], "strides": [0], "channels": [4], "hidden": [8]}),
    ("network", {"kernels": [3, 3], "strides": [3], "channels": [4], "hidden": [8]}),
    ("network", "big"),
    ("kind", 5),
]


@pytest.mark.parametrize(("key", "value"), HOSTILE)
def test_hostile_recipes_are_refused(key, value, policy, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    arrays, header = read_arrays(path)
    write_arrays(path, arrays, header | {key: value})
    with pytest.raises(BadFile):
        load_policy(path)


def test_a_missing_array_or_key_is_refused(policy, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    arrays, header = read_arrays(path)
    for name in list(arrays)[:3]:
        write_arrays(path, {other: array for other, array in arrays.items() if other != name}, header)
        with pytest.raises(BadFile, match="missing"):
            load_policy(path)
    for name in header:
        write_arrays(path, arrays, {other: value for other, value in header.items() if other != name})
        if name not in ("version",):
            with pytest.raises(BadFile):
                load_policy(path)


def test_nothing_is_left_half_written(policy, tmp_path: Path, monkeypatch):
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    before = path.read_bytes()
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(Exception, match="No space left"):
        save_policy(path, policy)
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["policy.safetensors"]
