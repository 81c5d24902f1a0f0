"""The README's pictures, also for the width of a phone, and the how-to's storms with a valve.

A phone shows a picture in 368 px, in which the text of the wide ones is too small.
"""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from storm_animation import draw as draw_storm

README = Path(__file__).resolve().parent.parent / "README.md"
HOW_TO = README.parent / "doc" / "howto" / "keep-storm-water-out.md"
STATIC = README.parent / "doc" / "_static"
# Width of a panel of the storm on a phone (px).
_PANEL = 290


def stacked(picture: str) -> str:
    """Return the picture of site and graph with the graph below the site, not right of it."""
    head, site, graph = re.split("<!-- the (?:site|graph) -->", picture)
    for wide, narrow in (
        ('viewBox="0 0 1000 570"', 'viewBox="0 0 604 1140" width="604"'),
        ('<rect width="1000" height="570"', '<rect width="604" height="1140"'),
        ("Left: ", "Above: "), ("Right: ", "Below: "),
    ):
        assert wide in head, wide
        head = head.replace(wide, narrow)
    graph = graph.replace("</svg>", "</g>\n</svg>")
    return (
        f'{head}<g transform="translate(100 0)">{site}</g>\n'
        f'<g transform="translate(-395 570)">{graph}'
    )


def run_block(page: Path, until: str) -> dict[str, Any]:
    """Run a page's first block of Python up to a text, and return its names."""
    block = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"),
                       re.DOTALL | re.MULTILINE)[0]
    names: dict[str, Any] = {}
    with redirect_stdout(StringIO()):
        exec(block.partition(until)[0], names)  # noqa: S102
    return names


def draw() -> None:
    """Draw the pictures; the storms are simulated again, which takes some twenty seconds."""
    for suffix, narrow in (("", False), ("-narrow", True)):
        picture = draw_storm(narrow)
        (STATIC / f"storm-animation{suffix}.svg").write_text(picture, encoding="utf-8")
    wide = (STATIC / "roof-and-graph.svg").read_text(encoding="utf-8")
    (STATIC / "roof-and-graph-narrow.svg").write_text(stacked(wide), encoding="utf-8")
    names = run_block(HOW_TO, "gr.compare(runs)")
    names["gr"].compare(names["runs"]).plot().save(STATIC / "storm-valve.png", scale_factor=2)
    chart = run_block(README, "storm.plot()")["storm"].plot()
    chart.save(STATIC / "storm.svg")
    for panel in chart.vconcat:
        panel.width = _PANEL
    chart.configure_axisX(labelFlush=False).save(STATIC / "storm-narrow.svg")
