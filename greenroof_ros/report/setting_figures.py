"""The figures of a quantity over each controller's settings."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from datetime import datetime

import altair as alt

from greenroof_ros.common.files import shared_directory
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.report.assessment import Assessment
from greenroof_ros.report.drawing import COLOURS, SHAPES, Figure, Panel, Rows, cycle, short
from greenroof_ros.report.results import Report, Window
from greenroof_ros.report.settings import controller_name

_PAPER_START = datetime.fromisoformat("2021-07-07T02:00-05:00")
_PAPER_HOURS = 12.0
_PAPERS_PARAMETER = {"mpc": "weight", "onoff": "fraction"}


@dataclass(frozen=True)
class Quantity:
    """What the runs are compared by, setting by setting."""

    name: str
    title: str
    axis: str
    caption: str
    value: Callable[[Assessment], float]


QUANTITIES = (
    Quantity(
        name="total-deviation", title="Total deviation", axis="total |x2 - x2*| (m³)",
        caption="The sum of |x2 - x2*| over the ticks: how far the roof was from its target, the "
        "whole time (paper: Fig. 5). Less is better.",
        value=lambda one: one.metrics["total_deviation_m3"],
    ),
    Quantity(
        name="time-in-band", title="Time near the target", axis="time in the band (h)",
        caption="How long the roof was within the band about its target. More is better.",
        value=lambda one: one.band_hours,
    ),
    Quantity(
        name="energy", title="Electric energy", axis="electric energy (Wh)",
        caption="What the pumps draw, at the site's pump_efficiency. Less is better.",
        value=lambda one: 1000 * one.metrics["electric_energy_kwh"],
    ),
    Quantity(
        name="pump-starts", title="Pump starts", axis="starts",
        caption="How often the pumps' flow went from 0 to more. Starts wear pumps.",
        value=lambda one: one.metrics["pump_starts"],
    ),
)


def by_setting(report: Report, window: Window, number: int, quantity: Quantity) -> Figure:
    """Return a quantity over each controller's settings, marked by initial state."""
    published = published_totals(report, window) if quantity is QUANTITIES[0] else []
    bounds = least_totals(report, window) if quantity is QUANTITIES[0] else []
    values = [quantity.value(one.assessment) for one in report.of(window)]
    # Where all are 0 any axis does.
    top = max([*values, *(row["v"] for row in (*published, *bounds))]) or 1.0
    panels = []
    data: dict[str, Rows] = {f"bound-{number}": bounds} if bounds else {}
    for controller in report.controllers:
        runs = report.of(window, controller)
        if not runs:
            continue
        settings = report.settings[controller]
        dataset = f"{quantity.name}-{number}-{controller}"
        data[dataset] = [
            {
                "run": one.entry.name, "setting": settings.label(one.entry),
                "x": one.entry.parameters[settings.axis] if settings.axis
                else settings.label(one.entry),
                "initial": one.entry.initial, "v": short(quantity.value(one.assessment)),
                # The first is drawn larger, so that it shows where another lies on it.
                "size": 150 if one.entry.initial == report.initials[0] else 50,
            }
            for one in runs
        ]
        if settings.axis:
            ticks = sorted({row["x"] for row in data[dataset]})
            x = alt.X(
                "x:Q", title=settings.title,
                scale=alt.Scale(type="log", padding=12) if settings.log
                else alt.Scale(padding=12, zero=False),
                axis=alt.Axis(values=ticks, labelExpr="'' + datum.value", labelOverlap=True),
            )
        else:
            x = alt.X("x:N", title=settings.title, sort=settings.labels,
                      axis=alt.Axis(labelAngle=-20 if max(map(len, settings.labels)) > 12 else 0,
                                    labelLimit=160))
        y = alt.Y("v:Q", title=quantity.axis, scale=alt.Scale(domain=[0, 1.08 * top], nice=False))
        colour = alt.Color(
            "initial:N", title="from",
            scale=alt.Scale(domain=report.initials, range=cycle(COLOURS, report.initials)),
        )
        shape = alt.Shape(
            "initial:N", title="from",
            scale=alt.Scale(domain=report.initials, range=cycle(SHAPES, report.initials)),
        )
        tooltip = [
            alt.Tooltip("run:N"), alt.Tooltip("setting:N", title=settings.title),
            alt.Tooltip("initial:N", title="from"),
            alt.Tooltip("v:Q", title=quantity.axis, format=".6~g"),
        ]
        base = alt.Chart(alt.NamedData(dataset))
        size = alt.Size("size:Q", scale=None)
        layers = [
            base.mark_line(strokeWidth=1, opacity=0.6).encode(x=x, y=y, color=colour),
            base.mark_point(filled=True, opacity=1).encode(
                x=x, y=y, color=colour, shape=shape, size=size, tooltip=tooltip
            ),
        ]
        if bounds:
            layers += _bound_layers(f"bound-{number}", y, colour)
        theirs = [row for row in published if row["controller"] == controller]
        if theirs:
            data[f"published-{number}-{controller}"] = theirs
            layers.append(
                alt.Chart(alt.NamedData(f"published-{number}-{controller}")).mark_point(
                    filled=False, size=330, strokeWidth=1.5
                ).encode(
                    x=x, y=y, color=colour, shape=shape,
                    tooltip=[alt.Tooltip("v:Q", title="authors' code", format=".8~g")],
                )
            )
        panels.append(
            Panel(alt.layer(*layers), controller_name(controller), toggle="initial")
        )
    caption = quantity.caption
    if published:
        caption += (
            " Large hollow marks: the paper's values, recomputed with the code that its authors "
            "published, as the paper gives them in a figure only."
        )
    if bounds:
        caption += (
            " Dashed, 'least': the least that any controller with commands up to 1 could reach "
            "from the initial state of the same colour."
        )
    title = report.title(quantity.title, window)
    if published:
        title += " (large hollow marks: the authors' code)"
    return Figure(
        f"{quantity.name}-{number}", title, caption,
        tuple(panels), len(panels), data,
    )


