"""Draw pictures from runs: the animation, and the how-to's storms with a valve."""

from __future__ import annotations

from pathlib import Path

from storm_animation import draw as draw_storm

import greenroof_ros as gr

DOC = Path(__file__).resolve().parent
STATIC = DOC / "_static"


def draw() -> None:
    """Draw the pictures; the storms are simulated again, which takes some twenty seconds."""
    for suffix, narrow in (("", False), ("-narrow", True)):
        picture = draw_storm(narrow)
        (STATIC / f"storm-animation{suffix}.svg").write_text(picture, encoding="utf-8")
    site = gr.read_site(DOC.parent / "config" / "site_valve.yaml", tau=60.0, M=1)
    runs = {
        name: gr.simulate("onoff", site=site, start="2021-07-07T00:00", hours=72, outlet=outlet)
        for name, outlet in (("closed", "closed"), ("always open", "open"), ("plan", "plan"))
    }
    gr.compare(runs).plot().save(STATIC / "storm-valve.png", scale_factor=2)
