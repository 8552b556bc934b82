"""Colours, the same in figures, animations and the HTML report.

Agents and options take the colours of Okabe and Ito, which colour-blind people tell apart; primitive actions, of which
there are many and which matter less, take shades of slate.
"""

from __future__ import annotations

from collections.abc import Sequence

AGENTS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
OPTIONS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
SLATE_DARK, SLATE_LIGHT = 0x48, 0xD0
"""Red part of the darkest and the lightest slate."""

INK = "#1f2933"
MUTED = "#66727f"
GRID = "#dfe3e8"
PAPER = "#ffffff"


def agent_colours(count: int) -> tuple[str, ...]:
    """One colour per agent."""
    return tuple(AGENTS[index % len(AGENTS)] for index in range(count))


def option_colours(option_names: Sequence[str], action_names: Sequence[str]) -> tuple[str, ...]:
    """One colour per option: slate for those that are primitive actions, a strong colour for the others."""
    primitive = [name in action_names for name in option_names]
    shades = iter(_slate(sum(primitive)))
    strong = iter(OPTIONS[index % len(OPTIONS)] for index in range(len(option_names)))
    return tuple(next(shades) if is_primitive else next(strong) for is_primitive in primitive)


def text_on(colour: str) -> str:
    """Black or white, whichever is read more easily on `colour`."""
    channels = (int(colour[index : index + 2], 16) / 255 for index in (1, 3, 5))
    red, green, blue = (channel**2.2 for channel in channels)
    luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    # Contrast as WCAG defines it is equal for both where the luminance is 0.18.
    return INK if luminance > 0.2 else PAPER


def _slate(count: int) -> list[str]:
    """Shades from dark to light."""
    shades = []
    for index in range(count):
        red = SLATE_DARK + (SLATE_LIGHT - SLATE_DARK) * index // max(count - 1, 1)
        blue = red + (255 - red) // 5
        shades.append(f"#{red:02x}{(red + blue) // 2:02x}{blue:02x}")
    return shades
