"""Descriptions of weather files: what the columns mean, how times are written, what is missing.

A description is a YAML file beside the weather file, with keys that are named as in
``pandas.read_csv`` where it has them::

    file: gauge_*.csv
    columns: {time: [Datum, Uhrzeit], rain: "Niederschlag [mm]"}
    time_format: "%d.%m.%Y %H:%M"
    time_zone: Europe/Berlin
    rows: end

``config/formats/*.yaml`` describes the files of services in the same way, with the beginning of the
header by which a file is recognised. Every key is optional in this project's own form, whose header
consists of ``time`` and columns ``name [unit]``; comments at the head of such a file can contain
the keys of :data:`IN_COMMENTS`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import YamlMapping, parse_yaml, read_yaml, shared_directory
from greenroof_ros.base.parameter import entry, find, make_record
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES

TIME = "time"
START, END = "start", "end"
STANDARD = "standard"
"""time zone of times in the site's standard time, ``utc_offset``"""
REANALYSIS, FORECAST = RAIN_KINDS = ("reanalysis", "forecast")
"""Rain from a weather model, for a past and for a future period."""
PLACE = "latitude", "longitude"
SEPARATORS = {",": ",", ";": ";", "|": "|", "tab": "\t", "space": " "}
"""separators by their names"""
TIPS = "if each row is a tip of a gauge, sum the tips to 5 minutes (doc/reference/file-formats.md)"
LONG = "the storms within a longer sum are lost: use a station with hours or minutes"
"""what to do with files of other kinds"""
IN_COMMENTS = (
    "rows", "step", "time_zone", "utc_offset", *PLACE, "wind_height", "rain_late", "rain_kind",
)
"""keys that the comments at the head of a file can contain, as in ``# rows: end``"""
_LISTS = "columns", "na_values", "zero_values", "flag_values", "header"
_COMMENT = re.compile(rf"#\s*((?:{'|'.join(IN_COMMENTS)}|stamped)\s*:.*)")


@dataclass(frozen=True)
class Description:
    """What a weather file means."""

    name: str = entry("name of the format, for messages", default="own form")
    file: str = entry("the file, or a pattern such as gauge_*.csv, beside the description",
                      default="")
    header: tuple[str, ...] = entry("first cells of the header, by which the file of a service is "
                                    "recognised", default=())
    columns: dict[str, tuple[str, ...]] = entry(
        "column of each quantity, and one or several of the time, by name or number from 0",
        factory=dict)
    units: dict[str, str] = entry("unit of each quantity, unless the header states it in brackets",
                                  factory=dict)
    time_format: str = entry("form of the times, as in strptime", default="")
    time_zone: str = entry(
        "time zone of times without an offset, by default the site's, such as Europe/Berlin, or "
        f"{STANDARD} for the site's utc_offset", default="")
    utc_offset: float | None = entry("offset of the times from UTC, in place of time_zone",
                                     -12.0, 14.0, unit="h", default=None)
    rows: str = entry("whether the time of a row is the start or the end of its interval",
                      choices=(START, END), default=START)
    step: float | None = entry("interval between rows; by default, their median",
                               1.0, 86400.0, unit="s", default=None)
    na_values: tuple[str, ...] = entry("texts that denote a missing value", default=())
    zero_values: tuple[str, ...] = entry("texts that denote a trace of rain, which counts as 0",
                                         default=())
    flags: dict[str, str] = entry("column with the flag of each quantity", factory=dict)
    flag_values: tuple[str, ...] = entry("flags of missing values", default=())
    encoding: str = entry("encoding of the text, such as cp1252", default="utf-8")
    sep: str = entry("separator between cells", choices=(*SEPARATORS,), default=",")
    decimal: str = entry("decimal mark", choices=(".", ","), default=".")
    skiprows: tuple[int, ...] = entry("numbers of the lines to skip, from 0, or how many at "
                                      "the start", 0, 10_000, default=())
    skipfooter: int = entry("number of lines to skip at the end", 0, 1000, default=0)
    latitude: float | None = entry("latitude, positive to the north", -90.0,
                                   90.0, unit="degrees", default=None)
    longitude: float | None = entry("longitude, positive to the east", -180.0,
                                    180.0, unit="degrees", default=None)
    wind_height: float | None = entry("height at which the wind was measured", 0.5, 100.0,
                                      unit="m", default=None)
    rain_late: int = entry("delay of the rain's times, which is reported but not corrected", 0, 1,
                           unit="h", default=0)
    rain_kind: str = entry("source of rain that no gauge measured", choices=("", *RAIN_KINDS),
                           default="")
    keys: frozenset[str] = frozenset()
    """the keys that were stated"""

    @property
    def stated(self) -> dict[str, Any]:
        """The values of the keys that were stated."""
        return {key: getattr(self, key) for key in self.keys}

    def check_unused(self, form: str, file: Path) -> None:
        """Reject a description of a file whose form is known, so that the keys have no effect.

        Raises:
            ConfigurationError: if the description states more than the file and its encoding.
        """
        for key in self.stated.keys() - {"name", "file", "encoding"}:
            raise ConfigurationError(
                f"has no effect, because the form of {file} is known: {form}", key=key,
                file=self.name if self.file else None,
            )


