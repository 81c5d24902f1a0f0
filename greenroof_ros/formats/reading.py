"""Files in whichever format they have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats import caspar, eccc, open_meteo, own_csv
from greenroof_ros.formats.issue import Archive
from greenroof_ros.formats.records import Records
from greenroof_ros.model.site import Site

_HEAD_BYTES = 4096


class _Format(Protocol):
    """A module that says by a file's name and first bytes whether it reads it."""

    def recognises(self, file: Path, head: bytes, /) -> bool: ...


class _OfWeather(_Format, Protocol):
    def read_records(self, file: Path, site: Site, /) -> Records: ...


class _OfForecasts(_Format, Protocol):
    def read_archive(self, files: Sequence[Path], site: Site, /) -> Archive: ...


# The first that recognises a file reads it, the last recognises any.
_WEATHER: tuple[_OfWeather, ...] = (eccc, open_meteo, own_csv)
_FORECASTS: tuple[_OfForecasts, ...] = (caspar, open_meteo, own_csv)
_Either = TypeVar("_Either", bound=_Format)


def read_records(file: Path, site: Site) -> Records:
    """Return the records of a weather file, each for the hour that starts at its time.

    Raises:
        ConfigurationError: the file is not as its format must be.
    """
    return _format_of(file, _WEATHER).read_records(file, site)


def read_forecasts(files: Sequence[Path], site: Site) -> Archive:
    """Return the forecasts in some files, which are of one format.

    Raises:
        ConfigurationError: they are of several, or one is not as its format must be.
    """
    found = _format_of(files[0], _FORECASTS)
    for file in files[1:]:
        if _format_of(file, _FORECASTS) is not found:
            raise ConfigurationError(
                f"must be of the format of {files[0].name}: an archive has one", file=file
            )
    return found.read_archive(files, site)


def _format_of(file: Path, formats: Sequence[_Either]) -> _Either:
    if file.exists() and not file.is_file():
        raise ConfigurationError("must be a regular file, or a directory of some", file=file)
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error.strerror}", file=file) from error
    return next(each for each in formats if each.recognises(file, head))
