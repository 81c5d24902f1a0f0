"""Inputs of the real seasons: sites, the gauge's record, and forecasts as issued."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from functools import cached_property
from pathlib import Path

import numpy as np
from dressing.__main__ import shortened, together
from numpy.typing import NDArray
from real_seasons.own_numbers import PACKAGE, chosen, used

from greenroof_ros.common.files import shared_directory
from greenroof_ros.forecast.dressing import Dressing, dress, dress_issue, learn
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import HOUR, SERVICE_DELAY_H, Archive
from greenroof_ros.model.site import Site, edited, read_site
from greenroof_ros.weather.reading import read_weather

Array = NDArray[np.float64]

SERVICES = {"GEM": "gem_global", "KNMI": "knmi_seamless", "GFS": "gfs_seamless"}
# The fifth day of GFS holds half the water of its fourth: an error of the archive.
HOURS_OF = {"GFS": 96}


@dataclass(frozen=True)
class Roof:
    """A site, and the length of its controllers' forecasts."""

    file: str
    hours: int
    """length of a dressed forecast"""
    target: float
    """target level (m)"""


# With the paper's target, as in all earlier results, and with the site file's.
ROOFS = {
    "measured": Roof("site_catchment.yaml", 48, 0.0457),
    "measured, target 39 mm": Roof("site_catchment.yaml", 48, 0.039),
    "paper": Roof("site.yaml", 120, 0.0457),
}
MAINS = {"mains_level": 0.85, "mains_flow": 5e-4}
TICK_S = 60.0
PLACEBO_DAYS = 35
BLOCK_WEEKS = 4
WEEK_H = 7 * 24


