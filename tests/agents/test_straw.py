"""STRAW: its steps against a plain interpreter, its loss against plain loops, plans that are known, what is learned."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import RIGHT, Corridor
from plain_plans import numpy_step

from lodestone.agents.straw import StrawConfig, collect, loss, retell, straw
from lodestone.envs.chain import Chain
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_execution import play_plans, start_planning, trace_plans
from lodestone.learning.plan_network import Plan, PlanConfig, init_plan_network
from lodestone.options.execution import Rules

FLAT = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(8,))
CORRIDOR = Corridor(length=4, step_reward=-1.5)
RULES = Rules(discount=0.9, step_limit=7)
LIMITED = Rules(discount=0.9, decision_limit=4)
SHARP = jnp.float32(0.7)
CONFIG = StrawConfig(
    network=FLAT,
    plan=PlanConfig(horizon=4, patch=3, peak=4.0, background=-1.0, noisy=True),
    environments=3,
    rollout=40,
    reward_scale=0.5,
    noise_cost=0.2,
    value_weight=0.7,
    decay=0.8,
)


def network(config: StrawConfig = CONFIG, seen: int = 4):
    """With weights all of which matter."""
    one = init_plan_network(config.network, config.plan, (seen,), 3, jax.random.key(0))
    leaves, structure = jax.tree.flatten(one)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [leaf + 0.3 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, drawn)


def collected(rules: Rules, rounds: int = 1):
    """The plans at the beginning of the last round, and what it brought."""
    one = network()
    actors = jax.vmap(lambda key: start_planning(CORRIDOR, one, key))(jax.random.split(jax.random.key(2), 3))
    run = jax.jit(lambda actors, key: collect(CONFIG, CORRIDOR, rules, one, SHARP, actors, key))
    for number in range(rounds):
        before = actors
        actors, decisions, taken = run(actors, jax.random.key(3 + number))
    return before, actors, jax.tree.map(np.asarray, (decisions, taken))


def lane(tree, number):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:, number], tree)


# What is taken down.


@pytest.mark.parametrize("rules", [RULES, LIMITED], ids=["step limit", "decision limit"])
def test_steps_are_what_a_plain_interpreter_says(rules):
    """Of two rounds: positions, rewards, limits and ends, which plans run, and what they are left to."""
    one = network()
    before, after, (decisions, taken) = collected(rules, rounds=2)
    kinds = set()
    for number in range(3):
        steps, settled = lane(taken, number), lane(decisions, number)
        plan = jax.tree.map(lambda leaf, number=number: np.asarray(leaf)[number], before.plan)
        actor = jax.tree.map(lambda leaf, number=number: np.asarray(leaf)[number], before.actor)
        cell, episode, plans, elapsed = (
            int(part) for part in (actor.state, actor.episode_steps, actor.episode_decisions, actor.elapsed)
        )
        anew = bool(actor.deciding)
        for t in range(CONFIG.rollout):
            np.testing.assert_array_equal(steps.seen[t], np.eye(4)[cell])
            assert bool(steps.anew[t]) == anew
            elapsed = 1 if anew else elapsed + 1
            plans += anew
            logits, commitment, _ = numpy_step(one, steps.seen[t], plan, anew, steps.noise[t], 0.7)
            plan = Plan(logits, commitment)
            cell = min(max(cell + (1 if steps.action[t] == RIGHT else -1), 0), 3)
            episode += 1
            assert float(steps.reward[t]) == pytest.approx(0.5 * (cell - 1.5))
            np.testing.assert_array_equal(steps.led_to[t], np.eye(4)[cell])
            terminated = cell == 3
            following = bool(steps.anew[t + 1]) if t + 1 < CONFIG.rollout else bool(after.actor.deciding[number])
            stops = bool(settled.valid[t])
            assert following == stops
            truncated = not terminated and (
                episode == rules.step_limit or (stops and plans == rules.decision_limit is not None)
            )
            over = terminated or truncated
            assert bool(steps.cut[t]) == over
            assert float(steps.discount[t]) == pytest.approx(0.0 if terminated else 0.9)
            if stops:
                assert int(settled.steps[t]) == elapsed
                assert bool(settled.episode_ended[t]) == over
            anew = stops
            kinds.add((terminated, truncated, elapsed > 1))
            if over:
                assert stops
                cell, episode, plans = 0, 0, 0
                plan = Plan(np.zeros((3, 4)), np.ones(4))
        np.testing.assert_allclose(after.plan.logits[number], plan.logits, atol=1e-4)
        np.testing.assert_allclose(after.plan.commitment[number], plan.commitment, atol=1e-4)
    assert {kind[:2] for kind in kinds} == {(False, False), (True, False), (False, True)}
    assert {kind[2] for kind in kinds} == {False, True}


def test_plans_are_renewed_as_often_as_their_commitment_says():
    """Over many steps the draws come out as the probabilities do, in the mean."""
    one = network()
    actors = jax.vmap(lambda key: start_planning(CORRIDOR, one, key))(jax.random.split(jax.random.key(2), 200))
    config = replace(CONFIG, environments=200)
    _, decisions, _ = jax.jit(lambda actors: collect(config, CORRIDOR, Rules(), one, SHARP, actors, jax.random.key(1)))(
        actors
    )
    told = jax.vmap(lambda plan, taken: retell(one, SHARP, 0.5, plan, taken), in_axes=(0, 1))(
        actors.plan, collect(config, CORRIDOR, Rules(), one, SHARP, actors, jax.random.key(1))[2]
    )
    going_on = ~np.asarray(decisions.episode_ended)
    drawn, said = np.asarray(decisions.valid)[going_on], np.asarray(told.commitment).T[going_on]
    assert 0.2 < said.mean() < 0.8
    assert drawn.mean() == pytest.approx(said.mean(), abs=3 * 0.5 / np.sqrt(drawn.size))


# The loss.


def numpy_loss(one, plan, taken, entropy_weight):
    """Everything one step at a time."""
    everything = []
    for number in range(3):
        steps = lane(taken, number)
        now = jax.tree.map(lambda leaf, number=number: np.asarray(leaf, np.float64)[number], plan)
        rows = []
        for t in range(CONFIG.rollout):
            logits, commitment, apart = numpy_step(one, steps.seen[t], now, steps.anew[t], steps.noise[t], 0.7)
            now = Plan(logits, commitment)
            looked, _, _ = numpy_step(one, steps.led_to[t], now, True, np.zeros(8), 0.7)
            probs = np.exp(logits[:2, 0]) * steps.allowed[t]
            probs /= probs.sum()
            rows.append((probs, logits[2, 0], looked[2, 0], apart, commitment[0]))
            if steps.cut[t]:
                now = Plan(np.zeros((3, 4)), np.ones(4))
        target = np.zeros(CONFIG.rollout)
        for t in reversed(range(CONFIG.rollout)):
            if t == CONFIG.rollout - 1 or steps.cut[t]:
                ahead = rows[t][2]
            else:
                ahead = (1 - CONFIG.decay) * rows[t + 1][1] + CONFIG.decay * target[t + 1]
            target[t] = steps.reward[t] + steps.discount[t] * ahead
        everything += [(*row, target[t], steps.action[t]) for t, row in enumerate(rows)]
    missed = np.array([target - value for _, value, _, _, _, target, _ in everything])
    total = 0.0
    for (probs, _, _, apart, c, _, action), wrong in zip(everything, missed, strict=True):
        total -= np.log(probs[action]) * wrong
        total += entropy_weight * sum(p * np.log(p) for p in probs if p > 0)
        total += CONFIG.value_weight / 2 * wrong**2 + CONFIG.noise_cost * apart + 0.3 * c
    return total / len(everything)


@jax.jit
def told_loss(one, plan, taken):
    told = jax.vmap(lambda plan, taken: retell(one, SHARP, CONFIG.decay, plan, taken), in_axes=(0, 1))(plan, taken)
    return loss(CONFIG, jnp.float32(0.05), jnp.float32(0.3), told)


@pytest.mark.parametrize("rules", [RULES, LIMITED], ids=["step limit", "decision limit"])
def test_loss_equals_a_plain_numpy_loop(rules):
    """From plans in the middle of an episode, on another network than the one that acted."""
    before, _, (_, taken) = collected(rules, rounds=2)
    other = jax.tree.map(lambda leaf: 0.9 * leaf, network())
    found = told_loss(other, before.plan, taken)
    np.testing.assert_allclose(found, numpy_loss(other, before.plan, taken, 0.05), rtol=2e-4)


def test_the_loss_is_about_what_is_allowed():
    """Where every second step left no choice, its action had probability 1 and no entropy."""
    before, _, (_, taken) = collected(RULES)
    only = np.eye(2, dtype=bool)[taken.action]
    forced = taken._replace(allowed=np.where((np.arange(CONFIG.rollout) % 2 == 0)[:, None, None], only, True))
    other = jax.tree.map(lambda leaf: 0.9 * leaf, network())
    found = told_loss(other, before.plan, forced)
    np.testing.assert_allclose(found, numpy_loss(other, before.plan, forced, 0.05), rtol=2e-4)
    assert abs(float(found - told_loss(other, before.plan, taken))) > 1e-3


def test_a_limit_bootstraps_and_an_end_does_not():
    """The return of the last step before either, for values that are all 7."""
    one = network()
    blank = jax.tree.map(jnp.zeros_like, one)
    sevens = eqx.tree_at(lambda n: n.patch.bias, blank, jnp.zeros(9).at[6:].set(1.0))
    before, _, (_, taken) = collected(RULES)
    told = jax.vmap(lambda plan, taken: retell(sevens, SHARP, 0.0, plan, taken), in_axes=(0, 1))(before.plan, taken)
    ended, limited = taken.discount == 0, taken.cut & (taken.discount > 0)
    target = np.asarray(told.target).T
    assert ended.any()
    assert limited.any()
    np.testing.assert_allclose(target[ended], taken.reward[ended], rtol=1e-6)
    assert (np.abs(target[limited] - taken.reward[limited]) > 0.1).all()


# Plans that are known.

LONG = Corridor(length=6, step_reward=-2.5)


def with_column(one, columns, centre=0.0, log_variance=-5.0):
    """Writes these columns [R, K], whatever is seen, through filters one column wide."""
    blank = jax.tree.map(jnp.zeros_like, one)
    return eqx.tree_at(
        lambda n: (n.focus.bias, n.patch.bias, n.schedule.bias),
        blank,
        (jnp.array([0.0, 0.0, -5.0]), jnp.asarray(columns, jnp.float32).ravel(), jnp.array([centre, log_variance])),
    )


def test_without_a_new_plan_the_fixed_sequence_of_actions_is_carried_out():
    """The commitment is 0 everywhere: one plan, and its actions one after the other until the episode ends."""
    shape = PlanConfig(horizon=8, patch=8, peak=0.0, background=-50.0)
    one = init_plan_network(FLAT, shape, (6,), 3, jax.random.key(0))
    rights = np.array([1, 1, 0, 1, 1, 1, 1, 0])
    planning = with_column(one, np.stack([1 - rights, rights, np.zeros(8)]))
    trace = jax.jit(lambda: trace_plans(LONG, Rules(), planning, jax.random.key(0), 7))()
    assert trace.action.tolist() == rights[:7].tolist()
    assert trace.anew.tolist() == [True] + 6 * [False]
    cells = [1, 2, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(trace.reward, np.array(cells) - 2.5)
    episode = jax.jit(lambda: play_plans(LONG, Rules(), planning, jax.random.key(0), 100))()
    assert (int(episode.steps), int(episode.decisions), bool(episode.success)) == (7, 1, True)
    assert float(episode.total_reward) == pytest.approx(sum(cells) - 2.5 * 7)


def test_the_next_plan_comes_where_the_commitment_peaks_and_when_a_plan_has_run_out():
    shape = PlanConfig(horizon=6, patch=6, peak=12.0, background=-6.0)
    one = init_plan_network(FLAT, shape, (6,), 3, jax.random.key(0))
    rights = np.stack([np.ones(6), np.zeros(6), np.zeros(6)])  # to the left, so that no episode ends
    for centre, every in ((-1.0, 1), (-0.2, 3), (1.0, 6), (9.0, 7)):
        planning = with_column(one, rights, centre)
        trace = jax.jit(lambda planning=planning: trace_plans(LONG, Rules(), planning, jax.random.key(0), 22))()
        assert np.flatnonzero(trace.anew).tolist() == list(range(0, 22, every))


@pytest.mark.parametrize(("background", "lengths"), [(20.0, {1}), (-6.0, {1, 2, 3, 4, 5})])
def test_with_a_high_background_every_step_plans_anew(background, lengths):
    config = replace(CONFIG, plan=replace(CONFIG.plan, background=background), sharpness=((0.0, 1.0),))
    one = network(config)
    actors = jax.vmap(lambda key: start_planning(CORRIDOR, one, key))(jax.random.split(jax.random.key(2), 3))
    _, decisions, _ = jax.jit(
        lambda actors: collect(config, CORRIDOR, RULES, one, jnp.float32(1), actors, jax.random.key(0))
    )(actors)
    assert set(np.asarray(decisions.steps)[np.asarray(decisions.valid)].tolist()) <= lengths
    assert np.asarray(decisions.valid).all() == (background > 0)


# What is learned.

LEARNING = StrawConfig(
    network=NetworkConfig(kernels=(), strides=(), channels=(), hidden=(16,)),
    plan=PlanConfig(horizon=4, patch=4, noisy=True),
    environments=8,
    rollout=8,
    learning_rate=((0.0, 5e-3),),
    reward_scale=0.1,
)


def learned(seeds):
    rounds, far, rules = 120, Corridor(length=5, step_reward=-5.0), Rules(discount=0.95, step_limit=12)
    for carry, chunk in train(straw(LEARNING, far, rules, rounds * LEARNING.steps_per_round), seeds, rounds, rounds):
        pass
    play = jax.jit(jax.vmap(lambda one: play_plans(far, rules, one, jax.random.key(0), 12)))
    return jax.tree.map(np.asarray, carry.network), chunk, play(carry.network)


@pytest.mark.slow
def test_the_shortest_way_is_learned_and_other_seeds_change_nothing():
    networks, chunk, episodes = learned((3, 4))
    assert episodes.steps.tolist() == [4, 4]
    assert (chunk.log.steps[chunk.log.valid] > 1).any()
    alone, _, _ = learned((4,))
    np.testing.assert_allclose(networks.patch.weight[1], alone.patch.weight[0], atol=1e-3)


def test_observations_may_be_indices():
    algorithm = straw(LEARNING, Chain(observation="index"), Rules(step_limit=20), 64)
    carry = jax.eval_shape(algorithm.init, jax.random.key(0))
    after, log = jax.eval_shape(algorithm.run_round, carry, jnp.int32(0))
    assert after.network == carry.network
    assert log.valid.shape == (LEARNING.steps_per_round,)


@pytest.mark.parametrize(
    "wrong",
    [
        {"decay": 1.5},
        {"sharpness": ((0.0, 2.0),)},
        {"environments": 0},
        {"rollout": 0},
        {"commitment_cost": ((0.0, -0.1),)},
        {"entropy": ((0.0, float("nan")),)},
        {"reward_scale": 0.0},
    ],
)
def test_bad_settings_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        StrawConfig(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"call_cost": 1.0}, {"undiscounted_option_reward": True}, {"bootstrap_at_limit": False}]
)
def test_rules_that_it_cannot_keep_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        straw(LEARNING, CORRIDOR, Rules(**wrong), 100)
