from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_mdp import NUM_ACTIONS, NUM_STATES, dense, random_mdp

from lodestone.envs.magnet_arm import ArmState, MagnetArm
from lodestone.envs.state_space import BATCH
from lodestone.errors import LodestoneError
from lodestone.planning.tables import state_text, tabulate


def test_tables_of_several_batches_are_the_environments_own_functions() -> None:
    arm = MagnetArm(7, 5, 4, 4)
    tables = tabulate(arm)
    assert tables.num_states > 2 * BATCH
    states = jax.tree.map(jnp.asarray, tables.space.states)
    for action in range(arm.num_actions):
        following = jax.vmap(arm.transition, in_axes=(0, None, None))(states, jnp.int32(action), jnp.int32(0))
        rewards = jax.vmap(arm.reward, in_axes=(0, None, 0))(states, jnp.int32(action), following)
        numbers, live = tables.successors[:, action, 0], ~tables.terminal
        for stored, leaf in zip(tables.space.states, following, strict=True):
            np.testing.assert_array_equal(stored[numbers][live], np.asarray(leaf)[live])
        np.testing.assert_array_equal(tables.rewards[live, action, 0], np.asarray(rewards)[live])
    np.testing.assert_array_equal(tables.terminal, jax.vmap(arm.terminal)(states))


def test_a_terminal_state_stays_for_nothing() -> None:
    tables = tabulate(MagnetArm(4, 3, 2, 2))
    assert tables.terminal.sum() == 6
    np.testing.assert_array_equal(
        tables.successors[tables.terminal], np.tile(np.flatnonzero(tables.terminal)[:, None, None], (1, 6, 1))
    )
    assert not tables.rewards[tables.terminal].any()


def test_probabilities_and_starts_of_a_random_world() -> None:
    mdp = random_mdp(seed=3, goals=1)
    tables = tabulate(mdp)
    # The numbering begins with the initial states, so that it need not be the state's own number.
    number_of = np.argsort(tables.space.states)
    probs, rewards = dense(tables)
    expected_probs = np.asarray(mdp.probs, dtype=np.float64)[:-1]
    expected_rewards = (expected_probs * np.asarray(mdp.rewards, dtype=np.float64)[:-1]).sum(axis=2)
    np.testing.assert_allclose(probs[number_of][:-1][:, :, number_of], expected_probs, atol=1e-6)
    np.testing.assert_allclose(rewards[number_of][:-1], expected_rewards, atol=1e-6)
    np.testing.assert_allclose(tables.probs.sum(axis=2), 1.0, atol=1e-15)
    np.testing.assert_allclose(tables.initial_probs[number_of], [0.5, 0.5, 0, 0, 0, 0, 0])
    assert tables.initial_mean(np.where(tables.initial_probs > 0, 4.0, -np.inf)) == 4.0


def test_matrices_agree_with_dense_sums() -> None:
    tables = tabulate(random_mdp(seed=1))
    probs, rewards = dense(tables)
    np.testing.assert_allclose(tables.matrix().toarray(), probs.swapaxes(0, 1).reshape(-1, NUM_STATES), atol=1e-15)
    np.testing.assert_allclose(tables.mean_rewards(), rewards, atol=1e-15)

    policy = np.random.default_rng(0).dirichlet(np.ones(NUM_ACTIONS), size=NUM_STATES)
    np.testing.assert_allclose(
        tables.policy_matrix(policy).toarray(), np.einsum("sa,sax->sx", policy, probs), atol=1e-15
    )
    np.testing.assert_allclose(tables.policy_rewards(policy), (policy * rewards).sum(axis=1), atol=1e-15)

    actions = np.array([2, 0, 1, 1, 2, 0, 0])
    one_hot = np.eye(NUM_ACTIONS)[actions]
    np.testing.assert_array_equal(tables.policy_matrix(actions).toarray(), tables.policy_matrix(one_hot).toarray())
    np.testing.assert_array_equal(tables.policy_rewards(actions), tables.policy_rewards(one_hot))


def test_step_reward_replaces_every_reward_but_the_terminal_ones() -> None:
    tables = tabulate(MagnetArm(4, 3, 2, 2)).with_step_reward(-2.0)
    np.testing.assert_array_equal(
        tables.mean_rewards(), np.where(tables.terminal, 0.0, -2.0)[:, None].repeat(6, axis=1)
    )


def test_tables_are_remembered_and_cannot_be_spoilt() -> None:
    tables = tabulate(MagnetArm(4, 3, 2, 2))
    assert tabulate(MagnetArm(4, 3, 2, 2)) is tables
    with pytest.raises(ValueError, match="read-only"):
        tables.rewards[0] = 1.0


def test_probabilities_that_do_not_sum_to_one_are_refused() -> None:
    mdp = random_mdp(seed=0)
    with pytest.raises(LodestoneError, match="nature's draws"):
        tabulate(replace(mdp, probs=mdp.probs * 0.9))


def test_text_of_a_state() -> None:
    start = ArmState(bricks=np.array([[0, 1, 1]]), row=np.array([0]), column=np.array([2]), magnet=np.array([True]))
    space = replace(tabulate(MagnetArm(4, 3, 2, 2)).space, states=start)
    assert state_text(space, 0) == "bricks=[0, 1, 1], row=0, column=2, magnet=True"
    assert state_text(replace(space, states=np.array([5, 7])), 1) == "7"
