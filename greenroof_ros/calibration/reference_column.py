"""Reference evapotranspiration of a record from its own column: short gaps filled, units judged."""

from __future__ import annotations

from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.calibration.row_steps import Slots
from greenroof_ros.calibration.scores import time_name
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import evaporable, extraterrestrial_radiation

_DAY_S = 86400
_LONGEST_GAP_S = 3600
# More than any day has (mm). Alfalfa, which takes 1.15 times what grass does, took 14 mm on the
# windiest days of four years in Texas, weighed (Evett, Howell, Todd, Schneider and Tolk, Alfalfa
# reference ET measurement and prediction, 4th Decennial National Irrigation Symposium, 2000).
_MOST_A_DAY = 20.0
# Less than the best day of a month has, as a share of what the sun above the atmosphere could
# evaporate. By Hargreaves' equation it has 0.12 at least at the two measured roofs, and 0.08 in
# eleven years of Toronto, in their coldest months; a twelfth of it 0.04 at most, in summer. A bound
# in mm cannot part the two.
_LEAST_SHARE, _FEWEST_DAYS = 0.06, 30


def through_short_gaps(
    record: Record, column: str, values: Values, times: list[datetime], lines: list[int],
    slots: Slots, *, counts: NDArray[np.bool_],
) -> Values:
    """Return reference evapotranspiration that is there in every step (mm), shape (steps,).

    A roof dries while its sensors fail, too: a gap of an hour at most takes the straight line
    between the steps beside it, and a longer one is refused. Rows' times measure a gap, not its
    steps: where a clock was set on, a step can be without a row though hardly any time is missing.

    Args:
        record: its times.
        column: for messages.
        values: of each step (mm), NaN where there is none.
        times: of the rows.
        lines: of the rows in the file.
        slots: step of each row.
        counts: whether a step is fitted or judged, shape (steps,); a gap in which none is may be of
            any length.

    Raises:
        ConfigurationError: another gap is longer.
    """
    missing = np.isnan(values)
    since = np.array([time.timestamp() for time in times])
    # Before the first row and after the last as if there were one more, so that gaps there count.
    since = np.concatenate(([since[0] - record.step_s], since, [since[-1] + record.step_s]))
    for low, high in gaps(missing):
        row, after = (int(one) for one in np.searchsorted(slots, (low, high)))
        gap_s = float(since[after + 1] - since[row]) - record.step_s
        if gap_s > _LONGEST_GAP_S and counts[low:high].any():
            what = "is empty" if slots[row] == low else f"there is no row of {record.times[low]}"
            raise ConfigurationError(
                f"{what}, and none has a value for {time_name(round(gap_s))}: it may be missing "
                "for an hour at most, as a roof dries in gaps of the sensors, too; write a day's "
                "value into each of its rows, and add missing rows with time and this value, "
                "their other cells empty", file=record.source, line=lines[row], key=column,
            )
    steps = np.arange(len(values))
    return np.interp(steps, steps[~missing], values[~missing])


def refuse_wrong_unit(record: Record, site: Site, column: str, values: Values) -> None:
    """Refuse reference evapotranspiration that no place has, as that in a wrong unit is.

    Too little is told where the site has its latitude, and in records of 30 days or more.

    Args:
        record: its times.
        site: its latitude.
        column: for messages.
        values: of each step (mm).

    Raises:
        ConfigurationError: it is 0, a day has too much, or every day too little.
    """
    def error(text: str) -> ConfigurationError:
        return ConfigurationError(text, file=record.source, key=column)

    if not np.any(values > 0):
        raise error(
            "is 0 throughout: it must be there, or nothing of how the roof dries can be fitted"
        )
    numbers, day = np.unique(record.seconds // _DAY_S, return_inverse=True)
    days, totals = numbers.astype("datetime64[D]"), np.bincount(day, values)
    over = np.flatnonzero(totals > _MOST_A_DAY)
    if len(over):
        raise error(
            f"is {totals[over[0]]:.4g} mm on {days[over[0]]}; no day has more than "
            f"{_MOST_A_DAY:g} mm, and few have 10: is the unit of the column right?"
        )
    if site.latitude is None or record.steps * record.step_s < _FEWEST_DAYS * _DAY_S:
        return
    least = _LEAST_SHARE * evaporable(extraterrestrial_radiation(site.latitude, days))
    if np.all(totals < least):
        best = int(np.argmax(totals))
        raise error(
            f"is {totals[best]:.2g} mm at most in a day, on {days[best]}; the best day of a month "
            f"has {least[best]:.2g} mm at least at this time of the year: is the unit of the "
            "column right?"
        )
