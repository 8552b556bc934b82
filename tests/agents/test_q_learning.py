"""What Q-learning over options learns, against the planner's table."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import LEFT, Corridor, Walk

from lodestone.agents.playing import play
from lodestone.agents.q_learning import STEPS_PER_ROUND, QLearningConfig, q_learning
from lodestone.agents.training import train_policy
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.learning.loop import train
from lodestone.learning.schedules import Knots
from lodestone.options.base import Capped, Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.options.execution import Rules
from lodestone.options.four_rooms import hallway_options
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate


@pytest.mark.parametrize("undiscounted", [False, True])
def test_learned_values_equal_the_planners(undiscounted):
    """Where the optimal policy goes; elsewhere exploration may not have come often enough."""
    arm = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)
    options = Union((Primitives(arm.action_names), Capped(scripted_options(arm, ("go-down", "lift")), 21)))
    rules = Rules(decision_limit=100, undiscounted_option_reward=undiscounted)
    algorithm = q_learning(QLearningConfig(epsilon=((0.0, 1.0), (1.0, 0.3))), arm, options, rules, 100_000)
    for carry, _ in train(algorithm, [0], 100_000 // STEPS_PER_ROUND, 100_000):
        learned = np.asarray(carry.table[0])
    tables = tabulate(arm)
    exact = option_value_iteration(
        tables, tabulate_options(options, tables.space), 0.99, undiscounted_option_reward=undiscounted
    ).option_values
    np.testing.assert_allclose(learned[0][np.isfinite(exact[0])], exact[0][np.isfinite(exact[0])], atol=1e-2)
    visited = (learned != 0) & np.isfinite(exact)
    assert visited.mean() > 0.5
    assert np.median(np.abs(learned[visited] - exact[visited])) < 1e-3


class Still(Corridor):
    """One state for ever."""

    def transition(self, state, action, outcome):
        return state

    def terminal(self, state):
        return jnp.bool_(False)


def test_a_time_limit_bootstraps_unless_it_is_taken_for_an_end():
    """Reward 1 for ever: V = 1 / (1 - 0.9) = 10. Where every tenth step, a limit, is taken for an end, V solves
    V = 1 + 0.9 * 0.9 V."""
    still = Still(length=2, step_reward=1.0)
    options = Primitives(still.action_names)
    found = {}
    for bootstrap in (True, False):
        rules = Rules(discount=0.9, step_limit=10, bootstrap_at_limit=bootstrap)
        config = QLearningConfig(learning_rate=((0.0, 0.5), (0.3, 0.002)))
        algorithm = q_learning(config, still, options, rules, 20_000)
        for carry, _ in train(algorithm, [0], 20_000 // STEPS_PER_ROUND, 20_000):
            found[bootstrap] = float(jnp.max(carry.table))
    assert found[True] == pytest.approx(10.0, abs=1e-2)
    assert found[False] == pytest.approx(1 / (1 - 0.81), abs=0.2)


class OnlyLeftPays(Still):
    """The same, where going left pays 1 and going right nothing."""

    def reward(self, state, action, next_state):
        return (action == LEFT).astype(jnp.float32)


def test_an_option_that_a_limit_cuts_bootstraps_from_itself_alone():
    """Going right for ever is worth nothing, though left, which pays 10, could begin wherever the limit cuts it."""
    world = OnlyLeftPays(length=2)
    options = Union((Primitives(world.action_names), Walk(stop=9)))
    rules = Rules(discount=0.9, step_limit=3)
    config = QLearningConfig(learning_rate=((0.0, 0.5), (0.3, 0.01)), epsilon=((0.0, 0.5),))
    for carry, _ in train(q_learning(config, world, options, rules, 20_000), [0], 20_000 // STEPS_PER_ROUND, 20_000):
        left, _, walk = carry.table[0, 0]
    assert left == pytest.approx(10.0, abs=0.05)
    assert walk == 0.0


def test_options_of_one_step_are_q_learning():
    """Primitives behind a cap, in a union, are the same learner as the primitives alone: the same random numbers give
    the same table."""
    corridor = Corridor(length=6)
    plain = Primitives(corridor.action_names)
    tables = []
    for options in (plain, Union((Capped(plain, 1),))):
        algorithm = q_learning(QLearningConfig(), corridor, options, Rules(step_limit=20), 2000)
        for carry, _ in train(algorithm, [0, 1], 2000 // STEPS_PER_ROUND, 2000):
            tables.append(np.asarray(carry.table))
    np.testing.assert_array_equal(*tables)
    assert tables[0].any()


@pytest.mark.parametrize("step_limit", [None, 7])
def test_the_maximum_beside_each_row_is_that_of_the_row(step_limit):
    rooms = FourRooms()
    options = Union((Primitives(rooms.action_names), hallway_options(rooms)))
    algorithm = q_learning(QLearningConfig(), rooms, options, Rules(step_limit=step_limit), 3200)
    for carry, _ in train(algorithm, [0, 1], 100, 100):
        table, best = np.asarray(carry.table), np.asarray(carry.learned.best)
    assert (best != 0).mean() > 0.5
    startable = np.isfinite(table).any(axis=2)
    np.testing.assert_array_equal(best[startable], table.max(axis=2)[startable])


EXPLORING: Knots = ((0.0, 1.0), (1.0, 0.3))


def tower(
    size: tuple[int, int, int, int], options: bool, steps: int, epsilon: Knots = EXPLORING, undiscounted: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Algorithm 1 with five seeds: decisions until the tower stood for the first time, episodes, greedy steps in the
    end (a greedy policy that does not build the tower is still at it after 200 decisions)."""
    arm = MagnetArm(*size)
    primitives = Primitives(arm.action_names)
    scripts = Capped(scripted_options(arm, ("go-down", "lift")), 21)
    policy, history = train_policy(
        QLearningConfig(epsilon=epsilon),
        arm,
        Union((primitives, scripts)) if options else primitives,
        Rules(decision_limit=200, undiscounted_option_reward=undiscounted),
        steps,
        seeds=range(5),
    )
    episodes = [history.episodes(seed) for seed in range(5)]
    first = np.array([one.decisions[one.success][0] for one in episodes])
    played = play(policy, jax.random.key(0))
    return first, np.array([len(one.success) for one in episodes]), played.steps


def test_small_towers_are_built_in_the_fewest_steps_and_sooner_with_options():
    """4x3: 13 steps within 5000 episodes."""
    with_options, episodes, steps = tower((4, 3, 3, 3), True, 100_000)
    assert episodes.max() < 5000
    np.testing.assert_array_equal(steps, 13)
    flat, _, _ = tower((4, 3, 3, 3), False, 50_000)
    assert np.median(with_options) < np.median(flat) / 5


@pytest.mark.slow
def test_large_towers_are_built_in_the_fewest_steps_and_far_sooner_with_options():
    """6x4: 25 steps within 20,000 episodes; the first tower after less than a twentieth of the decisions."""
    with_options, episodes, steps = tower((6, 4, 4, 4), True, 1_000_000)
    _, more_episodes, paper_steps = tower((6, 4, 4, 4), True, 1_000_000, undiscounted=True)
    flat, _, _ = tower((6, 4, 4, 4), False, 1_000_000)
    _, flat_episodes, flat_steps = tower((6, 4, 4, 4), False, 1_450_000, epsilon=((0.0, 0.5),))
    assert np.median(with_options) < np.median(flat) / 20
    assert max(episodes.max(), more_episodes.max(), flat_episodes.max()) < 20_000
    for found in (steps, paper_steps, flat_steps):
        assert np.median(found) == 25
        assert found.max() <= 26
