"""Atari's games as agents play them: `lodestone.envs.atari:Atari/Breakout-v5` for `ALE/Breakout-v5`, and so on.

A step is four frames under one action. What is seen are the last four steps, each as 84 x 84 pixels of grey, the newest
last (Mnih et al. 2015); an action sticks with probability 1/4, and a game goes on when a life is lost (Machado et al.
2018). All that is Gymnasium's. `ale_py:ALE/Breakout-v5` is the same game as it is, in colour, with 210 x 160 pixels.
"""

from __future__ import annotations

from contextlib import suppress

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TransformObservation

with suppress(ImportError):  # without it there are no games, as Gymnasium then says
    import ale_py

    gymnasium.register_envs(ale_py)

STACKED = 4
"""Steps that are seen."""
SIZE = 84
"""Pixels along a side."""


def make(game: str, render_mode: str | None = None) -> gymnasium.Env:
    """What `gymnasium.make` calls: `game` is an id of ale_py."""
    frames = gymnasium.make(game, frameskip=1, render_mode=render_mode, disable_env_checker=True)
    stacked = FrameStackObservation(AtariPreprocessing(frames, screen_size=SIZE), STACKED)
    space = spaces.Box(0, 255, (SIZE, SIZE, STACKED), np.uint8)
    return TransformObservation(stacked, lambda seen: np.moveaxis(seen, 0, -1), space)


for _spec in list(gymnasium.registry.values()):
    if _spec.namespace == "ALE":
        gymnasium.register(
            id=f"Atari/{_spec.name}-v{_spec.version}",
            entry_point="lodestone.envs.atari:make",
            kwargs={"game": _spec.id},
        )
