"""The page of a calibration: a self-contained HTML file with all figures."""

from __future__ import annotations

import altair as alt
import numpy as np
import polars as pl

from greenroof_ros.analysis.calibration.record import DAY_S, combine
from greenroof_ros.analysis.calibration.result import INTERVAL_NOTE, Calibration, describe_scores
from greenroof_ros.analysis.figures import Figure, Panel, distinguish_series
from greenroof_ros.analysis.page import Section, make_page
from greenroof_ros.analysis.tables import Column, Table
from greenroof_ros.base.times import duration
from greenroof_ros.site.file import SITE_KEYS

MEASURED, SIMULATED = "measured", "simulated"


def render(made: Calibration) -> str:
    """Return the page of a calibration."""
    answer = " ".join([
        *(describe_scores(row) for row in made.fit.scores if row.part == "validation"),
        "(The validation period was not used for the fit. An NSE of 1 is perfect; 0 is no better "
        "than the mean of the measurements.)",
    ])
    parameters = [
        [one.name, one.value, SITE_KEYS[one.name].unit, one.interval or "not fitted", one.reason,
         SITE_KEYS[one.name].meaning] for one in made.fit.parameters
    ]
    scores = [
        [row.quantity, row.part, *row.nse.values(), row.volume_error] for row in made.fit.scores
    ]
    return make_page("Green roof: calibration", answer, [
        Section("Parameters", [
            Table("Parameters of the roof", [
                "parameter", Column("value", "", "{:.4g}".format), "unit", "95 % interval",
                "what the data show", "meaning",
            ], parameters),
            f"{INTERVAL_NOTE} Intervals allow residuals within a week to depend on each other, and "
            "do not include errors of the model itself.",
        ]),
        Section("Pictures", [draw_quantity(quantity, made) for quantity in made.record.measured]),
        Section("What it rests on", [
            Table("Scores", [
                "quantity", "part",
                *(Column(f"NSE, {duration(time)}", "", "{:.2f}".format)
                  for time in made.fit.scores[0].nse),
                Column("volume error", "%", lambda share: f"{100 * share:+.1f}"),
            ], scores),
            "NSE is the Nash-Sutcliffe efficiency of sums or means over these time spans. The "
            "volume error is the simulated minus the measured total, as a share of the latter.",
        ]),
        Section("What was read", [[str(made.record.source), *made.notes]]),
        Section("How it was made", [made.site_file.splitlines()], folded=True),
    ])


def draw_quantity(quantity: str, made: Calibration) -> Figure:
    """Return the figure of a quantity: daily values, measured and simulated, and the residuals."""
    record, sums, name = made.record, quantity == "runoff", f"calibration-{quantity}"
    compared = made.halves["fit"] | made.halves["validation"]
    parts, begin = [*made.halves], record.seconds[np.argmax(made.halves["validation"])]
    seconds = record.seconds[compared]
    was, now = (
        (1.0 if sums else 1000.0) * combine(quantity, each[compared], seconds, DAY_S)
        for each in (record.measured[quantity], made.fit.simulated[quantity])
    )
    days = np.unique(seconds // DAY_S) * DAY_S
    rows = pl.DataFrame({
        "t": 1000 * days, "part": np.where(days >= begin, parts[1], parts[0]), MEASURED: was,
        SIMULATED: now, "error": now - was,
    }).to_dicts()
    time = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
                 axis=alt.Axis(tickCount=8, format="%d %b %y"))
    data = alt.Chart(alt.NamedData(f"{name}-days"))
    panels = [
        Panel(
            chart.mark_line(clip=True, strokeWidth=1.2, interpolate="step-after").encode(
                x=time, y=alt.Y(f"{value}:Q", title=f"{heading} {quantity} (mm)"),
                **distinguish_series(field, names),
            ), f"{heading.capitalize()} {quantity}",
        )
        for chart, heading, value, field, names in (
            (data.transform_fold([MEASURED, SIMULATED], as_=["series", "v"]), "daily", "v",
             "series", [MEASURED, SIMULATED]),
            (data, "error of the daily", "error", "part", parts),
        )
    ]
    caption = f"Daily {'sums' if sums else 'means'}; the error is simulated minus measured."
    return Figure(name, quantity.capitalize(), caption, tuple(panels), 2, {f"{name}-days": rows})
