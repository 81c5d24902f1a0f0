"""The seasons of a record: the same days of every year in which the record is complete."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from typing import TYPE_CHECKING, NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import FIRST_YEAR, LAST_YEAR, to_minutes
from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import RECORDED
from greenroof_ros.weather.quantities import FOR_EVAPOTRANSPIRATION, PRECIPITATION
from greenroof_ros.weather.series import Weather

if TYPE_CHECKING:
    import polars

# Any year that is not a leap year.
_YEAR = 2001


class Window(NamedTuple):
    """The first and the last day of a season, as in ``05-01/10-31``; it may span New Year."""

    first: date
    last: date

    def __str__(self) -> str:
        """Return the days in words, such as ``1 May to 31 October``."""
        return " to ".join(f"{day.day} {day:%B}" for day in self)

    @property
    def days(self) -> int:
        """Number of days; a season of a whole year ends a day earlier in a leap year."""
        return (self.last - self.first).days % 365 + 1

    def name(self, year: int) -> str:
        """Return the name of the season that begins in a year: ``2015``, or ``2015/16``."""
        end = self.first.replace(year=year) + timedelta(self.days - 1)
        return f"{year}" if end.year == year else f"{year}/{end.year % 100:02}"


def read_window(text: str | None, site: Site) -> Window:
    """Return the days of a season; the default is the half of the year with irrigation.

    The default is May to October, or November to April south of the equator.

    Args:
        text: first and last day, as in ``05-01/10-31``; None for the default.
        site: the site, whose latitude determines the default; a site without a latitude counts as
            north of the equator.

    Raises:
        ConfigurationError: if the text does not have this form.
    """
    if text is None:
        text = "11-01/04-30" if (site.latitude or 0.0) < 0 else "05-01/10-31"
    try:
        return Window(*(date.fromisoformat(f"{_YEAR}-{day}") for day in text.split("/")))
    except (ValueError, TypeError, AttributeError):
        raise ConfigurationError(
            "must be the first and the last day of the season, with the month before the day, "
            "such as 05-01/10-31 (29 February is not allowed)", key="season", value=text,
        ) from None


def find_seasons(
    inputs: RunInputs, site: Site, weather: Weather, window: Window
) -> tuple[dict[str, Run], dict[str, str]]:
    """Return the run of every complete season, and the gap in every other season, both by name.

    Args:
        inputs: inputs of a run of the site; the start and the length of this run are ignored.
        site: the site, with the ticks that all designs share.
        weather: the record.
        window: the days of a season.

    Raises:
        ConfigurationError: if no season is complete, or if a value in the weather is rejected.
    """
    runs: dict[str, Run] = {}
    incomplete: dict[str, str] = {}
    # Midnight of standard time, or of the record without a zone.
    zone = weather.first.tzinfo if site.time_zone is None else (
        timezone(timedelta(hours=site.clock_offset))
    )
    record = f"the record is from {to_minutes(weather.first)} to {to_minutes(weather.end)}"
    first, last = max(FIRST_YEAR, weather.first.year - 1), min(weather.end.year, LAST_YEAR)
    for year in range(first, last + 1):
        begin = datetime(year, window.first.month, window.first.day, tzinfo=zone)
        end, name = begin + timedelta(window.days), window.name(year)
        if weather.first <= begin and end <= weather.end:
            try:
                runs[name] = replace(
                    inputs, site=site, weather=weather, hours=24.0 * window.days,
                    start=begin.isoformat(), initial=None, cistern=None, roof=None,
                ).build()
            except ConfigurationError as error:
                if error.file != weather.source:
                    raise
                incomplete[name] = error.expected.partition("; ")[0]
        elif weather.first < end and begin < weather.end:
            incomplete[name] = record
    if not runs:
        seasons = "".join(f"; {name}: {why}" for name, why in incomplete.items())
        raise ConfigurationError(
            f"does not cover a complete season, {window}: {record}{seasons}. Choose other days "
            "with season, or fill missing hours (gaps: fill)", file=weather.source,
        )
    return runs, incomplete


def list_notes(runs: Mapping[str, Run], site: Site) -> list[str]:
    """Return the notes about the site and the weather for the reader, without duplicates.

    Args:
        runs: the runs of the seasons, by name.
        site: the user's site, because a note on the duration of a tick must refer to this site.
    """
    own = (replace(run, site=site) for run in runs.values())
    notes = [note for run in own for note in (*run.weather.left_out, *run.notes())]
    notes += [note for run in runs.values() for note in run.series.summary["notes"]]
    notes += [f"weather of another climate: {run.weather.climate}" for run in runs.values()
              if run.weather.climate != RECORDED]
    for quantity in (PRECIPITATION, *FOR_EVAPOTRANSPIRATION):
        hours = {name: sum(run.series.filled.get(quantity, ())) for name, run in runs.items()}
        if any(hours.values()):
            treated = "treated as no rain" if quantity == PRECIPITATION else "filled"
            notes.append(f"missing hours of {quantity} were {treated}: " + ", ".join(
                f"{count} in {name}" for name, count in hours.items() if count
            ))
    return list(dict.fromkeys(notes))


def find_ranges(rows: polars.DataFrame, by: list[str]) -> polars.DataFrame:
    """Return the mean, the lowest and the highest value of each column over the seasons.

    Args:
        rows: results, with a column ``season``.
        by: columns that identify what is compared.

    Returns:
        The columns ``by``, the means under their names, and the lowest and the highest values under
        names that end in ``_min`` and ``_max``.
    """
    groups = rows.drop("season").group_by(by, maintain_order=True)
    return groups.mean().join(groups.min(), on=by, suffix="_min", maintain_order="left").join(
        groups.max(), on=by, suffix="_max", maintain_order="left"
    )
