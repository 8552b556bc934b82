"""The training loop: compiled chunks of rounds, vectorised over seeds and spread over devices.

A *round* is a fixed number of decisions followed by the learner's updates. What a round does is the algorithm's;
the loop repeats it, collects what happened, and hands control back to Python between chunks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt32

from lodestone.errors import Diverged, InvalidConfig
from lodestone.options.execution import Decision


class RoundLog(NamedTuple):
    """What one round tells the host; M slots for decisions, the valid ones in order of time."""

    valid: Bool[Array, " M"]
    option: Int[Array, " M"]
    steps: Int[Array, " M"]
    episode_ended: Bool[Array, " M"]
    terminated: Bool[Array, " M"]
    episode_return: Float[Array, " M"]
    episode_steps: Int[Array, " M"]
    episode_decisions: Int[Array, " M"]
    loss: Float[Array, ""]
    """Mean loss of the round's updates; 0 before learning starts."""


def log_round(decisions: Decision, loss: Float[Array, ""]) -> RoundLog:
    """The part of a round's decisions that the host wants to know."""
    return RoundLog(
        valid=decisions.valid,
        option=decisions.transition.action,
        steps=decisions.steps,
        episode_ended=decisions.episode_ended,
        terminated=decisions.terminated,
        episode_return=decisions.episode_return,
        episode_steps=decisions.episode_steps,
        episode_decisions=decisions.episode_decisions,
        loss=loss,
    )


class Algorithm(NamedTuple):
    """What the loop needs of a learner, for one seed."""

    init: Callable[..., Any]
    """init(key) -> everything that the seed carries from round to round: learner, actors, key. What may start from
    something learned before takes that, too: init(key, start)."""
    run_round: Callable[[Any, Int[Array, ""]], tuple[Any, RoundLog]]
    """run_round(carry, number of the round) -> (carry, log)."""


class Chunk(NamedTuple):
    """What some rounds brought, on the host: S seeds, R rounds, M slots."""

    log: RoundLog
    """NumPy leaves [S, R, M], the loss [S, R]."""
    rounds: int
    """Rounds since the start of training."""
    seconds: float
    """Wall-clock time since the start of training, compilation included."""


class Begun(NamedTuple):
    """Where training goes on that was begun before."""

    carry: Any
    """What the seeds carried, with a leading seed axis."""
    rounds: int
    """Rounds that were over."""
    seconds: float
    """Wall-clock time that they had taken."""


def train(
    algorithm: Algorithm,
    seeds: Sequence[int],
    rounds: int,
    rounds_per_chunk: int,
    *start: PyTree,
    begun: Begun | None = None,
) -> Iterator[tuple[Any, Chunk]]:
    """Train all seeds at once for so many rounds each; yields (carry, chunk) after every chunk of rounds.

    The carry has a leading seed axis, on which seeds may be repeated after the last, and is valid until the next chunk
    is asked for (its memory is then reused). `start`, with a leading seed axis, is what `algorithm.init` takes beside
    the key; `begun` goes on from the end of a chunk, to the same bits on the same machine. Seeds do not influence one
    another. Processes that `jax.distributed` has joined share the seeds: each has to call this alike, holds only its
    part of the carry, and gets the whole log. Raises `Diverged` when a loss is no longer finite.
    """
    if not seeds:
        raise InvalidConfig("Training needs at least one seed.")
    if rounds < 1:
        raise InvalidConfig("Training needs at least one decision.")
    rounds_per_chunk = min(rounds, rounds_per_chunk)

    if jax.process_count() > 1 and len(seeds) < jax.device_count():
        raise InvalidConfig(
            f"{jax.process_count()} processes with {jax.device_count()} devices together need at least as many seeds."
        )
    devices = jax.devices()[: len(seeds)]
    positions = np.arange(len(seeds) + -len(seeds) % len(devices)) % len(seeds)  # every device gets equally many
    mesh = Mesh(np.array(devices), ("seeds",))
    over_seeds, everywhere = PartitionSpec("seeds"), PartitionSpec()

    def place(tree: PyTree) -> PyTree:
        repeated = jax.jit(partial(jax.tree.map, lambda leaf: leaf[positions]))(tree)
        return jax.device_put(repeated, NamedSharding(mesh, over_seeds))

    def init_from(key_data: UInt32[Array, " D"], *start: PyTree) -> Any:
        return algorithm.init(jax.random.wrap_key_data(key_data), *start)

    spread = partial(jax.shard_map, mesh=mesh, check_vma=False)
    init = jax.jit(spread(jax.vmap(init_from), in_specs=over_seeds, out_specs=over_seeds))
    run_chunk = jax.jit(
        spread(
            jax.vmap(partial(_run_chunk, algorithm, rounds_per_chunk), in_axes=(0, None, None)),
            in_specs=(over_seeds, everywhere, everywhere),
            out_specs=over_seeds,
        ),
        donate_argnums=0,
    )

    started, over = perf_counter(), 0
    if begun is None:
        carry = init(*place((jax.random.key_data(_keys(seeds)), *start)))  # keys themselves stay in their process
    else:
        carry, over, started = place(begun.carry), begun.rounds, started - begun.seconds
        del begun  # what it carried takes as much memory as the run
    for first in range(over, rounds, rounds_per_chunk):
        count = min(rounds_per_chunk, rounds - first)
        carry, log = run_chunk(carry, jnp.int32(first), jnp.int32(count))
        log = jax.tree.map(lambda leaf, count=count: leaf[: len(seeds), :count], process_allgather(log, tiled=True))
        _require_finite(log.loss, seeds)
        yield carry, Chunk(log, first + count, perf_counter() - started)


def carried(algorithm: Algorithm, seeds: Sequence[int], *start: PyTree) -> Any:
    """Shapes and dtypes of what `train` carries from round to round."""
    return jax.eval_shape(jax.vmap(algorithm.init), _keys(seeds), *start)


def _keys(seeds: Sequence[int]) -> PRNGKeyArray:
    return jnp.stack([jax.random.key(seed) for seed in seeds])


def _run_chunk(
    algorithm: Algorithm, capacity: int, carry: Any, first: Int[Array, ""], count: Int[Array, ""]
) -> tuple[Any, RoundLog]:
    """`count` rounds of one seed, at most `capacity`. The count is dynamic: one compilation serves all chunks."""
    _, shapes = jax.eval_shape(algorithm.run_round, carry, first)
    empty = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), shapes)

    def body(index: Int[Array, ""], state: tuple[Any, RoundLog]) -> tuple[Any, RoundLog]:
        carry, logs = state
        carry, log = algorithm.run_round(carry, first + index)
        return carry, jax.tree.map(lambda all_, one: all_.at[index].set(one), logs, log)

    return jax.lax.fori_loop(0, count, body, (carry, empty))


def _require_finite(loss: Float[np.ndarray, "S R"], seeds: Sequence[int]) -> None:
    bad = ~np.isfinite(loss).all(axis=1)
    if bad.any():
        seed = seeds[int(np.argmax(bad))]
        raise Diverged(
            f"The loss of seed {seed} is no longer a finite number; try a smaller learning rate, a smaller reward "
            "scale or a smaller gradient norm."
        )
