"""What dressing is worth: sums of rain after an issue, as issued, dressed and by climatology."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.dressing import Dressing
from greenroof_ros.formats.records import HOUR, Archive
from greenroof_ros.verification.scores import crps
from greenroof_ros.weather.series import Weather

Array = NDArray[np.float64]

# Lengths of the sums (h): the next half day, a storm, and what a roof has room for.
_SUMS = (12, 48, 120)


class Worth(NamedTuple):
    """Scores of the sums over the first hours of the issues."""

    hours: int
    n: int
    """number of issues with that many hours in forecast and record"""
    fell: float
    """mean of the observed sums (mm)"""
    bias: list[float]
    """bias as issued, dressed and by climatology: mean sum over the observed mean sum (1)"""
    crps: list[float]
    """mean fair CRPS of these three (mm)"""


def worth(
    archive: Archive, dressing: Dressing, weather: Weather, done: Callable[[int], None]
) -> list[Worth]:
    """Score an archive's issues by a record: as issued, dressed, and by climatology.

    Climatology is the rain observed after every issue that may be an analog. Sums are over 12, 48
    and 120 h, cut to the length of the forecasts. A sum is left out if the record lacks one of its
    hours.

    Args:
        archive: forecasts as issued.
        dressing: what the forecasts are dressed with.
        weather: the record.
        done: called with the number of issues just scored.

    Returns:
        The scores of each length of sum for which there is an issue.

    Raises:
        ConfigurationError: an issue has too few analogs.
    """
    rain, longest = weather.precipitation, dressing.edges[-1]
    rows_of: dict[int, list[list[float]]] = {
        hours: [] for hours in sorted({min(hours, longest) for hours in _SUMS})
    }
    for issue in archive.issues:
        begin = (issue.issued - weather.rain_from) // HOUR
        known = [
            hours for hours in rows_of
            if hours <= issue.hours and 0 <= begin <= len(rain) - hours
            and not np.isnan(rain[begin : begin + hours]).any()
        ]
        if known:
            issued = hours_since_1970(issue.issued)
            ensembles = (
                issue.rain, dressing.members(issued, issue.rain),
                dressing.fell[dressing.usable(issued)],
            )
        for hours in known:
            fell = float(rain[begin : begin + hours].sum())
            sums = [rain_ahead[:, :hours].sum(axis=1) for rain_ahead in ensembles]
            rows_of[hours].append([
                fell, *(members.mean() for members in sums),
                *(crps(members[:, None], np.array([fell]))[0] for members in sums),
            ])
        done(1)
    results = []
    for hours, rows in rows_of.items():
        if rows:
            fallen, *means = np.mean(rows, axis=0).tolist()
            bias = [mean / fallen if fallen else np.nan for mean in means[:3]]
            results.append(Worth(hours, len(rows), fallen, bias, means[3:]))
    return results
