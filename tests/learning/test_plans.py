"""Plans: a plain NumPy second implementation, the limits in which they are known exactly, and their gradients."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_plans import numpy_step

from lodestone.errors import InvalidConfig
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_network import Plan, PlanConfig, init_plan_network
from lodestone.learning.plans import (
    attention,
    commitment,
    divergence,
    perturb,
    read,
    shift,
    shift_commitment,
    straight_through,
    write,
)

R, T, K, SEEN = 3, 6, 4, 5
FLAT = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(7,))
SHARP = jnp.float32(0.8)


def network(noisy: bool = False, patch: int = K, horizon: int = T):
    """With weights and biases all of which matter."""
    shape = PlanConfig(horizon=horizon, patch=patch, peak=5.0, background=-2.0, noisy=noisy)
    one = init_plan_network(FLAT, shape, (SEEN,), R, jax.random.key(0))
    leaves, structure = jax.tree.flatten(one)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [leaf + 0.3 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(structure, drawn)


@jax.jit
def step(one, features, plan, anew, noise=None):
    return one.step(features, plan, jnp.bool_(anew), jnp.zeros(0) if noise is None else noise, SHARP)


def some(*shape: int, seed: int = 0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def some_plan(horizon: int = T) -> Plan:
    return Plan(some(R, horizon, seed=3), jax.nn.sigmoid(some(horizon, seed=4)))


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("anew", [False, True])
def test_a_step_equals_plain_loops(noisy, anew):
    one, plan = network(noisy), some_plan()
    seen, noise = some(SEEN, seed=1), some(one.noise_size, seed=2)
    wanted = numpy_step(one, seen, plan, anew, noise, float(SHARP))
    found, apart = step(one, one.trunk(seen), plan, anew, noise)
    for ours, theirs in zip((*found, apart), wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)
    acting = one.act(seen, plan, jnp.bool_(anew), noise, SHARP)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), acting, found)


# Attention.


@pytest.mark.parametrize(("sigma", "away"), [(1.0, 0.60), (0.5, 0.213), (0.2, 7.5e-6), (0.1, 1e-7)])
def test_narrow_filters_one_column_apart_are_the_identity(sigma, away):
    filters = attention(jnp.array([0.0, 0.0, 2 * np.log(sigma)], jnp.float32), 10, 10)
    assert float(jnp.abs(filters - jnp.eye(10)).max()) == pytest.approx(away, rel=0.02, abs=1e-7)
    if sigma < 0.3:
        np.testing.assert_allclose(read(some(R, 10), filters), some(R, 10), atol=1e-4)
        np.testing.assert_allclose(write(some(R, 10), filters), some(R, 10), atol=1e-4)


def test_then_a_new_plan_is_the_old_one_plus_the_patch():
    one = network(patch=T)
    sharp = eqx.tree_at(
        lambda n: (n.focus.weight, n.focus.bias), one, (jnp.zeros((7, 3)), jnp.array([0.0, 0.0, -4.6], jnp.float32))
    )
    plan, seen = some_plan(), some(SEEN, seed=1)
    z = sharp.trunk(seen)
    code = jnp.concatenate([plan.logits.ravel(), z])
    code = jnp.tanh(sharp.encoder[1](jax.nn.relu(sharp.encoder[0](code))))
    patch = sharp.patch(jnp.concatenate([code, z])).reshape(R, T)
    found, _ = step(sharp, z, plan, True)
    np.testing.assert_allclose(found.logits, shift(plan.logits) + patch, atol=1e-5)


@pytest.mark.parametrize("focus", [(-9.0, 0.0, 0.0), (9.0, 3.0, -50.0), (0.1, 80.0, 50.0), (0.1, 0.0, -50.0)])
def test_filters_that_miss_the_plan_are_numbers_and_so_are_their_gradients(focus):
    where = jnp.array(focus, jnp.float32)
    for one in (lambda f: attention(f, T, K).sum(), lambda f: commitment(f[::2], T, 40.0, -8.0, SHARP).sum()):
        value, gradient = jax.jit(jax.value_and_grad(one))(where)
        assert np.isfinite(value)
        assert np.isfinite(gradient).all()


def test_the_peak_of_a_commitment_does_not_depend_on_its_width():
    for log_variance in (-3.0, 0.0, 4.0):
        c = commitment(jnp.array([0.2, log_variance], jnp.float32), 6, 12.0, -6.0, jnp.float32(1))
        assert float(c[3]) == pytest.approx(1 / (1 + np.exp(-6.0)), rel=1e-5)
        assert int(jnp.argmax(c)) == 3


@pytest.mark.parametrize("log_variance", [-2.0, 3.0, 8.0])
def test_the_widest_bell_can_still_become_narrower(log_variance):
    """Beside the peak a narrower bell commits itself less; the gradient says so at any width."""

    def beside(log_variance):
        return commitment(jnp.stack([jnp.float32(-1), log_variance]), 6, 12.0, -6.0, jnp.float32(0.3))[1]

    gradient = float(jax.grad(beside)(jnp.float32(log_variance)))
    step = 1e-2
    ends = [float(beside(jnp.float32(log_variance + sign * step))) for sign in (-1, 1)]
    assert gradient > 1e-6
    assert gradient == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=0.1, abs=2e-5)


# Steps of time.


def test_after_m_steps_without_a_look_the_plan_is_at_its_column_m():
    one, seen = network(), some(SEEN, seed=1)
    plan, _ = step(one, one.trunk(seen), one.start(), True)
    made = plan
    for m in range(T + 2):
        column = made.logits[:, m] if m < T else jnp.zeros(R)
        np.testing.assert_array_equal(plan.logits[:, 0], column)
        assert float(plan.commitment[0]) == pytest.approx(float(made.commitment[m]) if m < T else 1.0)
        plan, apart = step(one, one.trunk(some(SEEN, seed=9)), plan, False)
        assert float(apart) == 0.0
    assert float(jax.nn.softmax(plan.logits[:, 0]).std()) == 0.0  # nothing is planned any more: all are alike
    np.testing.assert_array_equal(shift(some(2, 3)), np.pad(some(2, 3)[:, 1:], ((0, 0), (0, 1))))
    np.testing.assert_array_equal(shift_commitment(jnp.array([0.1, 0.2, 0.3])), jnp.array([0.2, 0.3, 1.0]))


def test_the_first_step_plans_for_sure():
    np.testing.assert_array_equal(network().start().commitment, np.ones(T))
    np.testing.assert_array_equal(network().start().logits, np.zeros((R, T)))


def test_planning_at_every_step_from_what_is_seen_alone_is_a_feed_forward_network():
    """Reading switched off, a horizon of one: nothing is left of the plan before."""
    one = network(horizon=1, patch=1)
    blind = one.encoder[0].weight.at[:R].set(0)
    one = eqx.tree_at(lambda n: n.encoder[0].weight, one, blind)
    plan = one.start()
    for number in range(3):
        z = one.trunk(some(SEEN, seed=number))
        plan, _ = step(one, z, plan, True)
        hidden = jnp.tanh(one.encoder[1](jax.nn.relu(z @ blind[R:] + one.encoder[0].bias)))
        weight = attention(one.focus(z), 1, 1)[0, 0]
        np.testing.assert_allclose(plan.logits[:, 0], weight * one.patch(jnp.concatenate([hidden, z])), rtol=1e-5)


# Gradients.


def unrolled(one, gates, observations, plan, noise):
    """A number that all of a plan's run goes into."""
    total = jnp.float32(0)
    for t in range(observations.shape[0]):
        plan, apart = one.step(one.trunk(observations[t]), plan, gates[t], noise[t], SHARP)
        total += jax.nn.log_softmax(plan.logits[:-1, 0])[t % (R - 1)] + plan.logits[-1, 0] + 0.3 * apart
        total += 0.5 * plan.commitment[0]
    return total


