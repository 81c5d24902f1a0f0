"""Archived forecasts: a file or a directory of files, each of one of several formats."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Protocol

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.forecast import caspar, open_meteo, own_csv
from greenroof_ros.forecast.issue import Contents, Issue
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import HOUR
from greenroof_ros.weather.series import Weather

_HEAD_BYTES = 4096
# Of the files in a directory; what is in one says which format it has.
_SUFFIXES = (".csv", ".json", ".nc")


class Format(Protocol):
    """A format of archives: a module with these names."""

    def recognises(self, file: Path, head: bytes, /) -> bool:
        """Whether a file looks like one of this format, by its name and first bytes."""
        ...

    def read(self, files: Sequence[Path], site: Site, /) -> Contents:
        """Return what is in some files.

        Raises:
            ConfigurationError: a file is not as the format must be.
        """
        ...


FORMATS: tuple[Format, ...] = (caspar, open_meteo, own_csv)
"""All formats; the first that recognises a file reads it, the last recognises any."""


@dataclass(frozen=True)
class Archive:
    """Forecasts as they were issued.

    Attributes:
        source: the file or directory.
        kind: what it is, in words.
        issues: in the order of time, all with as many members.
        delay: h after its nominal time from which an issue is known.
        verified: by which it is verified, mostly the same; their rain may be NaN.
        finest_lead: by how many hours of lead it can be verified.
    """

    source: Path
    kind: str
    issues: tuple[Issue, ...]
    delay: float
    verified: tuple[Issue, ...]
    finest_lead: int

    @property
    def members(self) -> int:
        """How many forecasts an issue is of."""
        return len(self.issues[0].rain)

    def known_from(self, weather: Weather) -> list[int]:
        """Return the hour of the records from whose start on each issue is known.

        Where their rain is late, so is what is known of it: the controller would otherwise know of
        rain that fell an hour ago that it is to come.

        Raises:
            ConfigurationError: an issue is not whole hours from where the records begin.
        """
        refuse_between_hours(self.issues, weather)
        delay = timedelta(hours=self.delay + weather.records.rain_late)
        return [-((weather.first - issue.issued - delay) // HOUR) for issue in self.issues]


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
            if file.suffix not in _SUFFIXES:
                raise ConfigurationError(
                    f"must end in {', '.join(_SUFFIXES[:-1])} or {_SUFFIXES[-1]}, as all files in "
                    "a directory of forecasts", file=file,
                )
    form = _form(files[0])
    for file in files[1:]:
        if _form(file) is not form:
            raise ConfigurationError(
                f"must be of the format of {files[0].name}: an archive has one", file=file
            )
    contents = form.read(files, site)
    issues = sorted(contents.issues, key=lambda issue: issue.issued)
    for one, other in itertools.pairwise(issues):
        if one.issued == other.issued:
            raise ConfigurationError(
                f"has the issue of {to_minutes(one.issued)}, which {one.file.name} has already",
                file=other.file, line=other.line,
            )
        if len(one.rain) != len(other.rain):
            raise ConfigurationError(
                f"the issue of {to_minutes(other.issued)} must have as many members as that before "
                f"it in {one.file.name}, {len(one.rain)}, not {len(other.rain)}",
                file=other.file, line=other.line,
            )
        if (one.evapotranspiration is None) != (other.evapotranspiration is None):
            raise ConfigurationError(
                f"must have a column of evapotranspiration, or have none, as {one.file.name}",
                file=other.file, line=other.line,
            )
    return Archive(
        source, contents.kind, tuple(issues), contents.delay if delay is None else delay,
        tuple(issues if contents.verified is None else contents.verified), contents.finest_lead,
    )


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


def _form(file: Path) -> Format:
    """Return the format of a file.

    Raises:
        ConfigurationError: it cannot be read.
    """
    if file.exists() and not file.is_file():
        raise ConfigurationError("must be a regular file, or a directory of some", file=file)
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error.strerror}", file=file) from error
    return next(form for form in FORMATS if form.recognises(file, head))
