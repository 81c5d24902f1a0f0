"""Pairs of rain sums, one from an archive of forecasts and one from records, by lead."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.verification.scores import Array, Tally
from greenroof_ros.base.times import to_people
from greenroof_ros.forecast.issue import read_archive
from greenroof_ros.site.site import Site
from greenroof_ros.weather.records import HOUR
from greenroof_ros.weather.series import Weather

# How many forecasts are added in one batch.
_AT_ONCE = 200
# Decimals to which sums are rounded (mm). In binary numbers, tenths of a millimetre do not add up
# to whole millimetres, which are the thresholds of events.
_DIGITS = 6


@dataclass(frozen=True)
class IssuedForecasts:
    """The forecasts of an archive.

    Attributes:
        name: name of the forecasts, in words.
        members: number of members of each forecast.
        hours: length of the longest forecast (h).
        finest_lead: finest resolution of the lead (h); more than 1 for previous runs.
        span: period that the forecasts cover, in words.
        issues: forecasts in the order in which they were issued, each with the hour of the records
            in which it begins (negative if it begins before the records) and its rain (mm/h), shape
            (members, hours), NaN if missing.
        notes: sentences about the data that could not be used unchanged.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    span: str
    issues: Sequence[tuple[int, Array]]
    notes: tuple[str, ...] = ()


def read_issued_forecasts(
    file: Path, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return the forecasts of an archive, for comparison with records.

    The forecasts are compared with the rain at the time at which it fell, even if the records count
    it later (``rain_late``). Forecasts that end before the records begin, or begin after the
    records end, are left out.

    Args:
        file: path of the archive, which is a file or a directory of files.
        weather: the records.
        site: site with its location.
        horizon: number of hours to compare in each forecast.

    Raises:
        ConfigurationError: if the archive is invalid.
    """
    issues = read_archive(file, site, daily=True)
    verified = [issue.align(weather.first) for issue in issues]
    first = weather.first - weather.rain_late * HOUR
    end = first + len(weather.precipitation) * HOUR
    within = [
        issue for issue in verified
        if issue.issued < end and issue.end > first
    ]
    begins = min(issue.issued for issue in verified)
    ends = max(issue.end for issue in verified)
    return IssuedForecasts(
        str(file), len(issues[0].rain),
        min(horizon, max((issue.hours for issue in within), default=horizon)),
        issues[0].finest_lead, f"{to_people(begins)} to {to_people(ends)}",
        [((issue.issued - first) // HOUR, issue.rain) for issue in within],
        tuple(dict.fromkeys(note for issue in issues for note in issue.notes)),
    )


class Sum(NamedTuple):
    """The length of a sum, and the sum that counts as an event."""

    hours: int
    event: float
    """minimum sum of an event (mm)"""


class Class(NamedTuple):
    """Pairs that are scored together: leads from ``low`` to below ``high`` (h), and a sum."""

    low: int
    high: int
    sum: Sum

    @property
    def lead(self) -> str:
        """The leads in words: ``day 2``, or ``6 to 12 h``."""
        if self.low % 24 == 0 and self.high == self.low + 24:
            return f"day {self.high // 24}"
        return f"{self.low} to {self.high} h"


def tally_pairs(
    forecasts: IssuedForecasts, observed: Array, lead: int, sums: Sequence[Sum],
    done: Callable[[int], None],
) -> dict[Class, Tally]:
    """Add up all pairs of forecasts and records.

    A pair consists of a sum over consecutive hours of a forecast, and the sum over the same hours
    of the records. A forecast is divided from its start: for sums of 12 h, into its first 12 hours,
    the next 12 hours, and so on. Every sum belongs to the class of leads into which it falls. A sum
    is left out if one of its hours is missing from the forecast or the records.

    Args:
        forecasts: forecasts to compare with the records.
        observed: records (mm/h), shape (hours,); NaN if missing.
        lead: width of a class of leads (h); a multiple of the length of every sum.
        sums: lengths of the sums, and events.
        done: callback that receives the number of forecasts added so far.

    Returns:
        The tally of every class, in the order of leads and sums.
    """
    classes = math.ceil(forecasts.hours / lead)
    reach = classes * lead
    tallies = {
        Class(number * lead, (number + 1) * lead, length): Tally(length.event)
        for number in range(classes) for length in sums
    }
    unknown = np.full(reach, np.nan)
    padded = np.concatenate((unknown, observed, unknown))
    for added in range(0, len(forecasts.issues), _AT_ONCE):
        batch = forecasts.issues[added : added + _AT_ONCE]
        rain = np.full((forecasts.members, len(batch), reach), np.nan)
        fallen = np.empty((1, len(batch), reach))
        for place, (hour, issue) in enumerate(batch):
            length = min(forecasts.hours, issue.shape[1])
            rain[:, place, :length] = issue[:, :length]
            begin = max(hour + reach, 0)
            fallen[0, place] = padded[begin : begin + reach]
        for key, total in tallies.items():
            predicted, fell = (
                np.round(
                    hours[:, :, key.low : key.high].reshape(len(hours), -1, key.sum.hours).sum(2),
                    _DIGITS,
                )
                for hours in (rain, fallen)
            )
            total.add(predicted, fell[0])
        done(added + len(batch))
    return tallies
