"""The page of a calibration: one file with all figures that needs nothing but a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import altair as alt
import numpy as np

from greenroof_ros.analysis.calibration.fit import FILLED, Fit
from greenroof_ros.analysis.calibration.record import (
    COMBINE,
    DAY_S,
    HOUR_S,
    RoofRecord,
    Steps,
    Values,
    sums,
    time_name,
)
from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.analysis.calibration.site_file import CROP_NOTE, INTERVAL_NOTE
from greenroof_ros.analysis.report.drawing import (
    COLOURS,
    Figure,
    Panel,
    Rows,
    pointed,
    reference_line,
    series_panel,
    short,
)
from greenroof_ros.analysis.report.page import page_of
from greenroof_ros.model.site import site_parameters

MEASURED, SIMULATED = "measured", "simulated"
# A scatter leaves out points with both values below this share of the largest: there are thousands
# of them, all in one corner.
_MIN_SHOWN = 0.01


def render(
    record: RoofRecord, halves: Mapping[str, Steps], fit: Fit, scores: Sequence[FitScores],
    site_file: str, spans: Mapping[str, str], warnings: Sequence[str], notes: Sequence[str],
) -> str:
    """Return the page.

    Args:
        record: the measurements in the months that count.
        halves: the steps that were fitted, and the steps for validation.
        fit: the result.
        scores: of each quantity, in the fit and in the validation.
        site_file: text of the site file that was written.
        spans: time span of each half, as text.
        warnings: objections to the record and the fit.
        notes: what else was found or changed.
    """
    known = {parameter.name: (parameter.unit, parameter.meaning) for parameter in site_parameters()}
    known[FILLED] = "1", "share of the available water on the roof when the record begins"
    figures = [
        _figure(quantity, record, halves, getattr(fit.simulated, quantity))
        for quantity in record.measured
    ]
    return page_of(
        __package__, figures, record=record, rain=float(np.nansum(record.rain)),
        parameters=fit.parameters, known=known, scores=scores, time_name=time_name, shown=_shown,
        site_file=site_file, spans=spans, warnings=warnings, notes=notes,
        crop_note=CROP_NOTE, interval_note=INTERVAL_NOTE,
    )


def _shown(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


# For each quantity: title of its figure, and how many mm make one of its unit.
_QUANTITIES = {"runoff": ("Runoff", 1.0), "level": ("Level on the roof", 1000.0)}


def _axis(quantity: str, span_s: int) -> str:
    """Return the title of an axis of sums or means over a time (s)."""
    per = f"/{time_name(span_s).removeprefix('1 ')}" if COMBINE[quantity] is sums else ""
    return f"{quantity} (mm{per})"


_TIME = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
              axis=alt.Axis(tickCount=8, format="%d %b %y"))
_WHEN = alt.Tooltip("t:T", title="day", timeUnit="utcyearmonthdate", format="%Y-%m-%d")


def _figure(
    quantity: str, record: RoofRecord, halves: Mapping[str, Steps], simulated: Values
) -> Figure:
    span_s = max(HOUR_S, round(record.step_s))
    days, points = (
        _combined(quantity, record, halves, simulated, *span)
        for span in ((DAY_S, 0.0), (span_s, _MIN_SHOWN))
    )
    name = f"calibration-{quantity}"
    adds_up = COMBINE[quantity] is sums
    values = [float(row[series]) for row in points for series in (MEASURED, SIMULATED)]
    ends = (0.0 if adds_up else min(values), max(values))
    boundary = [{"t": row["t"]} for row in days if row["part"] == [*halves][1]][:1]
    caption = (
        f"Above: {'sums' if adds_up else 'means'} of days, and the residuals (simulated less "
        "measured). The dashed line separates fit and validation; what was not measured is left "
        f"out. Below: simulated over measured, each point of {time_name(span_s)}; a perfect fit "
        "lies on the line."
    )
    data = alt.Chart(alt.NamedData(f"{name}-days"))
    rule = alt.Chart(alt.InlineData(boundary)).mark_rule(
        strokeDash=[4, 3], color="#555555"
    ).encode(x=alt.X("t:T", scale=alt.Scale(type="utc")))
    panels = []
    axis = _axis(quantity, DAY_S)
    for chart, title, value, field, names, label, zero in (
        (data.transform_fold([MEASURED, SIMULATED], as_=["series", "v"]), "Measured and simulated",
         "v", "series", [MEASURED, SIMULATED], axis, adds_up),
        (data, "Residuals", "error", "part", [*halves], f"simulated less measured, {axis}", True),
    ):
        lines = chart.mark_line(clip=True, strokeWidth=1.2, interpolate="step-after").encode(
            x=_TIME, y=alt.Y(f"{value}:Q", title=label, scale=alt.Scale(zero=zero)),
            tooltip=pointed(
                f"{field}:N", _WHEN, alt.Tooltip(f"{value}:Q", title=label, format=".4~g")
            ),
        )
        panels.append(series_panel(lines, field, names, title, below=[rule], zoom=True))
    panels += [
        _scatter(quantity, name, part, colour, ends, span_s)
        for part, colour in zip(halves, COLOURS, strict=False)
    ]
    return Figure(
        name, _QUANTITIES[quantity][0], caption, tuple(panels), 2,
        {f"{name}-days": days, f"{name}-points": points},
    )


def _combined(
    quantity: str, record: RoofRecord, halves: Mapping[str, Steps], simulated: Values, span_s: int,
    minimum: float,
) -> Rows:
    """Return sums or means over a time as rows, with the residual: simulated less measured.

    Pairs with both values at most ``minimum`` of the largest in their half are left out.
    """
    rows: Rows = []
    for part, steps in halves.items():
        seconds = record.seconds[steps]
        ours, theirs = (
            COMBINE[quantity](series[steps], seconds, span_s) * _QUANTITIES[quantity][1]
            for series in (simulated, record.measured[quantity])
        )
        times = np.unique(seconds // span_s) * span_s * 1000
        larger = np.maximum(ours, theirs)
        for place in np.flatnonzero((larger > minimum * larger.max()) | (minimum == 0)):
            was, now = theirs[place], ours[place]
            rows.append({
                "t": int(times[place]), "part": part, MEASURED: short(was), SIMULATED: short(now),
                "error": short(now - was),
            })
    return rows


def _scatter(
    quantity: str, name: str, part: str, colour: str, ends: tuple[float, float], span_s: int
) -> Panel:
    """Return simulated over measured values of one half, with the line of a perfect fit."""
    scale = alt.Scale(domain=ends, nice=True)
    line = reference_line(
        [{"v": end} for end in ends], alt.X("v:Q", scale=scale), alt.Y("v:Q", scale=scale)
    )
    points = alt.Chart(alt.NamedData(f"{name}-points")).transform_filter(
        alt.datum.part == part
    ).mark_point(size=14, filled=True, opacity=0.5, color=colour).encode(
        x=alt.X(f"{MEASURED}:Q", title=f"measured {_axis(quantity, span_s)}", scale=scale),
        y=alt.Y(f"{SIMULATED}:Q", title=f"simulated {_axis(quantity, span_s)}", scale=scale),
        tooltip=pointed(f"{MEASURED}:Q", f"{SIMULATED}:Q"),
    )
    return Panel(alt.layer(line, points), f"Simulated over measured: {part}", height=300)
