"""Every Gymnasium environment with discrete actions, as an environment for the agents that learn from steps.

A copy of one is an object with a memory of its own; its state here is what it said last. Where the compiled loop takes
a step it asks the objects, all copies of a device in one call. Nothing can be planned in them, nor tabulated.

A limit of the environment itself (`truncated`) is not an end: the episode is cut, and its tail bootstraps.
"""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, NoReturn, cast

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int, Num, PyTree, UInt8

from lodestone.envs.base import Environment, OutsideEnvironment
from lodestone.errors import EnvironmentFailed, InvalidConfig, TooManyStates
from lodestone.types import Observation


class Seen(NamedTuple):
    """What a copy shows."""

    observation: Num[Array, "..."]
    allowed: Bool[Array, " A"]
    """Actions that `info["action_mask"]` allows; all of them without it."""


class HostState(NamedTuple):
    """What one copy said last."""

    copy: Int[Array, ""]
    """Its number."""
    clock: Int[Array, ""]
    """Steps that it has taken in all; negative while it is held still."""
    seen: Seen
    reward: Float[Array, ""]
    """Of the last step."""
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    next_seen: Seen | None
    """Where the last step ended an episode: how the next one begins. A memory does without."""


class HostEnvironment(OutsideEnvironment):
    """Copies of a Gymnasium environment. Equal ones share their copies.

    Raises `InvalidConfig` where actions are not discrete, or no network here takes the observations.
    """

    @abstractmethod
    def build(self, render_mode: str | None = None) -> gymnasium.Env:
        """A new copy."""

    @property
    def copies(self) -> Copies:
        """The living ones."""
        if self not in _COPIES:
            _COPIES[self] = Copies(self.build)
        return _COPIES[self]

    def close(self) -> None:
        if self in _COPIES:
            _COPIES.pop(self).close()

    @property
    def action_names(self) -> tuple[str, ...]:
        return self.copies.action_names

    @property
    def num_outcomes(self) -> int:
        """Whatever chance there is, the copies draw themselves."""
        return 1

    def outcome_probs(self, state: HostState, action: Int[Array, ""]) -> Float[Array, " K"]:
        del state, action
        return jnp.ones(1)

    def initial_distribution(self) -> NoReturn:
        raise TooManyStates("A Gymnasium environment does not list its states: it can be learned in, not planned in.")

    def example(self) -> HostState:
        shapes = self.copies.shapes
        return self._opening(jnp.int32(0), jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))

    def begin(self, uniform: Float[Array, ""]) -> HostState:
        shapes = (jax.ShapeDtypeStruct((), jnp.int32), self.copies.shapes)
        return self._opening(*_ask(self.copies.begin, shapes, uniform))

    def begin_again(self, ended: HostState) -> HostState:
        assert ended.next_seen is not None
        return self._opening(ended.copy, ended.next_seen)._replace(clock=ended.clock)

    def hold(self, state: HostState, still: Bool[Array, ""]) -> HostState:
        return state._replace(clock=jnp.where(still, -1, state.clock))

    def transition(self, state: HostState, action: Int[Array, ""], outcome: Int[Array, ""]) -> HostState:
        del outcome
        shapes = jax.eval_shape(self.example)
        return HostState(*_ask(self.copies.step, tuple(shapes), state.copy, state.clock, action))

    def reward(self, state: HostState, action: Int[Array, ""], next_state: HostState) -> Float[Array, ""]:
        del state, action
        return next_state.reward

    def terminal(self, state: HostState) -> Bool[Array, ""]:
        return state.terminated

    def allowed(self, state: HostState) -> Bool[Array, " A"]:
        return state.seen.allowed

    def truncated(self, state: HostState) -> Bool[Array, ""]:
        return state.truncated

    def remember(self, state: HostState) -> HostState:
        return state._replace(next_seen=None)

    def observe(self, state: HostState) -> Observation:
        """What the environment shows; a number out of n as n numbers, of which that one is 1."""
        count = self.copies.count
        return state.seen.observation if count is None else jax.nn.one_hot(state.seen.observation, count)

    @property
    def num_states(self) -> int:
        """How many numbers an observation may be, which are the states of a table. Raises `InvalidConfig` where it is
        none."""
        if self.copies.count is None:
            raise InvalidConfig(
                "A table needs observations that are one number out of n, which this environment's are not; an agent "
                "with a network takes them."
            )
        return self.copies.count

    @property
    def step_limit(self) -> int | None:
        """Steps after which an episode is truncated, as far as Gymnasium's `TimeLimit` does it."""
        return self.copies.step_limit

    def render(self, state: HostState) -> UInt8[np.ndarray, "height width 3"]:
        raise NotImplementedError("A copy can only show what it is now.")

    @staticmethod
    def _opening(copy: Int[Array, ""], seen: Seen) -> HostState:
        no = jnp.bool_(False)
        return HostState(copy, jnp.int32(0), seen, jnp.float32(0), no, no, seen)


