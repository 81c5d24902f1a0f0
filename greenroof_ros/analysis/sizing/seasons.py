"""The seasons of a record: the same days of each year, if it has all their weather."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import date, datetime, timedelta
from typing import NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import FIRST_YEAR, LAST_YEAR, to_minutes
from greenroof_ros.experiment.inputs import RunInputs
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather

# Of a year that is no leap year.
_YEAR = 2001


class Window(NamedTuple):
    """The days of a season, first and last, as ``05-01/10-31``; it can span the turn of a year."""

    first: date
    last: date

    def __str__(self) -> str:
        """Return it for people: ``1 May to 31 October``."""
        return " to ".join(f"{day.day} {day:%B}" for day in self)

    @property
    def days(self) -> int:
        """Its length; in a leap year a season of all days ends a day earlier."""
        return (self.last - self.first).days % 365 + 1

    def name(self, year: int) -> str:
        """Return the name of the season that begins in a year: ``2015``, or ``2015/16``."""
        end = self.first.replace(year=year) + timedelta(self.days - 1)
        return f"{year}" if end.year == year else f"{year}/{end.year % 100:02}"


def read_window(text: str | None, site: Site) -> Window:
    """Return the days of a season; by default the half year of irrigation.

    That is May to October, south of the equator November to April.

    Args:
        text: as ``05-01/10-31``; None for the default.
        site: whose latitude decides; without one it is in the north.

    Raises:
        ConfigurationError: it is not of this form.
    """
    if text is None:
        text = "11-01/04-30" if (site.latitude or 0.0) < 0 else "05-01/10-31"
    match = re.fullmatch(r"(\d\d-\d\d)/(\d\d-\d\d)", text) if isinstance(text, str) else None
    try:
        if match is None:
            raise ValueError
        return Window(*(date.fromisoformat(f"{_YEAR}-{day}") for day in match.groups()))
    except ValueError:
        raise ConfigurationError(
            "must be the first and the last day, month before day, such as 05-01/10-31 (29 "
            "February is none)", key="season", value=text,
        ) from None


def find_seasons(
    inputs: RunInputs, site: Site, weather: Weather, window: Window
) -> tuple[dict[str, Run], dict[str, str]]:
    """Return the run of each complete season, by its name, and what others lack.

    Args:
        inputs: of a run of the site, whose start and length do not matter.
        site: with ticks of a length that all designs have.
        weather: the record.
        window: the days of a season.

    Raises:
        ConfigurationError: no season is complete, or one has values that no run may have.
    """
    runs: dict[str, Run] = {}
    incomplete: dict[str, str] = {}
    first, last = max(FIRST_YEAR, weather.first.year - 1), min(weather.end.year, LAST_YEAR)
    for year in range(first, last + 1):
        try:
            run = replace(
                inputs, site=site, weather=weather, hours=24.0 * window.days,
                start=f"{year}-{window.first:%m-%d}T00:00", initial=None, cistern=None, roof=None,
            ).build()
        except ConfigurationError as error:
            if error.file != weather.source:
                raise
            if reason := _find_reason(weather, year, window, error):
                incomplete[window.name(year)] = reason
        else:
            runs[window.name(year)] = run
    if not runs:
        seasons = "".join(f"; {name}: {why}" for name, why in incomplete.items())
        raise ConfigurationError(
            f"has no complete season, {window}: its records are from {to_minutes(weather.first)} "
            f"to {to_minutes(weather.end)}{seasons}. Name other days as season, or fill missing "
            "hours (gaps: fill)", file=weather.source,
        )
    return runs, incomplete


def _find_reason(
    weather: Weather, year: int, window: Window, error: ConfigurationError
) -> str:
    """Return why a season that begins in a year is incomplete; empty if it is not in the record."""
    zone, day = weather.first.tzinfo, window.first.replace(year=year)
    start = datetime.combine(day, datetime.min.time(), zone)
    end = start + timedelta(window.days)
    if end <= weather.first or weather.end <= start:
        return ""
    if start < weather.first:
        return f"the record begins at {to_minutes(weather.first)}"
    if weather.end < end:
        return f"the record ends at {to_minutes(weather.end)}"
    return error.expected.partition("; ")[0]


def list_notes(runs: Mapping[str, Run], site: Site) -> list[str]:
    """Return what a reader must know of site and weather of the seasons, each sentence once.

    Args:
        runs: the seasons.
        site: as the user gives it, since a note on the duration of a tick must not be on ours.
    """
    own = (replace(run, site=site) for run in runs.values())
    notes = [note for run in own for note in (*run.weather.notes, *run.notes())]
    notes += [
        f"{sentence}; used unchanged" for run in runs.values() for sentence in run.series.suspicious
    ]
    filled = [
        f"{run.series.filled_hours} in {name}" for name, run in runs.items()
        if run.series.filled_hours
    ]
    if filled:
        notes.append(
            "missing hours of weather were filled in, and missing rain counts as none: "
            + ", ".join(filled)
        )
    return list(dict.fromkeys(notes))
