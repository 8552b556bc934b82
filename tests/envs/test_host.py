"""Environments outside the program: what agents learn from them is what they did."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig
from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.agents.hdqn import HDQNConfig, hdqn
from lodestone.agents.playing import play_many
from lodestone.agents.policies import PlanPolicy, Policy
from lodestone.agents.saved import load_policy, save_policy
from lodestone.agents.straw import StrawConfig, collect
from lodestone.agents.training import train_policy
from lodestone.envs.host import FromFunction, HostEnvironment, Registered, visit
from lodestone.envs.registry import make_environment
from lodestone.envs.task import goal
from lodestone.errors import EnvironmentFailed, InvalidConfig, TooManyStates
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_execution import start_planning
from lodestone.learning.plan_network import PlanConfig, init_plan_network
from lodestone.options.base import Options, Union, primitives
from lodestone.options.execution import Rules
from lodestone.planning.tables import tabulate

LOG: list[tuple] = []
"""Every step of every `Walk`: (copy, before, action, reward, terminated, truncated, after)."""


class Walk(gymnasium.Env):
    """A number that actions lower or raise. At 4 the walk ends; after 7 steps it is cut. Lowering is forbidden at 0."""

    observation_space = spaces.Box(-1, 10, (2,), np.float32)
    action_space = spaces.Discrete(2, start=5)
    made = 0

    def __init__(self, fails_at: int = 99) -> None:
        self.copy, Walk.made = Walk.made, Walk.made + 1
        self.fails_at = fails_at

    def _see(self) -> tuple[np.ndarray, dict[str, Any]]:
        return np.array([self.place, self.copy], np.float32), {"action_mask": np.array([self.place > 0, 1], np.int8)}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.time = int(self.np_random.integers(3)), 0
        return self._see()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        before, self.place, self.time = self.place, self.place + (1 if action == 6 else -1), self.time + 1
        if self.place == self.fails_at:
            raise OSError("the walk is blocked")
        assert self.place >= 0, "a forbidden action was taken"
        ended, cut = self.place == 4, self.time == 7
        LOG.append((self.copy, before, action - 5, 10.0 * ended - 1, ended, cut and not ended, self.place))
        return (*self._see()[:1], 10.0 * ended - 1, ended, cut, self._see()[1])


class UpTwice(Options):
    """Raises the number until it is even."""

    @property
    def names(self):
        return ("up twice",)

    @property
    def max_steps(self):
        return (5,)

    def initiation(self, state):
        return jnp.ones(1, dtype=bool)

    def action_probs(self, state):
        return jnp.array([[0.0, 1.0]])

    def termination(self, state):
        return (state.seen.observation[:1] % 2 == 0).astype(jnp.float32)


SMALL = DQNConfig(
    network=NetworkConfig((), (), (), (8,)),
    environments=3,
    decisions_per_round=4,
    updates_per_round=2,
    learning_starts=8,
)


@pytest.fixture
def walk():
    LOG.clear()
    Walk.made = 0
    return FromFunction(Walk)


def trained(environment: HostEnvironment, options: Options, decisions: int) -> list[list[tuple]]:
    """What two seeds remember: (copy, before, option, reward, discount, after, available) of every decision."""
    found = []
    with visit(environment):
        algorithm = dqn(SMALL, environment, options, Rules(discount=0.5), decisions)
        for carry, _ in train(algorithm, [0, 1], decisions // SMALL.decisions_per_round, 9):
            replay = carry.learner.replay
        for seed in range(2):
            size = int(replay.size[seed])
            kept = jax.tree.map(lambda leaf, seed=seed, size=size: np.asarray(leaf)[seed, :size], replay.storage)
            (before, copy), after = kept.obs.seen.observation.T, kept.next_obs.seen.observation[:, 0]
            columns = (copy, before, kept.action, kept.reward, kept.discount, after, *kept.next_available.T)
            found.append(list(zip(*columns, strict=True)))
    return found


def test_what_is_remembered_is_what_happened(walk):
    """Every copy's decisions, in order, are its steps; both seeds have copies of their own."""
    first, second = trained(walk, primitives(walk), 200)
    assert not {one[0] for one in first} & {one[0] for one in second}
    for copy in {one[0] for one in first + second}:
        decisions = [one for one in first + second if one[0] == copy]
        steps = [one for one in LOG if one[0] == copy]
        assert len(decisions) > 20
        for decision, (_, before, action, reward, ended, _, after) in zip(decisions, steps, strict=True):
            assert decision == (copy, before, action, reward, 0.0 if ended else 0.5, after, after > 0, True)
    assert any(one[5] for one in LOG), "no episode was cut"


