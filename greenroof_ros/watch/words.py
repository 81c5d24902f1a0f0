"""Formats of the numbers, times and sentences on the page and in the status output."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterable, Mapping
from datetime import datetime, tzinfo
from functools import cache
from pathlib import Path
from shutil import which
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.base.times import duration
from greenroof_ros.interface.topics import Display, read_topics

NOT_PLAUSIBLE = "not a plausible value"
UNKNOWN = "unknown"
# The unit as it is written in logs.
_CUBIC = re.compile(r"\bm3\b")
# A command in an advice, rather than the service of that name.
_COMMAND = re.compile(r"\bgreenroof(?= (?:live|release|reset|watch)\b)")
SPACE = "\N{NO-BREAK SPACE}"
"""Space between a number and its unit, where no line may end."""
# Maximum number of names of nodes that are listed.
_MAX_NAMES = 3


def write_number(value: float, decimals: int) -> str:
    """Write a number with the given decimals, zero without a sign, and *unknown* from 1e12."""
    if not math.isfinite(value) or abs(value) >= 1e12:
        return UNKNOWN
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def write_quantity(value: float, unit: str, decimals: int, factor: float = 1.0) -> str:
    """Write a number with its unit, such as ``45.3 mm``.

    Args:
        value: value in its SI unit.
        unit: unit to show.
        decimals: number of decimals to show.
        factor: factor that converts the SI unit to the unit to show.
    """
    text = write_number(value * factor, decimals)
    return text if text == UNKNOWN or not unit else f"{text}{SPACE}{unit}"


def write_value(topic: str, value: float) -> str:
    """Write a topic's value, or a difference of values, in the interface's format: ``45.3 mm``.

    Args:
        topic: name of the topic in the interface.
        value: value in the topic's unit.
    """
    display = find_display(topic)
    return write_quantity(value, display.unit, display.decimals, display.factor)


@cache
def find_display(topic: str) -> Display:
    """Return the format in which the interface shows the values of a topic."""
    display = read_topics()[topic].display
    if display is None:
        raise KeyError(topic)
    return display


def write_rain(metres: float) -> str:
    """Write an amount of rain, as in ``12 mm``; with one decimal below 10 mm, as in ``1.2 mm``."""
    return write_quantity(metres, "mm", 0 if abs(metres) >= 0.00995 else 1, 1e3)


def write_litres(volume: float) -> str:
    """Write a volume (m3) in litres."""
    return write_quantity(volume, "L", 0, 1e3)


def write_horizon(seconds: float) -> str:
    """Format the time covered by a forecast or plan, in whole hours from 90 min on: ``12 h``."""
    if seconds >= 5400:
        return write_quantity(seconds / 3600, "h", 0)
    return duration(round(seconds)).replace(" ", SPACE)


def convert_time(seconds: float, zone: tzinfo) -> datetime | None:
    """Return a time since 1970 (s) in a time zone; None if it is outside the calendar's range."""
    try:
        return datetime.fromtimestamp(seconds, zone)
    except (ValueError, OverflowError, OSError):
        return None


def write_clock_time(seconds: float, zone: tzinfo, now: float) -> str:
    """Write a time since 1970 (s), as in ``05:00:00``, with the date unless it is today."""
    at, today = convert_time(seconds, zone), convert_time(now, zone)
    if at is None:
        return UNKNOWN
    same = today is not None and at.date() == today.date()
    return at.strftime("%H:%M:%S" if same else "%d %b %H:%M:%S")


def write_coming_time(seconds: float, zone: tzinfo, now: float) -> str:
    """Write a future time (s since 1970): ``06:20``, ``tomorrow 06:20``, or a date and time."""
    at, today = convert_time(seconds, zone), convert_time(now, zone)
    if at is None or today is None:
        return UNKNOWN
    days = (at.date() - today.date()).days
    clock = at.strftime("%H:%M")
    return clock if days == 0 else f"tomorrow {clock}" if days == 1 else at.strftime("%d %b %H:%M")


def clean_sentence(text: str) -> str:
    """Return a node's sentence with m³ for m3, in printable characters."""
    return _CUBIC.sub("m³", clean_text(text))


def text_of(values: Mapping[str, Any], key: str) -> str:
    """Return a text among the values that a node reports; empty if it reports none."""
    value = values.get(key)
    return clean_sentence(value) if isinstance(value, str) else ""


def name_source(status: str, role: str = "") -> str:
    """Return a plain name for the source of a status: ``Roof sensor`` for ``/roof_sensor: x``.

    Args:
        status: name of the status.
        role: role of the node, which is the name of a controller; empty if it has none.
    """
    name = "controller" if role == "controller" else status.partition(": ")[0].rpartition("/")[2]
    name = name.replace("_", " ")
    return f"{name[:1].upper()}{name[1:]}"


def list_names(names: Iterable[str]) -> str:
    """List only the first few node names, since the number of reported nodes is unlimited."""
    listed = sorted({*names})
    more = len(listed) - _MAX_NAMES
    return " and ".join(listed[:_MAX_NAMES] + ([f"{more} more"] if more > 0 else []))


def complete_commands(text: str) -> str:
    """Return an advice with its commands as they work in a terminal of this machine.

    They have the path of the program, if the shell does not find it, and the ROS domain.
    """
    domain, path = os.environ.get("ROS_DOMAIN_ID", "0"), Path(sys.executable).with_name("greenroof")
    before = "" if domain in ("", "0") else f"ROS_DOMAIN_ID={domain} "
    return _COMMAND.sub(before + ("greenroof" if which("greenroof") else str(path)), text)
