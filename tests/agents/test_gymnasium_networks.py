"""Goals and options learned by networks in a Gymnasium environment: what is learned is what is exact."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from lodestone.agents.hdqn import HDQNConfig, hdqn
from lodestone.agents.playing import play_many, record
from lodestone.agents.policies import GoalPolicy, UnitedPolicy
from lodestone.agents.saved import load_policy, save_policy
from lodestone.agents.training import train_policy
from lodestone.agents.united import UnitedConfig, united
from lodestone.envs.host import Registered, visit
from lodestone.envs.task import goal, looks
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.united_execution import explore
from lodestone.learning.united_network import Outputs
from lodestone.options.base import primitives
from lodestone.options.execution import Rules

LOG: list[tuple] = []
"""Every step of every `Walk`: (copy, before, action, after)."""
END, CUT, GAMMA = 5, 3, 0.9
PLACES = np.eye(END + 1, dtype=np.float32)
"""What is seen in each."""


class Walk(gymnasium.Env):
    """Places 0 to 5. In the last the walk ends and pays 10; other steps cost 1; after three it is cut. Going left is
    forbidden in the first place."""

    observation_space = spaces.Box(0, 1, (END + 1,), np.float32)
    action_space = spaces.Discrete(2)
    metadata: ClassVar = {"render_modes": ["rgb_array"]}
    made = 0

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.copy, Walk.made = Walk.made, Walk.made + 1

    def _see(self) -> tuple[np.ndarray, dict[str, Any]]:
        return PLACES[self.place], {"action_mask": np.array([self.place > 0, True])}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.time = int(self.np_random.integers(END)), 0
        return self._see()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        before, self.place, self.time = self.place, self.place + 2 * int(action) - 1, self.time + 1
        assert self.place >= 0, "a forbidden action was taken"
        LOG.append((self.copy, before, int(action), self.place))
        seen, info = self._see()
        return seen, 10.0 if self.place == END else -1.0, self.place == END, self.time == CUT, info

    def render(self) -> np.ndarray:
        return np.full((2, 2, 3), self.place, np.uint8)


@pytest.fixture
def walk():
    LOG.clear()
    gymnasium.register("PlacesWalk-v0", entry_point=Walk)
    yield Registered("PlacesWalk-v0")
    gymnasium.registry.pop("PlacesWalk-v0")


def goals_of(walk, *places):
    return tuple(goal(walk, f"at {place}", looks(PLACES[place])) for place in places)


ALLOWED = np.array([[False, True], *[[True, True]] * END])


def exact_actions(holds: int | None) -> np.ndarray:
    """Q of the actions in places 0 to 4: of the walk itself, or of getting where `holds`, which pays 1."""
    values = np.zeros((END, 2))
    for _ in range(200):
        for place, action in np.argwhere(ALLOWED[:END]):
            after = place + 2 * action - 1
            reward = (10.0 if after == END else -1.0) if holds is None else float(after == holds)
            over = after in (END, holds)
            values[place, action] = reward + (0 if over else GAMMA * values[after][ALLOWED[after]].max())
    return values


def exact_choices(actions: np.ndarray, stops: np.ndarray, available: np.ndarray) -> np.ndarray:
    """Q of choices in places 0 to 4, if each takes these actions until it stops (all three: places by choices)."""
    brings = {}
    for place, choice in np.ndindex(END, actions.shape[1]):
        total, factor, at = 0.0, 1.0, place
        while factor > 1e-6:
            at += 2 * int(actions[at, choice]) - 1
            total += factor * (10.0 if at == END else -1.0)
            factor *= 0.0 if at == END else GAMMA
            if at == END or stops[at, choice]:
                break
        brings[place, choice] = total, factor, at
    values = np.zeros((END + 1, actions.shape[1]))
    for _ in range(200):
        for one, (total, factor, at) in brings.items():
            values[one] = total + (factor * values[at][available[at]].max() if factor else 0.0)
    return values[:END]


def check_steps(steps: Any, seed: int) -> None:
    """What is remembered of every copy's steps is the last that happened, each once, in order."""
    size, cursor = int(steps.size[seed]), int(steps.cursor[seed])
    order = (cursor - size + np.arange(size)) % len(steps.storage.action[seed])
    kept = jax.tree.map(lambda leaf: np.asarray(leaf[seed])[order], steps.storage)
    before, after = (one.seen.observation.argmax(axis=1) for one in (kept.state, kept.next_state))
    first = min(one[0] for one in LOG)
    for copy in set(kept.state.copy.tolist()):
        here = kept.state.copy == copy
        found = list(zip(before[here].tolist(), kept.action[here].tolist(), after[here].tolist(), strict=True))
        assert len(found) > 20
        assert found == [one[1:] for one in LOG if one[0] == first + copy][-len(found) :]


def check_playing(policy: Any, path: Path) -> None:
    """Greedily to the right, until the end or the cut; also after saving and loading."""
    save_policy(path, policy)
    policy = load_policy(path)
    played = play_many(policy, jax.random.key(0), 20)
    assert played.success.any()
    assert not played.success.all()
    np.testing.assert_array_equal(played.total_reward, np.where(played.success, 11.0 - played.steps, -CUT))
    assert (played.steps[~played.success] == CUT).all()
    assert set(played.steps[played.success].tolist()) == {1, 2, 3}
    playback = record(policy, 0, jax.random.key(0), policy.agent)
    assert (np.diff(playback.pictures[:, 0, 0, 0].astype(int)) == 1).all()
    assert len(playback.pictures) == len(playback.action) + 1


