"""Roof records for a fit, read from this project's CSV format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.record import select_months
from greenroof_ros.analysis.calibration.step_record import (
    DAY_S,
    HOUR_S,
    StepRecord,
    Steps,
    Values,
    name_time,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.site.site import Site
from greenroof_ros.weather.description import END
from greenroof_ros.weather.evapotranspiration import (
    HARGREAVES,
    check_place,
    find_extremes,
    spread_hargreaves,
)
from greenroof_ros.weather.quantities import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    ROOF,
    TEMPERATURE,
    find_unit,
)
from greenroof_ros.weather.read import expand
from greenroof_ros.weather.records import describe_rows, find_gaps, make_hours
from greenroof_ros.weather.summary import as_lines, summarize
from greenroof_ros.weather.table import Rows, read_rows

_WANTED = (PRECIPITATION, EVAPOTRANSPIRATION, TEMPERATURE, *ROOF)
_LEVELS = "level", "cistern level"
_EXTREMES = "minimum temperature", "maximum temperature"
_MIN_ROWS = 100
# Temperatures further apart than this (s) miss a day's extremes: three hours apart they show at
# least 0.92 of a sine's range, six hours apart 0.71.
_MAX_STEP_S = 3 * HOUR_S


def read_csv_record(file: Path, site: Site, months: str | None = None) -> StepRecord:
    """Read a measured record from CSV; see :func:`greenroof_ros.weather.table.read_rows`.

    Each row covers the step that begins at the time given (or, with ``rows: end``, ends at it);
    levels are measured at that time. Rows are no more than a day apart. Rain, ``level`` or
    ``runoff``, and evapotranspiration are required. Evapotranspiration is taken from the column
    ``reference evapotranspiration``, with gaps of no more than an hour. Alternatively, it is
    computed with Hargreaves' equation from ``temperature``, or from ``minimum temperature`` and
    ``maximum temperature`` in any row of the day. Pumped water is taken from the column ``pumped``,
    or is computed from ``pump state`` (share of the maximum flow) and ``cistern level``; without
    these columns it is 0.

    Args:
        file: the record, or a description of it.
        site: site with its location, clock and pumps.
        months: months to use, such as ``4-10``. In other months, evapotranspiration may have
            longer gaps, which are interpolated linearly.

    Raises:
        ConfigurationError: if the file breaks a rule; the message names the line, the column and
            the value.
    """
    (file, described), *more = expand([file])
    if more:
        raise ConfigurationError("must be a single record", file=more[0][0])
    rows = read_rows(file, site, _WANTED, described)
    columns, measured = rows.columns, rows.method == "reference"
    for there, message in (
        (PRECIPITATION in columns, "there must be a column 'rain [mm]'"),
        ("runoff" in columns or "level" in columns,
         "there must be a column 'runoff [mm]' or 'level [m]'"),
        (measured or TEMPERATURE in columns or columns.keys() >= {*_EXTREMES},
         "there must be a column 'reference evapotranspiration [mm]', 'temperature [degC]', or "
         "both 'minimum temperature [degC]' and 'maximum temperature [degC]'"),
        ("pump state" not in columns or "cistern level" in columns,
         "with 'pump state' there must be a column 'cistern level [m]', on which the pumps' flow "
         "depends; alternatively, use 'pumped [l]'"),
    ):
        if not there:
            raise rows.table.refuse(message)
    step_s, count = rows.step_s, len(rows.steps)
    if count < _MIN_ROWS:
        raise ConfigurationError(
            f"has {count} rows; a record must have at least {_MIN_ROWS}", file=file
        )
    # A roof drains within hours, so longer sums show no more than the rain does.
    if step_s > DAY_S:
        raise rows.table.refuse(
            f"the rows are {name_time(step_s)} apart; they must be no more than a day apart"
        )
    step_h, steps = step_s / HOUR_S, int(rows.steps[-1]) + 1
    series = {}
    for quantity, values in rows.values.items():
        series[quantity] = np.full(steps, np.nan)
        series[quantity][rows.steps] = values
        if rows.described.rows == END and quantity in _LEVELS:
            series[quantity] = np.append(np.nan, series[quantity][:-1])
    for quantity, hours in (
        (PRECIPITATION, 1), ("runoff", 1), ("pumped", 1), (EVAPOTRANSPIRATION, 24),
    ):
        if quantity in series:  # mm per step
            series[quantity] = series[quantity] * step_h / hours
    late = round(rows.described.rain_late / step_h)
    rain = np.append(series[PRECIPITATION][late:], np.full(late, np.nan))
    last_decimal = 0.0
    if "runoff" in columns:
        per_ours = find_unit("runoff", columns["runoff"][1], step_h, site.a2).per_ours
        last_decimal = _find_last_decimal(rows.values["runoff"] * per_ours) / per_ours * step_h
    record = StepRecord(
        source=file, start=rows.first, step_s=step_s, rain=rain, reference=np.zeros(steps),
        pumped=_compute_pumped(series, site, step_s), runoff=series.get("runoff"),
        level=series.get("level"), last_decimal=last_decimal,
        reference_column=columns[EVAPOTRANSPIRATION][0] if measured else "",
        contents=_show(rows, site),
    )
    counts = select_months(record, months)
    if measured:
        reference = _bridge_short_gaps(record, series[EVAPOTRANSPIRATION], counts)
    else:
        reference = _compute_from_temperatures(record, site, series, counts)
    return replace(record, reference=reference)


def _show(rows: Rows, site: Site) -> tuple[str, ...]:
    """Return what the record contains; of rows longer than an hour, only how they were read."""
    if rows.step_s > HOUR_S:
        return (describe_rows(rows),)
    return tuple(as_lines(summarize(make_hours([rows]), site)))


def _find_last_decimal(values: Values) -> float:
    """Return the place value of the last decimal digit in the values, at least 1e-12."""
    there = values[~np.isnan(values)]
    places = 0
    while places < 12 and not np.allclose(np.round(there, places), there, rtol=1e-9, atol=0.0):
        places += 1
    return float(10.0**-places)


def _compute_pumped(series: Mapping[str, Values], site: Site, step_s: float) -> Values:
    """Return the water pumped onto the roof (mm per step), NaN if unknown.

    While the pumps are stopped, the cistern's level does not matter.
    """
    if "pumped" in series or "pump state" not in series:
        return series.get("pumped", np.zeros(len(series[PRECIPITATION])))
    levels, state = series["cistern level"], series["pump state"]
    highest = np.array([maximum_pump_flow(site, x1) for x1 in levels * site.a1])
    highest[np.isnan(levels)] = np.nan
    return np.where(state == 0, 0.0, state * highest * step_s * 1000 / site.a2)


# --- reference evapotranspiration -----------------------------------------------------------------


def _bridge_short_gaps(record: StepRecord, values: Values, counts: Steps) -> Values:
    """Return reference evapotranspiration without gaps (mm), shape (steps,).

    A roof dries out even while its sensors are not working. Therefore, a gap of no more than an
    hour, or of a single step, is interpolated linearly, and a longer gap is rejected.

    Args:
        record: record that contains the times and the name of the column.
        values: values of every step (mm), NaN if missing.
        counts: whether each step is used for the fit or the validation, shape (steps,). A gap that
            contains no such step may have any length.

    Raises:
        ConfigurationError: if any other gap is too long, or if evapotranspiration is always 0.
    """
    column = record.reference_column
    if not np.any(values > 0):
        raise ConfigurationError(
            "is always 0; without it, the drying of the roof cannot be fitted",
            file=record.source, key=column,
        )
    missing = np.isnan(values)
    for low, high in find_gaps(missing):
        gap_s = (high - low) * record.step_s
        if gap_s > max(HOUR_S, record.step_s) and counts[low:high].any():
            raise ConfigurationError(
                f"has no value from {record.time(low)} for {name_time(gap_s)}: at most an hour may "
                "be missing, since the roof continues to dry during a gap. Write a daily value "
                "into every row of its day, and add the missing rows with their time and this "
                "value, leaving all other cells empty", file=record.source, key=column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def _compute_from_temperatures(
    record: StepRecord, site: Site, series: Mapping[str, Values], counts: Steps
) -> Values:
    """Return Hargreaves' reference evapotranspiration in every step (mm), shape (steps,).

    Days follow the record's own clock. The temperatures of a day without values, or with fewer than
    75 % of its ``temperature`` values, are interpolated. For every day that is used, there must be
    temperatures no more than three days before or after.

    Args:
        record: record with the times.
        site: site with its location.
        series: series of every quantity, including ``temperature``, or ``minimum temperature`` and
            ``maximum temperature`` in any row of the day (degC), NaN if a step has none, shape
            (steps,).
        counts: whether each step is used for the fit or the validation, shape (steps,).

    Raises:
        ConfigurationError: if the site has no location, if temperatures are too far apart to
            capture a day's extremes or too far from a day that is used, or if a minimum is above
            the maximum.
    """
    check_place(site, HARGREAVES)
    if TEMPERATURE in series and record.step_s > _MAX_STEP_S:
        raise ConfigurationError(
            f"has rows that are {name_time(record.step_s)} apart, but only rows up to three "
            "hours apart capture a day's extremes; write columns 'minimum temperature [degC]' and "
            "'maximum temperature [degC]' instead", file=record.source, key=TEMPERATURE,
        )
    dates, day = np.unique(record.times.astype("datetime64[D]"), return_inverse=True)
    low, high = (
        series[name] for name in ([TEMPERATURE] * 2 if TEMPERATURE in series else _EXTREMES)
    )
    complete = DAY_S / record.step_s if TEMPERATURE in series else 1.0
    minimum, maximum = extremes = find_extremes(day, low, high, 0.75 * complete)
    crossed = np.flatnonzero(minimum > maximum)
    if len(crossed):
        raise ConfigurationError(
            f"on {dates[crossed[0]]} the minimum temperature, {minimum[crossed[0]]:g} degC, is "
            f"above the maximum, {maximum[crossed[0]]:g} degC", file=record.source,
        )
    there = ~np.isnan(extremes).any(axis=0)
    if not there.any():
        raise ConfigurationError("no day has a complete set of temperatures", file=record.source)
    clock = replace(site, utc_offset=record.offset_s / HOUR_S)
    depths, far = spread_hargreaves(clock, dates, extremes, record.seconds, record.step_s)
    lacking = np.flatnonzero(far & counts)
    if lacking.size:
        raise ConfigurationError(
            f"has no temperature within 3 days of {record.time(lacking[0])[:10]}, but "
            "evapotranspiration is computed from temperatures; add a row with the temperatures for "
            "each day that lacks them, leaving all other cells empty, or exclude its month with "
            "--months", file=record.source,
        )
    return depths
