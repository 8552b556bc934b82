"""Learned models of options against the exact ones (oracle T1)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor, Walk
from random_mdp import NUM_ACTIONS, NUM_STATES, random_mdp, random_options

from lodestone.agents.option_models import ModelLearningConfig, Models, option_model_learning, update
from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import train
from lodestone.options.base import Capped, Primitives, Union
from lodestone.options.execution import Rules
from lodestone.planning.option_models import option_models, tabulate_options
from lodestone.planning.tables import tabulate


def test_learned_models_are_the_exact_ones() -> None:
    """With options that draw their actions, and one-step options; the noise of single runs averaged out."""
    mdp, steps, seeds = random_mdp(seed=1, goals=1), 60_000, 32
    names = tuple(f"primitive-{action}" for action in range(NUM_ACTIONS))
    options = Union((Primitives(names), random_options(seed=5)))
    config = ModelLearningConfig(learning_rate=((0.0, 0.5), (0.1, 0.1), (0.4, 0.02), (1.0, 0.002)))
    algorithm = option_model_learning(config, mdp, options, Rules(discount=0.9, step_limit=50), steps)
    for carry, _ in train(algorithm, range(seeds), steps // STEPS_PER_ROUND, steps):
        rewards, ends = (np.asarray(leaf).mean(axis=0) for leaf in carry.models)
    tables = tabulate(mdp)
    live = ~tables.terminal
    exact = option_models(tables, tabulate_options(options, tables.space), 0.9)
    for option, model in enumerate(exact):
        np.testing.assert_allclose(rewards[live, option], model.rewards[live], atol=0.05)
        np.testing.assert_allclose(ends[live, option], model.backup(np.eye(NUM_STATES))[live], atol=0.01)


def test_one_step_moves_each_model_by_its_own_rate() -> None:
    models = Models(jnp.asarray([[0.0, 1.0], [4.0, 2.0]]), jnp.zeros((2, 2, 2)).at[1, :, 0].set(0.5))
    stops, rates = jnp.asarray([0.25, 1.0]), jnp.asarray([0.5, 0.0])
    found, _ = update(models, jnp.int32(0), jnp.float32(2.0), jnp.int32(1), stops, rates, 0.8)
    np.testing.assert_allclose(found.rewards, [[0.5 * (2 + 0.8 * 0.75 * 4), 1.0], [4.0, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(found.ends[0], [[0.5 * 0.8 * 0.75 * 0.5, 0.5 * 0.8 * 0.25], [0, 0]], rtol=1e-6)
    np.testing.assert_array_equal(found.ends[1], models.ends[1])


def test_capped_options_are_refused() -> None:
    corridor = Corridor()
    with pytest.raises(InvalidConfig, match="'walk' is stopped after 7 steps"):
        option_model_learning(ModelLearningConfig(), corridor, Capped(Walk(stop=3), 7), Rules(), 100)
