"""An animation: the same storm with a full cistern, and with a valve that made room.

The picture is SVG with CSS, drawn from two simulated runs. Where nothing moves (in print, for
readers who ask for less motion, in programs without CSS animation) it shows the end, so that the
gauges match the captions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import greenroof_ros as gr
from greenroof_ros.physics.storm_water import HOUR_S, find_wet

Values = NDArray[np.float64]

_SITE = Path(__file__).resolve().parent.parent / "config" / "site_valve.yaml"
_SECONDS = 6  # of the animation
_HOURS = 48
_FRAMES = 96
_STILL = _FRAMES - 1  # the frame without motion
_FULL = 10.0  # volume of the cistern (m3)

# Geometry (px): tops and heights of what water fills, in a panel of 380 px.
_CISTERN_TOP, _CISTERN_HEIGHT = 262.0, 112.0
_SOIL_TOP, _SOIL_HEIGHT = 104.0, 22.0
_GAUGE_TOP, _GAUGE_HEIGHT = 280.0, 94.0
_GAUGE_M3 = 12.0
_PANEL_WIDTH, _PANEL_HEIGHT = 380, 414
_TIMELINE_LEFT, _TIMELINE_HEIGHT = 50, 80
_GROUND = 236
_STYLE = """
text{fill:#1f2328}.title{font-size:19px;font-weight:bold}.caption{font-size:17px;font-weight:bold}
.name{text-anchor:middle}.small{font-size:15px}
.rain,.plant,.pipe,.outlet{fill:none;stroke-width:2}.rain,.plant{stroke-linecap:round}
.rain{stroke:#0072b2}.plant{stroke:#2f8f46}.pipe{stroke:#59636e;stroke-width:3}
.outlet{stroke-width:7}.pipe.drain{stroke:#b3261e}.tank{fill:#fff;stroke-width:2.5}
.wall{fill:#e7eaee;stroke:#818b98}.pane{fill:#fff;stroke:#818b98}
"""
_VISIBLE = 1e-5  # flow (m3/s)


def _simulate(outlet: str) -> gr.Result:
    site = gr.read_site(_SITE, tau=60.0, M=1, irrigation_rate=3.0)
    return gr.simulate(
        "onoff", site=site, outlet=outlet, start="2021-07-07T00:00", hours=_HOURS,
        initial=(_FULL, site.x2_star),
    )


# How an animation sets a value: in a frame, and as an attribute of the still picture.
_HEIGHT = "transform:scaleY({:.3f})", 'transform="scale(1 {:.3f})"'
_SHADE = "opacity:{:.1f}", 'opacity="{:.1f}"'
_PLACE = "transform:translateX({:.1f}px)", 'transform="translate({:.1f} 0)"'


class _Keyframes:
    """Animations of elements, each from a value for each frame.

    Attributes:
        rules: the animations, in CSS.
        start: the beginning of each animated element: its name, and how it looks without motion.
    """

    def __init__(self) -> None:
        self.rules: list[str] = []
        self.start: dict[str, str] = {}

    def add(self, name: str, form: tuple[str, str], values: Values) -> None:
        """Add an animation of one property: ``_HEIGHT``, ``_SHADE`` or ``_PLACE``."""
        in_frame, as_attribute = form
        self.start[name] = f'id="{name}" {as_attribute.format(values[_STILL])}'
        texts = [in_frame.format(value) for value in values]
        frames = [
            f"{100 * frame / (_FRAMES - 1):.4g}%{{{text}}}" for frame, text in enumerate(texts)
            # A frame that equals its neighbours is left out.
            if frame in (0, _FRAMES - 1) or not texts[frame - 1] == text == texts[frame + 1]
        ]
        self.rules.append(
            f"#{name}{{animation-name:{name}}}@keyframes {name}{{{''.join(frames)}}}\n"
        )


def _panel(
    keyframes: _Keyframes, key: str, left: float, top: float, title: str, caption: str, valve: bool
) -> str:
    """Return the drawing of a house; the names of its animations begin with a key."""
    bottom, soil = _CISTERN_TOP + _CISTERN_HEIGHT, _SOIL_TOP + _SOIL_HEIGHT
    drops = " ".join(f"M{x} {y} l-4 12" for y in (32, 58) for x in range(40 + y % 20, 330, 28))
    blades = "q-1 -8 -5 -11 m5 11 q1 -9 6 -12"
    plants = " ".join(f"M{x} {_SOIL_TOP} {blades}" for x in range(46, 140, 22))
    over = f"M246 {_CISTERN_TOP} h46 v{_CISTERN_HEIGHT}"
    low = f"M246 {bottom - 20} h46"
    drain = f"M40 {soil - 4} H28 V{bottom + 7} H336 V{bottom}"

    def water(part: str, x: float, y: float, width: float, height: float, colour: str) -> str:
        # Its bottom is at 0, from where its height is scaled.
        return (
            f'<g transform="translate({x} {y + height})"><rect {keyframes.start[f"{key}-{part}"]} '
            f'y="{-height}" width="{width}" height="{height}" fill="{colour}"/></g>'
        )

    parts = (
        f'<g transform="translate({left} {top})">',
        f'<text x="40" y="24" class="title">{title}</text>',
        f'<path {keyframes.start[f"{key}-rain"]} class="rain" d="{drops}"/>',
        # the green roof, the ordinary one, and the house
        f'<path d="M40 {_SOIL_TOP} h110 V{soil} h-110z" fill="#d0b48c"/>',
        water("soil", 40, _SOIL_TOP, 110, _SOIL_HEIGHT, "#4a90e2"),
        f'<path class="plant" d="{plants}"/>',
        f'<path d="M150 {soil} L236 84 L322 {soil}" fill="#8a6d5a"/>',
        f'<path class="wall" d="M46 {soil} h270 V{_GROUND} h-270z"/>',
        '<path class="pane" d="M70 150 h34 v30 h-34z m94 0 h34 v30 h-34z m94 0 h34 v30 h-34z"/>',
        f'<path d="M0 {_GROUND} H{_PANEL_WIDTH}" stroke="#818b98" stroke-width="2"/>',
        # what drains off the green roof
        f'<path class="pipe" d="{drain}"/>',
        f'<path {keyframes.start[f"{key}-drain"]} class="pipe drain" d="{drain}"/>',
        # the pipe from the roof, the pipe to it, the cistern and its outlets
        f'<path class="pipe" d="M322 {soil} V250 H226 V{_CISTERN_TOP} M62 330 H52 V134"/>',
        f'<rect class="tank" x="60" y="{_CISTERN_TOP - 8}" width="186" '
        f'height="{_CISTERN_HEIGHT + 8}" stroke="#59636e"/>',
        water("cistern", 62, _CISTERN_TOP, 182, _CISTERN_HEIGHT - 2, "#4a90e2"),
        f'<text x="153" y="{bottom - 42}" class="name">cistern</text>',
        f'<path class="outlet" stroke="#aab2bb" d="{over} {low}"/>',
        f'<path {keyframes.start[f"{key}-over"]} class="outlet" stroke="#b3261e" d="{over}"/>',
        f'<path {keyframes.start[f"{key}-low"]} class="outlet" stroke="#0072b2" d="{low} v20"/>',
        f'<path d="M248 {bottom - 32} v24 l24 -24 v24z" fill="#c25400"/>' if valve else "",
        # what has reached the sewer
        f'<text x="336" y="{_GAUGE_TOP - 14}" class="small" text-anchor="middle">sewer</text>',
        f'<rect class="tank" x="316" y="{_GAUGE_TOP - 8}" width="40" height="{_GAUGE_HEIGHT + 8}" '
        'stroke="#b3261e"/>',
        water("sewer", 317, _GAUGE_TOP, 38, _GAUGE_HEIGHT - 1, "#b3261e"),
        f'<text x="366" y="{bottom + 26}" class="caption" text-anchor="end">{caption}</text>',
        "</g>",
    )
    return "\n".join(parts)


def _cumulated_wet_discharge(run: gr.Result) -> Values:
    """Return what has reached the sewer in wet weather until each tick (m3)."""
    site, ticks = run.run.site, run.ticks
    flow = ticks.outflow + (1 - site.drainage_to_cistern) * ticks.drainage
    wet, _ = find_wet(
        ticks.precipitation, site.tau, site.wet_after * HOUR_S, run.run.without_rain_s
    )
    volumes = np.where(wet, site.tau * flow, 0.0)
    return np.asarray(np.cumsum(volumes) - volumes)


def _timeline(run: gr.Result, keyframes: _Keyframes, width: float, bottom: float) -> str:
    """Return the rain of the run by hours, and a cursor that moves along it."""
    hourly = 3.6e6 * np.asarray(run.ticks.precipitation)[:-1].reshape(_HOURS, -1).mean(axis=1)
    length = width - 1.5 * _TIMELINE_LEFT
    hour_width = length / _HOURS
    bars = "".join(
        f'<path d="M{_TIMELINE_LEFT + hour * hour_width:.1f} {bottom} v{-5 * rain:.1f} '
        f'h{hour_width - 1:.1f} v{5 * rain:.1f} z"/>'
        for hour, rain in enumerate(hourly) if rain
    )
    marks = "".join(
        f'<text class="small" x="{_TIMELINE_LEFT + hour * hour_width:.0f}" '
        f'y="{bottom + 18}">{label}</text>'
        for hour, label in ((0, "7 July 2021"), (24, "8 July 2021"))
    )
    keyframes.add("cursor", _PLACE, np.linspace(0.0, length, _FRAMES))
    return (
        f'<g fill="#0072b2">{bars}</g>'
        f'<path d="M{_TIMELINE_LEFT} {bottom} h{length}" stroke="#59636e"/>'
        f'<path {keyframes.start["cursor"]} d="M{_TIMELINE_LEFT} {bottom} v-44" stroke="#1f2328" '
        f'stroke-width="2"/>{marks}<text class="small" x="8" y="{bottom - 4}">rain</text>'
    )


def draw(narrow: bool) -> str:
    """Return the text of the animation; the two runs take a few seconds.

    Args:
        narrow: for the width of a phone: the houses are one above the other.
    """
    keyframes, wet, panels = _Keyframes(), {}, []
    columns, rows = (1, 2) if narrow else (2, 1)
    for key, outlet, place, title in (
        ("full", "closed", 0, "A full cistern overflows"),
        ("room", "plan", 1, "A valve made room in time"),
    ):
        run = _simulate(outlet)
        ticks, site, wet[key] = run.ticks, run.run.site, run.metrics["wet_discharge_m3"]
        picked = np.linspace(0, len(ticks.cistern) - 1, _FRAMES).round().astype(int)
        for part, form, values in (
            ("cistern", _HEIGHT, ticks.cistern / _FULL),
            ("soil", _HEIGHT, ticks.roof / site.z_cap),
            ("sewer", _HEIGHT, _cumulated_wet_discharge(run) / _GAUGE_M3),
            ("rain", _SHADE, np.minimum(1.0, ticks.precipitation * 3.6e6 / 2)),
            ("over", _SHADE, (ticks.outflow - ticks.low_outlet > _VISIBLE)),
            ("low", _SHADE, (ticks.low_outlet > _VISIBLE)),
            ("drain", _SHADE, ((1 - site.drainage_to_cistern) * ticks.drainage > _VISIBLE)),
        ):
            keyframes.add(f"{key}-{part}", form, np.asarray(values, float)[picked])
        caption = f"{wet[key]:.1f} m³ to the sewer in wet weather"
        left, top = place % columns * _PANEL_WIDTH, place // columns * _PANEL_HEIGHT
        panels.append(_panel(keyframes, key, left, top, title, caption, valve=outlet == "plan"))
    width, height = columns * _PANEL_WIDTH, rows * _PANEL_HEIGHT + _TIMELINE_HEIGHT
    timeline = _timeline(run, keyframes, width, height - 24)
    font = "Arial, Helvetica, 'Liberation Sans', sans-serif"
    told = (
        f"Two houses with a green roof and a cistern of {_FULL:g} m³, full on 7 July 2021. In the "
        f"first, the cistern stays full and overflows when it rains: {wet['full']:.1f} m³ reach "
        "the sewer in wet weather. In the second, a valve lets water out in dry weather before "
        f"the rain: {wet['room']:.1f} m³."
    )
    moving = '[id*="-"],#cursor'
    return "\n".join((
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" role="img" aria-labelledby="title description" font-family="{font}" '
        'font-size="16">',
        '<title id="title">The same storm without and with a valve</title>',
        f'<desc id="description">{told}</desc>',
        f"<style>{_STYLE}{moving}{{animation:{_SECONDS}s linear infinite}}",
        *keyframes.rules,
        f"@media print,(prefers-reduced-motion:reduce){{{moving}{{animation:none!important}}}}",
        f'</style><rect width="{width}" height="{height}" fill="#fff"/>', *panels, timeline,
        "</svg>\n",
    ))
