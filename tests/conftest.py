"""Strictness for all tests: no silent broadcasting over ranks, no silent widening of dtypes."""

import os

# Most of the suite's time goes into compiling programs that run for moments: a fifth less of it, by fewer passes.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")

import jax
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The first example of a test compiles: no deadline.
settings.register_profile("lodestone", deadline=None)
settings.load_profile("lodestone")
