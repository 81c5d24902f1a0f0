"""What was forecast, issue by issue: of an archive, or of a model of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970, to_people
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.dressing import chosen_archive
from greenroof_ros.forecast.models import make_model
from greenroof_ros.formats.records import HOUR, ISSUE_HOURS
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather, refuse_between_hours

# Values of day N of previous runs are 24 N to 24 N + 5 h old; the middle of the leads that they
# stand for, 24 (N - 1) to 24 N, is 24 N - 12.
_OLDER_H = 14.5


class Issued(NamedTuple):
    """One forecast."""

    hour: int
    """of the records, in which it begins; negative before them"""
    rain: NDArray[np.float64]
    """mm/h, shape (members, hours); NaN where missing"""


@dataclass(frozen=True)
class IssuedForecasts:
    """Forecasts of an archive or a model.

    Attributes:
        name: what they are, in words.
        members: of each.
        hours: of the longest.
        finest_lead: by how many hours of lead they can be told apart; more than 1 of previous runs.
        first: of the hours that they are of, with its offset from UTC.
        end: of these hours.
        count: how many forecasts there are.
        each: yields them, one after the other in the order of time.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    first: datetime
    end: datetime
    count: int
    each: Callable[[], Iterator[Issued]]

    @property
    def older(self) -> float:
        """By how much (h) they are older in the mean than their leads say."""
        return _OLDER_H if self.finest_lead > 1 else 0.0

    @property
    def span(self) -> str:
        """The hours that they are of, in words."""
        return f"{to_people(self.first)} to {to_people(self.end)}"


def issued_forecasts(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return the forecasts that a choice means, for comparison with records.

    Args:
        choice: an archive or a model.
        weather: the records.
        site: its place on earth.
        horizon: how far a forecast is looked at (h); a model makes them as long.

    Raises:
        ConfigurationError: an archive is wrong, or its hours are not those of the records.
    """
    if choice.file is None:
        return _modelled(choice, weather, site, horizon)
    return _archived(choice, weather, site, horizon)


def _archived(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return those of an archive that begin before the records end and end after they begin.

    They are compared with rain by when it fell, also where it stands later in the records.
    """
    archive = chosen_archive(choice, site)
    refuse_between_hours(archive.verified, weather)
    first = weather.rain_from
    end = first + len(weather.precipitation) * HOUR
    within = [
        issue for issue in archive.verified
        if issue.issued < end and issue.issued + issue.hours * HOUR > first
    ]

    def each() -> Iterator[Issued]:
        for issue in within:
            yield Issued((issue.issued - first) // HOUR, issue.rain)

    return IssuedForecasts(
        f"{archive.source} ({archive.kind})", archive.members,
        min(horizon, max((issue.hours for issue in within), default=horizon)), archive.finest_lead,
        min(issue.issued for issue in archive.verified),
        max(issue.issued + issue.hours * HOUR for issue in archive.verified), len(within), each,
    )


def _modelled(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return those that a model makes of the records, of every hour in which one is issued.

    They are known at once, since leads count from the time of issue. An hour that the records lack
    is dry for the model.
    """
    rain = np.nan_to_num(weather.precipitation)
    starts = range(-hours_since_1970(weather.first) % ISSUE_HOURS, len(rain), ISSUE_HOURS)

    def each() -> Iterator[Issued]:
        # Evapotranspiration is forecast, too, and asked for by nobody here.
        known = replace(weather, precipitation=rain, evapotranspiration=np.zeros_like(rain))
        model = make_model(replace(choice, delay=0.0), known, site, all_members=True)
        for hour in starts:
            yield Issued(hour, model.known(hour, min(horizon, len(rain) - hour))[0])

    options = [f"{name} {value}" for name, value in choice.options().items()]
    members = choice.members if choice.model == "ensemble" else 1
    return IssuedForecasts(
        ", ".join([choice.model, *options]), members, horizon, 1, weather.first, weather.end,
        len(starts), each,
    )
