"""A verification: the scores of an archive of forecasts against records, by lead and sum."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenroof_ros.analysis.verification.scores import Array, score_pairs
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.times import to_people
from greenroof_ros.forecast.issue import IssuedForecast, read_archive
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import find_files, read_weather
from greenroof_ros.weather.records import HOUR
from greenroof_ros.weather.series import Weather
from greenroof_ros.weather.summary import as_lines, summarize

if TYPE_CHECKING:
    import polars

# Default sums: hours, and the mm from which such a sum counts as an event.
_EVENTS = {1: 1.0, 6: 2.0, 12: 3.0, 24: 5.0}
# Decimals to which sums are rounded (mm). In binary numbers, tenths of a millimetre do not add up
# to whole millimetres, which are the thresholds of events.
_DIGITS = 6
# The lowest r of the services five days ahead is 0.32 (sums over 12 h; the package's table of
# skill). With this many unrelated pairs, r reaches the limit in hardly one case in a thousand.
_MIN_R, _MIN_PAIRS = 0.1, 1000


@dataclass(frozen=True)
class Verification:
    """Scores of forecasts against records.

    Attributes:
        title: what was compared, in words.
        rows: a row for each class of leads and sums: ``lead_from_h``, ``lead_to_h``, ``sum_hours``,
            ``event_mm`` and the scores; None for a score that is undefined.
        notes: sentences about the data.
        warnings: what is most likely wrong with the data.
    """

    title: str
    rows: Sequence[dict[str, Any]]
    notes: Sequence[str]
    warnings: Sequence[str]

    @property
    def table(self) -> polars.DataFrame:
        """The rows as a data frame.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame(self.rows)


def verify(
    forecasts: str | os.PathLike[str], weather: Sequence[str], site: str | os.PathLike[str] = "",
    *, lead: int = 24, sums: Sequence[int] | None = None, events: Sequence[float] | None = None,
    horizon: int = 120,
) -> Verification:
    """Score rain forecasts against records, like ``greenroof verify``.

    A pair consists of a sum over consecutive hours of a forecast, and the sum over the same hours
    of the records. A forecast is divided from its start: for sums of 12 h, into its first 12 hours,
    the next 12 hours, and so on. Every sum belongs to the class of leads into which it falls. A sum
    is left out if one of its hours is missing from the forecast or the records.

    Args:
        forecasts: archive of forecasts: a file, or a directory of files.
        weather: files with the records, or patterns.
        site: site file with the location; by default the paper's.
        lead: length of the blocks of lead time that are scored together (h).
        sums: numbers of hours over which rain is summed; by default those of 1, 6, 12 and 24 that
            divide ``lead``.
        events: amounts from which each of the sums counts as an event (mm).
        horizon: maximum lead time (h).

    Raises:
        ConfigurationError: if an input is invalid, or if forecasts and records have no complete sum
            in common.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.verify("gem_previous_runs.csv", ["gauge.csv"]).table  # doctest: +SKIP
    """
    if sums is None and events is None:
        sums = [hours for hours in _EVENTS if lead % hours == 0]
        events = [_EVENTS[hours] for hours in sums]
    if sums is None or events is None or len(sums) != len(events):
        raise ConfigurationError("must be used together, with as many values", key="sums, events")
    place = read_site(Path(site) if site else default_site_file())
    records = read_weather(find_files(weather, "weather"), place, method="")
    issues = read_archive(Path(forecasts), place, daily=True)
    for hours in sums:
        if lead % hours:
            raise ConfigurationError(f"must divide lead ({lead} h)", key="sums", value=hours)
    if lead % issues[0].finest_lead:
        raise ConfigurationError(
            f"must be a multiple of {issues[0].finest_lead} h, the finest lead time of "
            f"{forecasts}", key="lead", value=lead,
        )
    rain, fallen, span = pair_hours(issues, records, horizon, lead)
    rows = []
    for begin in range(0, rain.shape[2], lead):
        for hours, event in zip(sums, events, strict=True):
            predicted, fell = (
                np.round(
                    each[..., begin:begin + lead].reshape(len(each), -1, hours).sum(2), _DIGITS
                ) for each in (rain, fallen)
            )
            rows.append({
                "lead_from_h": begin, "lead_to_h": begin + lead, "sum_hours": hours,
                "event_mm": event, **score_pairs(predicted, fell[0], event),
            })
    if not any(row["n"] for row in rows):
        raise ConfigurationError(
            f"include no complete sum in the period of the records: the forecasts cover {span}, "
            f"and the records cover {to_people(records.first)} to {to_people(records.end)}",
            file=Path(forecasts),
        )
    known = [row["r"] for row in rows if row["n"] >= _MIN_PAIRS and not math.isnan(row["r"])]
    warnings = [
        f"the forecasts are unrelated to the records: no correlation reaches {_MIN_R:g}. Are the "
        "forecasts and the records for the same location, and are their times correct?"
    ] if known and max(known) < _MIN_R else []
    return Verification(
        f"{forecasts}: {rain.shape[1]} forecasts, compared with {records.source}",
        [{name: None if value != value else value for name, value in row.items()} for row in rows],
        [*as_lines(summarize(records, place)), *filter(None, [records.rain_note]),
         *records.left_out, *dict.fromkeys(note for issue in issues for note in issue.notes)],
        warnings,
    )


def pair_hours(
    issues: Sequence[IssuedForecast], records: Weather, horizon: int, lead: int
) -> tuple[Array, Array, str]:
    """Return the hours of forecasts, and the same hours of the records.

    The forecasts are compared with the rain at the time at which it fell, even if the records count
    it later (``rain_late``). Forecasts that end before the records begin, or begin after the
    records end, are left out.

    Args:
        issues: the forecasts.
        records: the records.
        horizon: number of hours to compare in each forecast.
        lead: number of hours of which the compared hours are a multiple.

    Returns:
        Rain of the forecasts (mm/h), shape (members, forecasts, hours), rain of the records, shape
        (1, forecasts, hours), both NaN if missing, and the period of the forecasts in words.
    """
    aligned = [issue.align(records.first) for issue in issues]
    span = " to ".join(map(to_people, (
        min(issue.issued for issue in aligned), max(issue.end for issue in aligned)
    )))
    first = records.first - records.rain_late * HOUR
    within = [
        issue for issue in aligned
        if first - issue.hours * HOUR < issue.issued < first + len(records.precipitation) * HOUR
    ]
    longest = min(horizon, max((issue.hours for issue in within), default=horizon))
    reach = math.ceil(longest / lead) * lead
    rain = np.full((len(issues[0].rain), len(within), reach), math.nan)
    unknown = np.full(reach, math.nan)
    padded = np.concatenate((unknown, records.precipitation, unknown))
    begins = [max(0, (issue.issued - first) // HOUR + reach) for issue in within]
    for place, issue in enumerate(within):
        hours = min(longest, issue.hours)
        rain[:, place, :hours] = issue.rain[:, :hours]
    fallen = padded[np.add.outer(np.array(begins, dtype=int), np.arange(reach))]
    return rain, fallen[None], span
