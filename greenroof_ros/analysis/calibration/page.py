"""The page of a calibration: a self-contained HTML file with all figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import altair as alt
import numpy as np

from greenroof_ros.analysis.calibration.fit import FILLED, Fit
from greenroof_ros.analysis.calibration.record import COMBINE, sum_spans
from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.analysis.calibration.site_file import CROP_NOTE, INTERVAL_NOTE
from greenroof_ros.analysis.calibration.step_record import (
    DAY_S,
    StepRecord,
    Steps,
    Values,
    name_time,
)
from greenroof_ros.analysis.figures import (
    Figure,
    Rows,
    make_tooltips,
    round_value,
    series_panel,
)
from greenroof_ros.analysis.report.page import make_page
from greenroof_ros.site.file import SITE_KEYS

MEASURED, SIMULATED = "measured", "simulated"


def render(
    record: StepRecord, halves: Mapping[str, Steps], fit: Fit, scores: Sequence[FitScores],
    site_file: str, spans: Mapping[str, str], warnings: Sequence[str], notes: Sequence[str],
) -> str:
    """Return the page.

    Args:
        record: the measurements in the months that are used.
        halves: the steps that were fitted, and the steps for validation.
        fit: the result of the fit.
        scores: scores of every quantity, for the fit and for the validation.
        site_file: text of the site file that was written.
        spans: time span of each half, as text.
        warnings: warnings about the record and the fit.
        notes: other findings, and changes made to the record.
    """
    known = {name: (each.unit, each.meaning) for name, each in SITE_KEYS.items()}
    known[FILLED] = (
        "1", "share of the available water capacity that is filled when the record begins"
    )
    figures = [
        draw_quantity(quantity, record, halves, getattr(fit.simulated, quantity))
        for quantity in record.measured
    ]
    return make_page(
        __package__, figures, record=record, rain=float(np.nansum(record.rain)),
        parameters=fit.parameters, known=known, scores=scores, name_time=name_time, shown=_shown,
        site_file=site_file, spans=spans, warnings=warnings, notes=notes,
        crop_note=CROP_NOTE, interval_note=INTERVAL_NOTE,
    )


def _shown(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


# For every quantity: the title of its figure, and how many mm make one of its unit.
_QUANTITIES = {"runoff": ("Runoff", 1.0), "level": ("Level on the roof", 1000.0)}


_TIME = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
              axis=alt.Axis(tickCount=8, format="%d %b %y"))
_WHEN = alt.Tooltip("t:T", title="day", timeUnit="utcyearmonthdate", format="%Y-%m-%d")


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
        (data, "Residuals", "error", "part", [*halves], f"simulated minus measured, {axis}", True),
    ):
        lines = chart.mark_line(
            clip=True, strokeWidth=1.2, interpolate="step-after", point="transparent"
        ).encode(
            x=_TIME, y=alt.Y(f"{value}:Q", title=label, scale=alt.Scale(zero=zero)),
            tooltip=make_tooltips(
                f"{field}:N", _WHEN, alt.Tooltip(f"{value}:Q", title=label, format=".4~g")
            ),
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