def test_what_is_seen_where_no_plan_is_made_has_no_gradient_at_all():
    one, gates = network(noisy=True), jnp.array([True, False, True, False, False])
    noise = some(5, one.noise_size, seed=6)
    gradient = jax.jit(jax.grad(unrolled, argnums=2))(one, gates, some(5, SEEN, seed=5), one.start(), noise)
    assert (jnp.abs(gradient).max(axis=1) > 0).tolist() == gates.tolist()


def test_acting_does_not_look_where_no_plan_is_made():
    one = network()
    plan = one.act(jnp.full(SEEN, jnp.nan), some_plan(), jnp.bool_(False), jnp.zeros(0), SHARP)
    assert np.isfinite(plan.logits).all()


def test_a_draw_is_what_was_drawn_and_passes_the_gradient_on():
    for drawn in (False, True):
        value, slope = jax.value_and_grad(straight_through)(jnp.float32(0.3), jnp.bool_(drawn))
        assert (float(value), float(slope)) == (float(drawn), 1.0)


def relaxed_step(one, features, plan, gate, noise):
    """A step with any number for a gate."""
    added, renewed, apart = one.renew(features, plan, noise, SHARP)
    kept = shift_commitment(plan.commitment)
    return Plan(shift(plan.logits) + gate * added, (1 - gate) * kept + gate * renewed), gate * apart


