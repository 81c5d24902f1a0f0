"""The page of a calibration: a self-contained HTML file with all figures."""

from __future__ import annotations

from collections.abc import Mapping

import altair as alt
import numpy as np

from greenroof_ros.analysis.calibration.fit import FILLED
from greenroof_ros.analysis.calibration.record import COMBINE, sum_spans
from greenroof_ros.analysis.calibration.result import (
    CROP_NOTE,
    INTERVAL_NOTE,
    Calibration,
    describe_halves,
)
from greenroof_ros.analysis.calibration.step_record import (
    DAY_S,
    StepRecord,
    Steps,
    Values,
    name_time,
)
from greenroof_ros.analysis.figures import Figure, Rows, round_value, series_panel
from greenroof_ros.analysis.page import Section, make_page
from greenroof_ros.analysis.tables import Column, Table
from greenroof_ros.site.file import SITE_KEYS

MEASURED, SIMULATED = "measured", "simulated"


def render(made: Calibration) -> str:
    """Return the page of a calibration."""
    record, known = made.record, {
        name: (each.unit, each.meaning) for name, each in SITE_KEYS.items()
    }
    known[FILLED] = (
        "1", "share of the available water capacity that is filled when the record begins"
    )
    figures = [
        draw_quantity(quantity, record, made.halves, getattr(made.fit.simulated, quantity))
        for quantity in record.measured
    ]
    judged = []
    for row in made.scores:
        if row.part == "validation":
            time, nse = list(row.nse.items())[-1]
            judged.append(f"the {row.quantity} of a {name_time(time).removeprefix('1 ')} has an "
                          f"NSE of {nse:.2f}")
            if row.quantity == "runoff":
                judged[-1] += f" and its volume is {100 * row.volume_error:+.1f} % off"
    answer = (
        f"In the half that was not used for the fit, {'; '.join(judged)}. (An NSE of 1 is perfect; "
        "0 is no better than the mean of the measurements.)"
    )
    if made.warnings:
        answer = f"Do not use this fit before you have read the warnings. {answer}"
    parameters = [
        [one.name, one.value, known[one.name][0], one.interval or "not fitted", one.reason,
         known[one.name][1]] for one in made.fit.parameters
    ]
    spans = made.scores[0].nse
    scores = [
        [row.quantity, row.part, *row.nse.values(), *row.kge.values(),
         row.volume_error if row.quantity == "runoff" else np.nan] for row in made.scores
    ]
    value, efficiency = Column("value", "", "{:.4g}".format), "{:.2f}".format
    return make_page("Green roof: calibration", answer, [
        *([Section("Warnings", [list(made.warnings)])] if made.warnings else []),
        Section("Parameters", [
            Table("Parameters of the roof", [
                "parameter", value, "unit", "95 % interval", "what the data show", "meaning",
            ], parameters),
            f"A parameter without an interval was not fitted: it keeps the site file's value. "
            f"{INTERVAL_NOTE} Intervals allow residuals within a week to depend on each other, and "
            f"do not include errors of the model itself. The crop_coefficient {CROP_NOTE}.",
        ]),
        Section("Pictures", figures),
        Section("What it rests on", [
            Table("Scores", [
                "quantity", "part",
                *(Column(f"{name}, {name_time(time)}", "", efficiency)
                  for name in ("NSE", "KGE") for time in spans),
                Column("volume error", "%", lambda share: f"{100 * share:+.1f}"),
            ], scores),
            "NSE (Nash and Sutcliffe) is 1 for a perfect simulation and 0 for one that is no "
            "better than the mean of the measurements. KGE (Kling and Gupta) is 1 for a perfect "
            "simulation, and -0.41 for the mean of the measurements. The volume error is the "
            "simulated minus the measured total, as a share of the measured total.",
        ]),
        Section("What was read", [[
            f"{record.source}: steps of {name_time(record.step_s)}, with "
            f"{np.nansum(record.rain):.4g} mm of rain", *record.contents, *made.notes,
        ]]),
        Section("How it was made", [
            describe_halves(record, made.halves)
            + " The site file follows, with every value and its interval.",
            made.site_file.splitlines(),
        ], folded=True),
    ])


# For every quantity: the title of its figure, and how many mm make one of its unit.
_QUANTITIES = {"runoff": ("Runoff", 1.0), "level": ("Level on the roof", 1000.0)}

_TIME = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
              axis=alt.Axis(tickCount=8, format="%d %b %y"))


def draw_quantity(
    quantity: str, record: StepRecord, halves: Mapping[str, Steps], simulated: Values
) -> Figure:
    """Return the figure of a quantity, measured and simulated, with the residuals."""
    title, _ = _QUANTITIES[quantity]
    days = _list_days(quantity, record, halves, simulated)
    name = f"calibration-{quantity}"
    adds_up = COMBINE[quantity] is sum_spans
    boundary = [{"t": row["t"]} for row in days if row["part"] == [*halves][1]][:1]
    caption = (
        f"Daily {'sums' if adds_up else 'means'}, and the residuals (simulated minus measured). "
        "The dashed line separates fit and validation. Times without measurements are left out."
    )
    data = alt.Chart(alt.NamedData(f"{name}-days"))
    rule = alt.Chart(alt.InlineData(boundary)).mark_rule(
        strokeDash=[4, 3], color="#555555"
    ).encode(x=alt.X("t:T", scale=alt.Scale(type="utc")))
    panels = []
    axis = f"{quantity} (mm{'/day' if adds_up else ''})"
    for chart, heading, value, field, names, label, zero in (
        (data.transform_fold([MEASURED, SIMULATED], as_=["series", "v"]), "Measured and simulated",
         "v", "series", [MEASURED, SIMULATED], axis, adds_up),
        (data, "Residuals", "error", "part", [*halves], f"error, {axis}", True),
    ):
        lines = chart.mark_line(
            clip=True, strokeWidth=1.2, interpolate="step-after"
        ).encode(
            x=_TIME, y=alt.Y(f"{value}:Q", title=label, scale=alt.Scale(zero=zero)),
        )
        panels.append(series_panel(lines, field, names, heading, [rule]))
    return Figure(name, title, caption, tuple(panels), 2, {f"{name}-days": days})


def _list_days(
    quantity: str, record: StepRecord, halves: Mapping[str, Steps], simulated: Values
) -> Rows:
    """Return daily sums or means as rows, with the residuals (simulated minus measured)."""
    rows: Rows = []
    for part, steps in halves.items():
        seconds = record.seconds[steps]
        ours, theirs = (
            (COMBINE[quantity](series[steps], seconds, DAY_S) * _QUANTITIES[quantity][1]).tolist()
            for series in (simulated, record.measured[quantity])
        )
        times = (np.unique(seconds // DAY_S) * DAY_S * 1000).tolist()
        rows += [
            {"t": time, "part": part, MEASURED: round_value(was), SIMULATED: round_value(now),
             "error": round_value(now - was)}
            for time, was, now in zip(times, theirs, ours, strict=True)
        ]
    return rows
