"""Several weather files as one: which files are meant, and their records joined."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import to_minutes
from greenroof_ros.weather.records import HOUR, Records


def find_files(names: Iterable[str], key: str, directory: Path = Path()) -> list[Path]:
    """Return the files that names and patterns (``data/2021_*.csv``) stand for, each once.

    A name that is not that of a file is a pattern where it has ``*``, ``?`` or ``[``.

    Args:
        names: of files, relative to the directory.
        key: option or parameter that has them, for messages.
        directory: from which they are seen.

    Raises:
        ConfigurationError: a pattern matches no file, or there are no names.
    """
    found: list[Path] = []
    for name in names:
        path = directory / name
        matches = [path]
        if not path.exists() and glob.has_magic(name):
            matches = [Path(match) for match in sorted(glob.glob(str(path)))]  # noqa: PTH207
            if not matches:
                raise ConfigurationError("matches no file", key=key, value=name)
        found += [match for match in matches if match not in found]
    if not found:
        raise ConfigurationError("must name at least one file", key=key)
    return found


def join(parts: Sequence[Records]) -> Records:
    """Join the records of several files.

    They are sorted by time. An hour that no file has is missing (NaN), and so is a quantity of an
    hour in which no file has it. Where several have it, they must have the same.

    Raises:
        ConfigurationError: two files have different values for an hour, different quantities,
            methods of evapotranspiration or conventions of time; or their hours do not begin
            together. The message names both.
    """
    parts = sorted(parts, key=lambda part: part.first)
    first = parts[0]
    for part in parts[1:]:
        _check_alike(first, part)
    begins = [(part.first - first.first) // HOUR for part in parts]
    hours = max(begin + part.hours for begin, part in zip(begins, parts, strict=True))
    values = {quantity: np.full(hours, np.nan) for quantity in first.values}
    owners = {quantity: np.zeros(hours, dtype=np.intp) for quantity in first.values}
    for number, (begin, part) in enumerate(zip(begins, parts, strict=True)):
        for quantity, series in part.values.items():
            joined = values[quantity][begin : begin + part.hours]
            owner = owners[quantity][begin : begin + part.hours]
            here = ~np.isnan(series)
            unequal = np.flatnonzero(here & ~np.isnan(joined) & (joined != series))
            if unequal.size:
                hour = unequal[0]
                raise ConfigurationError(
                    f"must be {joined[hour]:g}, as in {parts[owner[hour]].source}, or the files "
                    "must not overlap",
                    file=part.source, key=f"{quantity} at {to_minutes(part.first + hour * HOUR)}",
                    value=float(series[hour]),
                )
            joined[here] = series[here]
            owner[here] = number
    files = tuple(file for part in parts for file in part.files)
    return replace(first, files=files, values=values)


def _check_alike(one: Records, other: Records) -> None:
    """Refuse to join what cannot be one series."""
    for what, ours, theirs in (
        ("quantities", sorted(one.values), sorted(other.values)),
        ("method of evapotranspiration", [one.method], [other.method]),
        ("quantities of the hour before their time", one.shifted, other.shifted),
        ("hours by which rain is late", [str(one.rain_late)], [str(other.rain_late)]),
    ):
        if ours != theirs:
            raise ConfigurationError(
                f"must have the same {what} as {one.source}, {', '.join(ours) or 'none'}; "
                f"it has {', '.join(theirs) or 'none'}",
                file=other.source,
            )
    if (other.first - one.first) % HOUR:
        raise ConfigurationError(
            f"its hours begin at {to_minutes(other.first)}, which must be a whole number of hours "
            f"from {to_minutes(one.first)}, as in {one.source}",
            file=other.source,
        )
