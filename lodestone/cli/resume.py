"""`lodestone resume RUN`: go on with a training run that was ended early."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from lodestone.agents.run import Versions, is_finished
from lodestone.agents.run_folder import RunFolder
from lodestone.cli.parsing import parse
from lodestone.cli.printing import note, print_json
from lodestone.cli.train import finish


@dataclass(frozen=True)
class Resume:
    """Go on with a run of `lodestone train --out RUN` that was ended early, however that came about: from its last
    checkpoint, to the same bits as if it had not been (on the same machine, with the same versions)."""

    run: Positional[Path]
    """The run's folder."""
    json: bool = False
    """Print one JSON object at the end."""


def run(words: list[str]) -> None:
    """Parse the words after `resume` and go on."""
    _resume(parse(Resume, "resume", words))


def _resume(settings: Resume) -> None:
    path = settings.run
    if is_finished(path):
        if settings.json:
            print_json({"out": str(path), "finished": True})
        else:
            print(f"The run in {path} is finished; `lodestone watch {path}` plays it.")
        return
    with RunFolder(path) as folder:
        run = folder.read()
        before, now = dataclasses.asdict(run.versions), dataclasses.asdict(Versions())
        changes = [f"{name} was {before[name]} and is {now[name]}" for name in now if before[name] != now[name]]
        if changes:
            note(f"{'; '.join(changes)}: what follows may differ in its last bits.")
        finish(run, folder, settings.json)
