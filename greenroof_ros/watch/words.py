"""Formats of the numbers and sentences on the page and in the status output."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from shutil import which
from typing import Any

from greenroof_ros.base.text import clean_text
from greenroof_ros.interface.topics import Display, read_topics

UNKNOWN = "unknown"
# A command in an advice, rather than the service of that name.
_COMMAND = re.compile(r"\bgreenroof(?= (?:live|outlet|release|reset|watch)\b)")


def write_number(value: float, unit: str, decimals: int, factor: float = 1.0) -> str:
    """Write a number with its unit, such as ``45.3 mm``.

    Args:
        value: value in its SI unit.
        unit: unit to show; empty for none.
        decimals: number of decimals to show.
        factor: factor that converts the SI unit to the unit to show.
    """
    text = f"{value * factor:.{decimals}f}"
    text = text.removeprefix("-") if float(text) == 0 else text
    return f"{text} {unit}" if unit else text


def find_display(topic: str) -> Display:
    """Return the format in which the interface shows the values of a topic."""
    display = read_topics()[topic].display
    assert display is not None, topic
    return display


def write_value(topic: str, value: float) -> str:
    """Write a topic's value, or a difference of values, in the interface's format: ``45.3 mm``."""
    display = find_display(topic)
    return write_number(value, display.unit, display.decimals, display.factor)


def write_litres(volume: float) -> str:
    """Write a volume (m3) in litres."""
    return write_number(volume, "L", 0, 1e3)


def text_of(values: Mapping[str, Any], key: str) -> str:
    """Return a text among the values that a node reports; empty if it reports none."""
    value = values.get(key)
    return clean_text(value) if isinstance(value, str) else ""


def number_in(values: Mapping[str, Any], key: str) -> float | None:
    """Return a number among the values that a node reports; None if it reports none."""
    value = values.get(key)
    return value if isinstance(value, (int, float)) else None


def complete_commands(text: str) -> str:
    """Return an advice with its commands as they work in a terminal of this machine.

    They have the path of the program, if the shell does not find it, and the ROS domain.
    """
    domain, path = os.environ.get("ROS_DOMAIN_ID", "0"), Path(sys.executable).with_name("greenroof")
    before = "" if domain in ("", "0") else f"ROS_DOMAIN_ID={domain} "
    return _COMMAND.sub(before + ("greenroof" if which("greenroof") else str(path)), text)
