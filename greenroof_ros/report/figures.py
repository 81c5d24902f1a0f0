"""The figures of the paper and some beyond it; one specification makes page, PNG and SVG."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import altair as alt
import numpy as np

from greenroof_ros.common.files import shared_directory
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.report.assessment import Assessment
from greenroof_ros.report.drawing import (
    COLOURS,
    SHAPES,
    Figure,
    Panel,
    Rows,
    cycle,
    distinct,
    hover_points,
    short,
)
from greenroof_ros.report.pump_figures import pump_curve, pump_smoothing, read_pump_data
from greenroof_ros.report.results import Report, Result, Window, controller_name
from greenroof_ros.report.seed_figures import forecast_errors

_GREY = "#555555"
_FULL_FLOW = "full flow; above it is beyond the pump"
_PAPER_START = datetime.fromisoformat("2021-07-07T02:00-05:00")
_PAPER_HOURS = 12.0
_PAPERS_PARAMETER = {"mpc": "weight", "onoff": "fraction"}
# Longer runs have days on their axis.
_MOST_HOURS = 72.0
_TERMS = {
    "rain": "#56B4E9",
    "pumped": "#0072B2",
    "evapotranspiration": "#009E73",
    "drainage": "#000000",
    "outflow": "#999999",
}


def make_figures(report: Report, pump_data: Path | None) -> list[Callable[[], Figure]]:
    """Return what makes each figure, so that a caller can show how far it is.

    Args:
        report: all results.
        pump_data: points of the pumps' data sheet, if there are any.

    Raises:
        ConfigurationError: their file is wrong.
    """
    points = read_pump_data(pump_data) if pump_data is not None else None
    sites = {entry.site_name: entry.site for entry in report.entries}
    makers: list[Callable[[], Figure]] = []
    for number, (name, site) in enumerate(sites.items(), start=1):
        of = f" of {name}" if len(sites) > 1 else ""
        makers.append(partial(pump_curve, site, number, of, points))
        makers.append(partial(pump_smoothing, site, number, of))
    # Windows that differ in the evapotranspiration only share a figure of the weather.
    weathers = {window[:4]: window for window in reversed(report.windows)}
    for number, window in enumerate(reversed(weathers.values()), start=1):
        makers.append(partial(weather, report, window, number))
    for number, window in enumerate(report.windows, start=1):
        for quantity in QUANTITIES:
            makers.append(partial(by_setting, report, window, number, quantity))
    for number, window in enumerate(report.windows, start=1):
        for initial in report.initials:
            if report.of(window, initial=initial):
                makers.append(partial(trajectories, report, window, number, initial))
    for number, window in enumerate(report.windows, start=1):
        makers.append(partial(balance, report, window, number))
    if report.seeded:
        makers.append(partial(forecast_errors, report))
    return makers


# --- the weather -------------------------------------------------------------------------------


def weather(report: Report, window: Window, number: int) -> Figure:
    """Return rain and evapotranspiration over time (paper: Fig. 4)."""
    methods = [one for one in report.windows if one[:4] == window[:4]]
    first = {one.method: report.of(one)[0] for one in methods}
    run = first[window.method]
    offset = run.start.utcoffset()
    assert offset is not None
    # The axis is in UTC; shifted by the offset it shows local time in every reader's browser.
    origin = (run.start.timestamp() + offset.total_seconds()) * 1000
    rain = [
        {"t": origin + time * 1000, "v": short(value * 3.6e6)}
        for time, value in zip(*run.curves["precipitation"], strict=True)
    ]
    top = 1.05 * max(row["v"] for row in rain) or 1.0
    evaporation = [
        {"method": method, "t": origin + time * 1000,
         "v": short(value / one.entry.site.a2 * 8.64e7)}
        for method, one in first.items()
        for time, value in zip(*one.curves["evapotranspiration"], strict=True)
    ]
    x = alt.X(
        "t:T", scale=alt.Scale(type="utc"),
        title=f"local time (UTC{run.start.isoformat()[-6:]})",
        axis=alt.Axis(tickCount=6, format="%H:%M" if window.hours <= 36 else "%d %b"),
    )
    when = alt.Tooltip(
        "t:T", title="from", timeUnit="utcyearmonthdatehoursminutes", format="%Y-%m-%d %H:%M"
    )
    frozen = next((one.frost for one in first.values() if one.frost), ())
    frost = [
        alt.Chart(alt.InlineData([
            {"from": origin + low * 1000, "to": origin + high * 1000} for low, high in frozen
        ])).mark_rect(color="#999999", opacity=0.3).encode(
            x=alt.X("from:T", scale=alt.Scale(type="utc")), x2="to:T"
        )
    ] if frozen else []
    rained = alt.Chart(alt.NamedData(f"rain-{number}")).mark_area(
        interpolate="step-after", line={"color": "#0072B2"}, color="#56B4E9", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="rain (mm/h)", scale=alt.Scale(domain=[0, top])),
        tooltip=[when, alt.Tooltip("v:Q", title="mm/h")],
    )
    evaporated = alt.Chart(alt.NamedData(f"evapotranspiration-{number}")).mark_line(
        interpolate="step-after", clip=True
    ).encode(
        x=x, y=alt.Y("v:Q", title="evapotranspiration (mm/day)", scale=alt.Scale(zero=True)),
        tooltip=["method:N", when, alt.Tooltip("v:Q", title="mm/day")],
        **distinct("method", list(first), "method"),
    )
    caption = (
        "Rain, and evapotranspiration as a depth over the vegetation before it is limited to what "
        "the roof holds. Each value holds from its time to the next."
    )
    if frozen:
        caption += " Grey: frost, in which nothing is to be pumped."
    return Figure(
        f"weather-{number}",
        f"Weather: {Path(window.weather).stem}, {run.start.isoformat(' ', 'minutes')}, "
        f"{window.hours:.4g} h",
        caption,
        (
            Panel(alt.layer(*frost, rained), "Rain", zoom=True),
            Panel(alt.layer(*frost, evaporated), "Evapotranspiration",
                  hover=hover_points(evaporated), toggle="method", zoom=True),
        ),
        2,
        {f"rain-{number}": rain, f"evapotranspiration-{number}": evaporation},
    )


# --- what each setting comes to ----------------------------------------------------------------


class Quantity(NamedTuple):
    """What the runs are compared by, setting by setting."""

    name: str
    title: str
    axis: str
    caption: str
    value: Callable[[Assessment], float]


QUANTITIES = (
    Quantity(
        "total-deviation", "Total deviation", "total |x2 - x2*| (m³)",
        "The sum of |x2 - x2*| over the ticks: how far the roof was from its target, the whole "
        "time (paper: Fig. 5). Less is better.",
        lambda one: one.total_deviation_m3,
    ),
    Quantity(
        "time-in-band", "Time near the target", "time in the band (h)",
        "How long the roof was within the band about its target. More is better.",
        lambda one: one.band_hours,
    ),
    Quantity(
        "energy", "Energy", "energy (Wh)",
        "Electric energy of the pumps, as the assumptions beside the table have it.",
        lambda one: one.energy_kwh * 1000,
    ),
    Quantity(
        "pump-starts", "Pump starts", "starts",
        "How often the pumps' flow went from 0 to more. Starts wear pumps.",
        lambda one: float(one.pump_starts),
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
            x=alt.value(0), y=y, color=colour, text="text:N",
        ),
    ]


def published_totals(report: Report, window: Window) -> Rows:
    """Return the authors' values, where a window is the paper's; none elsewhere."""
    config = shared_directory() / "config"
    site, papers = report.of(window)[0].entry.site, read_site(config / "site.yaml")
    # What may be left out of a site file is its place, which makes no published evapotranspiration.
    table = [parameter.name for parameter in fields(Site) if parameter.default is MISSING]
    if (
        window.method != "published" or window.start != _PAPER_START
        or window.hours != _PAPER_HOURS
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


# --- what happened -----------------------------------------------------------------------------


def trajectories(report: Report, window: Window, number: int, initial: str) -> Figure:
    """Return command and volumes over time, controller beside controller (paper: Figs. 6-9)."""
    runs = report.of(window, initial=initial)
    site = runs[0].entry.site
    controllers = [name for name in report.controllers if report.of(window, name, initial)]
    unit, seconds = ("h", 3600.0) if window.hours <= _MOST_HOURS else ("days", 86400.0)
    panels, data = [], {}
    index = report.initials.index(initial) + 1
    for quantity, title, axis in (
        ("command", "command", "command (1)"),
        ("cistern", "cistern", "cistern, x1 (m³)"),
        ("roof", "green roof", "green roof, x2 (m³)"),
    ):
        low, high, references = _range(site, quantity, runs)
        for controller in controllers:
            dataset = f"{quantity}-{number}-{index}-{controller}"
            labels = _unique_labels(report, report.of(window, controller, initial))
            data[dataset] = [
                {"setting": label, "t": short(time / seconds), "v": short(value)}
                for label, one in labels.items()
                for time, value in zip(*one.curves[quantity], strict=True)
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
                        scale=alt.Scale(domain=[0, window.hours * 3600 / seconds], nice=False)),
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
                    alt.layer(*_reference_layers(references, low, high, scale), lines),
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
        tuple(panels), len(controllers), data,
    )


def _unique_labels(report: Report, runs: Sequence[Result]) -> dict[str, Result]:
    """Return the runs of a panel by label; equal settings are told apart by the run's name."""
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


