"""The description of a file, filled in as far as its first lines say it.

This is the only module that guesses, and what it guesses is printed for a person to read. A
question mark stands where a person must decide. Reading uses none of this.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import read_number
from greenroof_ros.base.times import parse_time
from greenroof_ros.weather.description import SEPARATORS
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    PRESSURE,
    RADIATION,
    TEMPERATURE,
    WIND,
    find_unit,
)
from greenroof_ros.weather.table import split, split_unit

_LINES = 2000
_FORMS = (
    "", "%d.%m.%Y %H:%M", "%d.%m.%Y %H:%M:%S", "%d.%m.%y %H:%M", "%d/%m/%Y %H:%M",
    "%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M", "%m/%d/%Y %H:%M:%S", "%d/%m/%y %H:%M", "%m/%d/%y %H:%M",
    "%m/%d/%y %I:%M:%S %p", "%d/%m/%y %I:%M:%S %p", "%m/%d/%Y %I:%M %p", "%m/%d/%y %I:%M %p",
    "%m/%d/%Y %I:%M:%S %p", "%Y/%m/%d %H:%M", "%Y/%m/%d %H:%M:%S", "%d-%m-%Y %H:%M",
    "%d-%m-%Y %H:%M:%S", "%d-%b-%Y %H:%M", "%d-%b-%Y %H:%M:%S", "%Y%m%d%H%M", "%Y%m%d%H",
    "%Y%m%d %H%M", "%Y%m%d %H:%M", "%Y%m%d %H",
)
# Words in the names of columns, in lower case, and words of columns that are something else.
_WORDS = {
    PRECIPITATION: r"rain|pr[eé]cip|niederschlag|regen|pluie|lluvia|neerslag|pioggia|tipping",
    DEW_POINT: r"dew|taupunkt|ros[eé]e",
    TEMPERATURE: r"temp|\bair_?t|\bt_?air",
    HUMIDITY: r"humid|\brh\b|feuchte|humidit|luftfeucht|\brf\b",
    WIND: r"wind[ _]?(speed|spd|velocity)|windgeschw|vitesse du vent|\bws(?![a-z])|^wind\b",
    PRESSURE: r"press|baro|luftdruck|\bbp\b",
    RADIATION: r"solar|radiation|strahlung|rayonnement|pyrano|\bsrad|\bslr|shortwave",
}
_OTHER = (
    r"gust|direction|\bdir|\bmax|\bmin\b|high|low\b|soil|inside|indoor|\bin temp|batt|panel|flag|"
    r"quality|qualit|chill|index|evt|water|logger|_std|apparent|bucket|daily|event|month|year|"
    r"sea level"
)
_OFFSET = re.compile(r"(?:UTC|GMT) ?([+-]\d{1,2})(?::?00)?\b")
_UNKNOWN = '"?"'


class _Found(NamedTuple):
    """Where the rows of a file are."""

    header: int
    """index of the line with the names of columns"""
    first: int
    """index of the first line with values"""
    time: tuple[int, ...]
    """positions of the columns with the time"""
    forms: list[str]
    """forms of the times that fit all rows"""


def describe(file: Path) -> str:
    """Return a description of a file as YAML.

    Raises:
        ConfigurationError: if the file cannot be read, or if no columns of times and values can be
            found in it.
    """
    encoding, lines = _read(file)
    separator, cells = _split_lines(lines)
    found = _find_rows(cells)
    if found is None:
        raise ConfigurationError(
            "has no rows that begin with a time in a known form: write its description by hand, or "
            "a file in the package's own form", file=file,
        )
    names = [" ".join(name.split()) for name in cells[found.header]]
    between = cells[found.header + 1 : found.first]
    rows = cells[found.first :]
    columns, units = _find_quantities(names, between)
    decimal, missing = _read_values([[row[n] for n in columns.values()] for row in rows])
    skipped = [n for n in range(found.first) if n != found.header]
    if skipped == [*range(len(skipped))]:
        skip = [str(len(skipped))] if skipped else []
    else:
        skip = [str(skipped)]
    time = [_quote(names[n]) for n in found.time]
    pairs = [f"time: {time[0] if len(time) == 1 else '[' + ', '.join(time) + ']'}", *(
        f"{_key(name)}: {_quote(names[n])}" for name, n in columns.items()
    )]
    form = found.forms[0] if len(found.forms) == 1 else "?"
    text = [
        f"file: {_quote(file.name)}",
        f"columns: {{{', '.join(pairs)}}}",
        *([f"time_format: {_quote(form)}" + (
            "" if len(found.forms) == 1 else f"    # {' or '.join(found.forms)}"
        )] if form else []),
        *_describe_zone([*names, *("".join(line) for line in cells[: found.header])],
                        rows[0], found),
        f"rows: {_UNKNOWN}    # is the time of a row the start or the end of its interval?",
        f"units: {{{', '.join(f'{_key(name)}: {unit}' for name, unit in units.items())}}}",
        *([f"na_values: [{', '.join(map(_quote, missing))}]"] if missing else []),
        *([f"encoding: {encoding}"] if encoding != "utf-8" else []),
        *([f"sep: {_quote(separator)}"] if separator != "," else []),
        *([f"decimal: {_quote(decimal)}"] if decimal != "." else []),
        *(f"skiprows: {number}" for number in skip),
    ]
    unused = [name for n, name in enumerate(names) if n not in (*found.time, *columns.values())]
    return "\n".join([*text, f"# not used: {', '.join(unused)}", ""])


def _read(file: Path) -> tuple[str, list[str]]:
    for encoding in ("utf-8", "cp1252"):
        with suppress(ConfigurationError):
            return encoding, [line.rstrip("\r\n") for line in islice(
                read_lines(file, encoding), _LINES)]
    return "utf-8", [*islice(read_lines(file), _LINES)]


def _split_lines(lines: Sequence[str]) -> tuple[str, list[list[str]]]:
    """Return the name of the separator, and the cells of all lines."""
    last = [line for line in lines if line.strip()][-20:]
    name = max(SEPARATORS, key=lambda name: min(line.count(SEPARATORS[name]) for line in last)
               if name != "space" else 0)
    cells = list[list[str]]()
    for line in lines:
        try:
            cells.append(split(line, SEPARATORS[name]))
        except ValueError:
            cells.append([line])
    return name, cells


def _find_rows(cells: Sequence[Sequence[str]]) -> _Found | None:
    for first, row in enumerate(cells):
        for time in ((n, m) for n in range(min(4, len(row))) for m in (n, n + 1) if m < len(row)):
            places = (time[0],) if time[0] == time[1] else time
            forms = [form for form in _FORMS if _fits(form, [row], places)]
            rows = [other for other in cells[first:] if any(other)]
            fits = [form for form in forms if _fits(form, rows, places)]
            if fits and first:
                wide = [n for n in range(first) if len(cells[n]) >= len(row) - 1]
                named = [n for n in wide if any(map(_quantity_of, cells[n]))]
                if wide:
                    return _Found((named or wide)[0], first, places, fits)
    return None


def _fits(form: str, rows: Iterable[Sequence[str]], places: tuple[int, ...]) -> bool:
    try:
        for row in rows:
            text = " ".join(row[place] for place in places)
            if form:
                datetime.strptime(text.replace(" 24", " 00"), form)  # noqa: DTZ007
            elif len(text) < 10 or parse_time(text) is None:
                return False
    except (ValueError, IndexError):
        return False
    return True


def _quantity_of(name: str) -> str | None:
    plain = name.lower()
    if re.search(_OTHER, plain):
        return None
    return next((quantity for quantity, words in _WORDS.items() if re.search(words, plain)), None)


def _find_quantities(
    names: Sequence[str], between: Sequence[Sequence[str]]
) -> tuple[dict[str, int], dict[str, str]]:
    """Return the column of every quantity, and its unit or a question mark."""
    columns, units = dict[str, int](), dict[str, str]()
    for n, name in enumerate(names):
        quantity = _quantity_of(name)
        if quantity is None or quantity in columns:
            continue
        columns[quantity], units[quantity] = n, _UNKNOWN
        texts = [split_unit(name)[1], *re.split(r"[,_ ]+", re.sub(r"\(.*", "", name))[1:]]
        for text in [*texts, *(line[n] for line in between if n < len(line))]:
            with suppress(ValueError):
                units[quantity] = _quote(find_unit(quantity, text, 1.0, 1.0).name)
                break
    return columns, units


def _read_values(rows: Sequence[Sequence[str]]) -> tuple[str, list[str]]:
    """Return the decimal mark, and texts that are no numbers."""
    texts = [text for row in rows for text in row if text]
    comma = any(re.fullmatch(r"[-+]?\d*,\d+", text) for text in texts)
    missing = dict[str, None]()
    for text in texts:
        try:
            if not math.isfinite(read_number(text.replace(",", ".") if comma else text)):
                missing[text] = None
        except ValueError:
            missing[text] = None
    return "," if comma else ".", [*missing][:10]


def _describe_zone(texts: Sequence[str], row: Sequence[str], found: _Found) -> list[str]:
    time = " ".join(row[n] for n in found.time)
    if not found.forms[0] and parse_time(time).tzinfo is not None:
        return []
    for text in texts:
        if match := _OFFSET.search(text):
            return [f"utc_offset: {float(match[1]):g}"]
        if re.search(r"\b(UTC|GMT)\b", text):
            return ["time_zone: UTC"]
    return [f"time_zone: {_UNKNOWN}    # such as Europe/Berlin, UTC, or standard for the site's"]


def _key(name: str) -> str:
    return name.replace(" ", "_")


def _quote(text: str) -> str:
    plain = re.fullmatch(r"[A-Za-z][\w ./()-]*", text) is not None
    return text if plain and text.lower() not in ("no", "yes", "on", "off", "null") else (
        '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
    )
