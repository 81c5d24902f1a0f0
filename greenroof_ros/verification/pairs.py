"""Forecasts of an archive or a model, and records: pairs of sums of rain, by lead."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970, to_people
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.dressing import chosen_archive
from greenroof_ros.forecast.models import make_model
from greenroof_ros.formats.records import EVAPOTRANSPIRATION, HOUR, ISSUE_HOURS, PRECIPITATION
from greenroof_ros.model.site import Site
from greenroof_ros.verification.scores import Tally
from greenroof_ros.weather.series import Weather, refuse_between_hours

Array = NDArray[np.float64]

# Values of day N of previous runs are 24 N to 24 N + 5 h old; the middle of the leads that they
# stand for, 24 (N - 1) to 24 N, is 24 N - 12.
_OLDER_H = 14.5
# How many forecasts are added up at once.
_AT_ONCE = 200
# To how many digits after the point sums are rounded (mm): tenths of a millimetre do not add up to
# whole ones in binary numbers, and an event begins at one.
_DIGITS = 6


@dataclass(frozen=True)
class IssuedForecasts:
    """Forecasts of an archive or a model.

    Attributes:
        name: what they are, in words.
        members: of each.
        hours: of the longest.
        finest_lead: by how many hours of lead they can be told apart; more than 1 of previous runs.
        span: the hours that they are of, in words.
        count: how many forecasts there are.
        issues: one after the other in the order of time: the hour of the records in which it
            begins, negative before them, and rain (mm/h), shape (members, hours); NaN where
            missing.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    span: str
    count: int
    issues: Iterator[tuple[int, Array]]

    @property
    def older(self) -> float:
        """By how much (h) they are older in the mean than their leads say."""
        return _OLDER_H if self.finest_lead > 1 else 0.0


def issued_forecasts(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return the forecasts that a choice means, for comparison with records.

    Those of an archive are compared with rain by when it fell, also where it stands later in the
    records; none counts that ends before the records begin, or begins after their end.

    Args:
        choice: an archive or a model.
        weather: the records.
        site: its place on earth.
        horizon: how far a forecast is looked at (h); a model makes them as long.

    Raises:
        ConfigurationError: an archive is wrong, or not of whole hours of the records.
    """
    if choice.file is None:
        return _modelled(choice, weather, site, horizon)
    archive = chosen_archive(choice, site)
    refuse_between_hours(archive.verified, weather)
    first = weather.rain_from
    end = first + len(weather.precipitation) * HOUR
    within = [
        issue for issue in archive.verified
        if issue.issued < end and issue.issued + issue.hours * HOUR > first
    ]
    begins = min(issue.issued for issue in archive.verified)
    ends = max(issue.issued + issue.hours * HOUR for issue in archive.verified)
    return IssuedForecasts(
        f"{archive.source} ({archive.kind})", archive.members,
        min(horizon, max((issue.hours for issue in within), default=horizon)), archive.finest_lead,
        f"{to_people(begins)} to {to_people(ends)}", len(within),
        (((issue.issued - first) // HOUR, issue.rain) for issue in within),
    )


def _modelled(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return those that a model makes of the records, of every hour in which one is issued.

    They are known at once, since leads count from the time of issue. An hour that the records lack
    is dry for the model. Evapotranspiration is forecast, too, and asked for by nobody here.
    """
    rain = np.nan_to_num(weather.precipitation)
    starts = range(-hours_since_1970(weather.first) % ISSUE_HOURS, len(rain), ISSUE_HOURS)
    known = replace(
        weather, values={PRECIPITATION: rain, EVAPOTRANSPIRATION: np.zeros_like(rain)}
    )
    model = make_model(replace(choice, delay=0.0), known, site, all_members=True)
    options = [f"{name} {value}" for name, value in choice.options().items()]
    return IssuedForecasts(
        ", ".join([choice.model, *options]), choice.members if choice.model == "ensemble" else 1,
        horizon, 1, f"{to_people(weather.first)} to {to_people(weather.end)}", len(starts),
        ((hour, model.known(hour, min(horizon, len(rain) - hour))[0]) for hour in starts),
    )


class Sum(NamedTuple):
    """A length of sums, and what counts as an event among them."""

    hours: int
    event: float
    """mm, from which on there is one"""


class Class(NamedTuple):
    """What is scored together: leads from one (h) to before another, and sums."""

    low: int
    high: int
    sum: Sum

    @property
    def lead(self) -> str:
        """The leads in words: ``day 2``, or ``6 to 12 h``."""
        if self.low % 24 == 0 and self.high == self.low + 24:
            return f"day {self.high // 24}"
        return f"{self.low} to {self.high} h"


def tally(
    forecasts: IssuedForecasts, observed: Array, lead: int, sums: Sequence[Sum],
    done: Callable[[int], None],
) -> dict[Class, Tally]:
    """Add up all pairs of some forecasts and the records.

    A pair is a sum over hours of an issue that follow one another, and that over the same hours of
    the records. An issue is parted from its start on: with sums of 12 h into its first 12 hours,
    the next 12, and so on, each in the class of leads in which it lies whole. A sum with an hour
    that the issue or the records lack is left out.

    Args:
        forecasts: any number.
        observed: records (mm/h), shape (hours,); NaN where missing.
        lead: how many hours make a class of leads; a multiple of each of the sums.
        sums: their lengths and events.
        done: is called with how many more forecasts were added.

    Returns:
        What adds up in each class, in the order of leads and sums.
    """
    classes = math.ceil(forecasts.hours / lead)
    reach = classes * lead
    tallies = {
        Class(number * lead, (number + 1) * lead, length): Tally(length.event, forecasts.members)
        for number in range(classes) for length in sums
    }
    unknown = np.full(reach, np.nan)
    padded = np.concatenate((unknown, observed, unknown))
    while batch := list(itertools.islice(forecasts.issues, _AT_ONCE)):
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
        done(len(batch))
    return tallies
