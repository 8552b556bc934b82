"""Every environment of Lodestone as a Gymnasium environment: one copy, or many copies in one compiled step.

After `import lodestone`:

    gymnasium.make("lodestone/MagnetArm-v0", rows=6, columns=4, bricks=4, tower_height=4, step_limit=200)
    gymnasium.make_vec("lodestone/MagnetArm-v0", num_envs=64, autoreset_mode="Disabled")

Here, and not in the environment, live the clock, the random key and the reset. A terminal state gives
`terminated=True`, the step limit `truncated=True`, never both. `info["success"]` says whether the episode ended in a
terminal state. Copy i of a vector that was seeded with s behaves as a single environment seeded with s + i.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8, UInt32

from lodestone.envs.base import Environment, example_state, sample_initial, sample_step
from lodestone.envs.registry import make_environment
from lodestone.envs.state_space import reachable_states
from lodestone.errors import InvalidConfig
from lodestone.types import Observation, State

METADATA = {"render_modes": ["rgb_array"], "render_fps": 8}
"""A person can follow eight frames a second."""


class Chance(NamedTuple):
    """Where all that is random in one copy comes from: draw number `drawn` of a stream.

    A counter and not a key that is split at every step: where a world is deterministic, XLA leaves the hashing out.
    """

    seed: UInt32[Array | np.ndarray, ""]
    drawn: UInt32[Array | np.ndarray, ""]

    def key(self) -> PRNGKeyArray:
        return jax.random.fold_in(jax.random.key(self.seed), self.drawn)

    def after(self) -> Chance:
        """The stream after one draw."""
        return Chance(self.seed, self.drawn + jnp.uint32(1))


class Running(NamedTuple):
    """One copy in the middle of an episode."""

    state: State
    chance: Chance
    elapsed: Int[Array, ""]
    """Steps since the episode began."""


class Outcome(NamedTuple):
    """What one step of one copy brought."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]


def _begin(environment: Environment, chance: Chance) -> Running:
    """The start of an episode."""
    return Running(sample_initial(environment, chance.key()), chance.after(), jnp.int32(0))


def _advance(
    environment: Environment, step_limit: Int[Array, ""], running: Running, action: Int[Array, ""]
) -> tuple[Running, Outcome]:
    """One step, without any reset."""
    step = sample_step(environment, running.chance.key(), running.state, action)
    elapsed = running.elapsed + 1
    truncated = (elapsed >= step_limit) & ~step.terminated
    return Running(step.state, running.chance.after(), elapsed), Outcome(step.reward, step.terminated, truncated)


def _either(condition: Bool[Array, ""], one: Running, other: Running) -> Running:
    return jax.tree.map(partial(jnp.where, condition), one, other)


@jax.jit
def _begin_one(environment: Environment, chance: Chance) -> tuple[Running, Observation]:
    running = _begin(environment, chance)
    return running, environment.observe(running.state)


@jax.jit
def _step_one(
    environment: Environment, step_limit: Int[Array, ""], running: Running, action: Int[Array, ""]
) -> tuple[Running, Observation, Outcome]:
    running, outcome = _advance(environment, step_limit, running, action)
    return running, environment.observe(running.state), outcome


@jax.jit
def _begin_many(environment: Environment, chance: Chance) -> tuple[Running, Observation]:
    return jax.vmap(partial(_begin_one, environment))(chance)


@jax.jit
def _begin_some(
    environment: Environment, mask: Bool[Array, " N"], running: Running, chance: Chance
) -> tuple[Running, Observation]:
    """New episodes where `mask` is true; the others go on."""

    def begin(mask: Bool[Array, ""], running: Running, chance: Chance) -> tuple[Running, Observation]:
        running = _either(mask, _begin(environment, chance), running)
        return running, environment.observe(running.state)

    return jax.vmap(begin)(mask, running, chance)


@partial(jax.jit, static_argnames="mode")
def _step_many(
    environment: Environment,
    step_limit: Int[Array, ""],
    running: Running,
    over: Bool[Array, " N"],
    action: Int[Array, " N"],
    mode: AutoresetMode,
) -> tuple[Running, Observation, Outcome, Observation]:
    """One step of every copy, with the resets that `mode` asks for; `over` says whose episode ended before this step.

    Returns the observations after the resets, the outcomes, and the observations before the resets.
    """

    def step(
        running: Running, over: Bool[Array, ""], action: Int[Array, ""]
    ) -> tuple[Running, Observation, Outcome, Observation]:
        after, outcome = _advance(environment, step_limit, running, action)
        final = environment.observe(after.state)
        if mode is AutoresetMode.DISABLED:
            return after, final, outcome, final
        if mode is AutoresetMode.SAME_STEP:
            after = _either(outcome.terminated | outcome.truncated, _begin(environment, after.chance), after)
        else:
            after = _either(over, _begin(environment, running.chance), after)
            outcome = jax.tree.map(lambda leaf: jnp.where(over, jnp.zeros_like(leaf), leaf), outcome)
        return after, environment.observe(after.state), outcome, final

    return jax.vmap(step)(running, over, action)


