"""The figure of the weather: rain and evapotranspiration over time."""

from __future__ import annotations

import altair as alt

from greenroof_ros.report.drawing import Figure, Panel, distinct, hover_points, pointed, short
from greenroof_ros.report.results import Report, Result, Sky


def weather(report: Report, sky: Sky, number: int) -> Figure:
    """Return rain and evapotranspiration over time (paper: Fig. 4)."""
    first: dict[str, Result] = {}
    for window in report.windows:
        if window.sky == sky:
            first.setdefault(window.method, report.of(window)[0])
    run = next(iter(first.values()))
    offset = run.start.utcoffset()
    assert offset is not None
    # The axis is in UTC; shifted by the offset it shows local time in every reader's browser.
    origin = (run.start.timestamp() + offset.total_seconds()) * 1000
    rain = [
        {"t": origin + time * 1000, "v": short(value * 3.6e6)}
        for time, value in run.curves["precipitation"].points()
    ]
    top = 1.05 * max(row["v"] for row in rain) or 1.0
    evaporation = [
        {"method": method, "t": origin + time * 1000,
         "v": short(value / one.entry.site.a2 * 8.64e7)}
        for method, one in first.items()
        for time, value in one.curves["evapotranspiration"].points()
    ]
    x = alt.X(
        "t:T", scale=alt.Scale(type="utc"),
        title=f"local time (UTC{run.start.isoformat()[-6:]})",
        axis=alt.Axis(tickCount=6, format="%H:%M" if sky.hours <= 36 else "%d %b"),
    )
    when = alt.Tooltip(
        "t:T", title="from", timeUnit="utcyearmonthdatehoursminutes", format="%Y-%m-%d %H:%M"
    )
    frozen = next((one.frost for one in first.values() if one.frost), ())
    frost = [
        alt.Chart(alt.InlineData([
            {"from": origin + low * 1000, "to": origin + high * 1000} for low, high in frozen
        ])).mark_rect(color="#999999", opacity=0.3).encode(
            x=alt.X("from:T", scale=alt.Scale(type="utc")), x2=alt.X2("to:T")
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
        tooltip=pointed("method:N", when, alt.Tooltip("v:Q", title="mm/day")),
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
        f"Weather: {report.heading(sky)}",
        caption,
        (
            Panel(alt.layer(*frost, rained), "Rain", zoom=True),
            Panel(alt.layer(*frost, evaporated), "Evapotranspiration",
                  hover=hover_points(evaporated), toggle="method", zoom=True),
        ),
        2,
        {f"rain-{number}": rain, f"evapotranspiration-{number}": evaporation},
    )