def test_options_take_several_steps_and_a_seed_that_is_done_waits(walk):
    """Rounds end when enough options have: the seed that is done first must not move on meanwhile."""
    both = Union((primitives(walk), UpTwice()))
    for seed in trained(walk, both, 400):
        for copy in {one[0] for one in seed}:
            steps = [one for one in LOG if one[0] == copy]
            for _, before, option, reward, discount, after, *available in (one for one in seed if one[0] == copy):
                total, factor = 0.0, 1.0
                while True:
                    _, at, action, paid, ended, cut, came = steps.pop(0)
                    assert at == before if factor == 1.0 else action == 1
                    total, factor = total + factor * paid, factor * 0.5
                    stops = option < 2 or came % 2 == 0
                    if ended or cut or stops:
                        break
                assert (reward, after, discount) == (total, came, 0.0 if ended else factor)
                assert available == ([False, False, True] if cut and not stops else [came > 0, True, True])


def test_a_policy_is_learned_played_saved_and_loaded(tmp_path):
    lake = Registered("FrozenLake-v1", max_episode_steps=40)
    config = DQNConfig(network=NetworkConfig((), (), (), ()), learning_rate=((0.0, 0.05),))
    with pytest.raises(TooManyStates, match="learned in, not planned in"):
        tabulate(lake)
    policy, history = train_policy(config, lake, primitives(lake), Rules(discount=0.95), 2000, [0, 1])
    assert history.taken(0)[1] >= 2000
    save_policy(tmp_path / "policy.safetensors", policy)
    again = load_policy(tmp_path / "policy.safetensors")
    assert isinstance(again, Policy)
    assert again.environment == lake
    one, other = (play_many(each, jax.random.key(0), 20) for each in (policy, again))
    jax.tree.map(np.testing.assert_array_equal, one, other)
    assert one.steps.shape == (2, 20)


def test_the_same_seeds_do_the_same_again(walk):
    seen = [trained(walk, primitives(walk), 40)]
    Walk.made = 0
    seen.append(trained(walk, primitives(walk), 40))
    assert seen[0] == seen[1]


def test_option_critic_takes_what_is_allowed(walk):
    """A forbidden action fails; every step of every copy is taken once."""
    config = DeepOptionCriticConfig(network=SMALL.network, environments=3)
    policy, history = train_policy(config, walk, primitives(walk), Rules(discount=0.5), 400, [0, 1])
    assert len(LOG) == 2 * config.rounds(400) * config.steps_per_round
    copies = sorted({one[0] for one in LOG})
    assert len(copies) == 6
    assert any(one[1] == 0 for one in LOG)
    assert any(one[5] for one in LOG), "no episode was cut"
    ends = [sum(one[4] or one[5] for one in LOG if one[0] in of_seed) for of_seed in (copies[:3], copies[3:])]
    found = [len(history.episodes(seed).total_reward) for seed in range(2)]
    assert sorted(found) == sorted(ends)
    assert play_many(policy, jax.random.key(0), 5).success.shape == (2, 5)


def test_plans_take_what_is_allowed(walk):
    """In training, greedily and where they are watched; the walk's numbers go up as soon as anything is learned."""
    config = StrawConfig(network=SMALL.network, environments=3, rollout=8)
    policy, history = train_policy(config, walk, primitives(walk), Rules(discount=0.5), 3000, [0, 1])
    assert len(LOG) == 2 * config.rounds(3000) * config.steps_per_round
    assert any(one[1] == 0 for one in LOG)
    assert any(one[5] for one in LOG), "no episode was cut"
    found = [len(history.episodes(seed).total_reward) for seed in range(2)]
    assert sum(found) == sum(one[4] or one[5] for one in LOG)
    assert play_many(policy, jax.random.key(0), 5).success.all()