class Shown(eqx.Module):
    """The numbering of states by the number that a Gymnasium environment shows."""

    environment: HostEnvironment

    @property
    def size(self) -> int:
        """How many there are. Raises `InvalidConfig` where an observation is no number."""
        return self.environment.num_states

    @property
    def states(self) -> HostState:
        """All of them, stacked along a leading axis: a number each. Nothing else is known of such a state."""
        unknown = cast(Any, None)
        seen = Seen(jnp.arange(self.size), unknown)
        return HostState(unknown, unknown, seen, unknown, unknown, unknown, unknown)

    def index_of(self, state: HostState) -> Int[Array, ""]:
        """The number that a state shows."""
        return state.seen.observation


class Registered(HostEnvironment):
    """A Gymnasium environment by its id."""

    id: str = eqx.field(static=True)
    """As `gymnasium.make` takes it: "CartPole-v1", or "module:id" of one that a module registers."""
    observation: str | None = eqx.field(static=True, default=None)
    """Which entry of its observations the agent sees, where they are a dictionary."""
    max_episode_steps: int | None = eqx.field(static=True, default=None)
    """Steps after which an episode is truncated. Default: the environment's own limit."""

    def build(self, render_mode: str | None = None) -> gymnasium.Env:
        limit = self.max_episode_steps
        pictures = {} if render_mode is None else {"render_mode": render_mode}  # which not every environment takes
        try:
            made = gymnasium.make(self.id, limit, disable_env_checker=True, **pictures)
        except (gymnasium.error.Error, ImportError) as error:
            raise InvalidConfig(f"Gymnasium cannot make {self.id}: {str(error).rstrip('.')}.") from None
        except TypeError as error:
            raise EnvironmentFailed(f"Gymnasium cannot make {self.id}: {str(error).rstrip('.')}.") from None
        return made if self.observation is None else _entry(made, self.observation)


class FromFunction(HostEnvironment):
    """A Gymnasium environment of one's own, from a function that makes a copy."""

    make: Callable[[], gymnasium.Env] = eqx.field(static=True)

    def build(self, render_mode: str | None = None) -> gymnasium.Env:
        return self.make()


@contextmanager
def visit(environment: Environment, film: bool = False) -> Iterator[list[UInt8[np.ndarray, "height width 3"]]]:
    """Acting in an environment: where it lives outside, its copies end with the block, and what they raise is
    raised as `EnvironmentFailed`. With `film`, yields a list that fills with the first copy's pictures."""
    if not isinstance(environment, HostEnvironment):
        yield []
        return
    environment.close()
    copies = _COPIES[environment] = Copies(partial(environment.build, "rgb_array") if film else environment.build)
    copies.film = [] if film else None
    log = logging.getLogger("jax._src.callback")  # which would print the error, too
    log.disabled = True
    try:
        yield copies.film if copies.film is not None else []
    except Exception:  # a compiled program raises another one than was raised in it
        if copies.failure is None:
            raise
        failure = f"{type(copies.failure).__name__}: {copies.failure}"
        raise EnvironmentFailed(f"The environment failed while an agent acted in it: {failure}.") from copies.failure
    finally:
        log.disabled = False
        environment.close()


def is_registered(name: str) -> bool:
    """Whether Gymnasium knows such an id, or it names a module that will tell."""
    return ":" in name or name in gymnasium.registry


def _entry(environment: gymnasium.Env, name: str) -> gymnasium.Env:
    """The environment with one entry of its observations alone."""
    space = environment.observation_space
    if not isinstance(space, spaces.Dict):
        raise InvalidConfig(f"observation is {name!r}, but this environment's observations are no dictionary.")
    if name not in space.spaces:
        raise InvalidConfig(f"observation is {name!r}, but must be one of: {', '.join(space.spaces)}.")
    entry = space.spaces[name]
    return gymnasium.wrappers.TransformObservation(environment, lambda seen: seen[name], entry)


def _ask(function: Callable[..., PyTree], shapes: PyTree, *arguments: Array) -> PyTree:
    """Each call's arguments depend on what the one before returned, which keeps them in order."""
    return jax.pure_callback(function, shapes, *arguments, vmap_method="broadcast_all")


