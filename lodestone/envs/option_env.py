"""Options as the actions of a Gymnasium environment, for learners that know actions only.

A learner that bootstraps with one discount for every action is wrong here: an option of k steps needs
`info["discount"]`, which is gamma^k, in its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Int8

from lodestone.errors import InvalidConfig, NoOptionAvailable

Info = dict[str, Any]


@dataclass(frozen=True)
class HostOption:
    """An option in plain Python: functions of an observation and the `info` that came with it."""

    name: str
    policy: Callable[[Any, Info], Any]
    """The action; any library's policy will do, as `lambda seen, info: model.predict(seen)[0]`."""
    termination: Callable[[Any, Info], float]
    """Probability that it stops on arrival; never asked where it begins."""
    initiation: Callable[[Any, Info], bool] = lambda seen, info: True
    """Whether it may begin."""
    max_steps: int | None = None
    """Steps after which it is stopped; None for never."""

    def __post_init__(self) -> None:
        if self.max_steps is not None and self.max_steps < 1:
            raise InvalidConfig(f"max_steps of {self.name} is {self.max_steps}, but an option runs at least one step.")


class OptionEnv(gymnasium.Wrapper):
    """The environment with its primitive actions, as options of one step, and more options. Actions count from 0.

    `info` tells of every step `steps` (k), `discount` (gamma^k; the caller multiplies by 1 - terminated),
    `total_reward` (the plain sum, where the reward returned is the discounted one) and `action_mask`, int8 [O], what
    may begin next. Where a limit cut an option that would have gone on, that option alone is in the mask: what
    bootstraps may use no other.
    """

    def __init__(
        self, env: gymnasium.Env, options: Sequence[HostOption], discount: float, primitives: bool = True
    ) -> None:
        """Raises `InvalidConfig`."""
        super().__init__(env)
        if not isinstance(env.action_space, spaces.Discrete):
            raise InvalidConfig(f"Options are over discrete actions, but these are {env.action_space}.")
        if not 0.0 <= discount <= 1.0:
            raise InvalidConfig(f"discount is {discount}, but must be from 0 to 1.")
        self.discount = discount
        self.options = tuple(options)
        self._first, self._primitives = int(env.action_space.start), int(env.action_space.n) if primitives else 0
        if not self._primitives + len(self.options):
            raise InvalidConfig("There is nothing to choose from: no options and no primitive actions.")
        self.action_space = spaces.Discrete(len(self.option_names))
        self._seen: Any = None
        self._info: Info = {}

    @property
    def option_names(self) -> tuple[str, ...]:
        """Of all that can be chosen."""
        return (*map(str, range(self._primitives)), *(option.name for option in self.options))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Begin an episode."""
        self._seen, self._info = self.env.reset(seed=seed, options=options)
        return self._seen, self._info | {"action_mask": self._mask()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Run one option to its end. Raises `gymnasium.error.InvalidAction` for one that may not begin here, and
        `NoOptionAvailable` where none may begin next."""
        choice = int(action)
        if not self.action_space.contains(choice) or not self._mask()[choice]:
            raise gymnasium.error.InvalidAction(f"Option {action!r} may not begin here.")
        option = None if choice < self._primitives else self.options[choice - self._primitives]
        reward, plain, factor, steps = 0.0, 0.0, 1.0, 0
        while True:
            primitive = choice + self._first if option is None else option.policy(self._seen, self._info)
            self._seen, paid, terminated, truncated, self._info = self.env.step(primitive)
            reward, plain = reward + factor * float(paid), plain + float(paid)
            factor, steps = factor * self.discount, steps + 1
            stops = option is None or self._stops(option, steps)
            if stops or terminated or truncated:
                break
        if stops or terminated:
            mask = self._mask()
        else:
            mask = (np.arange(len(self.option_names)) == choice).astype(np.int8)
        if not (mask.any() or terminated):
            raise NoOptionAvailable("No option may begin where the last one ended.")
        told = {"steps": steps, "discount": factor, "total_reward": plain, "action_mask": mask}
        return self._seen, reward, bool(terminated), bool(truncated), self._info | told

    def _stops(self, option: HostOption, steps: int) -> bool:
        if option.max_steps is not None and steps >= option.max_steps:
            return True
        probability = float(option.termination(self._seen, self._info))
        if not (math.isfinite(probability) and 0.0 <= probability <= 1.0):
            raise InvalidConfig(f"The termination of {option.name} is {probability}, but must be from 0 to 1.")
        return bool(self.np_random.random() < probability)

    def _mask(self) -> Int8[np.ndarray, " O"]:
        allowed = self._info.get("action_mask")
        actions = np.ones(self._primitives, np.int8) if allowed is None else np.asarray(allowed)[: self._primitives]
        begins = [bool(option.initiation(self._seen, self._info)) for option in self.options]
        return np.concatenate([actions, np.array(begins)]).astype(np.int8)
