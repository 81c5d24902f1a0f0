"""Draw pictures from runs: the animation, the how-to's storms with a valve, a chart of results."""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from storm_animation import draw as draw_storm

DOC = Path(__file__).resolve().parent
HOW_TO = DOC / "howto" / "keep-storm-water-out.md"
STATIC = DOC / "_static"


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
    names = run_block(HOW_TO, "gr.compare(runs)")
    names["gr"].compare(names["runs"]).plot().save(STATIC / "storm-valve.png", scale_factor=2)