class Copies:
    """Objects of a Gymnasium environment, by number, on the host. Arrays have leading axes of any number, B: of seeds,
    of environments."""

    def __init__(self, build: Callable[[], gymnasium.Env]) -> None:
        self._build = build
        self._living: list[gymnasium.Env] = []
        self._clocks: list[int] = []
        self.failure: Exception | None = None
        """What an object raised."""
        self._spare: gymnasium.Env | None = build()
        actions, observations = self._spare.action_space, self._spare.observation_space
        if not isinstance(actions, spaces.Discrete):
            raise InvalidConfig(f"Its actions are {actions}, but agents here choose among discrete ones.")
        self._first_action = int(actions.start)
        self.action_names = _action_names(self._spare, int(actions.n))
        limited = self._spare.has_wrapper_attr("_max_episode_steps")
        self.step_limit: int | None = self._spare.get_wrapper_attr("_max_episode_steps") if limited else None
        self.count: int | None = None
        """Of numbers that an observation may be, where it is one."""
        self._first_number = 0
        if isinstance(observations, spaces.Discrete):
            self.count, self._first_number = int(observations.n), int(observations.start)
            seen = jax.ShapeDtypeStruct((), jnp.int32)
        elif isinstance(observations, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
            dtype = observations.dtype
            seen = jax.ShapeDtypeStruct(observations.shape, dtype if dtype == np.uint8 else jnp.float32)
        else:
            hint = ""
            if isinstance(observations, spaces.Dict):
                hint = f"; choose one by `observation`: {', '.join(observations.spaces)}"
            raise InvalidConfig(
                f"Its observations are {observations}, but have to be one array or number{hint}; "
                "gymnasium.wrappers has FlattenObservation."
            )
        self.shapes: Any = Seen(cast(Any, seen), cast(Any, jax.ShapeDtypeStruct((len(self.action_names),), jnp.bool_)))
        self.film: list[UInt8[np.ndarray, "height width 3"]] | None = None
        """Where not None, pictures of the first copy are added: of its first state, and after every step."""

    def begin(self, uniform: Float[Array, "*B"]) -> tuple[Int[np.ndarray, "*B"], Seen]:
        """So many new copies at the start of an episode; each is seeded by its number."""
        drawn = np.asarray(uniform)
        numbers, seen = np.zeros(drawn.shape, np.int32), self._blank(drawn.shape)
        for at in np.ndindex(drawn.shape):
            copy, self._spare = self._spare or self._build(), None
            numbers[at] = len(self._living)
            self._living.append(copy)
            self._clocks.append(0)
            self._put(seen, at, *self._guard(partial(copy.reset, seed=int(drawn[at] * 2**24))))
            self._photograph(int(numbers[at]))
        return numbers, seen

    def step(
        self, copy: Int[Array, "*B"], clock: Int[Array, "*B"], action: Int[Array, "*B"]
    ) -> tuple[np.ndarray, np.ndarray, Seen, np.ndarray, np.ndarray, np.ndarray, Seen]:
        """One step of each, but of those that are held still; the fields of `HostState`. `ANEW` is no step."""
        numbers, clocks, actions = (np.asarray(each) for each in (copy, clock, action))
        shape = numbers.shape
        if np.unique(numbers).size < numbers.size:
            raise RuntimeError("Two ask the same copy for a step.")
        seen, next_seen = self._blank(shape), self._blank(shape)
        rewards, terminated, truncated = np.zeros(shape, np.float32), np.zeros(shape, bool), np.zeros(shape, bool)
        for at in np.ndindex(shape):
            number = int(numbers[at])
            if clocks[at] < self._clocks[number]:  # held still, or over in a loop that runs until the last one is
                continue
            one = self._living[number]
            if actions[at] == ANEW:
                self._put(seen, at, *self._guard(one.reset))
                self._clocks[number] += 1
                self._photograph(number)
                continue
            shown, reward, ended, cut, info = self._guard(partial(one.step, int(actions[at]) + self._first_action))
            self._clocks[number] += 1
            self._photograph(number)
            self._put(seen, at, shown, info)
            rewards[at], terminated[at], truncated[at] = reward, ended, cut and not ended
            if ended or cut:
                self._put(next_seen, at, *self._guard(one.reset))
        return numbers, clocks + np.int32(1), seen, rewards, terminated, truncated, next_seen

    def close(self) -> None:
        for one in (*self._living, *([self._spare] if self._spare else [])):
            one.close()

    def _blank(self, shape: tuple[int, ...]) -> Seen:
        return jax.tree.map(lambda leaf: np.zeros((*shape, *leaf.shape), leaf.dtype), self.shapes)

    def _put(self, seen: Seen, at: tuple[int, ...], observation: Any, info: dict[str, Any]) -> None:
        shown, allowed = cast(np.ndarray, seen.observation), cast(np.ndarray, seen.allowed)
        shown[at] = observation - self._first_number if self.count is not None else observation
        mask = info.get("action_mask")
        allowed[at] = True if mask is None else np.asarray(mask, dtype=bool)

    def _photograph(self, number: int) -> None:
        if self.film is not None and number == 0:
            self.film.append(np.asarray(self._guard(self._living[0].render), dtype=np.uint8))

    def _guard(self, call: Callable[[], Any]) -> Any:
        """`call()`, with an error kept for whoever started the program that asks."""
        try:
            return call()
        except Exception as error:
            self.failure = error
            raise


ANEW = -1
"""In place of an action: the episode is given up, and the next one begins."""

_COPIES: dict[HostEnvironment, Copies] = {}


def _action_names(environment: gymnasium.Env, count: int) -> tuple[str, ...]:
    """As the environment calls them (Atari, MiniGrid), or numbers."""
    inner = environment.unwrapped
    if hasattr(inner, "get_action_meanings"):
        names = tuple(str(name).lower() for name in inner.get_action_meanings())
    elif hasattr(inner, "actions") and hasattr(inner.actions, "__members__"):
        names = tuple(str(name) for name in inner.actions.__members__)
    else:
        names = ()
    return names if len(set(names)) == count else tuple(str(number) for number in range(count))
