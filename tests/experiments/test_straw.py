"""The experiment on STRAW: its judges against plain loops, and (slow) the numbers that must come out."""

from __future__ import annotations

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.agents.policies import PlanPolicy
from lodestone.envs.goal_maze import GOALS, NEIGHBOURS
from lodestone.experiments import straw
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_network import PlanConfig, init_plan_network
from lodestone.learning.progress import Silent

RIGHT, DOWN = 3, 1


def test_words_are_spelled_and_come_in_any_order():
    symbols = np.asarray(straw.draw_words(jax.random.key(0), 3, 50))
    words = {"".join(straw.SYMBOLS[symbol] for symbol in word) for word in symbols.reshape(-1, 4)}
    assert symbols.shape == (3, 200)
    assert words == set(straw.WORDS)
    assert pytest.approx(np.log(2) / 4) == straw.ENTROPY_RATE


def test_a_fixed_plan_is_judged_from_every_start():
    """Right, right, down, and again."""
    shape = PlanConfig(horizon=3, patch=3, peak=12.0, background=-6.0)
    one = init_plan_network(NetworkConfig((), (), (), (4,)), shape, (7, 7, 3), 5, jax.random.key(0))
    patch = np.zeros((5, 3), np.float32)
    patch[[RIGHT, RIGHT, DOWN], [0, 1, 2]] = 1.0
    fixed = eqx.tree_at(
        lambda n: (n.focus.bias, n.patch.bias, n.schedule.bias),
        jax.tree.map(jnp.zeros_like, one),
        (jnp.array([0.0, 0.0, -5.0]), jnp.asarray(patch.ravel()), jnp.array([1.0, -5.0])),
    )
    policy = PlanPolicy(
        "straw", straw.MAZE, straw.MAZE_RULES, NetworkConfig(), jax.tree.map(lambda leaf: leaf[None], fixed), 1.0, (0,)
    )
    found = straw.judge(policy)

    _, starts = straw.MAZE.initial_distribution()
    for index, (cell, goal) in enumerate(zip(np.asarray(starts.cell), np.asarray(starts.goal), strict=True)):
        steps = 0
        while cell != goal and steps < 50:
            cell = NEIGHBOURS[cell, (RIGHT, RIGHT, DOWN)[steps % 3]]
            steps += 1
        assert (int(found.steps[0, index]), bool(found.success[0, index])) == (steps, cell == goal)
        assert float(found.total_reward[0, index]) == 20 * (cell == goal) - steps
        assert int(found.decisions[0, index]) == -(-steps // 3)
    assert 0 < found.success.mean() < 1
    assert set(np.asarray(starts.goal)[np.asarray(found.success[0])]) <= set(GOALS.tolist())


def test_lengths_of_plans_are_steps_over_plans_chunk_by_chunk():
    def usage(steps: list[int], calls: list[int]) -> SimpleNamespace:
        return SimpleNamespace(steps=np.array(steps)[:, None], calls=np.array(calls)[:, None])

    taken, lengths = straw.plan_lengths(SimpleNamespace(usage=[usage([10, 20], [10, 5]), usage([30, 40], [10, 8])]))
    assert taken.tolist() == [15, 50]
    np.testing.assert_allclose(lengths, [[1, 3], [4, 5]])


def test_a_short_run_learns_the_grammar_but_not_yet_when_to_look():
    found = straw.read(2, 1200, lambda done, text: None)
    assert (found.surprise[:, 0] > 4 * straw.ENTROPY_RATE).all()
    assert (found.judged < 1.3 * straw.ENTROPY_RATE).all()
    assert (found.judged > 0.9 * straw.ENTROPY_RATE).all()
    assert (found.anew[:, straw.BRANCH] > 0.8).all()
    assert (found.right[:, :3] > 0.5).all()


@pytest.mark.slow
def test_all_numbers_come_out():
    """But two, which docs/straw.md tells: one seed in ten of either learner stays below 95 % in the maze."""
    failed = {gate.name for gate in straw.run(10, Silent()).gates if not gate.passed}
    worst = "maze: return beside the optimum, worst seed"
    assert failed == {f"{worst}, {straw.PLANNING}", f"{worst}, {straw.EVERY_STEP}"}