def _range(
    site: Site, quantity: str, runs: Sequence[Result]
) -> tuple[float, float, list[_Reference]]:
    """Return the range of a quantity's axis, the same in all panels, and its reference lines."""
    values = [one.curves[quantity].value for one in runs]
    low, high = float(min(map(np.min, values))), float(max(map(np.max, values)))
    if quantity == "command":
        # On a logarithmic axis that leaves room for the words above the line.
        top = max(2.5 * high, 0.002)
        return 0.0, top, [_Reference(1.0, _FULL_FLOW)] if top > 1.5 else []
    if quantity == "cistern":
        references = [
            _Reference(site.a1 * site.z_o, "outlet"),
            _Reference(site.a1 * site.suction_level, "suction limit"),
        ]
    else:
        references = [_Reference(site.x2_star, "target")]
    span = max(high - low, 1e-3 * high, 1e-9)
    for reference in references:
        # One nearby is worth the room; one far away would make all lines flat.
        if low - span / 2 <= reference.value <= high + span / 2:
            low, high = min(low, reference.value), max(high, reference.value)
    margin = 0.12 * max(high - low, span)
    return max(0.0, low - margin), high + margin, references


def _reference_layers(
    references: Iterable[_Reference], low: float, high: float, scale: alt.Scale
) -> list[alt.Chart]:
    """Return the reference lines, each with its name; those outside as a word at the edge."""
    layers = []
    for reference in references:
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
                .encode(y=alt.Y("from:Q", scale=scale), y2="to:Q")
            )
        if inside:
            layers.append(base.mark_rule(color=_GREY, strokeDash=[3, 2]).encode(y=y))
        layers.append(
            base.mark_text(
                align="right", baseline="top" if above and not inside else "bottom",
                dx=-4, dy=3 if above and not inside else -2, color="#333333", fontSize=10,
            ).encode(x=alt.value("width"), y=y, text="text:N")
        )
    return layers


