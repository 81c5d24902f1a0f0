"""Readers of weather files and forecast archives in any supported format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import to_minutes
from greenroof_ros.formats import dwd, eccc, open_meteo, own_csv
from greenroof_ros.formats.forecasts import Archive, IssuedForecast, check_same_form
from greenroof_ros.formats.hourly import Records
from greenroof_ros.site.site import Place

SUFFIXES = (".csv", ".json")
"""suffixes of forecast files, whose format is recognised from their content"""
_HEAD_BYTES = 4096

# The first format that recognises a file from its first bytes reads it. The last one, own CSV,
# recognises nothing: its errors state what is expected.
_WEATHER_NAMES = {
    eccc: "Environment and Climate Change Canada", open_meteo: "Open-Meteo",
    dwd: "Deutscher Wetterdienst", own_csv: "own CSV",
}
_WEATHER = {form: form.recognises for form in (eccc, open_meteo, dwd)}
_FORECASTS = {open_meteo: open_meteo.recognises_forecasts}


def read_records(file: Path, site: Place, stamped: str | None = None) -> Records:
    """Return the records of a weather file; each value is for the hour starting at its time stamp.

    Args:
        file: file to read.
        site: site with its location and clock.
        stamped: position of the time stamp in the interval of a row, for this project's format; see
            :func:`.own_csv.read_rows`.

    Raises:
        ConfigurationError: if the file does not conform to its format, or is too large.
    """
    form = _find_format(file, _WEATHER)
    if form is own_csv:
        return own_csv.read_records(file, site, stamped)
    records: Records = form.read_records(file, site)
    return records


def name_format(file: Path) -> str:
    """Return a readable name of a weather file's format.

    Raises:
        ConfigurationError: if the file cannot be read.
    """
    return _WEATHER_NAMES[_find_format(file, _WEATHER)]


def read_archive(source: Path, site: Place, delay: float | None = None) -> Archive:
    """Read an archive of forecasts.

    An issue is known as soon as it is available, hours after its nominal time, because the model
    run has to be computed and distributed. The nominal time is the time of the run's observations,
    at which the first hour begins.

    Args:
        source: file, or directory with files in a single format.
        site: site that must be near the archive's position, if the archive states a position.
        delay: time from the nominal time of an issue until the issue is known (h); by default, the
            usual delay for the kind of archive.

    Raises:
        ConfigurationError: if a file does not conform to its format, if the files have different
            formats, if an issue occurs twice, or if only some issues contain evapotranspiration.
    """
    files = [source]
    if source.is_dir():
        files = sorted(
            file for file in source.iterdir() if file.is_file() and not file.name.startswith(".")
        )
        if not files:
            raise ConfigurationError("must contain forecast files", file=source)
        for file in files:
            if file.suffix not in SUFFIXES:
                raise ConfigurationError(
                    f"must have the suffix {' or '.join(SUFFIXES)}, like all files in a "
                    "directory of forecasts", file=file,
                )
    form = _find_format(files[0], _FORECASTS)
    for file in files[1:]:
        if _find_format(file, _FORECASTS) is not form:
            raise ConfigurationError(
                f"must have the format of {files[0].name}, like all files of an archive", file=file
            )
    archive: Archive = form.read_archive(files, site)
    issues, notes = _equalise_members(sorted(archive.issues, key=lambda issue: issue.order))
    if delay is not None:
        issues = [replace(issue, available=None) for issue in issues]
    return replace(
        archive, source=source, issues=issues,
        verified=issues if archive.verified is archive.issues else archive.verified,
        delay=archive.delay if delay is None else delay,
        notes=tuple(dict.fromkeys([*archive.notes, *notes])),
    )


def _equalise_members(issues: Sequence[IssuedForecast]) -> tuple[list[IssuedForecast], list[str]]:
    """Return issues with equal numbers of members, and notes on omitted members and issues.

    If an issue was downloaded twice, it is used only once. If an issue has fewer members than
    others, the other issues are reduced to the same number. If this would be less than half of
    their members, the issue is left out instead.

    Raises:
        ConfigurationError: if an issue repeats another issue with different values, or has
            different quantities.
    """
    alike = list(issues[:1])
    notes = []
    for issue in issues[1:]:
        earlier = alike[-1]
        if issue.issued == earlier.issued and np.array_equal(issue.rain, earlier.rain):
            notes.append(
                f"{issue.file.name} is left out because it has the same content as "
                f"{earlier.file.name}"
            )
            continue
        check_same_form(earlier, issue)
        alike.append(issue)
    maximum = max(len(issue.rain) for issue in alike)
    used = [issue for issue in alike if 2 * len(issue.rain) >= maximum]
    minimum = min(len(issue.rain) for issue in used)
    notes += [
        f"{issue.file.name}: the issue of {to_minutes(issue.issued)} is left out: it has only "
        f"{len(issue.rain)} members, but the largest issue has {maximum}"
        for issue in alike if 2 * len(issue.rain) < maximum
    ]
    if minimum < maximum:
        notes.append(
            f"the number of members used from every issue is {minimum}, as in the smallest issue"
        )
    notes[:0] = [note for issue in used for note in issue.notes]
    return [replace(issue, rain=issue.rain[:minimum]) for issue in used], notes


def _find_format(
    file: Path, recognisers: Mapping[ModuleType, Callable[[bytes], bool]]
) -> ModuleType:
    if file.exists() and not file.is_file():
        raise ConfigurationError(
            "must be a regular file, or a directory of regular files", file=file
        )
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error.strerror}", file=file) from error
    return next((form for form, recognises in recognisers.items() if recognises(head)), own_csv)