def observation_space(environment: Environment) -> spaces.Space:
    """The space of what `environment.observe` returns: `Discrete` for a scalar integer, which is the number of a
    state; otherwise a `Box` of the array's shape and dtype.

    Raises `InvalidConfig` for an observation that is not one array.
    """
    observation = jax.eval_shape(lambda: environment.observe(example_state(environment)))
    if not isinstance(observation, jax.ShapeDtypeStruct):
        raise InvalidConfig("Gymnasium gets observations that are one array, but this environment's are a structure.")
    shape, dtype = observation.shape, np.dtype(observation.dtype)
    if shape == () and np.issubdtype(dtype, np.integer):
        return spaces.Discrete(reachable_states(environment).size)
    if np.issubdtype(dtype, np.floating):
        return spaces.Box(-np.inf, np.inf, shape, dtype)
    if np.issubdtype(dtype, np.bool_):
        return spaces.Box(0, 1, shape, np.int8)
    return spaces.Box(np.iinfo(dtype).min, np.iinfo(dtype).max, shape, dtype)


def _clock(step_limit: int | None) -> np.int32:
    """The step limit as the compiled step takes it."""
    if step_limit is None:
        return np.int32(np.iinfo(np.int32).max)
    if step_limit < 1:
        raise InvalidConfig(f"step_limit is {step_limit}, but must be at least 1, or None for no limit.")
    return np.int32(step_limit)


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise InvalidConfig(f"render_mode is {render_mode!r}, but must be None or 'rgb_array'.")


