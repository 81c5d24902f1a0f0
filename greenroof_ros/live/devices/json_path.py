"""Values in JSON messages of sensors and relays."""

from __future__ import annotations

import re
from typing import Any

_STEP = re.compile(r"\[(\d+)\]|([^.\[\]]+)")


def parse_path(path: str) -> list[str | int]:
    """Return the names and indices in a JSON path such as ``sensors[0].distance``."""
    return [int(index) if index else name for index, name in _STEP.findall(path)]


def value_at(content: Any, path: str) -> Any:
    """Return the value at a path in a JSON value.

    Raises:
        LookupError, TypeError: if there is no value at the path.
    """
    for step in parse_path(path):
        content = content[step]
    return content

