"""Drawings of who publishes what, made from ``msg_defs/topics.yaml``: one for each way to run.

A column is a node, or a device on Modbus or MQTT. A row is a topic, from the dot at its publisher
to the arrows at its subscribers. A drawing is dark on white, since it cannot know whether the page
that shows it is light or dark. Columns are narrow, with names from bottom to top, so that a phone
shows the text large enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from greenroof_ros.interface.topics import Topic, read_live_topics, read_topics

_LABELS, _COLUMN, _ROW, _HEAD = 312, 33, 28, 150
# A name's box: its top, height and half its width (px).
_TOP, _TALL, _HALF = 8, 132, 14


@dataclass(frozen=True)
class Way:
    """A way to run the graph.

    Attributes:
        name: its name in text.
        nodes: their roles in the interface, from left to right.
        live: whether it runs on the system's clock.
        devices: devices that are not nodes, on the right.
        exchanges: communication over Modbus or MQTT: text, from, to.
        perhaps: nodes and devices that may be absent.
    """

    name: str
    nodes: tuple[str, ...]
    live: bool = False
    devices: tuple[str, ...] = ()
    exchanges: tuple[tuple[str, str, str], ...] = ()
    perhaps: tuple[str, ...] = ()


WAYS = {
    "graph-simulated": Way("simulated", ("weather", "plant", "controller", "recorder")),
    "graph-live": Way(
        "live",
        (
            "rain_gauge", "thermometer", "weather", "controller", "recorder", "valve",
            "open_switch", "closed_switch", "pump", "flow_meter", "cistern_sensor", "roof_sensor",
        ),
        live=True,
        devices=("valve relay", "drive", "sensors"),
        exchanges=(
            ("on, off", "valve", "valve relay"),
            ("on or off, timer", "valve relay", "valve"),
            ("control word, speed", "pump", "drive"),
            ("status, actual speed, faults", "drive", "pump"),
            ("cistern level", "sensors", "cistern_sensor"),
            ("roof level", "sensors", "roof_sensor"),
        ),
        perhaps=(
            "rain_gauge", "thermometer", "flow_meter", "valve", "open_switch", "closed_switch",
            "valve relay",
        ),
    ),
}


def publisher(topic: Topic, way: Way) -> str | None:
    """Return a topic's publisher; of two possible ones, the one that replaces the simulation."""
    roles = [role for role in topic.publishers if role in way.nodes]
    return roles[-1] if roles else None


def rows(way: Way) -> list[tuple[str, str, list[str], bool]]:
    """Return the rows of a drawing: label, from, to, and whether it may be absent."""
    lines = []
    for topic in (read_live_topics() if way.live else read_topics()).values():
        source = publisher(topic, way)
        if source is None or topic.name == "/diagnostics":
            continue
        readers = [role for role in topic.subscribers if role in way.nodes and role != source]
        perhaps = topic.optional or topic.needs != "" or source in way.perhaps
        unit = f" [{topic.unit}]" if topic.unit else ""
        lines.append((topic.name + unit, source, readers, perhaps))
    lines += [
        (text, source, [reader], source in way.perhaps or reader in way.perhaps)
        for text, source, reader in way.exchanges
    ]
    return lines


def drawing(way: Way) -> str:
    """Return the drawing of a way to run, as SVG."""
    columns = [*way.nodes, *way.devices]
    at = {name: _LABELS + _COLUMN * number + _COLUMN // 2 for number, name in enumerate(columns)}
    lines = rows(way)
    width, height = _LABELS + _COLUMN * len(columns), _HEAD + _ROW * len(lines) + 12
    parts = [
        f'<svg viewBox="0 0 {width} {height}" width="{width}" style="max-width: 100%" role="img" '
        f'aria-label="Who publishes what: {escape(way.name)}" '
        'xmlns="http://www.w3.org/2000/svg" font-size="16" fill="#1f2328" stroke="#1f2328" '
        'font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#ffffff" stroke="none"/>',
    ]
    for name, x in at.items():
        device = name in way.devices
        dashes = ' stroke-dasharray="4 3"' if name in way.perhaps else ""
        parts += [
            f'<rect x="{x - _HALF}" y="{_TOP}" width="{2 * _HALF}" height="{_TALL}" '
            f'rx="{0 if device else _HALF}" fill="none"{dashes}/>',
            f'<text transform="translate({x + 5} {_TOP + _TALL // 2}) rotate(-90)" '
            f'text-anchor="middle" stroke="none">{escape(name)}</text>',
            f'<line x1="{x}" y1="{_TOP + _TALL}" x2="{x}" y2="{height - 6}" '
            'stroke-opacity="0.25"/>',
        ]
    for number, (label, source, readers, perhaps) in enumerate(lines):
        parts += _row(label, at[source], [at[reader] for reader in readers], perhaps,
                      _HEAD + _ROW * number + _ROW // 2)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _row(label: str, source: int, readers: Sequence[int], perhaps: bool, y: int) -> list[str]:
    dashes = ' stroke-dasharray="4 3"' if perhaps else ""
    ends = min([source, *readers]), max([source, *readers])
    parts = [
        f'<text x="{_LABELS - 8}" y="{y + 5}" text-anchor="end" stroke="none">'
        f"{escape(label)}</text>",
        f'<line x1="{ends[0]}" y1="{y}" x2="{ends[1]}" y2="{y}"{dashes}/>',
        f'<circle cx="{source}" cy="{y}" r="4"/>',
    ]
    for x in readers:
        back = 9 if x < source else -9
        parts.append(f'<path d="M{x} {y} l{back} -4 v8 z" stroke="none"/>')
    return parts
