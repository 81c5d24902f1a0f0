"""The figure of the water balance."""

from __future__ import annotations

from collections.abc import Callable

import altair as alt

from greenroof_ros.report.assessment import Assessment
from greenroof_ros.report.drawing import Figure, Panel, pointed, short
from greenroof_ros.report.results import Report, Window

_TERMS = {
    "rain": "#56B4E9",
    "pumped": "#0072B2",
    "evapotranspiration": "#009E73",
    "drainage": "#000000",
    "outflow": "#999999",
}


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
            "rain": lambda one: one.metrics["rain_cistern_m3"],
            "pumped": lambda one: -one.metrics["pumped_m3"],
            "outflow": lambda one: -one.metrics["outflow_m3"],
        },
        "Green roof": {
            "rain": lambda one: one.metrics["rain_roof_m3"],
            "pumped": lambda one: one.metrics["pumped_m3"],
            "evapotranspiration": lambda one: -one.metrics["evapotranspiration_m3"],
            "drainage": lambda one: -one.metrics["drainage_m3"],
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
            tooltip=pointed("run:N", "term:N", alt.Tooltip("v:Q", title="m³", format=".6~g")),
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
