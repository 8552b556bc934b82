"""The report: one HTML file with figures, tables and a player, which needs nothing else."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from io import BytesIO
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from lodestone.agents.playing import Playback
from lodestone.experiments.comparison import Comparison, Gate, OptionRun
from lodestone.files import json_safe
from lodestone.report.curves import (
    DECISIONS,
    LENGTH,
    RETURN,
    STEPS,
    WINDOW,
    agent_option_colours,
    draw_panel,
    draw_usage_panel,
    has_options,
    panel_svg,
)
from lodestone.report.page import (
    AGENT_COLOURS,
    PAGE_COLOURS,
    chart_figure,
    gates_section,
    header,
    interval_text,
    joined,
    settings_section,
    table_head,
    write_page,
)
from lodestone.report.palette import AGENTS, option_colours, text_on
from lodestone.report.results import THRESHOLD_WINDOW, Row, Summary, agent_rows
from lodestone.report.stopping import on_arrival, with_a_say


def write_report(
    comparisons: Sequence[Comparison], gates: Sequence[Gate], settings: Mapping[str, object], path: str | Path
) -> None:
    """Write the report of some comparisons. Of `settings`, "command", "seconds" and "machine" are shown at the
    top.

    Raises `CannotWrite`.
    """
    parts = [
        header(
            "Lodestone report",
            " · ".join(comparison.title for comparison in comparisons),
            gates,
            [len(agent.seeds) for comparison in comparisons for agent in comparison.agents],
            settings,
        )
    ]
    if gates:
        parts.append(gates_section(gates))
    parts += [_comparison(comparison) for comparison in comparisons]
    parts.append(settings_section(settings))
    write_page("Lodestone report", "\n".join(parts), path)


def write_player(playback: Playback, path: str | Path) -> None:
    """Write a page with the player of one episode. Raises `CannotWrite`."""
    write_page(f"{playback.agent}, seed {playback.seed}", player(playback), path)


# --------------------------------------------------------------------------------------------------- the page's parts


def _comparison(comparison: Comparison) -> str:
    parts = [
        f'<section id="{escape(comparison.name)}">',
        f"<h2>{escape(comparison.title)}</h2>",
        _optimum(comparison),
    ]
    if comparison.agents:
        parts += [_curves(comparison), _results(comparison)]
    if comparison.playback is not None:
        parts.append(player(comparison.playback))
    if comparison.agents:
        parts.append(_usage(comparison))
    if comparison.options:
        parts.append(_pretraining(comparison.options))
    return "\n".join([*parts, "</section>"])


def _optimum(comparison: Comparison) -> str:
    text = f"Exact optimum: return {comparison.optimal_return:g} in {comparison.optimal_steps:g} primitive steps"
    if any(has_options(agent) for agent in comparison.agents):
        text += f"; fewest decisions with options: {comparison.optimal_decisions:g}"
    return f'<p class="muted">{text}.</p>'


def _curves(comparison: Comparison) -> str:
    legend = []
    for index, agent in enumerate(comparison.agents):
        solved = sum(each.success for each in agent.greedy)
        legend.append(
            f'<li><span class="swatch" style="background: var(--agent-{index % len(AGENTS)})"></span>'
            f"<b>{escape(agent.name)}</b>: greedy policy of {solved} of {len(agent.greedy)} seeds reaches the goal</li>"
        )
    charts = []
    for quantity in (RETURN, LENGTH):
        for axis in (DECISIONS, STEPS):
            svg = panel_svg(partial(draw_panel, comparison=comparison, axis=axis, quantity=quantity))
            name = f"{comparison.name}-{quantity.label}-{axis.label}"
            label = f"{quantity.label} over {axis.label}: {comparison.title}"
            charts.append(chart_figure(svg, name, label, PAGE_COLOURS | AGENT_COLOURS))
    return (
        f'<div class="card">\n<h3>Learning curves</h3>\n<ul class="legend column">\n{joined(legend)}</ul>\n'
        f'<div class="charts">\n{joined(charts)}</div>\n'
        '<p class="muted">Thick lines: interquartile mean over seeds; bands: its 95 % bootstrap interval; thin lines: '
        f"single seeds; dashed: exact optimum. Running mean of {WINDOW} episodes. Lengths count decisions, as the "
        "paper does: an option is one action.</p>\n</div>"
    )


def _results(comparison: Comparison) -> str:
    tables = [agent_rows(agent, comparison.thresholds) for agent in comparison.agents]
    lines: list[str] = []
    for _, group in groupby(zip(*tables, strict=True), key=lambda rows: rows[0].label):
        lines += _result_lines(list(group))
    seconds = "".join(f'<td class="number">{agent.seconds:,.1f}</td>' for agent in comparison.agents)
    lines.append(f'<tr class="group"><th scope="row">Training, all seeds</th><td>seconds</td>{seconds}</tr>')
    head = table_head("", [escape(agent.name) for agent in comparison.agents], second="")
    return (
        f'<div class="card">\n<h3>Results</h3>\n<div class="scroll"><table>{head}<tbody>\n{joined(lines)}</tbody>'
        '</table></div>\n<p class="muted">Interquartile mean over seeds [95 % bootstrap interval]; a seed that did not '
        f"get there counts as ∞. Mean return: of the last {THRESHOLD_WINDOW} episodes of training.</p>\n</div>"
    )


def _result_lines(group: Sequence[tuple[Row, ...]]) -> Iterator[str]:
    """Table rows that share a label, one cell per agent."""
    for number, rows in enumerate(group):
        label = f'<th scope="rowgroup" rowspan="{len(group)}">{escape(rows[0].label)}</th>' if number == 0 else ""
        cells = "".join(f'<td class="number">{_estimate(row.summary)}</td>' for row in rows)
        yield f'<tr class="{"within" if number else "group"}">{label}<td>{escape(rows[0].unit)}</td>{cells}</tr>'


def _pretraining(options: Sequence[OptionRun]) -> str:
    rows = []
    for option in options:
        numbers = (
            f"{option.success:.1%}",
            f"{option.mean_steps:.2f}",
            f"{option.optimal_mean_steps:.2f}",
            f"{option.starts:,}",
            f"{option.decisions:,}",
            f"{option.seconds:,.1f}",
        )
        cells = "".join(f'<td class="number">{number}</td>' for number in numbers)
        rows.append(f'<tr><th scope="row">{escape(option.name)}</th>{cells}</tr>')
    columns = ("success", "mean steps", "best policy's mean steps", "starts", "training decisions", "seconds")
    head = table_head("option", columns)
    return (
        '<div class="card">\n<h3>Pretraining of the options</h3>\n<p class="muted">Judged from every start of the '
        "option's task, beside the policy with the best possible return.</p>\n"
        f'<div class="scroll"><table>{head}<tbody>\n{joined(rows)}</tbody></table></div>\n</div>'
    )


def _usage(comparison: Comparison) -> str:
    charts = []
    for number, agent in enumerate(comparison.agents):
        colours = agent_option_colours(agent)
        svg = panel_svg(partial(draw_usage_panel, agent=agent, colours=colours))
        label = f"Share of the decisions of {agent.name} that went to each option, over training"
        legend = "".join(
            f'<li><span class="swatch" style="background: {colour}"></span>{escape(name)}</li>'
            for name, colour in zip(agent.option_names, colours, strict=True)
        )
        chart = chart_figure(svg, f"{comparison.name}-usage-{number}", label, PAGE_COLOURS)
        charts.append(f'<div><h3>{escape(agent.name)}</h3>{chart}<ul class="legend">{legend}</ul></div>')
    return (
        '<div class="card">\n<h3>Options used during training</h3>\n<p class="muted">Share of decisions, mean over '
        f'seeds; primitive actions in grey.</p>\n<div class="charts">\n{joined(charts)}</div>\n</div>'
    )


def _estimate(summary: Summary) -> str:
    """The estimate, its interval, and how many seeds have a number, if not all."""
    if summary.reached == 0:
        return "not reached"
    text = interval_text(summary.iqm, summary.low, summary.high)
    if summary.reached < summary.seeds:
        text += f'<small class="count">{summary.reached} of {summary.seeds} seeds</small>'
    return text


# -------------------------------------------------------------------------------------------------------- the player


def player(playback: Playback) -> str:
    """The player of one episode, as a part of a page."""
    colours = option_colours(playback.option_names, playback.action_names)
    frames: dict[bytes, int] = {}  # picture -> its number; an action without effect shows the same picture again
    frame = [frames.setdefault(picture.tobytes(), len(frames)) for picture in playback.pictures]
    has_say = with_a_say(playback)
    stops = has_say.any()
    data = {
        "frames": [_data_uri(playback.pictures[frame.index(number)]) for number in range(len(frames))],
        "frame": frame,
        "options": playback.option_names,
        "colours": colours,
        "textColours": [text_on(colour) for colour in colours],
        "actions": playback.action_names,
        "option": playback.option,
        "chosen": playback.chosen,
        "action": playback.action,
        "values": playback.values.astype(np.float64).round(3),
        "available": playback.available,
        "termination": playback.termination.astype(np.float64).round(3) if stops else None,
        "hasSay": has_say,
        "onArrival": [on_arrival(playback, step) for step in range(len(playback.option))],
        "ahead": playback.ahead or None,
        "reward": playback.total_reward.astype(np.float64).round(3),
    }
    # A script ends at the first "</script", whatever stands around it.
    text = json.dumps(json_safe(data), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    tiny = ' class="tiny"' if playback.pictures.shape[2] < 160 else ""
    heading, hint = "<h3>Q(s, option)</h3>", ""
    if stops:
        heading = f'<div class="headings">{heading}<h3>β(s)<span> stops here</span></h3></div>'
        hint = " β: probability that the option, had it run until here, would stop here; framed: the one that had run."
    ahead = '<dt>Then</dt><dd class="ahead"></dd>\n' if playback.ahead else ""
    name = f"Greedy episode of {escape(playback.agent)}, seed {playback.seed}"
    return f"""<div class="card">
