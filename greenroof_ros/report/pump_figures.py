"""The figures of pumps and pipe: the pump curve, and the smooth model beside the exact one."""

from __future__ import annotations

import math
from pathlib import Path

import altair as alt
import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import read_table
from greenroof_ros.model.plant import head_loss, maximum_pump_flow, pump_flow
from greenroof_ros.model.pump_curve import fit_pump_curve
from greenroof_ros.model.site import Site
from greenroof_ros.model.smooth_plant import q_pump
from greenroof_ros.report.drawing import Figure, Panel, Rows, distinct, pointed, short

# Pumps of roofs are below these limits [assumed]; data sheets in l/s, m3/h or mm exceed them.
_LIMITS = ("m3/s", 0.0, 0.5), ("m", 0.0, 500.0)
_HEADER = "flow [m3/s]", "head [m]"


def read_pump_data(path: Path) -> list[tuple[float, float]]:
    """Read the points of a pump's data sheet: lines of flow (m3/s) and head (m).

    Raises:
        ConfigurationError: the file is wrong, or no curve can be fitted to it.
    """
    table = read_table(path)
    table.require_header(_HEADER, f" (the first line is '{','.join(_HEADER)}')")
    flows, heads = (
        table.numbers(column, limits, hint="; are they in other units, such as l/s (0.001 m3/s)?")
        for column, limits in zip(_HEADER, _LIMITS, strict=True)
    )
    try:
        fit_pump_curve(flows, heads)
    except ValueError as error:
        raise ConfigurationError(str(error), file=path) from error
    return list(zip(flows.tolist(), heads.tolist(), strict=True))


def pump_curve(
    site: Site, number: int, of: str, points: list[tuple[float, float]] | None
) -> Figure:
    """Return the figure of head over flow of pumps and pipe (paper: Fig. 2, Eqs. 3b-3d)."""
    levels = site.suction_level, site.z_o
    names = [
        "pump curve of the site", *(f"head loss, cistern at {level:g} m" for level in levels)
    ]
    working = []
    for level in levels:
        flow = maximum_pump_flow(site, level * site.a1)
        working.append({"flow": flow * 1000, "head": site.a_hat * flow**2 + site.c_hat})
    measured = [{"flow": flow * 1000, "head": head} for flow, head in points or ()]
    largest = max(math.sqrt(site.c_hat / -site.a_hat), *(flow for flow, _ in points or [(0, 0)]))
    flows = np.linspace(0, largest, 120)
    lines = [
        site.a_hat * flows**2 + site.c_hat,
        *(head_loss(site, np.full(len(flows), level * site.a1), flows) for level in levels),
    ]
    caption = (
        "Head over flow. Where the curve of the pumps (Eq. 3b) meets the head loss of the pipe "
        "(Eq. 3c), the pumps work at command 1 (Eq. 3d): hollow circles, for a cistern at the "
        "lowest level at which they may run and at its outlet's level. "
    )
    if points:
        fit = fit_pump_curve(*np.transpose(points))
        names.append("fit to the data sheet")
        lines.append(fit.a_hat * flows**2 + fit.c_hat)
        caption += (
            f"Crosses: points of the data sheet; fit: a_hat = {fit.a_hat:.4g} s2/m5, "
            f"c_hat = {fit.c_hat:.4g} m."
        )
    else:
        caption += "The points that the paper's curve was fitted to are not published as numbers."
    rows = [
        {"line": name, "flow": short(flow * 1000), "head": short(head)}
        for name, line in zip(names, lines, strict=True)
        for flow, head in zip(flows, line, strict=True)
        if head >= -1e-9  # rounding can make the end of the curve negative
    ]
    data = f"pump-curve-{number}"
    x = alt.X("flow:Q", title="flow (L/s)")
    top = 1.05 * float(np.max(lines))
    y = alt.Y("head:Q", title="head (m)", scale=alt.Scale(domain=[0, top], nice=False))
    layers = [
        alt.Chart(alt.NamedData(data)).mark_line(clip=True).encode(
            x=x, y=y, tooltip=pointed("line:N", "flow:Q", "head:Q"), **distinct("line", names, ""),
        ),
        alt.Chart(alt.InlineData(working)).mark_point(size=90, color="black").encode(
            x=x, y=y,
            tooltip=[alt.Tooltip(f"{name}:Q", format=".4g") for name in ("flow", "head")],
        ),
    ]
    if points:
        layers.append(
            alt.Chart(alt.InlineData(measured)).mark_point(shape="cross", size=60, color="black")
            .encode(x=x, y=y, tooltip=pointed("flow:Q", "head:Q"))
        )
    panel = Panel(alt.layer(*layers), "Head over flow", height=260, toggle="line")
    return Figure(
        f"pump-curve-{number}", f"Pumps and pipe{of}", caption, (panel,), 1, {data: rows},
        folded=True,
    )


def pump_smoothing(site: Site, number: int, of: str) -> Figure:
    """Return the figure of q_pump, exact and smooth (paper: Fig. 3, Eqs. 3a and 8)."""
    command, names = 0.5, ["exact (Eq. 3a)", "smooth (Eq. 8)"]
    switch, full = site.suction_level * site.a1, 4 / 3 * site.a1 * site.z_o
    near = 8 * site.epsilon
    sweeps = (
        ("x1", 0.0, full, "Over the cistern's volume, x2 = 0"),
        ("x1", max(0.0, switch - near), switch + near, "The same, about the suction limit"),
        ("x2", 0.0, site.x2_star + near, f"Over the roof's volume, x1 = {full:.3g} m³"),
    )
    panels, data = [], {}
    for index, (name, low, high, title) in enumerate(sweeps, start=1):
        edge = switch if name == "x1" else site.x2_star
        # Both sides of the switch, to draw the exact model's jump as a vertical line.
        grid = np.union1d(np.linspace(low, high, 241), [np.nextafter(edge, 0), edge])
        rows: Rows = []
        for value in grid[(grid >= low) & (grid <= high)].tolist():
            x1, x2 = (value, 0.0) if name == "x1" else (full, value)
            smooth = q_pump(site, x1, x2, command)[0]
            for line, flow in zip(
                names, (pump_flow(site, x1, x2, command), smooth), strict=True
            ):
                # x is not rounded: the two sides of the jump differ only in the last digit.
                rows.append({"model": line, "x": value, "q": short(flow * 1000)})
        dataset = f"pump-smoothing-{number}-{index}"
        data[dataset] = rows
        tank = "cistern" if name == "x1" else "green roof"
        chart = alt.Chart(alt.NamedData(dataset)).mark_line().encode(
            x=alt.X("x:Q", title=f"{tank}, {name} (m³)",
                    scale=alt.Scale(domain=[low, high], nice=False)),
            y=alt.Y("q:Q", title="pump flow (L/s)"),
            tooltip=pointed("model:N", alt.Tooltip("x:Q", format=".4g"), "q:Q"),
            **distinct("model", names, ""),
        )
        panels.append(Panel(chart, title, toggle="model"))
    caption = (
        f"The pumps' flow at command {command:g} in the exact model, which the plant steps, and in "
        f"the smooth one, which serves only to linearise (epsilon = {site.epsilon:g}). Where they "
        "differ, the predictive controller predicts the wrong pump flow."
    )
    return Figure(
        f"pump-smoothing-{number}", f"Exact and smooth pump flow{of}", caption, tuple(panels), 3,
        data, folded=True,
    )