def test_a_plan_that_is_forbidden_is_left_out_of_what_is_learned_and_played(walk):
    """It lowers the number wherever it may."""
    one = init_plan_network(SMALL.network, PlanConfig(horizon=2, patch=2), (2,), 3, jax.random.key(0))
    blank = jax.tree.map(jnp.zeros_like, one)
    lowers = eqx.tree_at(lambda n: n.patch.bias, blank, jnp.array([9.0, 9.0, 0.0, 0.0, 0.0, 0.0]))
    config = StrawConfig(network=SMALL.network, environments=3, rollout=20)
    with visit(walk):
        actors = jax.vmap(lambda key: start_planning(walk, lowers, key))(jax.random.split(jax.random.key(1), 3))
        run = jax.jit(lambda actors, key: collect(config, walk, Rules(), lowers, jnp.float32(1), actors, key))
        taken = jax.tree.map(np.asarray, run(actors, jax.random.key(2))[2])
    np.testing.assert_array_equal(taken.allowed[..., 0], taken.seen[..., 0] > 0)
    assert taken.allowed[..., 1].all()
    assert not taken.allowed.all()

    LOG.clear()
    policy = PlanPolicy("straw", walk, Rules(), SMALL.network, jax.tree.map(lambda leaf: leaf[None], lowers), 1.0, (0,))
    assert not play_many(policy, jax.random.key(0), 4).success.any()
    assert {(one[1] > 0, one[2]) for one in LOG} == {(True, 0), (False, 1)}


def test_what_the_environment_raises_is_told(walk):
    blocked = FromFunction(lambda: Walk(fails_at=3))
    with pytest.raises(EnvironmentFailed, match="OSError: the walk is blocked"):
        train_policy(SMALL, blocked, primitives(blocked), Rules(), 400, [0])


def test_what_does_not_fit_is_refused(walk):
    with pytest.raises(InvalidConfig, match="agents here choose among discrete ones"):
        primitives(Registered("Pendulum-v1"))
    with pytest.raises(InvalidConfig, match="have to be one array or number"):
        primitives(Registered("Blackjack-v1"))
    with pytest.raises(InvalidConfig, match="no dictionary"):
        primitives(Registered("CartPole-v1", observation="image"))
    with pytest.raises(InvalidConfig, match="rules may have none"):
        train_policy(SMALL, walk, primitives(walk), Rules(step_limit=9), 400, [0])
    with pytest.raises(InvalidConfig, match="cannot make Nothing-v0"):
        primitives(Registered("Nothing-v0"))


@pytest.mark.filterwarnings("ignore:.*is not in the possible render_modes")
def test_one_that_knows_no_render_mode_has_no_pictures():
    gymnasium.register("Walk-v0", entry_point=Walk)
    bare = Registered("Walk-v0")
    assert primitives(bare).names == ("0", "1")
    with pytest.raises(EnvironmentFailed, match="unexpected keyword argument 'render_mode'"), visit(bare, film=True):
        pass
    gymnasium.registry.pop("Walk-v0")


def test_a_file_does_not_import_what_it_likes():
    with pytest.raises(InvalidConfig, match="has to be imported before"):
        make_environment("gymnasium", id="antigravity:Fly-v0")
    assert make_environment("gymnasium", id="CartPole-v1") == Registered("CartPole-v1")


def is_at(place):
    return lambda environment, state: state.seen.observation[0] == place


def test_hdqn_learns_to_reach_goals_of_ones_own(walk):
    """What the controller remembers is what happened, and whose goal it was."""
    goals = tuple(goal(walk, f"at {place}", is_at(place)) for place in (1, 3))
    config = HDQNConfig(network=SMALL.network, environments=3, learning_starts=8, max_goal_steps=4)
    with visit(walk):
        for carry, _ in train(hdqn(config, walk, goals, Rules(discount=0.5), 200), [0], config.rounds(200), 50):
            steps = jax.tree.map(lambda leaf: np.asarray(leaf)[0], carry.learner.steps)
    kept = jax.tree.map(lambda leaf: leaf[: steps.size], steps.storage)
    found = list(zip(*kept.state.seen.observation.T, kept.action, kept.next_state.seen.observation[:, 0], strict=True))
    for copy in {one[1] for one in found}:
        assert [(one[0], *one[2:]) for one in found if one[1] == copy] == [
            (before, action, after) for number, before, action, *_, after in LOG if number == copy
        ]
