"""Exact values and gradients of options made of parameters, against finite differences and the general planner."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from jaxtyping import Float
from random_mdp import random_tables

from lodestone.errors import InvalidConfig
from lodestone.options.base import NO_CAP
from lodestone.planning.option_gradients import OptionParameters, SoftOptionProcess, soft_option_process
from lodestone.planning.option_models import OptionTables, evaluate_options
from lodestone.planning.solve import evaluate_policy
from lodestone.planning.tables import Tables

DISCOUNT, OPTIONS = 0.9, 3
STEP = 1e-5
"""Of the differences: leaves an error of about 1e-10."""


def parameters_of(tables: Tables, seed: int, temperature: float = 1.0) -> OptionParameters:
    rng = np.random.default_rng(seed)
    shape = (tables.num_states, OPTIONS)
    return OptionParameters(rng.normal(size=(*shape, tables.num_actions)), rng.normal(size=shape), temperature)


def policy_of(tables: Tables, seed: int) -> Float[np.ndarray, "S O"]:
    return np.random.default_rng(seed).dirichlet(np.ones(OPTIONS), size=tables.num_states)


def weights_of(tables: Tables, seed: int) -> Float[np.ndarray, "S O"]:
    return np.random.default_rng(seed).uniform(size=(tables.num_states, OPTIONS))


def differences(of, parameters: OptionParameters, name: str) -> np.ndarray:
    """Central differences of the number that `of` makes of parameters, by each entry of one array."""
    array = getattr(parameters, name)
    found = np.zeros(array.shape)
    for at in np.ndindex(*array.shape):
        moved = np.zeros(array.shape)
        moved[at] = STEP
        after, before = (of(parameters._replace(**{name: array + sign * moved})) for sign in (1, -1))
        found[at] = (after - before) / (2 * STEP)
    return found


def arriving_values(process: SoftOptionProcess) -> Float[np.ndarray, "S O"]:
    """U, from its definition."""
    found, stops = process.values(), process.parameters.terminations
    return (1 - stops) * found.by_option + stops * found.values[:, None]


CASES = list(product((0, 1, 2), (0, 1, 2), (1.0, 0.5)))[::3]


@pytest.mark.parametrize(("seed", "goals", "temperature"), CASES)
def test_gradients_are_the_finite_differences(seed, goals, temperature):
    tables = random_tables(seed, goals)
    parameters, policy = parameters_of(tables, seed, temperature), policy_of(tables, seed + 10)
    weights = weights_of(tables, seed + 20)

    def process_of(parameters: OptionParameters) -> SoftOptionProcess:
        return soft_option_process(tables, parameters, policy, DISCOUNT)

    def of_options(parameters: OptionParameters) -> float:
        return float((weights * process_of(parameters).values().by_option).sum())

    def of_arrivals(parameters: OptionParameters) -> float:
        return float((weights * arriving_values(process_of(parameters))).sum())

    process = process_of(parameters)
    by_preferences = process.policy_gradient(weights)
    by_exits = process.termination_gradient(weights)
    through_exits = process.termination_gradient(process.after_a_step(weights))
    np.testing.assert_allclose(by_preferences, differences(of_options, parameters, "preferences"), atol=1e-8, rtol=0)
    np.testing.assert_allclose(by_exits, differences(of_arrivals, parameters, "exits"), atol=1e-8, rtol=0)
    np.testing.assert_allclose(through_exits, differences(of_options, parameters, "exits"), atol=1e-8, rtol=0)
    assert np.abs(by_preferences).max() > 0.01
    assert np.abs(by_exits).max() > 0.01
    assert not by_preferences[tables.terminal].any()
    assert not by_exits[tables.terminal].any()
    assert not process.after_a_step(process.running(weights))[tables.terminal].any()


@pytest.mark.parametrize("goals", [0, 1])
def test_values_are_those_of_the_general_planner(goals):
    tables = random_tables(3, goals)
    parameters, policy = parameters_of(tables, 4), policy_of(tables, 5)
    found = soft_option_process(tables, parameters, policy, DISCOUNT).values()
    options = OptionTables(
        names=("a", "b", "c"),
        initiation=np.ones((OPTIONS, tables.num_states), dtype=bool),
        action_probs=parameters.policies.swapaxes(0, 1),
        termination=parameters.terminations.T,
        max_steps=(NO_CAP,) * OPTIONS,
    )
    np.testing.assert_allclose(found.values, evaluate_options(tables, options, policy, DISCOUNT), atol=1e-12)
    mean = (parameters.policies * found.by_action).sum(axis=2)
    np.testing.assert_allclose(mean, found.by_option, atol=1e-12)
    assert not found.by_action[tables.terminal].any()


def test_one_option_is_a_policy_whatever_its_termination():
    tables = random_tables(6, 1)
    one = OptionParameters(*(array[:, :1] for array in parameters_of(tables, 7)[:2]))
    process = soft_option_process(tables, one, np.ones((tables.num_states, 1)), DISCOUNT)
    np.testing.assert_allclose(
        process.values().values, evaluate_policy(tables, one.policies[:, 0], DISCOUNT), atol=1e-12
    )
    np.testing.assert_allclose(process.termination_gradient(np.ones((tables.num_states, 1))), 0.0, atol=1e-12)


def test_a_sum_that_does_not_exist_is_refused():
    tables = random_tables(6, 1)
    with pytest.raises(InvalidConfig, match="from 0 to below 1"):
        soft_option_process(tables, parameters_of(tables, 7), policy_of(tables, 5), 1.0)