# --- where the water went ----------------------------------------------------------------------


def balance(report: Report, window: Window, number: int) -> Figure:
    """Return the water balance of both tanks, run by run."""
    runs = sorted(
        report.of(window),
        key=lambda one: (
            report.initials.index(one.entry.initial),
            report.controllers.index(one.entry.controller),
            report.settings[one.entry.controller].labels.index(
                report.settings[one.entry.controller].label(one.entry)
            ),
        ),
    )
    labels = [f"{report.label(one)}, {one.entry.initial}" for one in runs]
    names = [
        f"{label} ({one.entry.name})" if labels.count(label) > 1 else label
        for label, one in zip(labels, runs, strict=True)
    ]
    terms: dict[str, dict[str, Callable[[Assessment], float]]] = {
        "Cistern": {
            "rain": lambda one: one.rain_cistern_m3,
            "pumped": lambda one: -one.pumped_m3,
            "outflow": lambda one: -one.outflow_m3,
        },
        "Green roof": {
            "rain": lambda one: one.rain_roof_m3,
            "pumped": lambda one: one.pumped_m3,
            "evapotranspiration": lambda one: -one.evapotranspiration_m3,
            "drainage": lambda one: -one.drainage_m3,
        },
    }
    panels, data = [], {}
    for tank, parts in terms.items():
        dataset = f"balance-{number}-{tank.split()[-1].lower()}"
        data[dataset] = [
            {"run": name, "term": term, "v": short(value(one.assessment))}
            for name, one in zip(names, runs, strict=True)
            for term, value in parts.items()
        ]
        chart = alt.Chart(alt.NamedData(dataset)).mark_bar(stroke="white", strokeWidth=0.5).encode(
            x=alt.X("v:Q", title="in (+) and out (-) (m³)", axis=alt.Axis(tickCount=5)),
            y=alt.Y("run:N", sort=names, title=None, axis=alt.Axis(labelLimit=190)),
            color=alt.Color(
                "term:N", title=None,
                scale=alt.Scale(domain=list(parts), range=[_TERMS[term] for term in parts]),
            ),
            tooltip=["run:N", "term:N", alt.Tooltip("v:Q", title="m³", format=".6~g")],
        )
        panels.append(Panel(chart, tank, height=max(90, 17 * len(runs)), toggle="term"))
    caption = (
        "What came into each tank and left it during the run; the bars' sum is the change of what "
        "it holds. Evapotranspiration is what the roof could give."
    )
    return Figure(
        f"water-balance-{number}", report.title("Water balance", window), caption,
        tuple(panels), 2, data,
    )
