"""Pictures of machines, as SVG: each machine from its start at the top to its stops, in layers.

An action is a box, a call a double box, a choice a diamond, a branch a hexagon, a stop a double circle. An edge whose
label is what the next vertex shows anyway has no label. With counts, the lines of choices are as wide as they are
taken often.

The layout is Sugiyama's: edges that close a cycle are turned round for the time being, vertices are put into layers by
the longest way from the start, edges get a joint in every layer that they pass, the order inside layers is improved by
barycentres, and places follow from those of the neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise
from math import sqrt

import numpy as np
from jaxtyping import Float

from lodestone.machines.machine import (
    Action,
    Argument,
    Branch,
    Call,
    Choice,
    Hierarchy,
    Machine,
    Parameter,
    Stop,
    Vertex,
    followers,
    pairs,
)
from lodestone.planning.joint import JointProcess
from lodestone.report.palette import AGENTS, GRID, INK, MUTED, PAPER

FONT, LETTER, HEIGHT = 12, 6.9, 30
"""Size of the letters, their mean width, and the height of a box, in pixels."""
LAYER_GAP, GAP, JOINT = 44, 22, 12
"""Space between layers, between vertices of one layer, and the width of a joint of an edge."""
MARGIN, TITLE, PANEL_GAP = 22, 44, 22
"""Space around a machine, for its title, and between machines."""
MAX_WIDTH = 1180
"""Width at which a new row of machines begins."""
SWEEPS = 24
"""How often the order inside layers and the places are improved."""

BLUE, ORANGE, GREEN = AGENTS[0], AGENTS[1], AGENTS[2]

Counts = Mapping[tuple[str, str, str], float]
"""How often an edge is taken, by machine, vertex and label."""


def edge_counts(process: JointProcess, visits: Float[np.ndarray, "N U"]) -> dict[tuple[str, str, str], float]:
    """Counts for a picture from those of every edge of every choice, as `planning.joint.expected_visits` gives them:
    summed over the environment's states and the places that a machine is called from."""
    counts: dict[tuple[str, str, str], float] = {}
    for number, edge in np.argwhere(process.available).tolist():
        machine, _, vertex, _ = process.configurations.configurations[process.configuration[number]]
        key = machine, vertex, process.names[process.name[number, edge]]
        counts[key] = counts.get(key, 0.0) + float(visits[number, edge])
    return counts


def machine_svg(machine: Machine, counts: Counts | None = None) -> str:
    """One machine as a complete SVG text. `counts` may hold those of other machines, too."""
    return _document([_panel(machine, counts)])


def hierarchy_svg(hierarchy: Hierarchy, counts: Counts | None = None) -> str:
    """All machines of a hierarchy side by side, the root first, as a complete SVG text."""
    machines = sorted(hierarchy.machines, key=lambda machine: machine.name != hierarchy.root)
    return _document([_panel(machine, counts) for machine in machines])


# ------------------------------------------------------------------------------------------------------------- layout


@dataclass
class _Node:
    """A vertex, or the joint of an edge in a layer that it passes."""

    name: str
    width: float
    layer: int
    vertex: Vertex | None = None
    x: float = 0.0
    y: float = 0.0
    above: list[_Node] = field(default_factory=list)
    below: list[_Node] = field(default_factory=list)


@dataclass
class _Edge:
    """An edge with the nodes it runs along, the upper end first."""

    source: str
    target: str
    label: str
    upwards: bool
    path: list[_Node] = field(default_factory=list)


