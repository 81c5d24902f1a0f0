"""Messages from a graph, decoded from bytes; an incomplete or far too large message is None."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from greenroof_ros.ros.reports import Status, read_statuses

# The largest message that is read (bytes): an ensemble of forecasts has some hundred thousand.
_MAX_BYTES = 8_000_000


def read_value(type_name: str, message: bytes) -> Any:
    """Return the value of a message; for rows of numbers, also the numbers before the offset.

    See :func:`greenroof_ros.ros.messages.decoder` and
    :func:`greenroof_ros.ros.messages.decode_numbers`.
    """
    from greenroof_ros.ros.messages import decode_numbers, decoder  # only a graph needs ROS

    with suppress(Exception):  # from the middleware, or because a text is not UTF-8
        if len(message) <= _MAX_BYTES:
            is_array = type_name == "std_msgs/msg/Float64MultiArray"
            return decode_numbers(message) if is_array else decoder(type_name)(message)
    return None


def read_reports(message: bytes) -> tuple[int, list[Status]] | None:
    """Return the time (ns) and the statuses of a message on /diagnostics or /alarms."""
    with suppress(Exception):
        return read_statuses(message)
    return None
