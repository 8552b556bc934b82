from __future__ import annotations

import jax.numpy as jnp
import pytest

from lodestone.errors import InvalidConfig
from lodestone.learning.schedules import check_knots, piecewise_linear


def test_piecewise_linear_is_constant_outside_the_knots():
    knots = ((0.2, 1.0), (0.6, 0.2))
    found = [float(piecewise_linear(knots, jnp.float32(fraction))) for fraction in (0.0, 0.2, 0.4, 0.6, 1.0)]
    assert found == pytest.approx([1.0, 1.0, 0.6, 0.2, 0.2])


@pytest.mark.parametrize(
    "knots", [(), ((0.5, 0.1), (0.2, 0.1)), ((0.0, float("nan")),), ((0.0, 2.0),), ((-0.1, 0.5),), ((1.5, 0.5),)]
)
def test_bad_knots_are_refused(knots):
    with pytest.raises(InvalidConfig, match="epsilon"):
        check_knots("epsilon", knots, 0.0, 1.0)