@pytest.mark.parametrize("noisy", [False, True])
def test_the_gradient_through_the_draws_is_that_of_gates_that_are_numbers(noisy):
    """Gates as free numbers, at the values that were drawn; their derivatives then go on to the probabilities by hand,
    from the last step to the first."""
    one, gates = network(noisy), [True, False, False, True]
    observations, noise = some(4, SEEN, seed=5), some(4, one.noise_size, seed=6)

    def relaxed(one, numbers):
        plan, total, probabilities = one.start(), jnp.float32(0), []
        for t in range(4):
            probabilities.append(plan.commitment[0])
            plan, apart = relaxed_step(one, one.trunk(observations[t]), plan, numbers[t], noise[t])
            total += jax.nn.log_softmax(plan.logits[:-1, 0])[t % (R - 1)] + plan.logits[-1, 0] + 0.3 * apart
            total += 0.5 * plan.commitment[0]
        return total, jnp.stack(probabilities)

    numbers = jnp.array(gates, jnp.float32)
    (_, probabilities), pull = jax.vjp(jax.jit(relaxed), one, numbers)
    assert probabilities.shape == (4,)
    # d total / d gate, and through the probabilities of later gates, which hang on earlier ones.
    slopes = jnp.zeros(4)
    pull = jax.jit(pull)
    for _ in range(4):
        wanted, of_gates = pull((jnp.float32(1), slopes))
        slopes = of_gates
    wanted, _ = pull((jnp.float32(1), slopes))
    found = jax.jit(jax.grad(unrolled))(one, jnp.array(gates), observations, one.start(), noise)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), found, wanted)


def test_the_gradient_for_given_draws_is_that_of_finite_differences():
    """Of the focus, whose gradient runs through both filters, for gates without a gradient of their own."""
    one, numbers = network(noisy=True), jnp.array([1.0, 0.0, 1.0])
    observations, noise = some(3, SEEN, seed=5), some(3, one.noise_size, seed=6)

    @jax.jit
    def total(bias):
        changed = eqx.tree_at(lambda n: n.focus.bias, one, bias)
        plan, result = changed.start(), jnp.zeros((), bias.dtype)
        for t in range(3):
            features = changed.trunk(observations[t])
            plan, apart = relaxed_step(changed, features, plan, numbers[t], noise[t])
            result += jnp.sum(plan.logits[:, 0] ** 2) + 0.3 * apart + plan.commitment[0]
        return result

    bias, small = one.focus.bias, 3e-3
    found = jax.grad(total)(bias)
    for index in range(3):
        ahead, behind = (total(bias.at[index].add(by)) for by in (small, -small))
        assert float(found[index]) == pytest.approx(float(ahead - behind) / (2 * small), rel=2e-2, abs=2e-3)


# Noise.


def test_the_divergence_is_that_of_the_samples():
    mean, log_variance = np.array([0.5, -1.0, 0.0]), np.array([0.3, -1.2, 0.0])
    noise = np.random.default_rng(0).normal(size=(1_000_000, 3))
    drawn = np.asarray(
        jax.vmap(partial(perturb, *(jnp.asarray(x, jnp.float32) for x in (mean, log_variance))))(
            jnp.asarray(noise, jnp.float32)
        )
    )
    np.testing.assert_allclose(drawn, mean + np.exp(log_variance / 2) * noise, atol=1e-5)
    log_ratio = -0.5 * (noise**2 + log_variance) + 0.5 * drawn**2
    found = divergence(jnp.asarray(mean, jnp.float32), jnp.asarray(log_variance, jnp.float32))
    assert float(found) == pytest.approx(log_ratio.sum(axis=1).mean(), abs=5e-3)
    assert float(divergence(jnp.zeros(3), jnp.zeros(3))) == 0.0


@pytest.mark.parametrize("wrong", [{"horizon": 0}, {"patch": 0}, {"peak": float("nan")}, {"background": float("inf")}])
def test_bad_shapes_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        PlanConfig(**wrong)


def test_a_network_without_a_hidden_layer_is_refused():
    with pytest.raises(InvalidConfig, match="hidden layer"):
        init_plan_network(NetworkConfig((), (), (), ()), PlanConfig(), (SEEN,), R, jax.random.key(0))
