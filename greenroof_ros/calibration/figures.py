"""The figures of a calibration: measured and simulated, residuals, and each over the other."""

from __future__ import annotations

from typing import NamedTuple

import altair as alt
import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.fit import Fit
from greenroof_ros.calibration.halves import Halves
from greenroof_ros.calibration.record import TOGETHER, Record, Values
from greenroof_ros.calibration.scores import DAY_S, HOUR_S, time_name
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

MEASURED, SIMULATED = "measured", "simulated"
FITTED, VALIDATED = "fit", "validation"
# Points of which neither value is this share of the largest are left out of a scatter: there are
# thousands of them, all in one corner.
_SEEN = 0.01


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


def make_figures(record: Record, halves: Halves, fit: Fit) -> list[Figure]:
    """Return the figures of what was measured, in the order of the page."""
    figures = []
    for quantity in _QUANTITIES:
        if quantity.name in record.measured:
            measured = record.measured[quantity.name] * quantity.factor
            simulated = getattr(fit.simulated, quantity.name) * quantity.factor
            figures.append(_figure(quantity, record, halves, measured, simulated))
    return figures


def _figure(
    quantity: _Quantity, record: Record, halves: Halves, measured: Values, simulated: Values
) -> Figure:
    parts = {FITTED: halves.earlier, VALIDATED: halves.later}
    days = {
        part: _sums(quantity, record, steps, measured, simulated, DAY_S)
        for part, steps in parts.items()
    }
    over_s = max(HOUR_S, round(record.step_s))
    pairs = {
        part: _sums(quantity, record, steps, measured, simulated, over_s)
        for part, steps in parts.items()
    }
    name = f"calibration-{quantity.name}"
    boundary = float(days[VALIDATED].times[0]) * 1000 if len(days[VALIDATED].times) else None
    caption = (
        f"Above: {'sums' if quantity.total else 'means'} of days, and what is simulated too much "
        "of them. The dashed line parts fit and validation; what was not measured is left out. "
        f"Below: simulated over measured, each point of {time_name(over_s)}; a perfect fit lies on "
        "the line."
    )
    return Figure(
        name, quantity.title, caption,
        (
            _over_time(quantity, name, boundary), _residuals(quantity, name, boundary),
            *(_scatter(quantity, name, part, pairs, over_s) for part in parts),
        ),
        2,
        {
            f"{name}-days": _series(days),
            f"{name}-residuals": _errors(days),
            **{f"{name}-{part}": _points(pairs[part]) for part in parts},
        },
    )


class _Sums(NamedTuple):
    times: NDArray[np.int64]
    measured: Values
    simulated: Values


def _sums(
    quantity: _Quantity, record: Record, steps: NDArray[np.bool_], measured: Values,
    simulated: Values, over_s: int,
) -> _Sums:
    seconds = record.seconds[steps]
    together = TOGETHER[quantity.name]
    return _Sums(
        np.unique(seconds // over_s) * over_s,
        together(measured[steps], seconds, over_s),
        together(simulated[steps], seconds, over_s),
    )


def _series(days: dict[str, _Sums]) -> Rows:
    return [
        {"t": int(time) * 1000, "series": series, "part": part, "v": short(float(value))}
        for part, one in days.items()
        for series, values in ((MEASURED, one.measured), (SIMULATED, one.simulated))
        for time, value in zip(one.times, values, strict=True)
    ]


def _errors(days: dict[str, _Sums]) -> Rows:
    return [
        {"t": int(time) * 1000, "part": part, "v": short(float(value))}
        for part, one in days.items()
        for time, value in zip(one.times, one.simulated - one.measured, strict=True)
    ]


def _points(pairs: _Sums) -> Rows:
    largest = max(float(np.max(pairs.measured, initial=0.0)),
                  float(np.max(pairs.simulated, initial=0.0)))
    seen = np.maximum(pairs.measured, pairs.simulated) > _SEEN * largest
    return [
        {"m": short(float(one)), "s": short(float(other))}
        for one, other in zip(pairs.measured[seen], pairs.simulated[seen], strict=True)
    ]


_TIME = alt.X("t:T", title=None, scale=alt.Scale(type="utc"),
              axis=alt.Axis(tickCount=8, format="%d %b %y"))
_WHEN = alt.Tooltip("t:T", title="day", timeUnit="utcyearmonthdate", format="%Y-%m-%d")


def _boundary(at: float | None) -> list[alt.Chart]:
    if at is None:
        return []
    return [
        alt.Chart(alt.InlineData([{"t": at}])).mark_rule(strokeDash=[4, 3], color="#555555")
        .encode(x=alt.X("t:T", scale=alt.Scale(type="utc")))
    ]


def _over_time(quantity: _Quantity, name: str, boundary: float | None) -> Panel:
    lines = alt.Chart(alt.NamedData(f"{name}-days")).mark_line(
        clip=True, strokeWidth=1.2, interpolate="step-after"
    ).encode(
        x=_TIME, y=alt.Y("v:Q", title=quantity.axis(DAY_S), scale=alt.Scale(zero=quantity.total)),
        tooltip=pointed(
            "series:N", _WHEN, alt.Tooltip("v:Q", title=quantity.axis(DAY_S), format=".4~g")
        ),
        **distinct("series", [MEASURED, SIMULATED], ""),
    )
    return Panel(
        alt.layer(*_boundary(boundary), lines), "Measured and simulated",
        hover=hover_points(lines), toggle="series", zoom=True,
    )


def _residuals(quantity: _Quantity, name: str, boundary: float | None) -> Panel:
    bars = alt.Chart(alt.NamedData(f"{name}-residuals")).mark_line(
        clip=True, strokeWidth=1.2, interpolate="step-after"
    ).encode(
        x=_TIME, y=alt.Y("v:Q", title=f"too much {quantity.axis(DAY_S)}"),
        tooltip=pointed("part:N", _WHEN, alt.Tooltip("v:Q", title="too much", format=".4~g")),
        **distinct("part", [FITTED, VALIDATED], ""),
    )
    return Panel(
        alt.layer(*_boundary(boundary), bars), "Residuals", hover=hover_points(bars),
        toggle="part", zoom=True,
    )


def _scatter(
    quantity: _Quantity, name: str, part: str, pairs: dict[str, _Sums], over_s: int
) -> Panel:
    both = [series for one in pairs.values() for series in (one.measured, one.simulated)]
    low = 0.0 if quantity.total else min(float(np.min(one, initial=np.inf)) for one in both)
    high = max(float(np.max(one, initial=0.0)) for one in both)
    scale = alt.Scale(domain=[low, high], nice=True)
    line = alt.Chart(alt.InlineData([{"v": low}, {"v": high}])).mark_line(
        color="#888888", strokeWidth=1
    ).encode(x=alt.X("v:Q", scale=scale), y=alt.Y("v:Q", scale=scale))
    points = alt.Chart(alt.NamedData(f"{name}-{part}")).mark_point(
        size=14, filled=True, opacity=0.5, color=COLOURS[part == VALIDATED]
    ).encode(
        x=alt.X("m:Q", title=f"measured {quantity.axis(over_s)}", scale=scale),
        y=alt.Y("s:Q", title=f"simulated {quantity.axis(over_s)}", scale=scale),
        tooltip=[alt.Tooltip("m:Q", title=MEASURED), alt.Tooltip("s:Q", title=SIMULATED)],
    )
    return Panel(alt.layer(line, points), f"Simulated over measured: {part}", height=300)
