"""The page of a calibration: one file with all figures that needs nothing but a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import altair as alt
import numpy as np

from greenroof_ros.calibration.fit import FILLED, Fit
from greenroof_ros.calibration.record import TOGETHER, Halves, Record, Values
from greenroof_ros.calibration.scores import DAY_S, HOUR_S, PARTS, ScoreRow, time_name
from greenroof_ros.calibration.site_file import CROP_NOTE, INTERVAL_NOTE
from greenroof_ros.common.quality import Finding, Severity
from greenroof_ros.common.versions import versions, versions_text
from greenroof_ros.model.site import site_parameters
from greenroof_ros.report.drawing import (
    COLOURS,
    Figure,
    Panel,
    Rows,
    distinct,
    hover_points,
    pointed,
    short,
)
from greenroof_ros.report.page import environment, library, payload

MEASURED, SIMULATED = "measured", "simulated"
# Points of which neither value is this share of the largest are left out of a scatter: there are
# thousands of them, all in one corner.
_SEEN = 0.01


def render(
    record: Record, halves: Halves, fit: Fit, scores: Sequence[ScoreRow], site_file: str,
    spans: Mapping[str, str], findings: Sequence[Finding],
) -> str:
    """Return the page.

    Args:
        record: what was measured in the months that count.
        halves: of it, which were fitted and judged.
        fit: the result.
        scores: of each quantity, in the fit and in the validation.
        site_file: that was written.
        spans: from when to when each part is.
        findings: what speaks against the fit, and what was found beside the roof's parameters.
    """
    known = {one.name: (one.unit, one.meaning) for one in site_parameters()}
    known[FILLED] = "1", "share of the available water on the roof when the record begins"
    figures = [
        _figure(quantity, record, halves, getattr(fit.simulated, quantity.name))
        for quantity in _QUANTITIES if quantity.name in record.measured
    ]
    return environment(__package__).get_template("page.html").render(
        record=record, rain=float(np.nansum(record.rain)), parameters=fit.parameters, known=known,
        scores=scores, figures=figures, times=list(scores[0].scores.nse), time_name=time_name,
        shown=_shown, site_file=site_file, spans=spans, crop_note=CROP_NOTE,
        warnings=[one.text for one in findings if one.severity is Severity.WARNING],
        notes=[one.text for one in findings if one.severity is Severity.NOTE],
        interval_note=INTERVAL_NOTE, versions=versions_text(versions()), library=library(),
        payload=payload(figures),
    )


def _shown(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


class _Quantity(NamedTuple):
    """How something measured is drawn."""

    name: str
    title: str
    total: bool
    """whether its steps add up, and its axis begins at 0; otherwise their mean counts"""
    factor: float

    def axis(self, over_s: int) -> str:
        """Return what an axis of its sums or means over a time (s) is called."""
        per = f"/{time_name(over_s).removeprefix('1 ')}" if self.total else ""
        return f"{self.name} (mm{per})"


_QUANTITIES = (
    _Quantity("runoff", "Runoff", True, 1.0),
    _Quantity("level", "Level on the roof", False, 1000.0),
)
_TIME = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
              axis=alt.Axis(tickCount=8, format="%d %b %y"))
_WHEN = alt.Tooltip("t:T", title="day", timeUnit="utcyearmonthdate", format="%Y-%m-%d")


def _figure(quantity: _Quantity, record: Record, halves: Halves, simulated: Values) -> Figure:
    over_s = max(HOUR_S, round(record.step_s))
    days, points = (
        _together(quantity, record, halves, simulated, time) for time in (DAY_S, over_s)
    )
    name = f"calibration-{quantity.name}"
    both = [float(row[series]) for row in points for series in (MEASURED, SIMULATED)]
    ends = (0.0 if quantity.total else min(both), max(both))
    boundary = [{"t": row["t"]} for row in days if row["part"] == PARTS[1]][:1]
    caption = (
        f"Above: {'sums' if quantity.total else 'means'} of days, and what is simulated too much "
        "of them. The dashed line parts fit and validation; what was not measured is left out. "
        f"Below: simulated over measured, each point of {time_name(over_s)}; a perfect fit lies on "
        "the line."
    )
    data = alt.Chart(alt.NamedData(f"{name}-days"))
    series = data.transform_fold([MEASURED, SIMULATED], as_=["series", "v"])
    return Figure(
        name, quantity.title, caption,
        (
            _lines(series, "v", "series", [MEASURED, SIMULATED], quantity.axis(DAY_S),
                   "Measured and simulated", boundary, zero=quantity.total),
            _lines(data, "error", "part", [*PARTS], f"too much {quantity.axis(DAY_S)}",
                   "Residuals", boundary, zero=True),
            *(_scatter(quantity, name, part, ends, over_s) for part in PARTS),
        ),
        2, {f"{name}-days": days, f"{name}-points": _seen(points)},
    )


def _together(
    quantity: _Quantity, record: Record, halves: Halves, simulated: Values, over_s: int
) -> Rows:
    """Return sums or means over a time, a row each, with what is simulated too much."""
    rows: Rows = []
    for part, steps in zip(PARTS, halves, strict=True):
        seconds = record.seconds[steps]
        ours, theirs = (
            TOGETHER[quantity.name](series[steps], seconds, over_s) * quantity.factor
            for series in (simulated, record.measured[quantity.name])
        )
        rows += [
            {"t": time, "part": part, MEASURED: short(was), SIMULATED: short(now),
             "error": short(now - was)}
            for time, was, now in zip(
                (np.unique(seconds // over_s) * over_s * 1000).tolist(), theirs.tolist(),
                ours.tolist(), strict=True,
            )
        ]
    return rows


def _seen(points: Rows) -> Rows:
    """Return the points that can be told from those in the corner of their scatter."""
    largest = {
        part: max((max(row[MEASURED], row[SIMULATED]) for row in points if row["part"] == part),
                  default=0.0)
        for part in PARTS
    }
    return [
        row for row in points if max(row[MEASURED], row[SIMULATED]) > _SEEN * largest[row["part"]]
    ]


def _lines(
    chart: alt.Chart, value: str, field: str, names: list[str], axis: str, title: str,
    boundary: Rows, *, zero: bool,
) -> Panel:
    """Return days over time, a line for each name in a field, and where the validation begins."""
    lines = chart.mark_line(clip=True, strokeWidth=1.2, interpolate="step-after").encode(
        x=_TIME, y=alt.Y(f"{value}:Q", title=axis, scale=alt.Scale(zero=zero)),
        tooltip=pointed(f"{field}:N", _WHEN, alt.Tooltip(f"{value}:Q", title=axis, format=".4~g")),
        **distinct(field, names, ""),
    )
    rule = alt.Chart(alt.InlineData(boundary)).mark_rule(
        strokeDash=[4, 3], color="#555555"
    ).encode(x=alt.X("t:T", scale=alt.Scale(type="utc")))
    return Panel(
        alt.layer(*([rule] if boundary else []), lines), title, hover=hover_points(lines),
        toggle=field, zoom=True,
    )


def _scatter(
    quantity: _Quantity, name: str, part: str, ends: tuple[float, float], over_s: int
) -> Panel:
    """Return simulated over measured of one part, and the line on which a perfect fit lies."""
    scale = alt.Scale(domain=ends, nice=True)
    line = alt.Chart(alt.InlineData([{"v": end} for end in ends])).mark_line(
        color="#888888", strokeWidth=1
    ).encode(x=alt.X("v:Q", scale=scale), y=alt.Y("v:Q", scale=scale))
    points = alt.Chart(alt.NamedData(f"{name}-points")).transform_filter(
        alt.datum.part == part
    ).mark_point(
        size=14, filled=True, opacity=0.5, color=COLOURS[PARTS.index(part)]
    ).encode(
        x=alt.X(f"{MEASURED}:Q", title=f"measured {quantity.axis(over_s)}", scale=scale),
        y=alt.Y(f"{SIMULATED}:Q", title=f"simulated {quantity.axis(over_s)}", scale=scale),
        tooltip=pointed(f"{MEASURED}:Q", f"{SIMULATED}:Q"),
    )
    return Panel(alt.layer(line, points), f"Simulated over measured: {part}", height=300)
