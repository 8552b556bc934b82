"""What intra-option Q-learning learns, against the planner's table; also about options that it never ran."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor, Walk
from random_mdp import NUM_ACTIONS, RandomOptions, random_mdp, random_options

from lodestone.agents.intra_option import IntraOptionConfig, Values, intra_option_q_learning, update
from lodestone.agents.q_learning import STEPS_PER_ROUND
from lodestone.envs.base import Environment
from lodestone.errors import InvalidConfig, NoOptionAvailable
from lodestone.learning.loop import train
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.execution import Rules
from lodestone.planning.option_models import option_models, option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate

SETTLING = ((0.0, 0.5), (0.1, 0.1), (0.4, 0.02), (0.7, 0.004), (1.0, 0.001))
"""A learning rate that falls about as 1/n."""


def learn(config: IntraOptionConfig, environment: Environment, options: Options, rules: Rules, steps: int, seeds: int):
    """Tables [seeds, S, O], and how often each option was chosen."""
    algorithm = intra_option_q_learning(config, environment, options, rules, steps)
    calls = np.zeros(options.size, dtype=int)
    rounds = -(-steps // STEPS_PER_ROUND)
    for carry, chunk in train(algorithm, range(seeds), rounds, -(-rounds // 10)):
        calls += np.bincount(chunk.log.option[chunk.log.valid], minlength=options.size)
    return np.asarray(carry.table)[:seeds], calls


def primitives_and_others(drawing: bool) -> Union:
    """Random options beside the primitives; where they do not draw their actions, they take the first likeliest."""
    mixed = random_options(seed=5)
    first_action = jax.nn.one_hot(jnp.argmax(mixed.acts, axis=2), NUM_ACTIONS)
    temporal = mixed if drawing else RandomOptions(mixed.start, first_action, mixed.stops, mixed.caps)
    return Union((Primitives(tuple(f"primitive-{action}" for action in range(NUM_ACTIONS))), temporal))


@pytest.mark.parametrize(("behaviour", "drawing"), [("primitives", False), ("primitives", True), ("options", True)])
def test_learned_values_are_the_planners_also_of_options_that_never_ran(behaviour, drawing) -> None:
    """Oracle T2, the noise of single runs averaged out; options draw their actions in some states, or in none."""
    mdp, options = random_mdp(seed=1, goals=1), primitives_and_others(drawing)
    config = IntraOptionConfig(learning_rate=SETTLING, epsilon=((0.0, 1.0),), behaviour=behaviour)
    learned, calls = learn(config, mdp, options, Rules(discount=0.9, step_limit=50), 100_000, seeds=32)
    tables = tabulate(mdp)
    tabulated = tabulate_options(options, tables.space)
    solution = option_value_iteration(tables, tabulated, 0.9)
    live = ~tables.terminal
    available = tabulated.initiation.T & live[:, None]
    assert np.abs(learned.mean(axis=0) - solution.option_values)[available].max() < 0.05
    # Where an option may not start: what going on with it is worth.
    models = option_models(tables, tabulated, 0.9)
    going_on = np.stack([model.rewards + model.backup(solution.values) for model in models], axis=1)
    assert np.abs(learned.mean(axis=0) - going_on)[live].max() < 0.05
    assert (calls[NUM_ACTIONS:] == 0).all() == (behaviour == "primitives")
    assert (calls[:NUM_ACTIONS] > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("drawing", [False, True])
def test_single_runs_learn_options_that_they_never_take(drawing):
    """Oracle T2 for each of 5 seeds: 24 million steps, behaving by the primitives alone."""
    mdp, options = random_mdp(seed=1, goals=1), primitives_and_others(drawing)
    learning_rate = ((0.0, 0.5), (0.01, 0.1), (0.05, 0.02), (0.2, 0.004), (1.0, 0.0001))
    config = IntraOptionConfig(learning_rate, epsilon=((0.0, 1.0),), behaviour="primitives")
    learned, calls = learn(config, mdp, options, Rules(discount=0.9, step_limit=50), 24_000_000, seeds=5)
    tables = tabulate(mdp)
    tabulated = tabulate_options(options, tables.space)
    exact = option_value_iteration(tables, tabulated, 0.9).option_values
    available = tabulated.initiation.T & ~tables.terminal[:, None]
    assert np.abs(learned - exact)[:, available].max() < 0.05
    assert (calls[NUM_ACTIONS:] == 0).all()


def test_a_step_updates_the_options_that_would_have_taken_it_and_no_other() -> None:
    values = Values(jnp.asarray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), None)
    weights, target = jnp.asarray([1.0, 0.0, 1.0]), jnp.asarray([3.0, 9.0, -1.0])
    found, loss = update(values, jnp.int32(1), jnp.int32(0), weights, target, jnp.float32(0.5))
    np.testing.assert_allclose(found.table, [[1, 2, 3], [3.5, 5, 2.5]])
    assert float(loss) == pytest.approx((1 + 49) / 2)


def test_an_option_that_draws_is_the_mean_over_its_actions() -> None:
    by_action = jnp.asarray([[[2.0], [6.0]]])  # one state, two actions, one option
    weights = jnp.asarray([0.25, 0.75])
    values = Values(jnp.sum(by_action * weights[None, :, None], axis=1), by_action)
    for action, target in ((0, 4.0), (1, 0.0), (1, 2.0)):
        values, _ = update(
            values, jnp.int32(0), jnp.int32(action), weights[action][None], jnp.asarray([target]), jnp.float32(0.5)
        )
    np.testing.assert_allclose(values.by_action, [[[3.0], [2.5]]])
    np.testing.assert_allclose(values.table, [[0.25 * 3.0 + 0.75 * 2.5]])


@pytest.mark.parametrize("bootstrap", [True, False])
def test_a_time_limit_bootstraps_unless_it_is_taken_for_an_end(bootstrap) -> None:
    """A walk along a corridor is cut after every second step; each step costs 1 and entering a cell pays its number."""
    corridor = Corridor(length=6, step_reward=-1.0)
    options = Union((Primitives(corridor.action_names), Walk(stop=5)))
    rules = Rules(discount=0.9, step_limit=5, bootstrap_at_limit=bootstrap)
    config = IntraOptionConfig(epsilon=((0.0, 1.0),))
    learned, _ = learn(config, corridor, options, rules, 4000, seeds=1)
    walk = [sum(0.9**step * (cell + step) for step in range(5 - cell)) for cell in range(5)]
    if bootstrap:
        np.testing.assert_allclose(learned[0][:5, 2], walk, rtol=1e-4)
    else:
        assert learned[0][0, 2] < walk[0] - 0.1


def test_what_cannot_be_learned_from_single_steps_is_refused() -> None:
    corridor = Corridor()
    walk, primitives = Walk(stop=3), Primitives(corridor.action_names)
    config = IntraOptionConfig()
    with pytest.raises(InvalidConfig, match=r"'walk' is stopped after 7 steps.* cannot be learned from single steps"):
        intra_option_q_learning(config, corridor, Union((primitives, Capped(walk, 7))), Rules(), 100)
    intra_option_q_learning(config, corridor, Union((primitives, Capped(walk, 1))), Rules(), 100)
    for rules in (Rules(undiscounted_option_reward=True), Rules(call_cost=0.5), Rules(discount_per_decision=True)):
        with pytest.raises(InvalidConfig, match="within options takes the reward"):
            intra_option_q_learning(config, corridor, primitives, rules, 100)
    with pytest.raises(NoOptionAvailable):
        intra_option_q_learning(IntraOptionConfig(behaviour="primitives"), corridor, walk, Rules(), 100)
    with pytest.raises(InvalidConfig, match="behaviour is 'both'"):
        IntraOptionConfig(behaviour="both")


def test_the_maximum_runs_over_what_may_start() -> None:
    """Random options without the primitives, so that one that may not start can be the best."""
    mdp, options = random_mdp(16), random_options(16)
    tables = tabulate(mdp)
    described = tabulate_options(options, tables.space)
    exact = option_value_iteration(tables, described, 0.9).option_values
    everywhere = described._replace(initiation=np.ones_like(described.initiation))
    counted = described.initiation.T
    assert np.abs(option_value_iteration(tables, everywhere, 0.9).option_values - exact)[counted].max() > 0.5
    config = IntraOptionConfig(((0.0, 0.5), (1.0, 0.005)), ((0.0, 1.0),))
    algorithm = intra_option_q_learning(config, mdp, options, Rules(discount=0.9, step_limit=50), 64_000)
    for carry, _ in train(algorithm, range(16), 2000, 2000):
        learned = np.asarray(carry.table).mean(axis=0)
    # A maximum of noisy values is too high by about 0.1 here; over all options it would be by 2.
    np.testing.assert_allclose(learned[counted], exact[counted], atol=0.25)
