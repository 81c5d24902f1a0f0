"""The page of a calibration: a self-contained HTML file with all figures."""

from __future__ import annotations

import altair as alt
import numpy as np

from greenroof_ros.analysis.calibration.record import DAY_S, combine, name_time
from greenroof_ros.analysis.calibration.result import (
    INTERVAL_NOTE,
    Calibration,
    describe_scores,
)
from greenroof_ros.analysis.figures import Figure, round_value, series_panel
from greenroof_ros.analysis.page import Section, make_page
from greenroof_ros.analysis.tables import Column, Table
from greenroof_ros.site.file import SITE_KEYS

MEASURED, SIMULATED = "measured", "simulated"


def render(made: Calibration) -> str:
    """Return the page of a calibration."""
    record = made.record
    answer = " ".join([
        *(made.warnings or [
            describe_scores(row) for row in made.scores if row.part == "validation"
        ]),
        "(The validation period was not used for the fit. An NSE of 1 is perfect; 0 is no better "
        "than the mean of the measurements.)",
    ])
    parameters = [
        [one.name, one.value, SITE_KEYS[one.name].unit, one.interval or "not fitted", one.reason,
         SITE_KEYS[one.name].meaning] for one in made.fit.parameters
    ]
    scores = [
        [row.quantity, row.part, *row.nse.values(), row.volume_error] for row in made.scores
    ]
    return make_page("Green roof: calibration", answer, [
        Section("Parameters", [
            Table("Parameters of the roof", [
                "parameter", Column("value", "", "{:.4g}".format), "unit", "95 % interval",
                "what the data show", "meaning",
            ], parameters),
            f"A parameter without an interval was not fitted: it keeps the site file's value. "
            f"{INTERVAL_NOTE} Intervals allow residuals within a week to depend on each other, and "
            f"do not include errors of the model itself.",
        ]),
        Section("Pictures", [draw_quantity(quantity, made) for quantity in record.measured]),
        Section("What it rests on", [
            Table("Scores", [
                "quantity", "part",
                *(Column(f"NSE, {name_time(time)}", "", "{:.2f}".format)
                  for time in made.scores[0].nse),
                Column("volume error", "%", lambda share: f"{100 * share:+.1f}"),
            ], scores),
            "NSE (Nash and Sutcliffe) is 1 for a perfect simulation and 0 for one that is no "
            "better than the mean of the measurements. The volume error is the simulated minus the "
            "measured total, as a share of the measured total.",
        ]),
        Section("What was read", [[
            f"{record.source}: steps of {name_time(record.step_s)}, with "
            f"{np.nansum(record.rain):.4g} mm of rain", *made.notes,
        ]]),
        Section("How it was made", [made.site_file.splitlines()], folded=True),
    ])


def draw_quantity(quantity: str, made: Calibration) -> Figure:
    """Return the figure of a quantity: daily values, measured and simulated, and the residuals."""
    record, sums, name = made.record, quantity == "runoff", f"calibration-{quantity}"
    compared = made.halves["fit"] | made.halves["validation"]
    parts, begin = [*made.halves], record.seconds[np.argmax(made.halves["validation"])]
    seconds = record.seconds[compared]
    was, now = (
        (1.0 if sums else 1000.0) * combine(quantity, series[compared], seconds, DAY_S)
        for series in (record.measured[quantity], getattr(made.fit.simulated, quantity))
    )
    days = np.unique(seconds // DAY_S) * DAY_S
    rows = [
        {"t": 1000 * day, "part": parts[int(day >= begin)], MEASURED: round_value(ours),
         SIMULATED: round_value(theirs), "error": round_value(theirs - ours)}
        for day, ours, theirs in zip(days.tolist(), was.tolist(), now.tolist(), strict=True)
    ]
    time = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
                 axis=alt.Axis(tickCount=8, format="%d %b %y"))
    data = alt.Chart(alt.NamedData(f"{name}-days"))
    unit = f"{quantity} (mm{'/day' if sums else ''})"
    panels = [
        series_panel(
            chart.mark_line(clip=True, strokeWidth=1.2, interpolate="step-after").encode(
                x=time, y=alt.Y(f"{value}:Q", title=label, scale=alt.Scale(zero=zero)),
            ), field, names, heading, [],
        )
        for chart, heading, value, field, names, label, zero in (
            (data.transform_fold([MEASURED, SIMULATED], as_=["series", "v"]),
             "Measured and simulated", "v", "series", [MEASURED, SIMULATED], unit, sums),
            (data, "Residuals", "error", "part", parts, f"error, {unit}", True),
        )
    ]
    caption = (
        f"Daily {'sums' if sums else 'means'}, and the residuals (simulated minus measured). "
        "Times without measurements are left out."
    )
    return Figure(
        name, quantity.capitalize() if sums else "Level on the roof", caption, tuple(panels), 2,
        {f"{name}-days": rows},
    )
