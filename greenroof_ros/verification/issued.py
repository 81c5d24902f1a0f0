"""What was forecast, issue by issue: of an archive, or of a model of this package."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970, to_people
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.dressing import chosen_archive
from greenroof_ros.forecast.models import make_model
from greenroof_ros.formats.records import HOUR, ISSUE_HOURS, Issue
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


class IssuedForecasts(Protocol):
    """Forecasts of an archive or a model.

    Attributes:
        name: what they are, in words.
        members: of each.
        hours: of the longest.
        finest_lead: by how many hours of lead they can be told apart.
        older: by how much (h) they are older in the mean than their leads say.
        span: of the hours that they are of, in words.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    older: float
    span: str

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __iter__(self) -> Iterator[Issued]:
        """Yield them, one after the other in the order of time."""
        ...


@dataclass
class ArchivedForecasts:
    """Those of an archive that begin before the records end and end after they begin.

    They are held against rain by when it fell, also where it stands later in the records.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    older: float
    span: str
    issues: tuple[Issue, ...]
    weather: Weather

    def __len__(self) -> int:
        """How many there are."""
        return len(self.issues)

    def __iter__(self) -> Iterator[Issued]:
        """Yield them in the order of time."""
        for issue in self.issues:
            yield Issued((issue.issued - self.weather.rain_from) // HOUR, issue.rain)


@dataclass
class ModelledForecasts:
    """Those that a model makes of the records, of every hour in which one is issued.

    They are known at once, since leads count from the time of issue. An hour that the records lack
    is dry for the model.
    """

    name: str
    members: int
    hours: int
    finest_lead: int
    older: float
    span: str
    choice: ForecastChoice
    weather: Weather
    site: Site

    def __len__(self) -> int:
        """How many there are."""
        return len(self._starts)

    @property
    def _starts(self) -> range:
        since_1970 = hours_since_1970(self.weather.first)
        return range(-since_1970 % ISSUE_HOURS, len(self.weather.precipitation), ISSUE_HOURS)

    def __iter__(self) -> Iterator[Issued]:
        """Yield them in the order of time."""
        rain = np.nan_to_num(self.weather.precipitation)
        # Evapotranspiration is forecast, too, and asked for by nobody here.
        weather = replace(
            self.weather, precipitation=rain, evapotranspiration=np.zeros_like(rain)
        )
        choice = replace(self.choice, delay=0.0)
        model = make_model(choice, weather, self.site, all_members=True)
        for hour in self._starts:
            yield Issued(hour, model.known(hour, min(self.hours, len(rain) - hour))[0])


def issued_forecasts(
    choice: ForecastChoice, weather: Weather, site: Site, horizon: int
) -> IssuedForecasts:
    """Return the forecasts that a choice means, to be held against records.

    Args:
        choice: an archive or a model.
        weather: the records.
        site: its place on earth.
        horizon: how far a forecast is looked at (h); a model makes them as long.

    Raises:
        ConfigurationError: an archive is wrong, or its hours are not those of the records.
    """
    if choice.file is None:
        members = choice.members if choice.model == "ensemble" else 1
        options = [f"{name} {value}" for name, value in choice.options().items()]
        return ModelledForecasts(
            ", ".join([choice.model, *options]), members, horizon, 1, 0.0,
            _span(weather.first, weather.end), choice, weather, site,
        )
    archive = chosen_archive(choice, site)
    refuse_between_hours(archive.verified, weather)
    first = weather.rain_from
    end = first + len(weather.precipitation) * HOUR
    within = tuple(
        issue for issue in archive.verified
        if issue.issued < end and issue.issued + issue.hours * HOUR > first
    )
    return ArchivedForecasts(
        f"{archive.source} ({archive.kind})", archive.members,
        min(horizon, max((issue.hours for issue in within), default=horizon)),
        archive.finest_lead,
        # Whole days of lead are those of previous runs.
        _OLDER_H if archive.finest_lead > 1 else 0.0,
        _span(
            min(issue.issued for issue in archive.verified),
            max(issue.issued + issue.hours * HOUR for issue in archive.verified),
        ),
        within, weather,
    )


def _span(first: datetime, end: datetime) -> str:
    return f"{to_people(first)} to {to_people(end)}"