RULES = Rules(discount=GAMMA)
SEEDS = (0, 1)
LINEAR = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
GOALS = HDQNConfig(
    network=LINEAR,
    learning_rate=((0.0, 3e-2), (0.4, 1e-2), (1.0, 1e-4)),
    learning_starts=200,
    replay_capacity=4000,
    goal_replay_capacity=2000,
    target_period=20,
    epsilon=((0.0, 1.0), (0.5, 0.0)),
    goal_epsilon=((0.0, 1.0),),
    environments=4,
    reward_scale=0.2,
)


def test_goals_are_reached_and_chosen_as_is_exact(walk, tmp_path):
    goals, steps = goals_of(walk, 2, END), 8000
    with visit(walk):
        algorithm = hdqn(GOALS, walk, goals, RULES, steps)
        for carry, _ in train(algorithm, SEEDS, GOALS.rounds(steps), GOALS.rounds(steps)):
            learner = jax.tree.map(np.asarray, carry.learner)
    for seed in range(len(SEEDS)):
        check_steps(learner.steps, seed)
        network = jax.tree.map(lambda leaf, seed=seed: jnp.asarray(leaf[seed]), learner.network)
        actions = np.asarray(jax.vmap(network.action_values)(PLACES))
        for number, place in enumerate((2, END)):
            may = ALLOWED[:END] & (np.arange(END) != place)[:, None]
            np.testing.assert_allclose(
                actions[:END, number][may] / GOALS.critic_scale, exact_actions(place)[may], atol=0.02
            )
        best = np.where(ALLOWED[:, None], actions, -np.inf).argmax(axis=2)
        holds = np.stack([PLACES[:, place] > 0 for place in (2, END)], axis=1)
        wanted = exact_choices(best, holds, ~holds)
        found = np.asarray(jax.vmap(network.goal_values)(PLACES))[:END] / GOALS.reward_scale
        np.testing.assert_allclose(found[~holds[:END]], wanted[~holds[:END]], atol=0.2)
    policy = GoalPolicy(
        "hdqn", walk, goals, GOALS.goal_cap, RULES, LINEAR, "nothing", learner.network, GOALS.reward_scale, SEEDS
    )
    check_playing(policy, tmp_path / "policy.safetensors")


UNITED = UnitedConfig(
    network=LINEAR,
    shared="nothing",
    learning_rate=((0.0, 3e-2), (0.4, 1e-2), (1.0, 1e-4)),
    learning_starts=200,
    replay_capacity=4000,
    target_period=20,
    epsilon=((0.0, 1.0),),
    environments=4,
    task_environments=0,
    decision_cost=0.0,
)


def test_a_united_network_learns_its_exact_tables(walk, tmp_path):
    """All heads from what the manager does; the options have no copies of their own."""
    tasks, steps = goals_of(walk, 2, 4), 8000
    with visit(walk):
        algorithm = united(UNITED, walk, tasks, RULES, steps)
        for carry, _ in train(algorithm, SEEDS, UNITED.rounds(steps), UNITED.rounds(steps)):
            learner = jax.tree.map(np.asarray, carry.learner)
    ring = learner.steps.ring
    for seed in range(len(SEEDS)):
        check_steps(ring._replace(storage=ring.storage.item), seed)
        network = jax.tree.map(lambda leaf, seed=seed: jnp.asarray(leaf[seed]), learner.network)
        outputs = jax.tree.map(np.asarray, jax.vmap(network)(PLACES))
        for head, place in enumerate((None, 2, 4)):
            may = ALLOWED[:END] & (np.arange(END) != place)[:, None]
            np.testing.assert_allclose(
                outputs.actions[:END, head][may] / UNITED.reward_scale, exact_actions(place)[may], atol=0.1
            )
        at = np.arange(END + 1)
        np.testing.assert_array_equal(jax.vmap(network)(PLACES).ended, np.stack([at == 2, at == 4], axis=1))
        best = np.where(ALLOWED[:, None], outputs.actions, -np.inf).argmax(axis=2)
        stops = np.stack([at >= 0, at == 2, at == 4], axis=1)
        wanted = exact_choices(best, stops, np.ones_like(stops))
        np.testing.assert_allclose(outputs.choices[:END] / UNITED.reward_scale, wanted, atol=0.2)
    policy = UnitedPolicy(
        agent="united",
        environment=walk,
        tasks=tasks,
        option_cap=UNITED.max_option_steps,
        rules=RULES,
        shape=LINEAR,
        shared="nothing",
        networks=learner.network,
        reward_scale=UNITED.reward_scale,
        seeds=SEEDS,
    )
    check_playing(policy, tmp_path / "policy.safetensors")


def test_exploring_draws_allowed_actions_and_options_alike():
    actions = jnp.array([[-jnp.inf, 2.0, 1.0], [-jnp.inf, 1.0, 0.0]])
    outputs = Outputs(jnp.array([0.0, 1.0]), actions, jnp.zeros(1))
    drawn = [explore(outputs, jnp.array([0.0, point]), jnp.float32(0.5), True) for point in (0.2, 0.5, 0.8)]
    assert [(int(choice), int(best[0])) for choice, best in drawn] == [(0, 1), (0, 2), (1, 1)]
    flat = [explore(outputs, jnp.array([0.0, point]), jnp.float32(0.5), False) for point in (0.2, 0.8)]
    assert [(int(choice), int(best[0])) for choice, best in flat] == [(0, 1), (0, 2)]


@pytest.mark.parametrize("wrong", [{}, {"task_environments": 0, "start_environments": 1}])
def test_options_cannot_begin_where_their_tasks_do(walk, wrong):
    with pytest.raises(InvalidConfig, match="must be 0"):
        train_policy(UnitedConfig(**wrong), walk, primitives(walk), RULES, 100, [0], tasks=goals_of(walk, 2))
