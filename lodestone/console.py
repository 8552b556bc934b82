"""Progress on the terminal, with an estimate of the time left; plain lines where there is no terminal."""

from __future__ import annotations

from time import monotonic
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn

SECONDS_BETWEEN_LINES = 10.0


class ConsoleProgress:
    """Shows the work on standard error, so that standard output stays clean. A context manager."""

    def __init__(self, total: float) -> None:
        """`total`: the work of all stages together."""
        self._console = Console(stderr=True)
        self._total = total
        self._done_before = 0.0
        self._stage_work = 0.0
        self._stage_done = 0.0
        self._skipped = 0.0
        """Work of stages that ended before their time; it says nothing about the speed."""
        self._elsewhere = 0.0
        """The same of the stage's work that another process did before."""
        self._stage = ""
        self._started = monotonic()
        self._last_line = -SECONDS_BETWEEN_LINES
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[left]}"),
            TextColumn("[dim]{task.fields[text]}"),
            console=self._console,
            transient=True,
        )
        self._task = self._bar.add_task("starting", total=total, left="", text="compiling")

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def begin(self, stage: str, work: float) -> None:
        """A stage begins, with so much work ahead."""
        self._done_before += self._stage_work
        self._skipped += self._stage_work - self._stage_done + self._elsewhere
        self._stage, self._stage_work, self._elsewhere = stage, work, 0.0
        self.advance(0.0, "compiling")

    def skip(self, work: float) -> None:
        """So much of the stage's work had been done before it began here."""
        self._elsewhere = work

    def advance(self, work: float, text: str) -> None:
        """So much of the stage's work has been done in all."""
        self._stage_done = work
        done = self._done_before + work
        left = self._time_left(done)
        self._bar.update(self._task, completed=done, description=self._stage, text=text, left=left)
        now = monotonic()
        if not self._console.is_terminal and (work == 0 or now - self._last_line >= SECONDS_BETWEEN_LINES):
            self._last_line = now
            self._console.print(
                f"{done / self._total:4.0%}  {self._stage}  {left}  {text}", highlight=False, soft_wrap=True
            )

    def _time_left(self, done: float) -> str:
        worked = done - self._skipped - self._elsewhere
        if worked < 0.02 * self._total:
            return "estimating"
        seconds = (monotonic() - self._started) * (self._total - done) / worked
        minutes, rest = divmod(int(seconds), 60)
        return f"about {minutes}:{rest:02d} left"
