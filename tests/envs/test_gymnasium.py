"""Lodestone's environments inside Gymnasium, one copy and many."""

import subprocess
import sys
from typing import Any

import equinox as eqx
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from jaxtyping import Array

import lodestone.envs.gymnasium as adapter
from benchmarks.numpy_magnet_arm import NumpyMagnetArm
from lodestone.envs.base import Environment
from lodestone.envs.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from lodestone.envs.magnet_arm import MagnetArm, lift_task
from lodestone.envs.registry import ENVIRONMENTS, make_environment
from lodestone.errors import InvalidConfig, UnknownName

ID = "lodestone/MagnetArm-v0"
SMALL = MagnetArm(3, 2, 2, 2)
"""Random actions finish this tower now and then."""


class Drift(Environment):
    """A walk on 0..9 with chance in the start and in each step; 9 ends it. `kind` is what the agent sees."""

    kind: str = eqx.field(static=True, default="float")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("down", "up")

    @property
    def num_outcomes(self) -> int:
        return 3

    def initial_distribution(self) -> tuple[Array, Array]:
        return jnp.full(4, 0.25), jnp.arange(4)

    def outcome_probs(self, state: Array, action: Array) -> Array:
        return jnp.array([0.5, 0.25, 0.25])

    def transition(self, state: Array, action: Array, outcome: Array) -> Array:
        return jnp.clip(state + (2 * action - 1) * outcome, 0, 9)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        return (next_state - state).astype(jnp.float32)

    def terminal(self, state: Array) -> Array:
        return state == 9

    def observe(self, state: Array) -> Any:
        views = {
            "float": state.astype(jnp.float32)[None],
            "bool": jnp.arange(10) == state,
            "index": state,
            "pair": (state, state),
        }
        return views[self.kind]

    def render(self, state: Array) -> np.ndarray:
        return np.full((8, 8, 3), int(state), dtype=np.uint8)


# One copy


@pytest.mark.parametrize("observation", ["rgb", "planes", "index"])
def test_made_by_name_it_passes_the_checker(observation: str) -> None:
    env = gymnasium.make(
        ID,
        rows=6,
        columns=4,
        bricks=4,
        tower_height=4,
        step_limit=200,
        tower_reward=100.0,
        step_reward=-1.0,
        observation=observation,
        pixels_per_cell=3,
        sticky_magnet=True,
        render_mode="rgb_array",
    )
    check_env(env.unwrapped)
    spaces = {
        "rgb": gymnasium.spaces.Box(0, 255, (18, 12, 3), np.uint8),
        "planes": gymnasium.spaces.Box(-128, 127, (6, 4, 4), np.int8),
        "index": gymnasium.spaces.Discrete(1512),
    }
    assert env.observation_space == spaces[observation]
    assert env.action_space == gymnasium.spaces.Discrete(6)


def test_a_stochastic_environment_passes_the_checker_and_follows_its_seed() -> None:
    env = GymnasiumEnv(Drift("index"), step_limit=30)
    check_env(env, skip_render_check=True)  # that check wants an environment made by its name

    def episode(**reset: Any) -> list:
        seen = [env.reset(**reset)[0]]
        for _ in range(20):
            seen.append(env.step(1)[0])
        return seen

    first, second = episode(seed=7), episode()
    assert first != second
    assert (episode(seed=7), episode()) == (first, second)
    assert episode(seed=8) != first


def test_it_agrees_with_the_numpy_environment() -> None:
    ours, theirs = gymnasium.make(ID, bricks=2, tower_height=2, step_limit=50), NumpyMagnetArm(4, 3, 2, 2, 50)
    actions = np.random.default_rng(0).integers(6, size=2_000)
    assert data_equivalence(ours.reset(), theirs.reset(), exact=True)
    ends = set()
    for action in actions.tolist():
        got, expected = ours.step(action), theirs.step(action)
        assert data_equivalence(got, expected, exact=True)
        if got[2] or got[3]:
            ends.add(got[2:4])
            ours.reset(), theirs.reset()
    assert ends == {(True, False), (False, True)}


def test_terminated_is_not_truncated() -> None:
    """An end on the very last step is a success, not a cut."""
    solve = [3, 3, 4, 1, 2, 5]  # down twice, on, up, right, off: two bricks in one column
    for step_limit, expected in ((None, (True, False)), (6, (True, False)), (5, (False, True))):
        env = GymnasiumEnv(MagnetArm(4, 3, 3, 2), step_limit)
        env.reset()
        steps = [env.step(action) for action in solve[:step_limit]]
        assert not any(terminated or truncated for _, _, terminated, truncated, _ in steps[:-1])
        _, reward, terminated, truncated, info = steps[-1]
        assert (terminated, truncated) == expected
        assert info == {"success": terminated}
        assert reward == (99.0 if terminated else -1.0)