@dataclass
class _Layout:
    nodes: dict[str, _Node]
    edges: list[_Edge]
    layers: list[list[_Node]]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height."""
        return max(node.x + node.width / 2 for layer in self.layers for node in layer), self.layers[-1][
            0
        ].y + HEIGHT / 2


def _lay_out(machine: Machine) -> _Layout:
    vertices = dict(pairs(machine.vertices))
    edges, order = _directed(machine, vertices)
    layers_of = _layers(order, edges)
    nodes = {
        name: _Node(name, _width(name, vertices[name]), layer, vertices[name]) for name, layer in layers_of.items()
    }
    layers: list[list[_Node]] = [[] for _ in range(max(layers_of.values()) + 1)]
    for node in nodes.values():
        layers[node.layer].append(node)
    for edge in edges:
        if edge.source == edge.target:
            continue
        upper, lower = (edge.target, edge.source) if edge.upwards else (edge.source, edge.target)
        edge.path = [nodes[upper]]
        for layer in range(nodes[upper].layer + 1, nodes[lower].layer):
            joint = _Node("", JOINT, layer)
            layers[layer].append(joint)
            edge.path.append(joint)
        edge.path.append(nodes[lower])
        for above, below in pairwise(edge.path):
            above.below.append(below)
            below.above.append(above)
    layers = _ordered(layers)
    _place(layers)
    return _Layout(nodes, edges, layers)


def _directed(machine: Machine, vertices: Mapping[str, Vertex]) -> tuple[list[_Edge], list[str]]:
    """All edges, of which those that close a cycle, on a walk from the start in depth first, go upwards; and the
    vertices, such that all others lead from earlier to later ones."""
    edges: list[_Edge] = []
    left_behind: list[str] = []
    seen, open_ = {machine.start}, {machine.start}
    walk = [(machine.start, iter(followers(vertices[machine.start])))]
    while walk:
        name, left = walk[-1]
        following = next(left, None)
        if following is None:
            open_.discard(name)
            left_behind.append(name)
            walk.pop()
            continue
        label, then = following
        edges.append(_Edge(name, then, label, upwards=then in open_))
        if then not in seen:
            seen.add(then)
            open_.add(then)
            walk.append((then, iter(followers(vertices[then]))))
    return edges, left_behind[::-1]


def _layers(order: Sequence[str], edges: Sequence[_Edge]) -> dict[str, int]:
    """The length of the longest way from the start to each vertex along the edges that do not go upwards."""
    layers = dict.fromkeys(order, 0)
    for name in order:
        for edge in edges:
            if edge.source == name and not edge.upwards:
                layers[edge.target] = max(layers[edge.target], layers[name] + 1)
    return layers


def _ordered(layers: list[list[_Node]]) -> list[list[_Node]]:
    """Each layer by the mean position of the neighbours, down and up in turn; the order with the fewest crossings."""
    best, fewest = [list(layer) for layer in layers], _crossings(layers)
    for sweep in range(SWEEPS):
        downwards = sweep % 2 == 0
        for layer in layers if downwards else reversed(layers):
            position = {id(node): index for each in layers for index, node in enumerate(each)}
            keys = {}
            for index, node in enumerate(layer):
                neighbours = node.above if downwards else node.below
                places = [position[id(other)] for other in neighbours] or [index]
                keys[id(node)] = sum(places) / len(places)
            layer.sort(key=lambda node: keys[id(node)])
        crossings = _crossings(layers)
        if crossings < fewest:
            best, fewest = [list(layer) for layer in layers], crossings
    return best


def _crossings(layers: Sequence[Sequence[_Node]]) -> int:
    total = 0
    for upper, lower in pairwise(layers):
        position = {id(node): index for index, node in enumerate(lower)}
        ends = [position[id(below)] for node in upper for below in sorted(node.below, key=lambda n: position[id(n)])]
        total += sum(first > second for index, first in enumerate(ends) for second in ends[index + 1 :])
    return total


def _place(layers: Sequence[list[_Node]]) -> None:
    """x and y of every node: near its neighbours, in order, with room between."""
    for layer in layers:
        x = 0.0
        for node in layer:
            node.x, node.y = x + node.width / 2, node.layer * (HEIGHT + LAYER_GAP) + HEIGHT / 2
            x += node.width + GAP
    for sweep in range(SWEEPS):
        for layer in layers if sweep % 2 == 0 else reversed(layers):
            wanted = []
            for node in layer:
                neighbours = [*node.above, *node.below]
                wanted.append(sum(other.x for other in neighbours) / len(neighbours) if neighbours else node.x)
            apart = [(one.width + other.width) / 2 + GAP for one, other in pairwise(layer)]
            to_right, to_left = list(wanted), list(wanted)
            for index in range(1, len(layer)):
                to_right[index] = max(to_right[index], to_right[index - 1] + apart[index - 1])
            for index in reversed(range(len(layer) - 1)):
                to_left[index] = min(to_left[index], to_left[index + 1] - apart[index])
            for node, right, left in zip(layer, to_right, to_left, strict=True):
                node.x = (right + left) / 2
    leftmost = min(node.x - node.width / 2 for layer in layers for node in layer)
    for layer in layers:
        for node in layer:
            node.x -= leftmost


# ------------------------------------------------------------------------------------------------------------ drawing


@dataclass
class _Panel:
    width: float
    height: float
    body: str


def _panel(machine: Machine, counts: Counts | None) -> _Panel:
    layout = _lay_out(machine)
    parameters = f"({', '.join(machine.parameters)})" if machine.parameters else ""
    title = machine.name + parameters
    width, height = layout.size
    extra = max([0.0, *(_loop_width(edge) for edge in layout.edges if edge.source == edge.target)])
    width = max(width + extra, _text_width(title) * 1.15)
    start = layout.nodes[machine.start]
    entry = start.y - _half_height(start, 0.0)
    parts = [
        f'<rect width="{width + 2 * MARGIN:.1f}" height="{height + TITLE + 2 * MARGIN:.1f}" rx="8" fill="{PAPER}" '
        f'stroke="{GRID}"/>',
        f'<text x="{MARGIN}" y="{MARGIN + 5}" font-weight="bold" text-anchor="start">{escape(title)}</text>',
        f'<g transform="translate({MARGIN:.1f} {MARGIN + TITLE:.1f})">',
        f'<circle cx="{start.x:.1f}" cy="-24" r="4" fill="{INK}"/>',
        f'<path d="M{start.x:.1f} -24V{entry - 6:.1f}" stroke="{INK}" fill="none"/>',
        _arrow(start.x, entry, up=False, colour=INK, width=1.0),
    ]
    ports = _ports(layout)
    most = max([1e-12, *(counts.values() if counts else [])])
    labels = []
    for edge in layout.edges:
        count = None if counts is None else counts.get((machine.name, edge.source, edge.label))
        line, label = _draw_edge(layout, edge, ports, count, most, counts is not None)
        parts.append(line)
        labels.append(label)
    parts += [_draw_node(node) for node in layout.nodes.values()]
    return _Panel(width + 2 * MARGIN, height + TITLE + 2 * MARGIN, "".join([*parts, *labels, "</g>"]))


def _ports(layout: _Layout) -> dict[tuple[int, str], float]:
    """How far from a vertex's middle each edge begins or ends, by the edge's identity and the side: spread over the
    side in the order of where the edges come from."""
    ports = {}
    for side, end, next_ in (("bottom", 0, 1), ("top", -1, -2)):
        at: dict[str, list[_Edge]] = {}
        for edge in layout.edges:
            if edge.path:
                at.setdefault(edge.path[end].name, []).append(edge)
        for name, edges in at.items():
            edges.sort(key=lambda edge: (edge.path[next_].x, edge.upwards))
            room = min(layout.nodes[name].width * 0.6, 24.0 * (len(edges) - 1))
            for index, edge in enumerate(edges):
                ports[id(edge), side] = room * (index / (len(edges) - 1) - 0.5) if len(edges) > 1 else 0.0
    return ports


def _draw_edge(
    layout: _Layout,
    edge: _Edge,
    ports: Mapping[tuple[int, str], float],
    count: float | None,
    most: float,
    counted: bool,
) -> tuple[str, str]:
    """The line and its label."""
    colour, width = MUTED, 1.2
    if count is not None:
        colour, width = (BLUE, 1.2 + 4.3 * sqrt(count / most)) if count > 0 else (GRID, 1.2)
    elif counted:
        width = 1.0
    text = "" if edge.label == _shown(layout.nodes[edge.target].vertex, edge.target) else edge.label
    if count is not None:
        text = f"{text} {_number(count)}".strip()
    if not edge.path:
        return _draw_loop(layout.nodes[edge.source], text, colour, width)

    points = [(node.x, node.y) for node in edge.path]
    top, bottom = edge.path[0], edge.path[-1]
    first, last = ports[id(edge), "bottom"], ports[id(edge), "top"]
    points[0] = top.x + first, top.y + _half_height(top, first)
    points[-1] = bottom.x + last, bottom.y - _half_height(bottom, last)
    head = 5.0 + 1.2 * width
    arrow = _arrow(*(points[0] if edge.upwards else points[-1]), up=edge.upwards, colour=colour, width=width)
    if edge.upwards:
        points[0] = points[0][0], points[0][1] + head
    else:
        points[-1] = points[-1][0], points[-1][1] - head
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for index, ((x, y), (then_x, then_y)) in enumerate(pairwise(points)):
        middle = (y + then_y) / 2
        path += f"C{x:.1f} {middle:.1f} {then_x:.1f} {middle:.1f} {then_x:.1f} {then_y:.1f}"
        if index + 2 < len(points):
            path += f"V{then_y:.1f}"
    line = f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{width:.2f}"/>{arrow}'
    # The label is near the end where it belongs: where choices part.
    (x, y), (then_x, then_y) = (points[-2], points[-1]) if edge.upwards else (points[0], points[1])
    at = 0.62
    spot = _on_curve(x, then_x, at), _on_curve_y(y, then_y, at)
    return line, _label(*spot, text)


def _draw_loop(node: _Node, text: str, colour: str, width: float) -> tuple[str, str]:
    """An edge from a vertex to itself, at its right."""
    right, y = node.x + node.width / 2, node.y
    head = right + 5 + 1.2 * width
    path = (
        f"M{right:.1f} {y - 7:.1f}C{right + 34:.1f} {y - 16:.1f} {right + 34:.1f} {y + 18:.1f} {head:.1f} {y + 7:.1f}"
    )
    size = 3.2 + width
    arrow = f'<path d="M{right:.1f} {y + 6:.1f}L{head:.1f} {y + 7 - size:.1f}V{y + 7 + size:.1f}Z" fill="{colour}"/>'
    line = f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{width:.2f}"/>{arrow}'
    return line, _label(right + 28 + _text_width(text) / 2, y + 4, text)


def _loop_width(edge: _Edge) -> float:
    return 34.0 + _text_width(edge.label)


def _on_curve(start: float, end: float, at: float) -> float:
    """x at a fraction of a curve that leaves and arrives vertically."""
    return start + (end - start) * (3 * at**2 - 2 * at**3)


def _on_curve_y(start: float, end: float, at: float) -> float:
    return start + (end - start) * (1.5 * at * (1 - at) + at**3)


def _arrow(x: float, y: float, up: bool, colour: str, width: float) -> str:
    """A head whose point is at (x, y)."""
    length, half = 6.0 + 1.2 * width, 3.2 + width
    back = y + length if up else y - length
    return f'<path d="M{x:.1f} {y:.1f}L{x - half:.1f} {back:.1f}H{x + half:.1f}Z" fill="{colour}"/>'


def _label(x: float, y: float, text: str) -> str:
    if not text:
        return ""
    halo = f'stroke="{PAPER}" stroke-width="4" stroke-linejoin="round" paint-order="stroke"'
    return f'<text x="{x:.1f}" y="{y + 4:.1f}" font-size="11" fill="{INK}" {halo}>{escape(text)}</text>'


def _draw_node(node: _Node) -> str:
    """The vertex's shape and text; its name and what it asks are its title."""
    left, right, top, bottom = (
        node.x - node.width / 2,
        node.x + node.width / 2,
        node.y - HEIGHT / 2,
        node.y + HEIGHT / 2,
    )
    assert node.vertex is not None
    colour = _colour(node.vertex)
    style = f'fill="{PAPER}" stroke="{colour}" stroke-width="1.4"'
    tint = f'fill="{colour}" fill-opacity="0.13" stroke="{colour}" stroke-width="1.4"'

    def box(inset: float, how: str) -> str:
        return (
            f'<rect x="{left + inset:.1f}" y="{top + inset:.1f}" width="{node.width - 2 * inset:.1f}" '
            f'height="{HEIGHT - 2 * inset:.1f}" rx="{4 - inset / 2:.1f}" {how}/>'
        )

    def outline(points: Sequence[tuple[float, float]]) -> str:
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"
        return f'<path d="{path}" {style}/><path d="{path}" {tint}/>'

    match node.vertex:
        case Action():
            shape = box(0, style) + box(0, tint)
        case Call():
            shape = box(0, style) + box(3.5, tint)
        case Choice():
            tall = _half_height(node, 0.0)
            shape = outline([(left, node.y), (node.x, node.y - tall), (right, node.y), (node.x, node.y + tall)])
        case Branch():
            inner = (left + 11, right - 11)
            shape = outline(
                [
                    (left, node.y),
                    (inner[0], top),
                    (inner[1], top),
                    (right, node.y),
                    (inner[1], bottom),
                    (inner[0], bottom),
                ]
            )
        case Stop():
            shape = (
                f'<circle cx="{node.x:.1f}" cy="{node.y:.1f}" r="11" {style}/>'
                f'<circle cx="{node.x:.1f}" cy="{node.y:.1f}" r="7" fill="{colour}"/>'
            )
    text = _shown(node.vertex, node.name)
    drawn = f'<text x="{node.x:.1f}" y="{node.y + 4:.1f}">{escape(text)}</text>' if text else ""
    return f"<g><title>{escape(_explained(node))}</title>{shape}{drawn}</g>"


