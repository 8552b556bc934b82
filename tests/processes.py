"""The program in processes of its own, which can be killed. They are forked from one that has imported it already, and
share the code that they compile."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

from lodestone.cli import main, train

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["lodestone.cli"])


def as_it_is() -> None:
    """No change to the process."""


class Program:
    """Runs `lodestone`, without judging what was trained. `folder` keeps what was compiled and what was printed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextmanager
    def started(self, *words: str, prepare: Callable[[], None] = as_it_is) -> Iterator[BaseProcess]:
        """A process that runs it with these words, and that has ended at the end."""
        process = CONTEXT.Process(target=_child, args=(list(words), self.folder, prepare))
        process.start()
        yield process
        process.join()

    def run(self, *words: str, prepare: Callable[[], None] = as_it_is) -> tuple[int | None, str]:
        """Exit code (minus the signal that killed it) and what was printed."""
        with self.started(*words, prepare=prepare) as process:
            pass
        return process.exitcode, self.printed

    def end(self, end: signal.Signals, run: Path, lines: int, delay: float, *words: str) -> tuple[int | None, str]:
        """The same, but send a signal `delay` seconds after the metrics of `run` have so many lines more."""
        lines += count_lines(run)
        with self.started(*words) as process:
            while process.is_alive() and count_lines(run) < lines:
                time.sleep(0.001)
            time.sleep(delay)
            if process.is_alive():
                assert process.pid is not None
                os.kill(process.pid, end)
        return process.exitcode, self.printed

    @property
    def printed(self) -> str:
        """By the last process."""
        return (self.folder / "printed").read_text()


def count_lines(run: Path) -> int:
    """Lines of the metrics so far."""
    metrics = run / "metrics.jsonl"
    return metrics.read_bytes().count(b"\n") if metrics.exists() else 0


def _child(words: list[str], folder: Path, prepare: Callable[[], None]) -> None:
    jax.config.update("jax_disable_most_optimizations", True)
    jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the process it is forked from ignores it
    printed = os.open(folder / "printed", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(printed, stream)
    train._print_result = lambda *result: None  # type: ignore[assignment]
    prepare()
    sys.exit(main(words))
