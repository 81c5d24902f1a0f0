"""The description of a file, filled in as far as its first lines say it.

This is the only module that guesses, and what it guesses is printed for a person to read. A
question mark stands where a person must decide. Reading uses none of this.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import yaml

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_lines
from greenroof_ros.base.parameter import parameters_of
from greenroof_ros.base.ranges import read_number
from greenroof_ros.base.text import escape
from greenroof_ros.weather.description import LONG, SEPARATORS, TIME, Description
from greenroof_ros.weather.quantities import PRECIPITATION, QUANTITIES, Unit, find_unit
from greenroof_ros.weather.table import parse_text, split, split_unit

_LINES = 10_000
# The first that fits the file is used.
_ENCODINGS = "utf-8", "cp1252"
# Lines after the rows that can contain sums and remarks.
_FOOT = 4
_HIGHEST = 1e4  # of any quantity in our unit
_DATES = (
    "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y", "%m/%d/%y", "%Y/%m/%d", "%d-%m-%Y",
    "%d-%b-%Y",
)
_CLOCKS = "%H:%M", "%H:%M:%S", "%I:%M %p", "%I:%M:%S %p", "%I:%M%p", "%Hh%M", "%H.%M"
_FORMS = (
    "", *_DATES, "%Y%m%d", "%Y %m %d", *map(" ".join, itertools.product(_DATES, _CLOCKS)),
    "%Y-%m-%d %Hh%M", "%Y-%m-%d %H.%M", "%Y%m%d%H", "%Y%m%d%H%M", "%Y%m%d %H%M", "%Y%m%d %H:%M",
    "%Y%m%d %H", "%Y %m %d %H", "%Y %m %d %H %M",
)
# Words in the names of columns, in lower case, and words of columns that are something else.
_WORDS = {
    "precipitation": r"rain|pr[eé]cip|prectot|niederschlag|regen|pluie|lluvia|neerslag|pioggia|"
    r"nedbør|nederbörd|^rr1?$",
    "dew point": r"dew|taupunkt|ros[eé]e",
    "temperature": r"temp|\bair_?t|\bt_?air|\bt2m$",
    "relative humidity": r"humid|humed|\brh|feuchte|fuktighet|\brf\b|\bhum\b",
    "wind speed": r"wind[ _]?(speed|spd|velocity)|windgeschw|vitesse du vent|velocidad|middelvind|"
    r"\bws(?![a-z])|^wind\b",
    "station pressure": r"press|baro|luftdruck|\bbp|^ps$",
    "solar radiation": r"solar|radiation|strahlung|rayonnement|pyrano|\bsrad|\bslr|shortwave|"
    r"allsky_sfc_sw",
}
_OTHER = (
    r"gust|direction|\bdir|\bmax|\bmin\b|high|low\b|soil|inside|indoor|\bin temp|batt|panel|flag|"
    r"quali|chill|index|evt|water|logger|_std|apparent|bucket|daily|event|month|year|week|"
    r"sea ?level|rel\w*\.? press|altimeter|change|tendenc|vapo|24 h|total|racha|rate|heat|wet"
)
# A code of missing values is a number, or a text without digits, but not the T of a trace of rain.
_CODE = re.compile(r"[-+]?\d*([.,]\d+)?|(?!t$|tr$|trace$)\D*", re.IGNORECASE)
_COMMA = re.compile(r"[-+]?\d*,\d+")
_UNKNOWN = "?"


def describe(file: Path) -> str:
    """Return a description of a file as YAML.

    Args:
        file: the file.

    Raises:
        ConfigurationError: if the file cannot be read, or if no columns of times and values can be
            found in it.
    """
    encoding, lines = _read(file)
    separator, cells, header, first, last, time, forms = _find_rows(file, lines)
    rows = [row for row in cells[first : last + 1] if any(row)]
    times = [parse_text(" ".join(row[n] for n in time), forms[0]) for row in rows]
    if len(rows) > 1 and len({each.time() for each in times}) == 1:
        raise ConfigurationError(f"has a row for each day, but {LONG}", file=file)
    full = names = [" ".join(name.split()) for name in cells[header]]
    counts = Counter(names)
    if header and any(counts[name] > 1 for name in counts if name):  # in two lines
        full = [" ".join(parts) for parts in zip(cells[header - 1], names, strict=False)]
    names = [str(n) if counts[name] > 1 else name for n, name in enumerate(names)]
    comma = any(_COMMA.fullmatch(text) for row in rows for text in row)
    columns, units, missing = {TIME: [names[n] for n in time]}, dict[str, str](), list[str]()
    between, two_rains = cells[header + 1 : first], False
    for name, title, *texts in itertools.zip_longest(names, full, *between, *rows, fillvalue=""):
        quantity = _quantity_of(title)
        if quantity is None or quantity in columns or name in columns[TIME]:
            two_rains = two_rains or quantity == PRECIPITATION
            continue
        words = re.split(r"[,_ ]+", re.sub(r"\(.*", "", title))
        unit = _find_unit(quantity, [*texts[: len(between)], split_unit(title)[1], *words])
        columns[quantity], units[quantity] = [name], unit.name
        missing += (
            text for text in texts[len(between) :]
            if text and not _is_value(quantity, unit, text.replace(",", ".") if comma else text)
        )
    missing = [*dict.fromkeys(missing)]
    if two_rains or PRECIPITATION not in columns:
        columns[PRECIPITATION] = [_UNKNOWN]
    used, skipped = {*itertools.chain(*columns.values())}, {*range(first)} - {header}
    stated = {
        "file": file.name,
        "columns": {name: each if len(each) > 1 else each[0] for name, each in columns.items()},
        "time_format": forms[0] if len(forms) == 1 else _UNKNOWN,
        "time_zone": "" if times[0].tzinfo else _UNKNOWN, "rows": _UNKNOWN, "units": units,
        "na_values": missing[:10] if all(map(_CODE.fullmatch, missing)) else _UNKNOWN,
        "encoding": encoding, "sep": separator, "decimal": "," if comma else ".",
        "skiprows": len(skipped) if skipped == {*range(len(skipped))} else sorted(skipped),
        "skipfooter": len(cells) - 1 - last,
    }
    usual = vars(Description())
    stated = {key: value for key, value in stated.items() if value and value != usual[key]}
    comments = [
        *(f"{key.name}: {key.description}" for key in parameters_of(Description)
          if _UNKNOWN in str(stated.get(key.name))),
        *(f"time_format can be {form}" for form in forms if len(forms) > 1),
        *(f"not a number: {text}" for text in missing if stated.get("na_values") == _UNKNOWN),
        f"not used: {', '.join(name for name in names if name not in used)}",
    ]
    printable = "".join([file.name, *names, *missing]).isprintable()
    return yaml.safe_dump(
        stated, sort_keys=False, allow_unicode=printable, default_flow_style=None, width=1000
    ) + "".join(f"# {escape(comment)}\n" for comment in comments)


def _read(file: Path) -> tuple[str, list[str]]:
    for encoding in _ENCODINGS:
        with suppress(ConfigurationError):
            lines = itertools.islice(read_lines(file, encoding), _LINES)
            return encoding, [line.rstrip("\r\n") for line in lines]
    return "", [*read_lines(file, _ENCODINGS[0])]  # its error


def _find_rows(
    file: Path, lines: Sequence[str]
) -> tuple[str, list[list[str]], int, int, int, tuple[int, ...], list[str]]:
    """Return where the rows of a file are, by the separator that divides its last lines most often.

    Returns:
        The separator, the cells of all lines, the lines of the header, of the first and of the last
        row, the positions of the columns with the time, and the forms of times that fit all rows.

    Raises:
        ConfigurationError: if no rows contain a time, or no header is before them.
    """
    end = [line for line in lines if line.strip()][-20:]
    for separator in sorted(SEPARATORS, key=lambda name: (
        name == "space", -min(line.count(SEPARATORS[name]) for line in end)
    )):
        cells = [split(line, SEPARATORS[separator]) or [line] for line in lines]
        filled = [n for n, row in enumerate(cells) if any(row)]
        feet = range(min(_FOOT + 1, len(filled)))
        for foot, begin, count in itertools.product(feet, range(8), (1, 2, 3, 4)):
            time = tuple(range(begin, begin + count))
            rows, forms = _find_times(cells, filled[: len(filled) - foot], time)
            # A date alone is the same in many rows; an hour can occur twice in autumn.
            if 2 * len({(*cells[n][begin : begin + count],) for n in rows}) > len(rows) > foot:
                last = rows[-1] if foot else len(cells) - 1
                header = _find_header(file, cells, rows[0])
                return separator, cells, header, rows[0], last, time, forms
    raise ConfigurationError(
        f"has no rows with a time in a known form in its first {_LINES} lines: write its "
        "description by hand, or a file in the package's own form", file=file,
    )


def _find_times(
    cells: Sequence[Sequence[str]], lines: Sequence[int], time: Iterable[int]
) -> tuple[list[int], list[str]]:
    """Return the lines with a time, which must be the last lines, and the forms that fit them."""
    fits = {
        form: [n for n in lines if _is_time(cells[n], time, form)]
        for form in _FORMS if _is_time(cells[lines[-1]], time, form)
    }
    rows = max(fits.values(), key=len, default=[])
    if rows != lines[len(lines) - len(rows) :]:
        return [], []
    return rows, [form for form in fits if fits[form] == rows]


def _find_header(file: Path, cells: Sequence[Sequence[str]], first: int) -> int:
    """Return the line of the header, which is one of those before the first row."""
    heads = [n for n in range(first) if len(cells[n]) >= max(2, len(cells[first]) - 1)]
    named = [n for n in heads if any(map(_quantity_of, cells[n]))]
    if not heads:
        raise ConfigurationError(
            "is a row, but must be a header with the names of the columns", file=file,
            line=first + 1,
        )
    return (named or heads[:1])[-1]


def _is_time(row: Sequence[str], places: Iterable[int], form: str) -> bool:
    with suppress(ValueError, IndexError):
        text = " ".join(row[place] for place in places)
        is_long = text[:1].isdecimal() and len(text) >= 8 + 2 * (not form)
        return is_long and bool(parse_text(text, form))
    return False


def _quantity_of(name: str) -> str | None:
    plain = name.lower()
    if re.search(_OTHER, plain):
        return None
    return next((quantity for quantity, words in _WORDS.items() if re.search(words, plain)), None)


def _find_unit(quantity: str, names: Iterable[str]) -> Unit:
    """Return the unit of the quantity among the names, or a question mark if there is not one."""
    units = set[Unit]()
    for name in filter(None, names):
        with suppress(ValueError):
            units.add(find_unit(quantity, name, 1.0, 1.0))
    return units.pop() if len(units) == 1 else Unit(_UNKNOWN)


def _is_value(quantity: str, unit: Unit, text: str) -> bool:
    """Return whether a text is a number that the quantity can have."""
    with suppress(ValueError):
        value = (read_number(text) - unit.zero) / unit.per_ours
        return QUANTITIES[quantity].low <= value <= _HIGHEST
    return False
