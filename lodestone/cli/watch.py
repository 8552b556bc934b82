"""`lodestone watch RUN`: play a saved policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax
from tyro.conf import Positional

from lodestone.agents.playing import record
from lodestone.agents.run import load_run
from lodestone.cli.parsing import parse
from lodestone.errors import InvalidConfig
from lodestone.files import prepare_folder


@dataclass(frozen=True)
class Watch:
    """Play a saved policy greedily: in the terminal, or as a GIF or an HTML page."""

    run: Positional[Path]
    """A run's folder, or a policy file."""
    position: int = 0
    """Which of the policy's seeds, counted from 0."""
    gif: Path | None = None
    """Write an animation instead of playing in the terminal."""
    html: Path | None = None
    """Write a page with a player instead of playing in the terminal."""
    delay: float = 0.4
    """Seconds per step in the terminal."""


def run(words: list[str]) -> None:
    """Parse the words after `watch` and play."""
    _watch(parse(Watch, "watch", words))


def _watch(watch: Watch) -> None:
    from lodestone.report import animation, html, terminal  # pictures are only needed here and in `reproduce`

    policy = load_run(watch.run)
    if not 0 <= watch.position < len(policy.seeds):
        raise InvalidConfig(
            f"position is {watch.position}, but {watch.run} holds {len(policy.seeds)} seeds, counted from 0."
        )
    playback = record(policy, watch.position, jax.random.key(0), policy.agent)
    for target, write in ((watch.gif, animation.write_gif), (watch.html, html.write_player)):
        if target is not None:
            prepare_folder(target.parent)
            write(playback, target)
            print(f"Wrote {target}.")
    if watch.gif is None and watch.html is None:
        terminal.show(playback, watch.delay)