def _shown(vertex: Vertex | None, name: str) -> str:
    """The text of a vertex."""
    match vertex:
        case Action(action, _):
            return "no action" if action is None else _argument(action)
        case Call(machine, _, arguments):
            return machine + _argument_list(pairs(arguments))
        case Stop():
            return ""
    return name


def _explained(node: _Node) -> str:
    match node.vertex:
        case Branch(predicate, _):
            return f"{node.name}: {predicate.function.__name__}{_argument_list(pairs(predicate.arguments))}"
        case Choice(_, only_if) if pairs(only_if):
            needed = (
                f"{name} only if {predicate.function.__name__}{_argument_list(pairs(predicate.arguments))}"
                for name, predicate in pairs(only_if)
            )
            return f"{node.name}: {', '.join(needed)}"
    return node.name


def _argument(argument: Argument) -> str:
    """A value, or the name of a parameter in angle quotes."""
    return f"\u2039{argument.name}\u203a" if isinstance(argument, Parameter) else str(argument)


def _argument_list(arguments: tuple[tuple[str, Argument], ...]) -> str:
    """Values alone: the title of the machine called names its parameters."""
    return f"({', '.join(_argument(argument) for _, argument in arguments)})" if arguments else ""


def _colour(vertex: Vertex) -> str:
    match vertex:
        case Call():
            return BLUE
        case Choice():
            return ORANGE
        case Branch():
            return GREEN
    return INK


