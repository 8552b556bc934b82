"""Checkpoints: what is written comes back, bit for bit; whatever is wrong with a file is found."""

from __future__ import annotations

import errno
import os
import random
import signal
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from lodestone.errors import BadFile, CannotWrite
from lodestone.files import read_arrays, write_arrays
from lodestone.learning.checkpoints import FORMAT, Checkpoints
from lodestone.learning.history import History
from lodestone.learning.loop import Chunk, RoundLog

SEEDS, CHOICES = 2, ("a", "b", "c")


class Carry(NamedTuple):
    """A leaf of every type that a learner carries, with room for one seed more, repeated for the devices' sake."""

    key: Array
    weights: dict[str, Array]
    counts: tuple[Array, Array, Array]
    flags: Array
    nothing: Array
    none: None


def make_carry(value: int = 0) -> Carry:
    keys = jax.random.split(jax.random.key(value), SEEDS + 1)
    weights = jax.random.normal(jax.random.key(value + 1), (SEEDS + 1, 3, 2))
    odd = weights.at[0, 0].set(jnp.array([jnp.nan, -0.0])).at[0, 1].set(jnp.array([-jnp.inf, 1e-42]))
    counts = (jnp.arange(SEEDS + 1), jnp.uint8([1, 255, 7]), jnp.int8([-128, 3, 4]))
    return Carry(keys, {"w": odd}, counts, weights[..., 0] > 0, jnp.zeros((SEEDS + 1, 0)), None)


TEMPLATE = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[:SEEDS], make_carry()))


def make_chunks(count: int) -> list[Chunk]:
    rng, chunks = np.random.default_rng(0), []
    shape = (SEEDS, 2, 5)
    for number in range(count):
        log = RoundLog(
            valid=rng.random(shape) < 0.8,
            option=rng.integers(0, 3, shape),
            steps=rng.integers(1, 9, shape),
            episode_ended=rng.random(shape) < 0.4,
            terminated=rng.random(shape) < 0.5,
            episode_return=rng.normal(size=shape).astype(np.float32),
            episode_steps=rng.integers(1, 99, shape),
            episode_decisions=rng.integers(1, 99, shape),
            loss=rng.normal(size=shape[:2]).astype(np.float32),
        )
        chunks.append(Chunk(log, 2 * number + 2, 0.5 * number))
    return chunks


def make_history(chunks: int = 3) -> History:
    history = History(SEEDS, CHOICES)
    for chunk in make_chunks(chunks):
        history.add(chunk)
    return history


def save(folder: Path, *rounds: int, run: str = "run", every: float = 0.0) -> None:
    with Checkpoints(folder, run, every) as checkpoints:
        for number in rounds:
            checkpoints.after_chunk(make_carry(number), make_history(), number)


def load(folder: Path, template: object = TEMPLATE, choices: tuple[str, ...] = CHOICES, rounds: int = 100):
    told: list[str] = []
    history = History(SEEDS, choices)
    with Checkpoints(folder, "run", tell=told.append) as checkpoints:
        begun = checkpoints.newest(template, history, rounds)
    return begun, history, told


def bits(tree: object) -> list[tuple[str, bytes]]:
    leaves = [
        jax.random.key_data(leaf) if leaf.dtype == jax.random.key(0).dtype else leaf for leaf in jax.tree.leaves(tree)
    ]
    return [(str(leaf.dtype), np.asarray(leaf).tobytes()) for leaf in leaves]


@pytest.fixture
def one(tmp_path) -> Path:
    """The only checkpoint of a folder."""
    save(tmp_path, 6)
    (path,) = tmp_path.iterdir()
    return path


def refused(folder: Path) -> str:
    with pytest.raises(BadFile) as caught:
        load(folder)
    return str(caught.value)


def test_everything_comes_back(one):
    begun, history, told = load(one.parent)
    assert (begun.rounds, begun.seconds, told) == (6, 1.0, [])
    assert jax.tree.structure(begun.carry) == jax.tree.structure(TEMPLATE)
    assert bits(begun.carry) == bits(jax.tree.map(lambda leaf: leaf[:SEEDS], make_carry(6)))
    assert jax.random.uniform(begun.carry.key[1]) == jax.random.uniform(make_carry(6).key[1])
    wanted = make_history()
    for seed in range(SEEDS):
        assert history.taken(seed) == wanted.taken(seed)
        jax.tree.map(np.testing.assert_array_equal, history.episodes(seed), wanted.episodes(seed))
    for found, usage in zip(history.usage, wanted.usage, strict=True):
        jax.tree.map(np.testing.assert_array_equal, found, usage)


def test_a_history_goes_on_as_if_it_had_not_been_saved():
    restored, whole = History(SEEDS, CHOICES), make_history(3)
    restored.restore(make_history(2).arrays())
    for chunk in make_chunks(3)[2:]:
        restored.add(chunk)
    for name, wanted in whole.arrays().items():
        np.testing.assert_array_equal(restored.arrays()[name], wanted)


