"""The experiment on h-DQN: its judge against the planner, and (slow) the numbers that must come out."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.experiments import hdqn
from lodestone.learning.goal_network import GoalNetwork, init_goal_network
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Silent
from lodestone.options.base import NO_CAP
from lodestone.options.catalogue import goals
from lodestone.options.subgoals import arrival, solve_subgoal, subgoal_options
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate

GOALS = goals(hdqn.CHAIN)


def exact_network() -> GoalNetwork:
    """The exact tables of both levels as a network without hidden layers."""
    tables = tabulate(hdqn.CHAIN)
    subgoals = [arrival(tables, goal, 0.99) for goal in GOALS]
    controller = np.stack([solve_subgoal(tables, subgoal, 0.99).action_values for subgoal in subgoals])
    exact = tabulate_options(subgoal_options(tables, subgoals, 0.99), tables.space)
    meta = option_value_iteration(tables, exact, 0.99).option_values
    seen = np.asarray(jax.vmap(hdqn.CHAIN.observe)(tables.space.states)).reshape(tables.num_states, -1)
    flat = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
    network = init_goal_network(flat, "nothing", (1, 6, 2), 2, len(GOALS), jax.random.key(0))
    return eqx.tree_at(
        lambda one: (one.meta.layers[0].weight, one.controller.layers[0].weight),
        network,
        (
            jnp.asarray(seen.T @ np.where(np.isfinite(meta), meta, 0.0), jnp.float32),
            jnp.asarray(np.einsum("sx,gsa->gxa", seen, controller), jnp.float32),
        ),
    )


@pytest.mark.parametrize("cap", [NO_CAP, 3])
def test_exact_tables_are_judged_to_be_optimal(cap):
    """With a cap, too: a goal that was given up is chosen again."""
    found = hdqn.greedy_return(tabulate(hdqn.CHAIN), GOALS, exact_network(), cap)
    assert found == pytest.approx(0.208, abs=1e-6)


def test_the_exact_values_beside_the_learners():
    (_, *chain), (_, *tower) = hdqn._exact_values().rows
    assert chain == pytest.approx([0.208, 0.208], abs=1e-6)
    assert tower == pytest.approx([13.0, 13.0])


def test_a_short_run_on_the_chain_finds_the_best_policy(monkeypatch):
    monkeypatch.setattr(hdqn, "CHAIN_STEPS", 30_000)
    monkeypatch.setattr(hdqn, "CHAIN_LOOKS", 2)
    one = hdqn._follow(hdqn.TABLES, 2, Silent())
    assert one.judged[-1].min() >= 0.19
    assert hdqn._training_returns(one).min() >= 0.13


@pytest.mark.slow
def test_all_numbers_come_out():
    failed = [gate for gate in hdqn.run(20, Silent()).gates if not gate.passed]
    assert failed == []
