"""The README's pictures: the storm of its lines, and both pictures for the width of a phone.

A phone shows a picture in 368 px, in which the text of the wide ones is too small.
"""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"
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


def draw() -> None:
    """Draw the pictures; the storm is simulated again, which takes some ten seconds."""
    wide = (STATIC / "roof-and-graph.svg").read_text(encoding="utf-8")
    (STATIC / "roof-and-graph-narrow.svg").write_text(stacked(wide), encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"),
                        re.DOTALL | re.MULTILINE)
    names: dict[str, object] = {}
    with redirect_stdout(StringIO()):
        exec(blocks[0].partition("storm.plot()")[0], names)  # noqa: S102
    chart = names["storm"].plot()  # type: ignore[attr-defined]
    chart.save(STATIC / "storm.svg")
    for panel in chart.vconcat:
        panel.width = _PANEL
    chart.configure_axisX(labelFlush=False).save(STATIC / "storm-narrow.svg")
