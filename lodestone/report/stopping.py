"""What the options' terminations say in an episode, for the players."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from lodestone.agents.playing import Playback

STOPS = 0.5
"""Termination probability above which an option that ended is said to have ended of itself."""


def with_a_say(playback: Playback) -> Bool[np.ndarray, " O"]:
    """Which options would go on somewhere in the episode. The others stop after every step, as primitive actions and
    a basic policy do, or have no termination: of them there is nothing to tell."""
    return np.any(playback.termination < 1, axis=0)


def on_arrival(playback: Playback, step: int) -> str:
    """What became of the option that had run until the state before this step: "β 0.03" where it goes on, "lift had
    ended, β 0.98" where it does not. Nothing where none had run, or one without a say."""
    before = playback.option[step - 1]
    beta = playback.termination[step, before]
    if step == 0 or np.isnan(beta) or not with_a_say(playback)[before]:
        return ""
    if not playback.chosen[step]:
        return f"β {beta:.2f}"
    # An option also ends at its limit of steps, whatever its termination says, or by an improbable draw.
    return f"{playback.option_names[before]} {'had ended' if beta > STOPS else 'was stopped'}, β {beta:.2f}"
