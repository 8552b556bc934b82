"""Pytrees as named arrays, and back: how what was learned travels through a file. Random keys travel as their data."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, PyTree

from lodestone.errors import BadFile

Arrays = dict[str, np.ndarray]


def named_arrays(tree: PyTree, prefix: str) -> Arrays:
    """The arrays of a pytree by their paths."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {prefix + jax.tree_util.keystr(path): np.asarray(plain(leaf)) for path, leaf in leaves}


def fill(template: PyTree, arrays: Arrays, prefix: str) -> PyTree:
    """A pytree of the template's structure from named arrays. Raises `BadFile` where a shape or a type differs."""

    def find(path: tuple, leaf: jax.ShapeDtypeStruct) -> Array:
        wanted = jax.eval_shape(plain, leaf)
        found = jnp.asarray(take(arrays, prefix + jax.tree_util.keystr(path), wanted.shape, wanted.dtype))
        return jax.random.wrap_key_data(found) if _is_key(leaf) else found

    return jax.tree_util.tree_map_with_path(find, template)


def take(arrays: Arrays, name: str, shape: tuple[int | None, ...], dtype: DTypeLike) -> np.ndarray:
    """The array of this name. Raises `BadFile` unless it has this dtype and shape; None stands for any length."""
    if name not in arrays:
        raise BadFile(f"the array {name} is missing.")
    found = arrays[name]
    fits = len(found.shape) == len(shape) and all(
        wanted in (None, length) for length, wanted in zip(found.shape, shape, strict=True)
    )
    if not fits or found.dtype != dtype:
        raise BadFile(
            f"{name} is {found.dtype} {list(found.shape)}, but this environment needs {np.dtype(dtype)} {list(shape)}."
        )
    return found


def plain(leaf: Array) -> Array:
    """The leaf, or the data of a random key."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: Array | jax.ShapeDtypeStruct) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