@dataclass(frozen=True)
class Period:
    """When runs begin, and how long they last."""

    words: str
    start: datetime
    hours: float

    @property
    def weeks(self) -> int:
        """Number of weeks; the last may be short."""
        return math.ceil(self.hours / WEEK_H)

    def blocks(self) -> NDArray[np.intp]:
        """Return the block of each week; a short block at the end joins the one before."""
        last = max(1, round(self.weeks / BLOCK_WEEKS)) - 1
        return np.minimum(np.arange(self.weeks) // BLOCK_WEEKS, last)


# The whole length of the archives, and a season that begins with a dry roof.
YEAR = Period("20 February to 31 December", datetime(2024, 2, 20, 12, tzinfo=timezone.utc), 7548.0)
SEASON = Period("May to October", datetime(2024, 5, 1, tzinfo=timezone.utc), 4416.0)
AUTUMN = Period("September and October", datetime(2024, 9, 1, tzinfo=timezone.utc), 1464.0)


class Inputs:
    """Everything that a run needs, read once."""

    def __init__(self, archives: Path, scratch: Path) -> None:
        """Take the directory of the archives, and one for the files that a run reads."""
        self.archives, self.scratch = archives, scratch
        self.sites = {roof: self._write_site(roof) for roof in ROOFS}
        self._wet: dict[Period, NDArray[np.bool_]] = {}
        gauge, site = scratch / "gauge.csv", self.sites["measured"]
        gauge.write_text(_gauge(archives / "gauge_2024.csv", site), encoding="utf-8")
        self.record = read_weather([gauge], site, rain_only=True)
        """rain as the gauge has it; missing hours are NaN"""
        self.weather = {
            roof: read_weather([gauge], own, "assumed", "fill") for roof, own in self.sites.items()
        }
        """weather of a run, by roof; missing hours are dry"""

    def site_file(self, roof: str) -> Path:
        """Return the file of a roof's site, with ticks of a minute and with mains."""
        return self.scratch / (re.sub(r"\W+", "_", roof) + ".yaml")

    def _write_site(self, roof: str) -> Site:
        file = shared_directory() / "config" / ROOFS[roof].file
        mains = {} if read_site(file).mains_level is not None else MAINS
        values = {"tau": TICK_S, "M": 1, "z_veg": ROOFS[roof].target, **mains}
        self.site_file(roof).write_text(edited(file, values), encoding="utf-8")
        return read_site(self.site_file(roof))

    @cached_property
    def issued(self) -> Mapping[str, Archive]:
        """The archives by name, each known some hours after its nominal time, like a service's."""
        site = self.sites["measured"]
        services = {
            short: replace(
                read_archive(self.archives / f"{name}_previous_runs.csv", site),
                delay=SERVICE_DELAY_H,
            )
            for short, name in SERVICES.items()
        }
        services |= {
            source: shortened(services[source], hours) for source, hours in HOURS_OF.items()
        }
        gem = services["GEM"]
        return {
            "three": together(list(services.values())),
            "placebo": _shifted(gem),
            **services,
            "no rain": replace(
                gem, issues=tuple(replace(issue, rain=0 * issue.rain) for issue in gem.issues)
            ),
        }

    def dressed(self, roof: str, source: str) -> Archive:
        """Return an archive dressed by the record, without the days around each issue."""
        archive = self.issued[source]
        return dress(archive, learn(archive, self.record, ROOFS[roof].hours))

    def crossed(self, roof: str, source: str, period: Period, own_numbers: bool) -> Archive:
        """Return an archive with each half of a period dressed by the other half.

        Issues outside the period are dressed by the wetter half. With their own numbers the halves
        choose the numbers of dressing, too.
        """
        archive, by = self.issued[source], self.by_half(roof, source, period)
        numbers = {
            wet: chosen(archive, dressing) if own_numbers else PACKAGE
            for wet, dressing in by.items()
        }
        members = math.lcm(*(own.members for own in numbers.values()))  # all issues have as many
        issues = []
        for issue in archive.issues:
            half = not self.is_wet(period, issue.issued)
            with used(numbers[half]):
                dressed = dress_issue(issue, by[half])
            rain = np.repeat(dressed.rain, members // len(dressed.rain), axis=0)
            issues.append(replace(dressed, rain=rain))
        return replace(archive, issues=tuple(issues))

    def scaled(self, roof: str, source: str, period: Period, own_half: bool) -> Archive:
        """Return an archive with the rain of each half of a period scaled to the gauge's.

        The factor is of the half itself or of the other half. Issues outside the period have the
        factor of the wetter half.
        """
        archive, factors = self.issued[source], self.factors(roof, source, period)
        issues = []
        for issue in archive.issues:
            wet = self.is_wet(period, issue.issued)
            factor = factors[wet is not False if own_half else not wet]
            issues.append(replace(issue, rain=factor * issue.rain))
        return replace(archive, issues=tuple(issues))

    def factors(self, roof: str, source: str, period: Period) -> dict[bool, float]:
        """Return the gauge's rain over the forecast's in the drier half (False) and in the wetter.

        In sums over the length of a dressed forecast, of issues that do not reach into the other
        half; gaps of the gauge of up to 12 h are bridged.
        """
        return {
            wet: float(by.fell.sum() / by.forecast.sum())
            for wet, by in self.by_half(roof, source, period).items()
        }

    def by_half(self, roof: str, source: str, period: Period) -> dict[bool, Dressing]:
        """Return dressings by the drier half of a period (False) and by the wetter half (True)."""
        rain = self.record.precipitation
        half = [
            self.is_wet(period, self.record.rain_from + hour * HOUR) for hour in range(len(rain))
        ]
        return {
            wet: learn(
                self.issued[source],
                replace(self.record, values={
                    "precipitation": np.where([of_half is wet for of_half in half], rain, np.nan),
                }),
                ROOFS[roof].hours,
            )
            for wet in (False, True)
        }

    def measured(self, time: datetime, hours: int) -> float:
        """Return the rain after a time (mm); NaN if one of its hours is missing."""
        begin = (time - self.record.rain_from) // HOUR
        rain = self.record.precipitation[max(0, begin) : begin + hours]
        return float(rain.sum()) if len(rain) == hours else math.nan

    def is_wet(self, period: Period, time: datetime) -> bool | None:
        """Return whether a time is in the wetter half of a period; None if it is in neither."""
        week = (time - period.start) // timedelta(hours=WEEK_H)
        return bool(self.wet_weeks(period)[week]) if 0 <= week < period.weeks else None

    def wet_weeks(self, period: Period) -> NDArray[np.bool_]:
        """Return which weeks are in the wetter half of a period's blocks."""
        if period not in self._wet:
            begin = (period.start - self.record.rain_from) // HOUR
            rain = self.record.precipitation[begin : begin + round(period.hours)]
            block = np.repeat(period.blocks(), WEEK_H)[: len(rain)]
            totals = [np.nansum(rain[block == number]) for number in range(block[-1] + 1)]
            wettest = np.argsort(totals)[-(len(totals) // 2) :]
            self._wet[period] = np.isin(period.blocks(), wettest)
        return self._wet[period]


def _half_sine(hour: int) -> float:
    """Return the factor from a day's mean evaporation to an hour of UTC; the sun rises at 5."""
    return math.pi * max(0.0, math.sin(math.pi * (hour + 0.5 - 5) / 12))


def _gauge(file: Path, site: Site) -> str:
    """Return the gauge's record with the assumed evapotranspiration (mm/day)."""
    monthly = site.monthly_evapotranspiration
    assert monthly is not None
    lines = ["time,precipitation [mm/h],assumed evapotranspiration [mm/day]"]
    with file.open(encoding="utf-8") as stream:
        for time, rain in list(csv.reader(stream))[1:]:
            begins = datetime.fromisoformat(time).replace(tzinfo=timezone.utc)
            dries = monthly[begins.month - 1] * _half_sine(begins.hour)
            lines.append(f"{begins.isoformat()},{rain},{dries:.4f}")
    return "\n".join([*lines, ""])


def _shifted(archive: Archive) -> Archive:
    """Return each issue with the forecast of an issue some weeks later."""
    issues: Sequence = archive.issues
    count = PLACEBO_DAYS * round(timedelta(days=1) / (issues[1].issued - issues[0].issued))
    moved = [*issues[count:], *issues[:count]]
    return replace(archive, issues=tuple(
        replace(issue, rain=other.rain) for issue, other in zip(issues, moved, strict=True)
    ))