def _chance(generator: np.random.Generator) -> Chance:
    """A stream of its own for one copy."""
    return Chance(generator.integers(2**32, size=(), dtype=np.uint32), np.zeros((), dtype=np.uint32))


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.int64]):
    """One copy of an environment."""

    def __init__(self, environment: Environment, step_limit: int | None = None, render_mode: str | None = None) -> None:
        """`step_limit`: steps after which an episode is truncated. Raises `InvalidConfig`."""
        _check_render_mode(render_mode)
        self.metadata = dict(METADATA)
        self.environment = environment
        self.step_limit = step_limit
        self.render_mode = render_mode
        self.observation_space = observation_space(environment)
        self.action_space = spaces.Discrete(environment.num_actions)
        self._clock = _clock(step_limit)
        self._running: Running | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode; with a seed, the first of a reproducible sequence of episodes."""
        super().reset(seed=seed)
        if seed is not None or self._running is None:
            chance = _chance(self.np_random)
        else:
            chance = self._running.chance
        self._running, observation = _begin_one(self.environment, chance)
        return self._to_host(observation), {"success": False}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One primitive step. Raises `gymnasium.error.ResetNeeded` and `gymnasium.error.InvalidAction`."""
        if self._running is None:
            raise gymnasium.error.ResetNeeded("Call reset before the first step.")
        if not self.action_space.contains(action):
            raise gymnasium.error.InvalidAction(f"The action is {action!r}, but must be in {self.action_space}.")
        self._running, observation, outcome = _step_one(self.environment, self._clock, self._running, np.int32(action))
        reward, terminated, truncated = (value.item() for value in outcome)
        return self._to_host(observation), reward, terminated, truncated, {"success": terminated}

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """The picture for people, or None without a render mode."""
        if self.render_mode is None or self._running is None:
            return None
        return self.environment.render(jax.tree.map(np.asarray, self._running.state))

    @property
    def state(self) -> State:
        """The environment's own state, for tests and for planning."""
        if self._running is None:
            raise gymnasium.error.ResetNeeded("Call reset before asking for the state.")
        return self._running.state

    def _to_host(self, observation: Array) -> np.ndarray:
        """A copy that the caller may write to; a number for an observation without axes."""
        return np.array(observation, dtype=self.observation_space.dtype)[()]


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N copies of an environment that one compiled call steps together."""

    def __init__(
        self,
        environment: Environment,
        num_envs: int,
        step_limit: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ) -> None:
        """`autoreset_mode`: who begins the next episode. `SAME_STEP` begins it in the step that ends the last one, so
        that no step is wasted; `NEXT_STEP` in the step after, whose action is ignored; with `DISABLED` the caller does,
        by `reset(options={"reset_mask": mask})`. Raises `InvalidConfig`."""
        _check_render_mode(render_mode)
        if num_envs < 1:
            raise InvalidConfig(f"num_envs is {num_envs}, but must be at least 1.")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise InvalidConfig(f"autoreset_mode is {autoreset_mode!r}, but must be one of {known}.") from None
        self.metadata = {**METADATA, "autoreset_mode": self._mode}
        self.environment = environment
        self.num_envs = num_envs
        self.step_limit = step_limit
        self.render_mode = render_mode
        self.single_observation_space = observation_space(environment)
        self.single_action_space = spaces.Discrete(environment.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._clock = _clock(step_limit)
        self._running: Running | None = None
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes: in every copy, or where `options["reset_mask"]` (bool [N]) is true.

        An integer `seed` gives copy i the seed `seed + i`; a sequence gives one seed, or None, to each copy.
        Raises `InvalidConfig` for a mask or seeds of a wrong shape.
        """
        mask, chance = self._reset_mask(options), self._reset_chance(seed)
        if mask.all():
            self._running, observation = _begin_many(self.environment, chance)
        elif self._running is None:
            raise gymnasium.error.ResetNeeded("Reset every copy before resetting some.")
        else:
            self._running, observation = _begin_some(self.environment, mask, self._running, chance)
        self._over &= ~mask
        return self._to_host(observation), {"success": np.zeros(self.num_envs, dtype=bool), "_success": mask}

    def _reset_mask(self, options: dict[str, Any] | None) -> Bool[np.ndarray, " N"]:
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise InvalidConfig(f"reset_mask must be a bool array of shape ({self.num_envs},) with a True in it.")
        return mask.copy()

    def _reset_chance(self, seed: int | Sequence[int | None] | None) -> Chance:
        """Each copy's stream: that of its seed, or the one that it goes on with."""
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seeds: Sequence[int | None] = [int(seed) + copy for copy in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else seed
        if len(seeds) != self.num_envs:
            raise InvalidConfig(f"There are {len(seeds)} seeds for {self.num_envs} copies.")
        if self._running is not None and all(each is None for each in seeds):
            return self._running.chance
        streams = [_chance(self.np_random if each is None else seeding.np_random(each)[0]) for each in seeds]
        chance = jax.tree.map(lambda *leaves: np.stack(leaves), *streams)
        if self._running is None:
            return chance
        goes_on = np.array([each is None for each in seeds])
        return jax.tree.map(lambda old, new: np.where(goes_on, old, new), self._running.chance, chance)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One primitive step of every copy. Raises `gymnasium.error.ResetNeeded` and `gymnasium.error.InvalidAction`.

        In the mode `SAME_STEP`, `info["final_obs"]` and `info["final_info"]` hold what the step led to, where an
        episode ended; the observation is the next episode's first.
        """
        if self._running is None or (self._mode is AutoresetMode.DISABLED and self._over.any()):
            raise gymnasium.error.ResetNeeded("Reset every copy whose episode is over before the next step.")
        actions = np.asarray(actions)
        if not self.action_space.contains(actions):
            raise gymnasium.error.InvalidAction(f"The actions are {actions!r}, but must be in {self.action_space}.")
        self._running, observation, outcome, final = _step_many(
            self.environment, self._clock, self._running, self._over, actions.astype(np.int32), self._mode
        )
        rewards = np.array(outcome.reward, dtype=np.float64)
        terminated, truncated = np.array(outcome.terminated), np.array(outcome.truncated)
        self._over = terminated | truncated
        info = {"success": terminated.copy(), "_success": np.ones(self.num_envs, dtype=bool)}
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            info = self._same_step_info(self._to_host(final), terminated)
        return self._to_host(observation), rewards, terminated, truncated, info

    def _same_step_info(self, final: np.ndarray, terminated: Bool[np.ndarray, " N"]) -> dict[str, Any]:
        """Gymnasium's layout: `info` is the new episodes', `final_info` and `final_obs` those of the ended ones."""
        final_obs = np.full(self.num_envs, None, dtype=object)
        for copy in np.flatnonzero(self._over):
            final_obs[copy] = final[copy]
        return {
            "final_obs": final_obs,
            "_final_obs": self._over.copy(),
            "final_info": {"success": terminated.copy(), "_success": self._over.copy()},
            "_final_info": self._over.copy(),
            "success": np.zeros(self.num_envs, dtype=bool),
            "_success": np.ones(self.num_envs, dtype=bool),
        }

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """The pictures for people, one a copy, or None without a render mode."""
        if self.render_mode is None or self._running is None:
            return None
        states = jax.tree.map(np.asarray, self._running.state)
        return tuple(
            self.environment.render(jax.tree.map(lambda leaf, copy=copy: leaf[copy], states))
            for copy in range(self.num_envs)
        )

    def _to_host(self, observation: Array) -> np.ndarray:
        """A copy that the caller may write to."""
        return np.array(observation, dtype=self.observation_space.dtype)


def make(
    environment: str, step_limit: int | None = None, render_mode: str | None = None, **parameters: Any
) -> GymnasiumEnv:
    """What `gymnasium.make` calls: `environment` is a name of the registry, `parameters` are that environment's."""
    return GymnasiumEnv(make_environment(environment, **parameters), step_limit, render_mode)


def make_vector(
    environment: str,
    num_envs: int,
    step_limit: int | None = None,
    render_mode: str | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    **parameters: Any,
) -> GymnasiumVectorEnv:
    """What `gymnasium.make_vec` calls, as `make`."""
    return GymnasiumVectorEnv(
        make_environment(environment, **parameters), num_envs, step_limit, render_mode, autoreset_mode
    )
