"""What every page of ours is made of: the frame, its header, tables, charts that follow the page from light to dark."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from lodestone.experiments.comparison import Gate
from lodestone.files import json_safe, write_atomically
from lodestone.report.palette import AGENTS, GRID, INK, MUTED, PAPER

HEADLINE = ("command", "seconds", "machine")
"""Settings that are shown at the top, if they are given; the others are in a table at the end."""

PAGE_COLOURS = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)", PAPER: "var(--card)"}
AGENT_COLOURS = {colour: f"var(--agent-{index})" for index, colour in enumerate(AGENTS)}
"""Colours of a figure that follow the page from light to dark. Those of options do not: text stands on them."""
DRAWING_COLOURS = {
    f'"{colour}"': f'"{variable}"'
    for variable, colours in {"var(--ink)": ("black", "#000", "#000000"), "var(--card)": ("white", "#fff")}.items()
    for colour in colours
}
"""What drawings that are not figures of ours use for ink and paper, as values of attributes."""


def write_page(title: str, body: str, path: str | Path) -> None:
    """Write a page around a body of HTML. Raises `CannotWrite`."""
    template = Template((files("lodestone.report") / "template.html").read_text(encoding="utf-8"))
    write_atomically(path, template.substitute(title=escape(title), body=body).encode())


def header(
    title: str, subtitle: str, gates: Sequence[Gate], seeds: Sequence[int], settings: Mapping[str, object]
) -> str:
    """The top of a report, with the seeds of each learner; in each tile what is given."""
    tiles = []
    if gates:
        tiles.append(("Gates passed", f"{sum(gate.passed for gate in gates)} of {len(gates)}"))
    if seeds:
        tiles.append(("Seeds per learner", " or ".join(map(str, sorted(set(seeds))))))
    seconds = settings.get("seconds")
    if isinstance(seconds, int | float):
        tiles.append(("Wall-clock time", duration_text(seconds)))
    if "machine" in settings:
        tiles.append(("Machine", str(settings["machine"])))
    parts = [
        "<header>",
        f"<h1>{escape(title)}</h1>",
        f'<p class="muted">{escape(subtitle)}</p>',
    ]
    if "command" in settings:
        parts.append(f'<pre aria-label="The command that was run">{escape(str(settings["command"]))}</pre>')
    parts.append('<dl class="tiles">')
    parts += [f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in tiles]
    return "\n".join([*parts, "</dl>", "</header>"])


def gates_section(gates: Sequence[Gate]) -> str:
    """What must come out, what did, and whether that is enough."""
    rows = []
    for gate in gates:
        badge = '<span class="badge passed">✓ yes</span>' if gate.passed else '<span class="badge failed">✗ no</span>'
        rows.append(
            f'<tr><th scope="row">{escape(gate.name)}</th><td class="number">{number_text(gate.measured)}</td>'
            f'<td class="number">{escape(gate.required)}</td><td class="number">{badge}</td></tr>'
        )
    head = table_head("gate", ("measured", "required", "passed"))
    return f'<h2>Gates</h2>\n<div class="card scroll"><table>{head}<tbody>\n{joined(rows)}</tbody></table></div>'


def settings_section(settings: Mapping[str, object]) -> str:
    """The settings that the header does not show, folded away; nothing if there are none."""
    rows = [
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(value))}</td></tr>'
        for name, value in _flatten({key: value for key, value in settings.items() if key not in HEADLINE})
    ]
    if not rows:
        return ""
    return (
        f'<h2>Settings</h2>\n<div class="card"><details><summary>{len(rows)} settings</summary>'
        f'<div class="scroll"><table><tbody>\n{joined(rows)}</tbody></table></div></details></div>'
    )


def _flatten(settings: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Settings within settings get dotted names."""
    for key, value in json_safe(settings).items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


# ----------------------------------------------------------------------------------------------------- small pieces


def chart_figure(svg: str, name: str, label: str, colours: Mapping[str, str]) -> str:
    """An SVG fit to stand in a page beside others: with ids of its own, without addresses, some colours replaced."""
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    prefix = re.sub(r"\W+", "-", name)
    svg = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{prefix}-", svg)
    for colour, variable in colours.items():
        svg = svg.replace(colour, variable)
    svg = svg.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1)
    return f"<figure>{svg}</figure>"


def table_head(first: str, others: Sequence[str], second: str | None = None) -> str:
    """A table's head: one or two columns of text, then columns of numbers."""
    texts = [first] if second is None else [first, second]
    cells = [f'<th scope="col">{text}</th>' if text else "<td></td>" for text in texts]
    cells += [f'<th scope="col" class="number">{text}</th>' for text in others]
    return f"<thead><tr>{''.join(cells)}</tr></thead>"


def joined(parts: Sequence[str]) -> str:
    """Each part on a line of its own."""
    return "".join(f"{part}\n" for part in parts)


def number_text(value: float, digits: int = 3) -> str:
    """A number for people: so many digits, or all of a whole number and of thousands."""
    if math.isnan(value):
        return "not measured"
    if math.isinf(value):
        return "∞" if value > 0 else "\u2212∞"
    text = f"{value:,.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:,.{digits}g}"
    return text.replace("-", "\u2212")  # a minus sign rather than a hyphen


def interval_text(iqm: float, low: float, high: float) -> str:
    """An estimate with its interval in small print."""
    return f"{number_text(iqm)} <small>[{number_text(low)}, {number_text(high)}]</small>"


def duration_text(seconds: float) -> str:
    """Hours and minutes, minutes and seconds, or seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"
