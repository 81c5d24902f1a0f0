"""Archived forecasts: a file or a directory of files, each of one of several formats."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.forecast.choice import SUFFIXES
from greenroof_ros.formats.issue import Archive, Issue
from greenroof_ros.formats.reading import read_forecasts
from greenroof_ros.formats.records import HOUR
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather


def read_archive(source: Path, site: Site, delay: float | None = None) -> Archive:
    """Read an archive of forecasts.

    An issue is known from when it is available, which is hours after its nominal time: until then
    its run computes and is distributed. The nominal time is that at which its observations were
    made and its first hour begins.

    Args:
        source: a file, or a directory of files of one format.
        site: to which the archive must be near, as far as it says its own place.
        delay: h after its nominal time from which an issue is known; that of its kind unless given.

    Raises:
        ConfigurationError: a file is not as its format must be, two have the same issue, or issues
            have different members, or evapotranspiration in some of them only.
    """
    files = [source]
    if source.is_dir():
        files = sorted(
            file for file in source.iterdir() if file.is_file() and not file.name.startswith(".")
        )
        if not files:
            raise ConfigurationError("must have files of forecasts in it", file=source)
        for file in files:
            if file.suffix not in SUFFIXES:
                raise ConfigurationError(
                    f"must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}, as all files in a "
                    "directory of forecasts", file=file,
                )
    archive = read_forecasts(files, site)
    issues = sorted(archive.issues, key=lambda issue: issue.issued)
    for one, other in itertools.pairwise(issues):
        _check_alike(one, other)
    return replace(
        archive, source=source, issues=issues, delay=archive.delay if delay is None else delay
    )


def _check_alike(one: Issue, other: Issue) -> None:
    """Refuse an issue after another one in an archive, if it is no other, or not alike."""
    wrong, when = "", to_minutes(other.issued)
    if one.issued == other.issued:
        wrong = f"has the issue of {when}, which {one.file.name} has already"
    elif len(one.rain) != len(other.rain):
        wrong = (
            f"the issue of {when} must have as many members as that before it in {one.file.name}, "
            f"{len(one.rain)}, not {len(other.rain)}"
        )
    elif (one.evapotranspiration is None) != (other.evapotranspiration is None):
        wrong = f"must have a column of evapotranspiration, or have none, as {one.file.name}"
    if wrong:
        raise ConfigurationError(wrong, file=other.file, line=other.line)


def refuse_between_hours(issues: Sequence[Issue], weather: Weather) -> None:
    """Refuse issues that are not whole hours from where the records begin.

    Raises:
        ConfigurationError: one is not.
    """
    for issue in issues:
        if (issue.issued - weather.first) % HOUR:
            raise ConfigurationError(
                f"must be a whole number of hours from {to_minutes(weather.first)}, where "
                f"{weather.source} begins",
                file=issue.file, line=issue.line, key="issued", value=to_minutes(issue.issued),
            )
