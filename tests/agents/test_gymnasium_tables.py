"""Tables learned in Gymnasium environments that show a number: what is learned is what is exact."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.playing import play_many
from lodestone.agents.policies import Policy
from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.sarsa import SarsaConfig
from lodestone.agents.saved import load_policy, save_policy
from lodestone.agents.training import check_training, train_policy
from lodestone.envs.host import FromFunction, Registered
from lodestone.errors import InvalidConfig
from lodestone.options.base import NO_CAP, Options, Union, primitives
from lodestone.options.execution import Rules

FIRST_PLACE, FIRST_ACTION = 3, 5


class Walk(gymnasium.Env):
    """Five places; in the last the walk ends and pays 10. Steps cost 1, after three of them it is cut. Going left is
    forbidden in the first place."""

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
        return seen, 10.0 if self.place == 4 else -1.0, self.place == 4, self.time == 3, info


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


def test_observations_that_are_no_number_are_refused():
    pole = Registered("CartPole-v1")
    with pytest.raises(InvalidConfig, match="one number out of n"):
        check_training(QLearningConfig(), pole, primitives(pole), Rules())