def test_without_a_checkpoint_there_is_nothing_to_go_on_from(tmp_path):
    (tmp_path / "notes.safetensors").write_text("not ours")
    (tmp_path / ".000000000006.safetensors.1.tmp").write_text("half written")
    assert load(tmp_path)[0] is None
    assert load(tmp_path / "missing")[0] is None


def test_the_last_two_are_kept_and_foreign_files_too(tmp_path):
    (tmp_path / "notes.safetensors").write_text("not ours")
    save(tmp_path, 2, 4, 6, 8)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "000000000006.safetensors",
        "000000000008.safetensors",
        "notes.safetensors",
    ]


def test_a_damaged_one_is_named_and_the_one_before_it_used(tmp_path):
    save(tmp_path, 2, 4)
    path = tmp_path / "000000000004.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    begun, _, told = load(tmp_path)
    assert begun.rounds == 2
    assert told == [f"{path} is truncated, or no safetensors file. The one before it is used."]
    with Checkpoints(tmp_path, "run", 0.0) as checkpoints:
        checkpoints.newest(TEMPLATE, History(SEEDS, CHOICES), 100)
        checkpoints.after_chunk(make_carry(), make_history(), 3)
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["000000000002", "000000000003"]  # both are whole


def test_every_flipped_bit_is_found(one):
    content, chance = one.read_bytes(), random.Random(0)
    for position in range(0, len(content), 3):
        damaged = bytearray(content)
        damaged[position] ^= 1 << chance.randrange(8)
        one.write_bytes(damaged)
        assert one.name in refused(one.parent)


def test_every_truncation_is_found(one):
    content = one.read_bytes()
    for length in range(0, len(content), 7):
        one.write_bytes(content[:length])
        assert one.name in refused(one.parent)


@pytest.mark.parametrize(
    ("template", "choices", "sentence"),
    [
        (TEMPLATE._replace(flags=jax.ShapeDtypeStruct((SEEDS, 4), bool)), CHOICES, r"carry.flags is bool \[2, 3\]"),
        (TEMPLATE._replace(flags=jax.ShapeDtypeStruct((SEEDS, 3), jnp.int8)), CHOICES, "needs int8"),
        (TEMPLATE._replace(none=TEMPLATE.flags), CHOICES, "carry.none is missing"),
        (TEMPLATE._replace(key=TEMPLATE.flags), CHOICES, r"carry.key is uint32 \[2, 2\]"),
        (TEMPLATE, CHOICES[:2], r"usage/calls is int64 \[3, 2, 3\]"),
    ],
)
def test_what_does_not_fit_is_refused(template, choices, sentence, one):
    with pytest.raises(BadFile, match=sentence):
        load(one.parent, template, choices)


def test_a_run_that_was_over_or_is_another_is_refused(one):
    with pytest.raises(BadFile, match="6 of 6 rounds are over"):
        load(one.parent, rounds=6)
    save(one.parent, 6, run="another")
    assert "belongs to another run" in refused(one.parent)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"format": FORMAT + 1}, f"has the format {FORMAT + 1}, but version"),
        ({"format": [[]]}, "has the format [[]], but"),
        ({"kind": "policy"}, "is no checkpoint"),
        ({"sha256": None}, "checksum does not fit"),
        ({"rounds": 7}, "checksum does not fit"),
        ({"more": {"a": [1]}}, "checksum does not fit"),
    ],
)
def test_hostile_headers_are_refused(changes, sentence, one):
    arrays, header = read_arrays(one)
    write_arrays(one, arrays, header | changes)
    assert sentence in refused(one.parent)


def test_what_cannot_be_written_is_said_after_the_next_chunk(tmp_path, monkeypatch):
    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with Checkpoints(tmp_path, "run", 0.0) as checkpoints:
        checkpoints.after_chunk(make_carry(), make_history(), 2)
        checkpoints.after_chunk(make_carry(), make_history(), 4)
        checkpoints.wait()
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            checkpoints.after_chunk(make_carry(), make_history(), 6)
            with pytest.raises(CannotWrite, match="No space left on device"):
                checkpoints.after_chunk(make_carry(), make_history(), 8)
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["000000000002", "000000000004"]


def test_one_is_written_when_it_is_due(tmp_path):
    save(tmp_path, 2, 4, every=60.0)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def interruptible():
    """As of a process in the foreground, wherever the tests run."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_for_a_last_one_and_a_second_does_not(tmp_path):
    with Checkpoints(tmp_path, "run", every=60.0) as checkpoints:
        checkpoints.after_chunk(make_carry(), make_history(), 2)
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            checkpoints.after_chunk(make_carry(), make_history(), 4)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert [path.stem for path in tmp_path.iterdir()] == ["000000000004"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_an_interrupt_that_is_ignored_stays_ignored(tmp_path):
    """As of a process in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Checkpoints(tmp_path, "run", every=60.0) as checkpoints:
            signal.raise_signal(signal.SIGINT)
            checkpoints.after_chunk(make_carry(), make_history(), 2)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    assert list(tmp_path.iterdir()) == []
