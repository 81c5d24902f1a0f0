"""What dressing is worth: sums of rain from an issue on, as issued, dressed and by climatology."""

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

# Sums from the issue on (h): the next half day, a storm, and what a roof has room for.
_SUMS = (12, 48, 120)


class Worth(NamedTuple):
    """Scores of the sums over some hours from an issue on."""

    hours: int
    n: int
    """issues with that many hours in forecast and record"""
    fell: float
    """mean of the observed sums (mm)"""
    bias: tuple[float, float, float]
    """water as issued, dressed and by climatology, each over what fell"""
    crps: tuple[float, float, float]
    """mean fair CRPS of these (mm)"""


def worth(
    archive: Archive, dressing: Dressing, weather: Weather, done: Callable[[int], None]
) -> list[Worth]:
    """Score an archive's issues by a record: as issued, dressed, and by climatology.

    Climatology is all that fell after all issues of the dressing that the issue's analogs may be
    taken from. Sums are over 12, 48 and 120 h, and none is longer than the forecasts; one with an
    hour that the record lacks is left out.

    Args:
        archive: of forecasts, as issued.
        dressing: by which they are dressed.
        weather: the record.
        done: is called with how many more issues were scored.

    Returns:
        Of each sum for which there is an issue.

    Raises:
        ConfigurationError: an issue has too few analogs.
    """
    reach = dressing.edges[-1]
    sums = sorted({min(hours, reach) for hours in _SUMS})
    whole = dressing.fell[~np.isnan(dressing.fell).any(axis=1)]
    climate = dict(zip(sums, (whole[:, :hours].sum(axis=1) for hours in sums), strict=True))
    found: dict[int, list[tuple[float, ...]]] = {hours: [] for hours in sums}
    for issue in archive.issues:
        begin = (issue.issued - weather.rain_from) // HOUR
        fell = {
            hours: float(weather.precipitation[begin : begin + hours].sum()) for hours in sums
            if 0 <= begin <= len(weather.precipitation) - hours and hours <= issue.hours
        }
        fell = {hours: rain for hours, rain in fell.items() if not np.isnan(rain)}
        if fell:
            issued = hours_since_1970(issue.issued)
            members = dressing.members(issued, issue.rain)
            usable = dressing.usable(issued)
        for hours, rain in fell.items():
            ensembles = (
                issue.rain[:, :hours].sum(axis=1), members[:, :hours].sum(axis=1),
                climate[hours][usable],
            )
            found[hours].append((
                rain, *(float(each.mean()) for each in ensembles),
                *(float(crps(each[:, None], np.array([rain]))[0]) for each in ensembles),
            ))
        done(1)
    results = []
    for hours, rows in found.items():
        if rows:
            fallen, *means = map(float, np.mean(rows, axis=0))
            bias = [mean / fallen if fallen else np.nan for mean in means[:3]]
            results.append(
                Worth(hours, len(rows), fallen, (bias[0], bias[1], bias[2]),
                      (means[3], means[4], means[5]))
            )
    return results
