"""The description of a file, filled in as far as its first lines say it.

This is the only module that guesses, and what it guesses is printed for a person to read. A
question mark stands where a person must decide. Reading uses none of this.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.ranges import read_number
from greenroof_ros.base.times import parse_time
from greenroof_ros.weather.description import SEPARATORS, Description
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    HUMIDITY,
    PRECIPITATION,
    PRESSURE,
    QUANTITIES,
    RADIATION,
    TEMPERATURE,
    WIND,
    find_unit,
)
from greenroof_ros.weather.table import parse_text, split, split_unit

_LINES = 2000
_HIGHEST = 1e4  # of any quantity in our unit
_DATES = "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y", "%m/%d/%y", "%Y/%m/%d"
_CLOCKS = "%H:%M", "%H:%M:%S", "%I:%M %p", "%I:%M:%S %p", "%I:%M%p"
_FORMS = (
    "", *map(" ".join, itertools.product((*_DATES, "%d-%m-%Y", "%d-%b-%Y"), _CLOCKS)), "%Y%m%d%H%M",
    "%Y%m%d%H", "%Y%m%d %H%M", "%Y%m%d %H:%M", "%Y%m%d %H", "%Y %m %d %H", "%Y %m %d %H %M",
)
# Words in the names of columns, in lower case, and words of columns that are something else.
_WORDS = {
    PRECIPITATION: r"rain|pr[eé]cip|prectot|niederschlag|regen|pluie|lluvia|neerslag|pioggia|"
    r"nedbør|nederbörd|^rr1?$",
    DEW_POINT: r"dew|taupunkt|ros[eé]e",
    TEMPERATURE: r"temp|\bair_?t|\bt_?air|\bt2m$",
    HUMIDITY: r"humid|humed|\brh|feuchte|fuktighet|\brf\b|\bhum\b",
    WIND: r"wind[ _]?(speed|spd|velocity)|windgeschw|vitesse du vent|velocidad|middelvind|"
    r"\bws(?![a-z])|^wind\b",
    PRESSURE: r"press|baro|luftdruck|\bbp|^ps$",
    RADIATION: r"solar|radiation|strahlung|rayonnement|pyrano|\bsrad|\bslr|shortwave|allsky_sfc_sw",
}
_OTHER = (
    r"gust|direction|\bdir|\bmax|\bmin\b|high|low\b|soil|inside|indoor|\bin temp|batt|panel|flag|"
    r"quali|chill|index|evt|water|logger|_std|apparent|bucket|daily|event|month|year|week|"
    r"sea ?level|relative pressure|altimeter|change|tendenc|vapo|24 h|total|racha|rate|heat|wet"
)
_OFFSET = re.compile(r"(?:UTC|GMT) ?([+-]\d{1,2})(?::?00)?\b")
_UNKNOWN = "?"


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
    foot: int
    """number of lines after the rows"""


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
    rows = [row for row in cells[found.first : len(cells) - found.foot] if any(row)]
    full = names
    if found.header and len({*names}) < len([*filter(None, names)]):  # in two lines
        full = [" ".join(parts) for parts in zip(cells[found.header - 1], names, strict=False)]
    columns, units = _find_quantities(full, cells[found.header + 1 : found.first])
    decimal, missing = _read_values(
        [(name, units[name], [row[n] for row in rows]) for name, n in columns.items()]
    )
    names = [str(n) if names.count(name) > 1 else name for n, name in enumerate(names)]
    time, skipped = [names[n] for n in found.time], {*range(found.first)} - {found.header}
    head = " ".join(itertools.chain(names, *cells[: found.header]))
    keys = {
        "file": file.name,
        "columns": {"time": time[0] if len(time) == 1 else time}
        | {name: names[n] for name, n in columns.items()},
        "time_format": found.forms[0] if len(found.forms) == 1 else _UNKNOWN,
        **_find_zone(head, rows[0], found), "rows": _UNKNOWN, "units": units,
        "na_values": missing, "encoding": encoding, "sep": separator, "decimal": decimal,
        "skiprows": len(skipped) if skipped == {*range(len(skipped))} else sorted(skipped),
        "skipfooter": found.foot,
    }
    default = Description()
    stated = {key: value for key, value in keys.items() if value and value != getattr(default, key)}
    unused = [name for n, name in enumerate(names) if n not in (*found.time, *columns.values())]
    text = yaml.safe_dump(
        stated, sort_keys=False, allow_unicode=True, default_flow_style=None, width=1000
    )
    to_decide = {
        "time_format": " or ".join(found.forms), "time_zone": "such as Europe/Berlin, UTC, or "
        "standard for the site's utc_offset", "rows": "is the time of a row the start or the end "
        "of its interval?", "units": "of each quantity with a question mark",
    }
    comments = [
        *(f"{key}: {what}" for key, what in to_decide.items() if _UNKNOWN in str(stated.get(key))),
        f"not used: {', '.join(unused)}",
    ]
    return text + "".join(f"# {comment}\n" for comment in comments)


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
        except csv.Error:
            cells.append([line])
    return name, cells


def _find_rows(cells: Sequence[Sequence[str]]) -> _Found | None:
    for first, row in enumerate(cells[1:], start=1):
        header = [n for n in range(first) if len(cells[n]) >= len(row) - 1]
        rows = [other for other in cells[first:] if any(other)]
        for begin, count in itertools.product(range(min(8, len(row))), (4, 2, 1)):
            places = tuple(range(begin, begin + count))
            forms = [form for form in _FORMS if header and _fits(form, [row], places)]
            foot = 0 if any(_fits(form, rows[-1:], places) for form in forms) else 1
            fits = [form for form in forms if _fits(form, rows[: len(rows) - foot], places)]
            if fits:
                named = [n for n in header if any(map(_quantity_of, cells[n]))]
                return _Found((named or header[:1])[-1], first, places, fits, foot)
    return None


def _fits(form: str, rows: Iterable[Sequence[str]], places: tuple[int, ...]) -> bool:
    try:
        for row in rows:
            text = " ".join(row[place] for place in places)
            if len(text) < 8 + 2 * (not form) or parse_text(text, form) is None:
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
        texts = [split_unit(name)[1], *re.split(r"[,_ ]+", re.sub(r"\(.*", "", name))]
        for text in [*(line[n] for line in between if n < len(line)), *texts]:
            with suppress(ValueError):
                units[quantity] = find_unit(quantity, text, 1.0, 1.0).name
                break
    return columns, units


def _read_values(columns: Sequence[tuple[str, str, list[str]]]) -> tuple[str, list[str]]:
    """Return the decimal mark, and texts that are no numbers or not possible for the quantity."""
    comma = any(
        re.fullmatch(r"[-+]?\d*,\d+", text) for _, _, texts in columns for text in texts
    )
    missing = dict[str, None]()
    for name, unit_name, texts in columns:
        unit = find_unit(name, QUANTITIES[name].unit, 1.0, 1.0)
        with suppress(ValueError):
            unit = find_unit(name, unit_name, 1.0, 1.0)
        for text in filter(None, texts):
            with suppress(ValueError):
                number = read_number(text.replace(",", ".") if comma else text)
                if QUANTITIES[name].low <= (number - unit.zero) / unit.per_ours <= _HIGHEST:
                    continue
            missing[text] = None
    return "," if comma else ".", [*missing][:10]


def _find_zone(head: str, row: Sequence[str], found: _Found) -> dict[str, Any]:
    """Return the key of the zone, unless the times contain their offset."""
    if not found.forms[0] and parse_time(" ".join(row[n] for n in found.time)).tzinfo is not None:
        return {}
    if match := _OFFSET.search(head):
        return {"utc_offset": float(match[1])}
    return {"time_zone": "UTC" if re.search(r"\b(UTC|GMT)\b", head) else _UNKNOWN}
