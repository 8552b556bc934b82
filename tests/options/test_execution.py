"""The lock-step executor against transitions worked out by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import LEFT, RIGHT, Corridor, Walk

from lodestone.errors import InvalidConfig
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.execution import Decision, Rules, draw_chance, start_actor, tick, uniforms

GAMMA = 0.9
WALK = 2
"""Position of the walking option behind the two primitive actions."""


def play(corridor: Corridor, walk: Walk, rules: Rules, choices: list[int]) -> list[Decision]:
    """One tick per entry; the entry is the choice that stands ready on that tick."""
    return play_options(corridor, Union((Primitives(corridor.action_names), walk)), rules, choices)


def play_options(corridor: Corridor, options: Options, rules: Rules, choices: list[int]) -> list[Decision]:
    @jax.jit
    def run(choices):
        def step(actor, choice):
            return tick(corridor, options, rules, draw_chance(jax.random.key(1)), actor, choice)

        return jax.lax.scan(step, start_actor(corridor, jax.random.key(0)), choices)[1]

    decisions = jax.tree.map(np.asarray, run(jnp.asarray(choices, dtype=jnp.int32)))
    return [jax.tree.map(lambda leaf, tick=tick: leaf[tick], decisions) for tick in range(len(choices))]


def test_option_reward_is_discounted_and_bootstrap_is_gamma_to_the_k():
    # Rewards of entering cells 1, 2, 3 are 1, 2, 3; the walk stops on arrival in cell 3.
    decisions = play(Corridor(length=6), Walk(stop=3), Rules(discount=GAMMA), [WALK, RIGHT, RIGHT])
    assert [bool(decision.valid) for decision in decisions] == [False, False, True]
    last = decisions[-1].transition
    assert float(last.reward) == pytest.approx(1 + 2 * GAMMA + 3 * GAMMA**2)
    assert float(last.discount) == pytest.approx(GAMMA**3)
    assert (int(last.obs), int(last.action), int(last.next_obs)) == (0, WALK, 3)
    assert int(decisions[-1].steps) == 3


def test_undiscounted_sum_and_call_cost_are_switches():
    rules = Rules(discount=GAMMA, undiscounted_option_reward=True, call_cost=0.5)
    decisions = play(Corridor(length=6), Walk(stop=3), rules, [WALK, WALK, WALK, LEFT])
    assert float(decisions[2].transition.reward) == pytest.approx(1 + 2 + 3 - 0.5)
    assert float(decisions[2].transition.discount) == pytest.approx(GAMMA**3)
    assert float(decisions[3].transition.reward) == pytest.approx(2.0)  # a primitive pays no call


def test_one_discount_a_decision_is_a_switch():
    rules = Rules(discount=GAMMA, discount_per_decision=True)
    decisions = play(Corridor(length=6), Walk(stop=3), rules, [WALK, WALK, WALK, LEFT])
    assert float(decisions[2].transition.reward) == pytest.approx(1 + 2 * GAMMA + 3 * GAMMA**2)
    assert float(decisions[2].transition.discount) == pytest.approx(GAMMA)
    end = play(Corridor(length=3), Walk(stop=99), rules, [WALK, WALK])[-1]
    assert float(end.transition.discount) == 0.0


def test_an_option_runs_at_least_one_step():
    # The walk would stop in cell 0, where it is chosen: termination is only asked on arrival.
    decisions = play(Corridor(length=6), Walk(stop=0), Rules(), [WALK, WALK])
    assert not bool(decisions[0].valid)
    assert int(decisions[1].steps) == 2


def test_environment_end_inside_an_option_stops_it_without_bootstrap():
    decisions = play(Corridor(length=3), Walk(stop=99), Rules(discount=GAMMA), [WALK, WALK])
    last = decisions[-1]
    assert bool(last.valid)
    assert bool(last.terminated)
    assert bool(last.episode_ended)
    assert float(last.transition.discount) == 0.0
    assert float(last.episode_return) == pytest.approx(1 + 2)


def test_step_limit_inside_an_option_bootstraps_from_that_option_alone():
    decisions = play(Corridor(length=9), Walk(stop=8), Rules(discount=GAMMA, step_limit=2), [WALK, WALK])
    last = decisions[-1]
    assert bool(last.valid)
    assert bool(last.episode_ended)
    assert not bool(last.terminated)
    assert float(last.transition.discount) == pytest.approx(GAMMA**2)
    np.testing.assert_array_equal(last.transition.next_available, [False, False, True])


def test_step_limit_where_the_option_ends_by_itself_bootstraps_from_all():
    decisions = play(Corridor(length=9), Walk(stop=2), Rules(discount=GAMMA, step_limit=2), [WALK, WALK])
    np.testing.assert_array_equal(decisions[-1].transition.next_available, [True, True, True])


def test_decision_limit_never_cuts_an_option():
    decisions = play(Corridor(length=9), Walk(stop=3), Rules(decision_limit=2), [RIGHT, WALK, WALK, RIGHT])
    assert [bool(decision.episode_ended) for decision in decisions] == [False, False, True, False]
    assert int(decisions[2].episode_decisions) == 2
    assert int(decisions[2].episode_steps) == 3
    assert int(decisions[3].transition.obs) == 0  # a new episode


def test_limit_as_an_end_is_a_switch():
    rules = Rules(discount=GAMMA, decision_limit=1, bootstrap_at_limit=False)
    decisions = play(Corridor(length=9), Walk(stop=9), rules, [RIGHT])
    assert float(decisions[0].transition.discount) == 0.0
    assert not bool(decisions[0].terminated)


def test_cap_stops_an_option_and_all_options_are_available_then():
    corridor = Corridor(length=9)
    options = Union((Primitives(corridor.action_names), Capped(Walk(stop=8), 2)))
    decision = play_options(corridor, options, Rules(), [WALK, WALK])[-1]
    assert bool(decision.valid)
    assert int(decision.steps) == 2
    assert bool(decision.transition.next_available.all())


def test_termination_is_a_probability():
    corridor, walk = Corridor(length=100), Walk(stop=-1, chance=0.25)
    options = Union((Primitives(corridor.action_names), walk))

    @jax.jit
    @jax.vmap
    def first_end(key):
        """Whether the option stops on its first step."""
        actor = start_actor(corridor, key)
        return tick(corridor, options, Rules(), draw_chance(key), actor, jnp.int32(WALK))[1].valid

    stops = np.asarray(first_end(jax.random.split(jax.random.key(3), 4000)))
    assert abs(stops.mean() - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 4000)


@pytest.mark.parametrize("wrong", [{"discount": 1.5}, {"discount": -0.1}, {"step_limit": 0}, {"decision_limit": -3}])
def test_bad_rules_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        Rules(**wrong)


@pytest.mark.parametrize("shape", [(32, 4), (7,), ()])
def test_random_numbers_are_those_of_jax(shape):
    for seed in range(3):
        key = jax.random.fold_in(jax.random.key(seed), 11)
        np.testing.assert_array_equal(jax.jit(uniforms, static_argnums=1)(key, shape), jax.random.uniform(key, shape))
