"""Preparation of a roof's record for a fit: sums over time, usable storms, months and halves."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.step_record import (
    AFTER_STORM_S,
    DAY_S,
    HOUR_S,
    StepRecord,
    Steps,
    Values,
    find_storms,
    prolong_steps,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.weather.records import find_gaps

# An unknown storm is forgotten after this long (s) and this much reference evapotranspiration (mm).
_FORGOTTEN_S, _FORGOTTEN_MM = 7 * DAY_S, 20.0
# More rain than a drizzle in the hours next to a short outage (mm).
_RAINED_MM = 1.0


def sum_spans(values: Values | Steps, seconds: NDArray[np.int64], span_s: int) -> Values:
    """Add up the values whose steps begin in the same clock span of ``span_s`` seconds.

    Spans without values are left out.
    """
    _, index = np.unique(seconds // span_s, return_inverse=True)
    return np.bincount(index, values).astype(np.float64)


def average_spans(values: Values, seconds: NDArray[np.int64], span_s: int) -> Values:
    """Average the values whose steps begin in the same clock span; see :func:`sum_spans`.

    NaN values are ignored; the mean of a span that contains only NaN is NaN.
    """
    count = sum_spans(~np.isnan(values), seconds, span_s)
    total = sum_spans(np.nan_to_num(values), seconds, span_s)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


COMBINE = {"runoff": sum_spans, "level": average_spans}
"""how to combine the values of a span, by the names of :attr:`StepRecord.measured`

Amounts add up. Levels do not: their sum would depend on the length of gaps in the span.
"""


def find_outages(record: StepRecord) -> list[slice]:
    """Return the steps from each outage of a water meter to the end of its effect on the roof.

    A storm may have occurred during an outage. The water of such a storm is gone after about a
    week, but not before 20 mm could have evaporated. Outages of up to an hour count only if it
    rained in the hour before or after them.
    """
    lost = find_gaps(np.isnan(record.rain) | np.isnan(record.pumped))
    evaporated = np.concatenate(([0.0], np.cumsum(record.reference)))
    week, hour = (math.ceil(time / record.step_s) for time in (_FORGOTTEN_S, HOUR_S))
    found = []
    for first, end in lost:
        near = np.nansum(record.rain[max(0, first - hour):end + hour])
        if (end - first) * record.step_s <= HOUR_S and near <= _RAINED_MM:
            continue
        dried = int(np.searchsorted(evaporated, evaporated[end] + _FORGOTTEN_MM))
        found.append(slice(first, min(max(end + week, dried), record.steps)))
    return found


def select_comparable(record: StepRecord) -> Steps:
    """Return the steps in which a simulation is compared: complete steps outside broken storms.

    A storm is broken if rain, pumped water or runoff is missing during it, because unrecorded water
    affects the roof for the whole storm. In addition, meters tend to fail when runoff is largest,
    and their values can then be incomplete for an unknown time before and after the gap. Steps
    after an outage are left out until the unrecorded water no longer affects the roof
    (:func:`find_outages`).
    """
    steps = record.complete
    for outage in find_outages(record):
        steps[outage] = False
    missing = np.isnan(record.rain) | np.isnan(record.pumped)
    if record.runoff is not None:
        missing |= np.isnan(record.runoff)
    for storm in find_storms(record):
        if missing[storm].any():
            steps[storm] = False
    return steps


def halve_steps(record: StepRecord, steps: Steps) -> dict[str, Steps]:
    """Split steps on the first dry day after half of all rain and pumped water has arrived.

    The halves receive equal amounts of water, because only water reveals the properties of a roof:
    with halves of equal duration, one half could contain all the storms. A storm in both halves
    would make the validation depend on data used in the fit. Without a dry day, all steps are in
    the earlier half.

    Args:
        record: record with rain and pumped water.
        steps: steps to split.

    Returns:
        The steps of each half by its purpose: ``fit`` for the earlier half, and ``validation`` for
        the later half.
    """
    total = np.cumsum(np.where(steps, record.water, 0.0))
    dry = ~prolong_steps(record.water > 0, math.ceil(AFTER_STORM_S / record.step_s))
    later = np.cumsum((total >= total[-1] / 2) & dry) > 0
    return {"fit": steps & ~later, "validation": steps & later}


def read_months(span: str) -> tuple[int, int]:
    """Return the first and the last month (1 to 12) of a span such as ``4-10``.

    Raises:
        ConfigurationError: if the text is not a span of months.
    """
    match = re.fullmatch(r"(\d{1,2})-(\d{1,2})", span)
    first, last = map(int, match.groups()) if match else (0, 0)
    if not (1 <= first <= 12 and 1 <= last <= 12):
        raise ConfigurationError(
            "must be the first and the last month to use, such as 4-10, or 11-3 across the new "
            "year",
            key="--months", value=span,
        )
    return first, last


def select_months(record: StepRecord, span: str | None) -> Steps:
    """Return a mask of the steps that begin in a span of months on the record's own clock.

    A span is written as ``4-10``, or as ``11-3`` across the new year; both ends are included. None
    selects all steps.

    Raises:
        ConfigurationError: if no step begins in the span, or if the text is not a span of months.
    """
    if span is None:
        return np.full(record.steps, True)
    first, last = read_months(span)
    number = record.times.astype("datetime64[M]").astype(np.int64) % 12 + 1
    within = (number - first) % 12 <= (last - first) % 12
    if not within.any():
        raise ConfigurationError(
            f"has no row in the months {span} of --months: the record is from "
            f"{str(record.times[0])[:10]} to {str(record.times[-1])[:10]}", file=record.source,
        )
    return within