def least_totals(report: Report, window: Window) -> Rows:
    """Return the least possible total deviation from each initial state where it is known."""
    known = {
        one.entry.initial: one.bound_m3
        for one in report.of(window) if one.bound_m3 is not None
    }
    return [
        {"initial": name, "v": short(bound), "text": "least",
         # As with the marks: it shows where another lies on it.
         "width": 4.0 if name == report.initials[0] else 1.5}
        for name, bound in known.items()
    ]


def _bound_layers(data: str, y: alt.Y, colour: alt.Color) -> list[alt.Chart]:
    """Return the lines of the least possible, each with its name in the left corner."""
    base = alt.Chart(alt.NamedData(data))
    return [
        base.mark_rule(strokeDash=[6, 3]).encode(
            y=y, color=colour, strokeWidth=alt.StrokeWidth("width:Q", scale=None),
            tooltip=[
                alt.Tooltip("initial:N", title="from"),
                alt.Tooltip("v:Q", title="least possible (m³)", format=".6~g"),
            ],
        ),
        base.mark_text(align="left", baseline="bottom", dx=4, dy=-1, fontSize=10).encode(
            x=alt.XValue(0), y=y, color=colour, text=alt.Text("text:N"),
        ),
    ]


def published_totals(report: Report, window: Window) -> Rows:
    """Return the authors' values, where a window is the paper's; none elsewhere."""
    config = shared_directory() / "config"
    site, papers = report.of(window)[0].entry.site, read_site(config / "site.yaml")
    # What may be left out of a site file is its place, which makes no published evapotranspiration.
    table = [parameter.name for parameter in fields(Site) if parameter.default is MISSING]
    if (
        window.method != "published" or window.sky.start != _PAPER_START
        or window.sky.hours != _PAPER_HOURS
        or window.forecast or window.sensor_pump_errors
        or any(getattr(site, name) != getattr(papers, name) for name in table)
    ):
        return []
    with (config / "paper" / "totals.csv").open(encoding="utf-8", newline="") as stream:
        return [
            {
                "controller": row["controller"], "initial": row["initial"],
                "x": float(row["parameter"]), "v": float(row["total_deviation_m3"]),
            }
            for row in csv.DictReader(stream)
            if row["initial"] in report.initials and row["controller"] in report.controllers
            and report.settings[row["controller"]].axis == _PAPERS_PARAMETER[row["controller"]]
        ]
