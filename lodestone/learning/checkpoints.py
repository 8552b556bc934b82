"""Checkpoints: all that a run needs to go on to the same bits, written while it goes on.

A checkpoint is one safetensors file of named arrays: what every seed carries from round to round (what it has learned,
its optimiser, replay, random keys and environments in the middle of their options) and what the host knows of it. A
SHA-256 in its header covers all of it. It appears whole or not at all, and the one before stays until it has.
"""

from __future__ import annotations

import hashlib
import json
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from time import monotonic
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import PyTree

from lodestone import __version__
from lodestone.errors import BadFile
from lodestone.files import read_arrays, write_arrays
from lodestone.learning.history import History
from lodestone.learning.loop import Begun
from lodestone.learning.named_arrays import Arrays, fill, named_arrays, plain

FORMAT = 1
"""Of run folders and checkpoints; a change that makes old ones unreadable, or that trains otherwise, counts it up."""

KEPT = 2
"""Checkpoints that are kept: the last one, and the one before it in case the last is damaged."""

CARRY, HISTORY = "carry", "history/"
"""What the names of arrays begin with."""


class Checkpoints:
    """The checkpoints of one run, in a folder of their own.

    A context manager: inside it Ctrl-C waits for the end of the chunk, has a last checkpoint written, and then
    interrupts; a second Ctrl-C interrupts at once.
    """

    def __init__(
        self, folder: Path, run: str, every: float = 60.0, tell: Callable[[str], None] = lambda sentence: None
    ) -> None:
        """`run` names the run that they belong to, and no other; `every` is in seconds, 0 for every chunk. `tell` gets
        a sentence about each damaged file that was passed over."""
        self._folder, self._run, self._every, self._tell = folder, run, every, tell
        self._begun_at = monotonic()
        self._good: list[Path] = []
        """Those that this process has read or written, in order."""
        self._writer = ThreadPoolExecutor(max_workers=1)
        self._writing: Future[None] | None = None
        self._interrupted = False

    def __enter__(self) -> Self:
        is_main = threading.current_thread() is threading.main_thread()  # no other thread may handle signals
        self._listens = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._listens:
            signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.shutdown()
        if self._listens:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def newest(self, template: PyTree, history: History, rounds: int) -> Begun | None:
        """Where the run of so many rounds goes on, and `history` as it was there; None before the first checkpoint.

        `template` has the shapes and dtypes of what the seeds carry. Raises `BadFile` if there are only damaged ones.
        """
        problems: list[str] = []
        for path in sorted(self._all(), reverse=True):
            try:
                begun = self._read(path, template, history, rounds)
            except BadFile as error:
                problems.append(str(error))
                continue
            for problem in problems:
                self._tell(f"{problem} The one before it is used.")
            self._good = [path]
            return begun
        if problems:
            raise BadFile(f"No checkpoint can be used, so the run cannot go on. The newest: {problems[0]}")
        return None

    def after_chunk(self, carry: PyTree, history: History, rounds: int) -> None:
        """Begin to write a checkpoint if one is due. `rounds` is how many are over. Training waits for the copy in the
        host's memory, not for the disk, if `every` is not 0.

        Raises `CannotWrite` if the last one could not be written, and `KeyboardInterrupt`, once it is written, after
        Ctrl-C.
        """
        due = self._interrupted or monotonic() - self._begun_at >= self._every
        if self._interrupted or not self._every or (self._writing is not None and self._writing.done()):
            self.wait()
        if not due or self._writing is not None:
            return
        self._begun_at = monotonic()
        own = jax.tree.map(lambda leaf: np.array(plain(leaf))[: history.seeds], carry)
        arrays = named_arrays(own, CARRY) | {HISTORY + name: array for name, array in history.arrays().items()}
        self._writing = self._writer.submit(self._write, arrays, rounds)
        if self._interrupted:
            self.wait()
            raise KeyboardInterrupt

    def wait(self) -> None:
        """Until what was begun is on the disk. Raises `CannotWrite` if it could not be written."""
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()

    def _all(self) -> list[Path]:
        return [path for path in self._folder.glob("*.safetensors") if path.stem.isdecimal()]

    def _write(self, arrays: Arrays, rounds: int) -> None:
        header = {"kind": "checkpoint", "format": FORMAT, "version": __version__, "run": self._run, "rounds": rounds}
        path = self._folder / f"{rounds:012d}.safetensors"
        write_arrays(path, arrays, header | {"sha256": _checksum(arrays, header)})
        self._good = [*self._good, path][-KEPT:]
        for other in (*self._all(), *self._folder.glob(".*.tmp")):  # what a killed process left half written, too
            if other not in self._good:
                other.unlink(missing_ok=True)

    def _read(self, path: Path, template: PyTree, history: History, rounds: int) -> Begun:
        arrays, header = read_arrays(path)
        checksum = header.pop("sha256", None)
        if header.get("kind") != "checkpoint":
            raise BadFile(f"{path} is no checkpoint.")
        if header.get("format") != FORMAT:
            raise BadFile(f"{path} has the format {header.get('format')!r}, but version {__version__} reads {FORMAT}.")
        if checksum != _checksum(arrays, header):
            raise BadFile(f"{path} is damaged: its checksum does not fit.")
        if header.get("run") != self._run:
            raise BadFile(f"{path} belongs to another run, or the settings of this one were changed.")
        try:
            over = header["rounds"]
            if type(over) is not int or not 0 < over < rounds:
                raise BadFile(f"{over!r} of {rounds} rounds are over.")
            carry = fill(template, arrays, CARRY)
            history.restore({name.removeprefix(HISTORY): arrays[name] for name in arrays if name.startswith(HISTORY)})
        except (BadFile, KeyError) as error:
            raise BadFile(f"{path} does not fit this run: {error}") from None
        return Begun(carry, over, history.seconds)


def _checksum(arrays: Arrays, header: dict[str, Any]) -> str:
    """SHA-256 of everything that a checkpoint says."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(json.dumps([name, str(arrays[name].dtype), arrays[name].shape]).encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()
