"""Playing an episode in the terminal: the picture in half blocks, the running option, values and terminations."""

from __future__ import annotations

from time import sleep

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lodestone.agents.playing import Playback
from lodestone.report.stopping import on_arrival, with_a_say

WIDTH = 56
"""Columns of the picture."""


def show(playback: Playback, delay: float) -> None:
    """Play once, `delay` seconds a step; where there is no terminal, print one line a step instead."""
    console = Console()
    length = len(playback.option)
    if not console.is_terminal:
        for step in range(length):
            console.print(_line(playback, step), highlight=False, soft_wrap=True)
            if playback.ahead:
                console.print(f"          then {playback.ahead[step]}", highlight=False, soft_wrap=True)
        return
    with Live(console=console, refresh_per_second=20) as live:
        for step in range(length):
            live.update(_screen(playback, step, playback.pictures[step]))
            sleep(delay)
        live.update(_screen(playback, length - 1, playback.pictures[length]))


def _line(playback: Playback, step: int) -> str:
    """What one step is about."""
    option = playback.option_names[playback.option[step]]
    value = playback.values[step, playback.option[step]]
    begins = "begins" if playback.chosen[step] else "goes on"
    if said := on_arrival(playback, step):
        begins += f" ({said})"
    return (
        f"step {step + 1:3d}: {option} {begins}, Q {value:.2f}, action {playback.action_names[playback.action[step]]}, "
        f"return {playback.total_reward[step]:g}"
    )


def _screen(playback: Playback, step: int, picture: UInt8[np.ndarray, "height width 3"]) -> Group:
    values = Table("option", "Q", box=None)
    if stops := with_a_say(playback).any():
        values.add_column("β")
    for index, name in enumerate(playback.option_names):
        style = "bold green" if index == playback.option[step] else "" if playback.available[step, index] else "dim"
        cells = [name, f"{playback.values[step, index]:8.2f}"]
        if stops:
            beta = playback.termination[step, index]
            cells.append("" if np.isnan(beta) else f"{beta:.2f}")
        values.add_row(*cells, style=style)
    ahead = [Text(f"then {playback.ahead[step]}")] if playback.ahead else []
    return Group(half_blocks(picture), Text(_line(playback, step)), *ahead, values)


def half_blocks(picture: UInt8[np.ndarray, "height width 3"]) -> Text:
    """A picture as text: every character is two pixels, one above the other."""
    height, width, _ = picture.shape
    lines = max(1, round(WIDTH * height / width / 2))
    small = np.asarray(Image.fromarray(picture).resize((WIDTH, 2 * lines), Image.Resampling.BOX))
    text = Text()
    for row in range(lines):
        for top, bottom in zip(small[2 * row], small[2 * row + 1], strict=True):
            text.append("▀", style=f"rgb({top[0]},{top[1]},{top[2]}) on rgb({bottom[0]},{bottom[1]},{bottom[2]})")
        text.append("\n")
    return text
