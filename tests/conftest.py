"""Strictness for all tests: no silent broadcasting over ranks, no silent widening of dtypes."""

import sys
from pathlib import Path

import jax
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the second implementations that live in benchmarks/

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The first example of a test compiles: no deadline.
settings.register_profile("lodestone", deadline=None)
settings.load_profile("lodestone")
