"""What dressing is worth where it was not fitted: the bias and the error of sums.

The months of the record are parted by their rain into a wetter and a drier half. Forecasts are
dressed by what fell in one half and judged in the other, then the other way round. Last comes the
whole, where each issue is dressed without the days around it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from markdown_tables import head, row
from real_seasons.inputs import Inputs

from greenroof_ros.forecast.dressing import learn
from greenroof_ros.formats.records import HOUR
from greenroof_ros.verification.dressed import worth
from greenroof_ros.weather.series import Weather

_HOURS = 120  # of a member


def _halves(inputs: Inputs) -> tuple[Weather, Weather, Weather]:
    """Return the records of the drier months, of the wetter ones by their totals, and of all.

    Hours before the first issue that all services have, and of the other months, are missing.
    """
    record = inputs.record
    times = [record.rain_from + hour * HOUR for hour in range(record.hours)]
    begin = inputs.issued["three"].issues[0].issued
    month = np.array([time.year * 12 + time.month if time >= begin else 0 for time in times])
    rain = np.where(month > 0, record.precipitation, np.nan)
    months = sorted(set(month[month > 0]), key=lambda one: np.nansum(rain[month == one]))
    drier = np.isin(month, months[: (len(months) + 1) // 2])
    return tuple(
        replace(record, values={"precipitation": np.where(chosen, rain, np.nan)})
        for chosen in (drier, ~drier, month > 0)
    )


def table(inputs: Inputs) -> Iterator[str]:
    """Yield of each sum the bias, and the fair CRPS (mm): as issued, dressed, of climatology."""
    yield head(["fit, judged", "forecasts", "sum", "n", "fell mm", *(
        f"{what} {how}" for what in ("bias", "CRPS") for how in ("issued", "dressed", "climate")
    )])
    drier, wetter, whole = _halves(inputs)
    for fit, judge, words in (
        (drier, wetter, "dry, wet"), (wetter, drier, "wet, dry"), (whole, whole, "all, all"),
    ):
        for name in ("GEM", "KNMI", "GFS", "three"):
            archive = inputs.issued[name]
            for found in worth(archive, learn(archive, fit, _HOURS), judge, lambda _: None):
                values = [f"{value:.2f}" for value in (*found.bias, *found.crps)]
                cells = [words, name, f"{found.hours} h", str(found.n), f"{found.fell:.1f}"]
                yield row([*cells, *values])
