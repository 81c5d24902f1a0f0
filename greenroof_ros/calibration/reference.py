"""Reference evapotranspiration of a record: its own column, or by the temperatures of its days."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record, Steps, Values
from greenroof_ros.calibration.scores import DAY_S, HOUR_S, time_name
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import Days, hargreaves, over_the_day

# Of a day, so that its extremes are among them; and days without that take those beside them (d).
_ENOUGH, _LONGEST_GAP = 0.75, 3
# Temperatures further apart (s) miss a day's extremes: those three hours apart see 0.92 of a sine's
# range at least, those six hours apart 0.71.
_LONGEST_STEP_S = 3 * HOUR_S


def through_short_gaps(
    record: Record, values: Values, times: Sequence[datetime], lines: Sequence[int],
    slots: NDArray[np.int64], *, counts: Steps,
) -> Values:
    """Return reference evapotranspiration that is there in every step (mm), shape (steps,).

    A roof dries while its sensors fail, too: a gap of an hour at most takes the straight line
    between the steps beside it, and a longer one is refused. Rows' times measure a gap, not its
    steps: where a clock was set on, a step can be without a row though hardly any time is missing.

    Args:
        record: its times, and the column's name.
        values: of each step (mm), NaN where there is none.
        times: of the rows.
        lines: of the rows in the file.
        slots: step of each row.
        counts: whether a step is fitted or judged, shape (steps,); a gap in which none is may be of
            any length.

    Raises:
        ConfigurationError: another gap is longer, or it is 0 throughout.
    """
    if not np.any(values > 0):
        raise ConfigurationError(
            "is 0 throughout: it must be there, or nothing of how the roof dries can be fitted",
            file=record.source, key=record.reference_column,
        )
    missing = np.isnan(values)
    since = np.array([time.timestamp() for time in times])
    # Before the first row and after the last as if there were one more, so that gaps there count.
    since = np.concatenate(([since[0] - record.step_s], since, [since[-1] + record.step_s]))
    for low, high in gaps(missing):
        row, after = (int(one) for one in np.searchsorted(slots, (low, high)))
        gap_s = float(since[after + 1] - since[row]) - record.step_s
        if gap_s > HOUR_S and counts[low:high].any():
            what = "is empty" if slots[row] == low else f"there is no row of {record.times[low]}"
            raise ConfigurationError(
                f"{what}, and none has a value for {time_name(round(gap_s))}: it may be missing "
                "for an hour at most, as a roof dries in gaps of the sensors, too; write a day's "
                "value into each of its rows, and add missing rows with time and this value, "
                "their other cells empty", file=record.source, line=lines[row],
                key=record.reference_column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def reference_from_temperatures(
    record: Record, site: Site, days: Days, temperatures: dict[str, Values], *,
    counts: Steps,
) -> Values:
    """Return Hargreaves' reference evapotranspiration of each step (mm), shape (steps,).

    A temperature is of its row's day, not of its step's: the step that a row of 0:00 lies in can
    have begun the day before, where the logger's clock was set. A step has the evapotranspiration
    of the day that it begins in on the record's own clock. A day without temperatures, or with
    those of part of it, takes the line between its neighbours', where it counts over three days at
    most.

    Args:
        record: its times.
        site: its place.
        days: of each row, on the clock of its time, shape (rows,).
        temperatures: ``temperature``, or ``least temperature`` and ``greatest temperature`` in any
            row of their day (degC), NaN where a row has none, shape (rows,).
        counts: whether a step is fitted or judged, shape (steps,).

    Raises:
        ConfigurationError: the site has no place, temperatures are too far apart to show a day's
            extremes, or more days in a row have none.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError(
            "evapotranspiration from temperatures needs latitude and longitude in the site file "
            "(see config/site.yaml)"
        )
    offset = record.start.utcoffset()
    assert offset is not None
    dates, day = np.unique(days, return_inverse=True)
    if "temperature" in temperatures:
        if record.step_s > _LONGEST_STEP_S:
            raise ConfigurationError(
                f"its rows are {time_name(round(record.step_s))} apart, and show a day's extremes "
                "where they are three hours apart at most; write columns 'least temperature "
                "[degC]' and 'greatest temperature [degC]' instead", file=record.source,
                key="temperature",
            )
        enough = _ENOUGH * DAY_S / record.step_s
        least, greatest = _extremes(temperatures["temperature"], day, len(dates), enough)
    else:
        least, _ = _extremes(temperatures["least temperature"], day, len(dates), 1)
        _, greatest = _extremes(temperatures["greatest temperature"], day, len(dates), 1)
    crossed = np.flatnonzero(least > greatest)
    if len(crossed):
        raise ConfigurationError(
            f"on {dates[crossed[0]]} the least temperature, {least[crossed[0]]:g} degC, is above "
            f"the greatest, {greatest[crossed[0]]:g} degC", file=record.source,
        )
    seconds = record.seconds
    numbers, day_of_step = np.unique(seconds // DAY_S, return_inverse=True)
    of_steps = numbers.astype("datetime64[D]")
    daily = hargreaves(
        site.latitude, of_steps,
        *(
            _filled(record, of_steps, dates, one, np.unique(day_of_step[counts]))
            for one in (least, greatest)
        ),
    )
    east = site.longitude - offset.total_seconds() / 240
    return over_the_day(daily, site.latitude, seconds, day_of_step, record.step_s, east)


def _extremes(
    values: Values, day: NDArray[np.int64], days: int, enough: float
) -> tuple[Values, Values]:
    """Return least and greatest value of each day, NaN where there are too few."""
    there = ~np.isnan(values)
    least, greatest = np.full(days, np.inf), np.full(days, -np.inf)
    np.minimum.at(least, day[there], values[there])
    np.maximum.at(greatest, day[there], values[there])
    few = np.bincount(day[there], minlength=days) < enough
    least[few], greatest[few] = np.nan, np.nan
    return least, greatest


def _filled(
    record: Record, days: Days, dates: Days, values: Values, counts: NDArray[np.int64]
) -> Values:
    """Return the value of each day; of one without, that between its neighbours.

    Args:
        record: for messages.
        days: wanted.
        dates: of the values.
        values: NaN where there is none.
        counts: index of each day that is fitted or judged, and must not be far from a value.

    Raises:
        ConfigurationError: one is.
    """
    there = ~np.isnan(values)
    if not there.any():
        raise ConfigurationError("no day has its temperatures", file=record.source)
    number, known = days.astype(np.int64), dates[there].astype(np.int64)
    nearest = np.abs(number[counts, None] - known[None, :]).min(axis=1)
    if nearest.max() > _LONGEST_GAP:
        worst = days[counts][int(np.argmax(nearest > _LONGEST_GAP))]
        raise ConfigurationError(
            f"has no temperature within {_LONGEST_GAP} days of {worst}, from which "
            "evapotranspiration is computed; add a row of each day without, its temperatures in it "
            "and the other cells empty, or leave its month out with --months", file=record.source,
        )
    return np.interp(number, known, values[there])