def test_the_picture_is_for_people() -> None:
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset()
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.shape[0] > 200
    env = GymnasiumEnv(MagnetArm())
    env.reset()
    assert env.render() is None


def test_the_state_is_that_of_the_environment() -> None:
    env = GymnasiumEnv(MagnetArm())
    env.reset()
    env.step(3)
    assert int(env.state.row) == 1


def test_a_task_is_an_environment_too() -> None:
    check_env(GymnasiumEnv(lift_task(MagnetArm()), step_limit=20), skip_render_check=True)


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("float", gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)),
        ("bool", gymnasium.spaces.Box(0, 1, (10,), np.int8)),
        ("index", gymnasium.spaces.Discrete(10)),
    ],
)
def test_observation_spaces(kind: str, space: gymnasium.Space) -> None:
    env = GymnasiumEnv(Drift(kind), step_limit=20)
    assert env.observation_space == space
    assert env.reset(seed=0)[0] in space
    assert env.step(1)[0] in space


def test_observations_are_the_callers_to_change() -> None:
    env = GymnasiumEnv(MagnetArm())
    first, _ = env.reset()
    first[:] = 0
    assert env.reset()[0].any()


# Errors


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        ({"rows": 1}, InvalidConfig, "rows is 1"),
        ({"step_limit": 0}, InvalidConfig, "step_limit is 0"),
        ({"raws": 4}, UnknownName, "no parameter of magnet-arm named 'raws'"),
    ],
)
def test_bad_parameters(parameters: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        gymnasium.make(ID, **parameters)
    with pytest.raises(error, match=message):
        gymnasium.make_vec(ID, num_envs=2, **parameters)


def test_other_bad_arguments() -> None:
    with pytest.raises(InvalidConfig, match="render_mode is 'human'"):
        GymnasiumEnv(SMALL, render_mode="human")
    with pytest.raises(InvalidConfig, match="num_envs is 0"):
        GymnasiumVectorEnv(SMALL, 0)
    with pytest.raises(InvalidConfig, match="'Sometimes'"):
        GymnasiumVectorEnv(SMALL, 2, autoreset_mode="Sometimes")
    with pytest.raises(InvalidConfig, match="one array"):
        GymnasiumEnv(Drift("pair"))
    with pytest.raises(UnknownName, match="no environment named 'magnet'; there are: magnet-arm"):
        make_environment("magnet")


@pytest.mark.parametrize("action", [6, -1, 0.5])
def test_actions_out_of_range(action: float) -> None:
    env, envs = GymnasiumEnv(SMALL), GymnasiumVectorEnv(SMALL, 2)
    env.reset(), envs.reset()
    with pytest.raises(gymnasium.error.InvalidAction):
        env.step(action)
    with pytest.raises(gymnasium.error.InvalidAction):
        envs.step(np.array([0, action]))


def test_a_step_needs_a_reset() -> None:
    env, envs = GymnasiumEnv(SMALL), GymnasiumVectorEnv(SMALL, 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.state  # noqa: B018
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(2, dtype=int))
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.reset(options={"reset_mask": np.array([True, False])})


# Many copies


@pytest.mark.parametrize("environment", [SMALL, Drift("float"), lift_task(SMALL)])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_many_copies_are_that_many_single_ones(environment: Environment, mode: AutoresetMode) -> None:
    """Against Gymnasium's own vector of single environments, everything that they return, through many episodes."""
    copies, step_limit = 5, 25
    ours = GymnasiumVectorEnv(environment, copies, step_limit, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: GymnasiumEnv(environment, step_limit)] * copies, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert data_equivalence(ours.reset(seed=3), theirs.reset(seed=3), exact=True)
    actions = np.random.default_rng(0).integers(environment.num_actions, size=(150, copies))
    ends = np.zeros(2, dtype=int)
    for action in actions:
        got, expected = ours.step(action), theirs.step(action)
        assert data_equivalence(got, expected, exact=True)
        assert got[0] in ours.observation_space
        _, _, terminated, truncated, _ = got
        ends += terminated.sum(), truncated.sum()
        over = terminated | truncated
        if mode is AutoresetMode.DISABLED and over.any():
            # Gymnasium's own vector takes the mask out of the dictionary and leaves the infos of the others out.
            got = ours.reset(options={"reset_mask": over})
            expected = theirs.reset(options={"reset_mask": over.copy()})
            assert data_equivalence(got, expected, exact=True)
    assert np.all(ends > 0)


def test_same_step_gives_the_final_observation() -> None:
    envs = GymnasiumVectorEnv(SMALL, 3, step_limit=2)
    first, _ = envs.reset()
    envs.step(np.array([3, 2, 0]))
    observation, _, terminated, truncated, info = envs.step(np.array([3, 2, 0]))
    assert not terminated.any()
    assert truncated.all()
    np.testing.assert_array_equal(observation, first)
    assert all((final != start).any() for final, start in zip(info["final_obs"][:2], first[:2], strict=True))
    np.testing.assert_array_equal(info["final_info"]["success"], False)


def test_next_step_ignores_the_action_after_an_end() -> None:
    envs = GymnasiumVectorEnv(SMALL, 1, step_limit=1, autoreset_mode="NextStep")
    first, _ = envs.reset()
    envs.step(np.array([3]))
    observation, reward, terminated, truncated, _ = envs.step(np.array([3]))
    np.testing.assert_array_equal(observation, first)
    assert (reward[0], terminated[0], truncated[0]) == (0, False, False)


def test_disabled_refuses_to_step_what_is_over() -> None:
    envs = GymnasiumVectorEnv(SMALL, 2, step_limit=1, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset()
    envs.step(np.zeros(2, dtype=int))
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(2, dtype=int))
    envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros(2, dtype=int))
    envs.reset(options={"reset_mask": np.array([False, True])})
    envs.step(np.zeros(2, dtype=int))


