"""An episode as an animated picture."""

from __future__ import annotations

from functools import cache
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lodestone.agents.playing import Playback
from lodestone.files import write_atomically
from lodestone.report.palette import GRID, INK, MUTED, option_colours, text_on

MIN_WIDTH = 360
"""Pixels; smaller pictures are enlarged by a whole factor."""
STRIP = 62
"""Height of the strip under the picture, in pixels."""
LINE = 24
"""Height of one more line in the strip: of what is planned, where something is."""
STEP_MS, END_MS = 600, 3000


@cache
def _font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu, which every installation of matplotlib brings."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, size)


def write_gif(playback: Playback, path: str | Path) -> None:
    """Write the episode as a GIF of T+1 frames: before each step, with what is done there, and the end.

    Raises `CannotWrite`.
    """
    frames = [_frame(playback, step) for step in range(len(playback.pictures))]
    content = BytesIO()
    frames[0].save(
        content,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[STEP_MS] * (len(frames) - 1) + [END_MS],
        loop=0,
        optimize=True,
    )
    write_atomically(path, content.getvalue())


def _frame(playback: Playback, step: int) -> Image.Image:
    picture = Image.fromarray(playback.pictures[step])
    scale = -(-MIN_WIDTH // picture.width)
    picture = picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.NEAREST)
    strip = STRIP + (LINE if playback.ahead else 0)
    frame = Image.new("RGB", (picture.width, picture.height + strip), "white")
    frame.paste(picture)
    draw = ImageDraw.Draw(frame)
    top, left, right = picture.height, 12, picture.width - 12
    draw.line((0, top, frame.width, top), GRID)

    total = len(playback.option)
    total_reward = playback.total_reward[step - 1] if step else 0.0
    reward_text = f"return {total_reward:g}"
    draw.text((right, top + 20), reward_text, INK, _font(13), anchor="rm")
    if step == total:
        draw.text((left, top + 20), "end of the episode", INK, _font(14, bold=True), anchor="lm")
        draw.text((left, top + 46), f"{total} steps, {playback.chosen.sum()} decisions", MUTED, _font(12), anchor="lm")
        return frame
    option, action = playback.option[step], playback.action[step]
    colour = option_colours(playback.option_names, playback.action_names)[option]
    room = right - 24 - draw.textlength(reward_text, _font(13)) - left
    name = _shortened(playback.option_names[option], _font(14, bold=True), room)
    label = (left, top + 8, left + 16 + draw.textlength(name, _font(14, bold=True)), top + 32)
    draw.rounded_rectangle(label, 6, colour)
    draw.text((left + 8, top + 20), name, text_on(colour), _font(14, bold=True), anchor="lm")
    chosen_at = np.flatnonzero(playback.chosen[: step + 1])[-1]
    since = "▶ chosen now" if chosen_at == step else f"since step {chosen_at + 1}"
    doing = _shortened(f"{since} · {playback.action_names[action]}", _font(12), right - left - 90)
    draw.text((left, top + 46), doing, INK if chosen_at == step else MUTED, _font(12), anchor="lm")
    draw.text((right, top + 46), f"step {step + 1} of {total}", MUTED, _font(12), anchor="rm")
    if playback.ahead:
        then = _shortened(f"then {playback.ahead[step]}", _font(12), right - left)
        draw.text((left, top + 70), then, INK, _font(12), anchor="lm")
    return frame


def _shortened(text: str, font: ImageFont.FreeTypeFont, width: float) -> str:
    """The text on one line, or as much of it as fits."""
    text = " ".join(text.split())
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"
