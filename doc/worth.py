"""The figure of what forecasts are worth, made from ``results/real_seasons.csv``.

The figure has its own background, light or dark like the reader's system.
"""

from __future__ import annotations

from html import escape
from typing import NamedTuple

from real_season_tables import MEAN, OVER_ONOFF, TOGETHER, Number, numbers

# The runs in the figure, by their labels.
_SHOWN = {
    "on/off": "on/off",
    "lookahead, no forecast": "no rain",
    "with issued forecasts": TOGETHER,
    "with perfect forecasts": "perfect",
}
_TITLES = {
    "measured": "Neubrandenburg roof: drains in most storms",
    "paper": "The paper's roof: drains only when full",
}
_WIDTH, _LEFT, _RIGHT, _ROW, _HEAD, _FOOT = 600, 215, 90, 27, 64, 48
_FROM, _TO = 68, 102
"""ends of the axis (%)"""

_STYLE = """
  .back { fill: #fff } text { fill: #222 } .quiet { fill: #555 } .grid { stroke: #ddd }
  .mark { fill: #0072b2; stroke: #0072b2 } .onoff { fill: #d55e00; stroke: #d55e00 }
  @media (prefers-color-scheme: dark) {
    .back { fill: #1a1c1e } text { fill: #eee } .quiet { fill: #bbb } .grid { stroke: #444 }
    .mark { fill: #56b4e9; stroke: #56b4e9 } .onoff { fill: #e69f00; stroke: #e69f00 }
  }
"""


class Row(NamedTuple):
    """A row of the figure.

    Attributes:
        decided_by: its label.
        mean: deviation from the target (mm).
        share: of the deviation of on/off.
    """

    decided_by: str
    mean: float
    share: Number


def rows(roof: str) -> list[Row]:
    """Return the rows of a roof."""
    return [
        Row(
            words, numbers()[roof, forecast, MEAN].value, numbers()[roof, forecast, OVER_ONOFF]
        )
        for words, forecast in _SHOWN.items()
    ]


def _at(percent: float) -> float:
    """Return the position of a share on the axis (px)."""
    share = (percent - _FROM) / (_TO - _FROM)
    return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)


def drawing() -> str:
    """Return the figure, as SVG."""
    panels = []
    top = 0
    for roof, title in _TITLES.items():
        panel, height = _panel(title, rows(roof), top)
        panels += panel
        top += height
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {top}" '
        'font-family="Helvetica, Arial, sans-serif" font-size="16" role="img" '
        'aria-label="Deviation from the target level in percent of on/off, on two roofs">',
        f"<style>{_STYLE}</style>",
        f'<rect class="back" width="{_WIDTH}" height="{top}" rx="8"/>',
        *panels,
        "</svg>",
    ]) + "\n"


def _panel(title: str, rows: list[Row], top: int) -> tuple[list[str], int]:
    """Return the marks of a roof, and their total height (px)."""
    bottom = top + _HEAD + _ROW * len(rows)
    parts = [
        f'<text x="16" y="{top + 28}" font-weight="bold">{escape(title)}</text>',
        f'<text class="quiet" x="{_WIDTH - 16}" y="{top + 28}" text-anchor="end" '
        'font-size="14">mean deviation</text>',
    ]
    for percent in range(70, 101, 10):
        x = _at(percent)
        parts += [
            f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{top + 42}" y2="{bottom - 10}"/>',
            f'<text class="quiet" x="{x:.1f}" y="{bottom + 8}" text-anchor="middle" '
            f'font-size="14">{percent} %</text>',
        ]
    for number, row in enumerate(rows):
        parts += _row(row, top + _HEAD + _ROW * number)
    parts.append(
        f'<text class="quiet" x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{bottom + 26}" '
        'text-anchor="middle" font-size="14">deviation from the target, in % of on/off</text>'
    )
    return parts, _HEAD + _ROW * len(rows) + _FOOT


def _row(row: Row, y: int) -> list[str]:
    share, low, high = (_at(100 * end) for end in row.share)
    words = row.decided_by
    kind = "onoff" if words == "on/off" else "mark"
    return [
        f'<text x="{_LEFT - 14}" y="{y + 5}" text-anchor="end">{escape(words)}</text>',
        f'<line class="{kind}" x1="{low:.1f}" x2="{high:.1f}" y1="{y}" y2="{y}" '
        'stroke-width="3"/>',
        f'<circle class="{kind}" cx="{share:.1f}" cy="{y}" r="5.5"/>',
        f'<text x="{_WIDTH - 16}" y="{y + 5}" text-anchor="end">'
        f"{row.mean:#.3g} mm</text>",
    ]
