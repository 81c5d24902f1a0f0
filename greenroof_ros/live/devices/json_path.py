"""Values in JSON messages of sensors and relays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

_STEP = re.compile(r"\[(\d+)\]|([^.\[\]]+)")


def parse_path(path: str) -> list[str | int]:
    """Return the names and indices in a JSON path such as ``sensors[0].distance``."""
    return [int(index) if index else name for index, name in _STEP.findall(path)]


def value_at(content: Any, path: str) -> Any:
    """Return the value at a path in a JSON value.

    Raises:
        LookupError: if there is no value at the path.
    """
    try:
        for step in parse_path(path):
            content = content[step]
    except TypeError:
        raise LookupError(path) from None
    return content


def with_value(content: Any, path: Sequence[str | int], value: Any) -> Any:
    """Return a JSON value with another value at a path, which need not exist yet."""
    if not path:
        return value
    step, *rest = path
    if isinstance(step, str):
        items = content if isinstance(content, dict) else {}
        return {**items, step: with_value(items.get(step), rest, value)}
    old = content if isinstance(content, list) else []
    new = old + [None] * (step + 1 - len(old))
    new[step] = with_value(new[step], rest, value)
    return new
