"""The figures of command and volumes over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import altair as alt
import numpy as np

from greenroof_ros.model.site import Site
from greenroof_ros.report.drawing import Figure, Panel, distinct, hover_points, short
from greenroof_ros.report.results import Report, Result, Window
from greenroof_ros.report.settings import controller_name

_GREY = "#555555"
_FULL_FLOW = "full flow; above it is beyond the pump"
# Longer runs have days on their axis.
_MOST_HOURS = 72.0


def trajectories(report: Report, window: Window, number: int, initial: str) -> Figure:
    """Return command and volumes over time, controller beside controller (paper: Figs. 6-9)."""
    runs = report.of(window, initial=initial)
    site = runs[0].entry.site
    controllers = [name for name in report.controllers if report.of(window, name, initial)]
    unit, seconds = ("h", 3600.0) if window.sky.hours <= _MOST_HOURS else ("days", 86400.0)
    panels, data = [], {}
    index = report.initials.index(initial) + 1
    for quantity, title, axis in (
        ("command", "command", "command (1)"),
        ("cistern", "cistern", "cistern, x1 (m³)"),
        ("roof", "green roof", "green roof, x2 (m³)"),
    ):
        axis_range = _range(site, quantity, runs)
        low, high = axis_range.low, axis_range.high
        for controller in controllers:
            dataset = f"{quantity}-{number}-{index}-{controller}"
            labels = _unique_labels(report, report.of(window, controller, initial))
            data[dataset] = [
                {"setting": label, "t": short(time / seconds), "v": short(value)}
                for label, one in labels.items()
                for time, value in one.curves[quantity].points()
            ]
            scale = alt.Scale(domain=[low, high], nice=False)
            ticks = alt.Axis()
            if quantity == "command":
                # Of 1e-3 and of 1 both must be seen.
                scale = alt.Scale(type="symlog", constant=1e-3, domain=[low, high], nice=False)
                powers = [10.0**power for power in range(-3, 10)]
                ticks = alt.Axis(values=[0.0, *powers], format="~g")
            lines = alt.Chart(alt.NamedData(dataset)).mark_line(
                clip=True, strokeWidth=1.8,
            ).encode(
                x=alt.X("t:Q", title=f"time since the start ({unit})",
                        scale=alt.Scale(domain=[0, window.sky.hours * 3600 / seconds], nice=False)),
                y=alt.Y("v:Q", title=axis, scale=scale, axis=ticks),
                tooltip=[
                    alt.Tooltip("setting:N", title=report.settings[controller].title),
                    alt.Tooltip("t:Q", title=f"time ({unit})", format=".4~g"),
                    alt.Tooltip("v:Q", title=axis, format=".6~g"),
                ],
                **distinct("setting", list(labels), report.settings[controller].title),
            )
            panels.append(
                Panel(
                    alt.layer(*_reference_layers(axis_range, scale), lines),
                    f"{controller_name(controller)}: {title}",
                    hover=hover_points(lines), toggle="setting", zoom=True,
                )
            )
    caption = (
        "Command and volumes over time, one line a setting. The command's axis is logarithmic "
        "above 0.001; in the shaded part a command asks for more than the pumps have. A reference "
        "that lies outside a panel is named at its edge."
    )
    return Figure(
        f"trajectories-{number}-{index}",
        report.title(f"Command and volumes from {initial}", window), caption,
        tuple(panels), len(controllers) if len(controllers) > 1 else len(panels), data,
    )


def _unique_labels(report: Report, runs: Sequence[Result]) -> dict[str, Result]:
    """Return the runs of a panel by label; equal settings have the run's name, too."""
    settings = report.settings[runs[0].entry.controller]
    plain = [settings.label(one.entry) for one in runs]
    named = {
        f"{label} ({one.entry.name})" if plain.count(label) > 1 else label: one
        for label, one in zip(plain, runs, strict=True)
    }
    order = {label: place for place, label in enumerate(settings.labels)}
    return dict(
        sorted(named.items(), key=lambda item: order[settings.label(item[1].entry)])
    )


class _Reference(NamedTuple):
    """A level that means something."""

    value: float
    text: str


class _Range(NamedTuple):
    """The range of an axis, and its reference lines."""

    low: float
    high: float
    references: list[_Reference]


def _range(site: Site, quantity: str, runs: Sequence[Result]) -> _Range:
    """Return the range of a quantity's axis, the same in all panels."""
    values = [one.curves[quantity].value for one in runs]
    low, high = float(min(map(np.min, values))), float(max(map(np.max, values)))
    if quantity == "command":
        # On a logarithmic axis that leaves room for the words above the line.
        top = max(2.5 * high, 0.002)
        return _Range(0.0, top, [_Reference(1.0, _FULL_FLOW)] if top > 1.5 else [])
    if quantity == "cistern":
        references = [
            _Reference(site.a1 * site.z_o, "outlet"),
            _Reference(site.a1 * site.suction_level, "suction limit"),
        ]
    else:
        references = [_Reference(site.x2_star, "target")]
    span = max(high - low, 1e-3 * high, 1e-9)
    if quantity == "cistern" and site.low_outlet_level is not None:
        low_outlet = site.a1 * site.low_outlet_level
        if low - span / 2 <= low_outlet <= high + span / 2:  # else two words would be in one place
            references.append(_Reference(low_outlet, "low outlet"))
    for reference in references:
        # One nearby is worth the room; one far away would make all lines flat.
        if low - span / 2 <= reference.value <= high + span / 2:
            low, high = min(low, reference.value), max(high, reference.value)
    margin = 0.12 * max(high - low, span)
    return _Range(max(0.0, low - margin), high + margin, references)


def _reference_layers(axis_range: _Range, scale: alt.Scale) -> list[alt.Chart]:
    """Return the reference lines, each with its name; those outside as a word at the edge."""
    layers = []
    low, high = axis_range.low, axis_range.high
    for reference in axis_range.references:
        inside = low <= reference.value <= high
        above = reference.value > high
        text = reference.text
        if not inside:
            text += f" at {reference.value:.4g} {'↑' if above else '↓'}"
        base = alt.Chart(alt.InlineData(
            [{"v": reference.value if inside else high if above else low, "text": text}]
        ))
        y = alt.Y("v:Q", scale=scale)
        if reference.text == _FULL_FLOW:
            layers.append(
                alt.Chart(alt.InlineData([{"from": reference.value, "to": high}]))
                .mark_rect(color="#D55E00", opacity=0.12)
                .encode(y=alt.Y("from:Q", scale=scale), y2=alt.Y2("to:Q"))
            )
        if inside:
            layers.append(base.mark_rule(color=_GREY, strokeDash=[3, 2]).encode(y=y))
        layers.append(
            base.mark_text(
                align="right", baseline="top" if above and not inside else "bottom",
                dx=-4, dy=3 if above and not inside else -2, color="#333333", fontSize=10,
            ).encode(x=alt.XValue("width"), y=y, text=alt.Text("text:N"))
        )
    return layers
