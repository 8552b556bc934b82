"""What SARSA learns, against the exact values of the policy that it follows."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor
from random_mdp import RandomOptions, random_mdp, random_options

from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.agents.sarsa import SarsaConfig, sarsa
from lodestone.envs.base import Environment
from lodestone.learning.loop import train
from lodestone.options.base import Options, Primitives
from lodestone.options.execution import Rules
from lodestone.planning.option_models import evaluate_option_choices, option_value_iteration, tabulate_options
from lodestone.planning.solve import evaluate_policy
from lodestone.planning.tables import tabulate

SETTLING = ((0.0, 0.5), (0.1, 0.1), (0.4, 0.02), (0.7, 0.004), (1.0, 0.001))
"""A learning rate that falls about as 1/n."""


def learn(config: SarsaConfig, environment: Environment, options: Options, rules: Rules, steps: int, seeds: int):
    """The tables [seeds, S, O]."""
    rounds = -(-steps // STEPS_PER_ROUND)
    for carry, _ in train(sarsa(config, environment, options, rules, steps), range(seeds), rounds, rounds):
        pass
    return np.asarray(carry.table)[:seeds]


@pytest.mark.parametrize("everywhere", [False, True])
def test_it_learns_what_its_own_choices_are_worth(everywhere):
    """Options chosen at random, that may not start everywhere, or that a limit often cuts: both at once would ask what
    an option is worth where it never starts."""
    mdp, options = random_mdp(4, goals=1), random_options(4)
    if everywhere:
        options = RandomOptions(jnp.ones_like(options.start), options.acts, options.stops, options.caps)
    config, rules = (
        SarsaConfig(SETTLING, epsilon=((0.0, 1.0),)),
        Rules(discount=0.9, step_limit=7 if everywhere else 50),
    )
    each = learn(config, mdp, options, rules, 100_000, seeds=32)
    tables, learned = tabulate(mdp), each.mean(axis=0)
    described = tabulate_options(options, tables.space)
    assert not each[:, ~described.initiation.T].any()
    at_random = described.initiation.T / described.initiation.T.sum(axis=1, keepdims=True)
    exact = evaluate_option_choices(tables, described, at_random, 0.9)
    counted = described.initiation.T & ~tables.terminal[:, None]
    np.testing.assert_allclose(learned[counted], exact[counted], atol=0.05)
    best = option_value_iteration(tables, described, 0.9).option_values
    assert np.abs(best - exact)[counted].max() > 0.3


def test_exploring_less_and_less_it_finds_the_optimum():
    corridor = Corridor(length=6, step_reward=-5.0)
    config = SarsaConfig(epsilon=((0.0, 0.5), (0.8, 0.0)))
    rules = Rules(discount=0.9, step_limit=50)
    learned = learn(config, corridor, Primitives(corridor.action_names), rules, 20_000, seeds=2)
    exact = evaluate_policy(tabulate(corridor), np.ones(6, dtype=int), 0.9)
    np.testing.assert_allclose(learned[:, :5].max(axis=2), np.tile(exact[:5], (2, 1)), atol=1e-3)