def _width(name: str, vertex: Vertex) -> float:
    if isinstance(vertex, Stop):
        return 22.0
    around = {Choice: 44.0, Branch: 30.0, Call: 24.0}.get(type(vertex), 20.0)
    # A diamond has less room where it is flat: its text needs more around.
    return max(48.0, _text_width(_shown(vertex, name)) * (1.25 if isinstance(vertex, Choice) else 1.0) + around)


def _half_height(node: _Node, off: float) -> float:
    """How far above and below the middle a vertex's outline is, so far beside its middle."""
    match node.vertex:
        case Choice():
            return (HEIGHT / 2 + 4) * (1 - 2 * abs(off) / node.width)
        case Branch():
            return HEIGHT / 2 * min(1.0, (node.width / 2 - abs(off)) / 11)
        case Stop():
            return sqrt(max(0.0, 11.0**2 - off**2))
    return HEIGHT / 2


def _text_width(text: str) -> float:
    return LETTER * len(text)


def _number(count: float) -> str:
    """A count in few letters."""
    if 0 < count < 0.01:
        return "<0.01"
    digits = 0 if count >= 100 or count == round(count) else 1 if count >= 1 else 2
    return f"{count:.{digits}f}"


def _document(panels: Sequence[_Panel]) -> str:
    """Panels in rows, from left to right."""
    x, y, row_height, width = 0.0, 0.0, 0.0, 0.0
    parts = []
    for panel in panels:
        if x > 0 and x + panel.width > MAX_WIDTH:
            x, y, row_height = 0.0, y + row_height + PANEL_GAP, 0.0
        parts.append(f'<g transform="translate({x:.1f} {y:.1f})">{panel.body}</g>')
        x += panel.width + PANEL_GAP
        row_height, width = max(row_height, panel.height), max(width, x - PANEL_GAP)
    height = y + row_height
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="-1 -1 {width + 2:.0f} {height + 2:.0f}" '
        f'width="{width + 2:.0f}" height="{height + 2:.0f}" font-family="DejaVu Sans, Verdana, sans-serif" '
        f'font-size="{FONT}" text-anchor="middle" fill="{INK}">{"".join(parts)}</svg>'
    )