<h3>{name}</h3>
<p class="muted">After training, without exploration.</p>
<div class="player{" stopping" if stops else ""}" role="group" tabindex="0" aria-label="{name}: player">
<script type="application/json">{text}</script>
<div class="stage"><img{tiny} src="{_data_uri(playback.pictures[0])}" alt="The start of the episode"></div>
<div>
<dl class="facts">
<dt>Option</dt><dd><span class="pill"></span><span class="since"></span></dd>
<dt>Primitive action</dt><dd class="action"></dd>
{ahead}<dt>Return so far</dt><dd class="return"></dd>
</dl>
{heading}
<ul class="bars"></ul>
<p class="note">Bars from <span class="range"></span>; struck out: not available.{hint}</p>
</div>
<div class="timeline" aria-hidden="true"></div>
<div class="controls">
<button type="button" class="first" aria-label="To the start">|←</button>
<button type="button" class="back" aria-label="One step back">←</button>
<button type="button" class="play">Play</button>
<button type="button" class="next" aria-label="One step on">→</button>
<input type="range" min="0" max="{len(playback.option)}" value="0" aria-label="Step">
<output></output>
</div>
<p class="note hint">Keys: ← → step, space plays, Home and End. The strip shows which option ran; a gap where a new one
was chosen.</p>
<noscript>The player needs JavaScript.</noscript>
</div>
</div>"""


def _data_uri(picture: UInt8[np.ndarray, "height width 3"]) -> str:
    content = BytesIO()
    Image.fromarray(picture).save(content, format="PNG", optimize=True)
    return f"data:image/png;base64,{b64encode(content.getvalue()).decode()}"
