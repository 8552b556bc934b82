"""How long work tells how far it is. Whoever shows it (the command line, a test, nobody) passes a `Progress`."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Receives what has been done, in units of the work's own choosing; a total was announced before."""

    def begin(self, stage: str, work: float) -> None:
        """A stage begins, with so much work ahead."""

    def advance(self, work: float, text: str) -> None:
        """So much of the stage's work has been done in all; `text` says how it goes."""


class Silent:
    """Shows nothing."""

    def begin(self, stage: str, work: float) -> None:
        del stage, work

    def advance(self, work: float, text: str) -> None:
        del work, text