def make_description(values: Mapping[str, Any], path: Path | None = None) -> Description:
    """Return the description with the given keys.

    Args:
        values: values of the keys.
        path: file that contains them; errors name the file and the line of the key.

    Raises:
        ConfigurationError: if a key is unknown, or a value is not valid for it.
    """
    try:
        made = make_record(Description, {key: _shape(key, values[key]) for key in values})
        made = replace(made, keys=frozenset(values))
        for key, expected in _find_mistakes(made):
            raise ConfigurationError(expected, key=key, value=getattr(made, key, None))
    except ConfigurationError as error:
        if not isinstance(values, YamlMapping):
            raise
        line = find(values, error.key or "")[0] or min(values.lines.values(), default=1)
        raise ConfigurationError(
            error.expected, file=path, line=line, key=error.key, value=error.value
        ) from None
    return made


def _shape(key: str, value: Any) -> Any:
    """Return a value with lists of texts, as the key has it, where a file may be shorter."""
    if value == "?":
        raise ConfigurationError(
            "must be decided, because the file does not say it", key=key, value=value
        )
    if isinstance(value, Mapping):
        shaped = {usual_name(each): _shape(f"{key}.{each}", value[each]) for each in value}
        if len(shaped) < len(value):
            raise ConfigurationError("must name a quantity only once", key=key, value=[*value])
        return shaped
    if key == "skiprows" and isinstance(value, int) and value >= 0:
        return [*range(value)]
    if key.partition(".")[0] in _LISTS:
        return [_as_text(each) for each in (value if isinstance(value, (list, tuple)) else [value])]
    return "tab" if (key, value) == ("sep", "\t") else _as_text(value) if "." in key else value


def _as_text(value: Any) -> Any:
    return str(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _find_mistakes(made: Description) -> Iterator[tuple[str, str]]:
    """Yield the key and the correction of every mistake."""
    for key, others in (("columns", (TIME, *PLACE)), ("units", ()), ("flags", ())):
        for name in getattr(made, key):
            if quantity_of(name) not in QUANTITIES and name not in others:
                yield f"{key}.{name}", f"must be one of {', '.join((*others, *QUANTITIES))}"
            if made.columns and quantity_of(name) not in map(quantity_of, made.columns):
                yield f"{key}.{name}", "has no effect, because columns does not name this quantity"
    for name, columns in made.columns.items():
        if len(columns) != 1 and name != TIME:
            yield f"columns.{name}", "must be one column"
    if made.columns and TIME not in made.columns:
        yield f"columns.{TIME}", "must name the column of the times"
    if made.header and made.file:
        yield "header", "has no effect: only the descriptions in config/formats recognise a file"
    if made.time_zone and made.utc_offset is not None:
        yield "utc_offset", "must not be stated together with time_zone"
    if "%Z" in made.time_format:  # strptime reads a zone's name, and ignores it
        yield "time_format", "must not contain %Z; state the zone in time_zone or utc_offset"
    zone = "UTC" if made.time_zone in ("", STANDARD) else made.time_zone
    form, some_time = made.time_format, datetime(2021, 7, 7, tzinfo=timezone.utc)
    for key, name, look_up, expected in (
        ("time_zone", zone, ZoneInfo, "the name of a time zone, such as Europe/Berlin or UTC"),
        ("encoding", made.encoding, "".encode, "the name of an encoding, such as utf-8 or cp1252"),
        ("time_format", some_time.strftime(form), lambda text: datetime.strptime(text, form),  # noqa: DTZ007
         "the form of a time, such as %d.%m.%Y %H:%M, with each directive only once"),
    ):
        try:
            look_up(name)
        except (LookupError, ValueError, OSError, re.error):
            yield key, f"must be {expected}"


def usual_name(name: str) -> str:
    """Return the usual name of a quantity, which may be written with underscores, or as rain."""
    plain = name.replace("_", " ")
    return PRECIPITATION if plain == "rain" else plain


def quantity_of(name: str) -> str:
    """Return the quantity of a name; the name of evapotranspiration begins with its method."""
    return EVAPOTRANSPIRATION if name.endswith(EVAPOTRANSPIRATION) else name


def read_description(path: Path) -> Description:
    """Read a description.

    Raises:
        ConfigurationError: if the file is not a description; the message names the line and key.
    """
    content = read_yaml(path)
    content.setdefault("name", path.name)
    return make_description(content, path)


def read_comments(
    path: Path, comments: Iterable[tuple[int, str]], given: Description
) -> Description:
    """Return the description in comments at the head of a file, such as ``# rows: end``.

    Comments that do not begin with a key are prose, and state nothing.

    Args:
        path: the file, for messages.
        comments: number and text of each line.
        given: description whose keys come first.

    Raises:
        ConfigurationError: if a comment that begins with a key does not consist of keys and values,
            or two comments state the same key.
    """
    stated = {
        number: match[1] for number, text in comments
        if (match := _COMMENT.fullmatch(text.strip().strip(',;"')))
    }
    lines = [f"{stated[n]}," if n in stated else "" for n in range(1, max(stated, default=0) + 1)]
    made = make_description(parse_yaml("{" + "\n".join(lines) + "}", path), path)
    own = given.stated
    if own.keys() & {"time_zone", "utc_offset"}:
        made = replace(made, time_zone="", utc_offset=None)
    return replace(made, **own, keys=made.keys | given.keys)


@functools.cache
def service_descriptions() -> tuple[Description, ...]:
    """Return the descriptions of services' files, from ``config/formats``."""
    return tuple(map(read_description, sorted(
        (shared_directory() / "config" / "formats").glob("*.yaml")
    )))


def find_service(line: str) -> Description | None:
    """Return the description of the service whose files have this header; None if unknown."""
    for described in service_descriptions():
        cells = [cell.strip('" ') for cell in line.strip().split(SEPARATORS[described.sep])]
        if (*cells[: len(described.header)],) == described.header:
            return described
    return None