def test_a_mask_resets_only_some() -> None:
    envs = GymnasiumVectorEnv(SMALL, 3, autoreset_mode="Disabled")
    first, _ = envs.reset()
    moved, *_ = envs.step(np.full(3, 3))
    observation, info = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(observation[1], first[1])
    np.testing.assert_array_equal(observation[[0, 2]], moved[[0, 2]])
    assert info["_success"].tolist() == [False, True, False]


@pytest.mark.parametrize("mask", [np.array([True]), np.array([1, 0]), [True, False], np.zeros(2, dtype=bool)])
def test_bad_masks(mask: Any) -> None:
    envs = GymnasiumVectorEnv(SMALL, 2)
    envs.reset()
    with pytest.raises(InvalidConfig, match="reset_mask"):
        envs.reset(options={"reset_mask": mask})


def test_seeds_of_a_vector() -> None:
    envs = GymnasiumVectorEnv(Drift("float"), 4)
    by_number, _ = envs.reset(seed=5)
    later, _ = envs.reset()
    one_by_one, _ = envs.reset(seed=[5, 6, 7, 8])
    np.testing.assert_array_equal(one_by_one, by_number)
    partly, _ = envs.reset(seed=[None, 6, 7, 8])
    np.testing.assert_array_equal(partly[1:], by_number[1:])
    np.testing.assert_array_equal(partly[0], later[0])
    with pytest.raises(InvalidConfig, match="3 seeds for 4 copies"):
        envs.reset(seed=[1, 2, 3])
    assert len({envs.reset()[0].tobytes() for _ in range(20)}) > 5


def test_made_by_name_many_copies_come_from_one_compiled_step() -> None:
    envs = gymnasium.make_vec(
        ID, num_envs=3, vectorization_mode="vector_entry_point", autoreset_mode="Disabled", render_mode="rgb_array"
    )
    assert isinstance(envs, GymnasiumVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == 3
    np.testing.assert_array_equal(frames[0], frames[2])


def test_copies_are_independent() -> None:
    envs = GymnasiumVectorEnv(SMALL, 3)
    first, _ = envs.reset()
    observation, *_ = envs.step(np.array([0, 3, 0]))
    np.testing.assert_array_equal(observation[[0, 2]], first[[0, 2]])
    assert (observation[1] != first[1]).any()


def test_nothing_is_compiled_twice() -> None:
    environment = MagnetArm(5, 3, 2, 2)
    for _ in range(2):
        env = GymnasiumEnv(environment, step_limit=3)
        envs = GymnasiumVectorEnv(environment, 2, step_limit=3)
        env.reset(seed=0), envs.reset(seed=0)
        for action in range(6):
            env.step(action), envs.step(np.full(2, action))
            env.reset(), envs.reset()
    before = adapter._step_one._cache_size(), adapter._step_many._cache_size(), adapter._begin_one._cache_size()
    again = GymnasiumEnv(MagnetArm(5, 3, 2, 2), step_limit=99)
    again.reset()
    again.step(0)
    after = adapter._step_one._cache_size(), adapter._step_many._cache_size(), adapter._begin_one._cache_size()
    assert after == before


# Others


def test_importing_lodestone_is_light() -> None:
    heavy = "{'jax', 'equinox', 'matplotlib', 'PIL', 'scipy', 'optax'}"
    code = f"import lodestone, sys, gymnasium; assert '{ID}' in gymnasium.registry; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_every_environment_of_the_registry_is_known_to_gymnasium() -> None:
    known = {spec.kwargs.get("environment") for spec in gymnasium.registry.values() if spec.namespace == "lodestone"}
    assert known == set(ENVIRONMENTS)


@pytest.mark.filterwarnings("default")  # what others warn about is theirs
def test_stable_baselines_trains_on_it() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make(ID, step_limit=50)
    model = sb3.DQN("MlpPolicy", env, learning_starts=50, buffer_size=500, device="cpu", seed=0)
    model.learn(200)
    assert model.num_timesteps == 200
