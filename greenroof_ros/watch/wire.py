"""Messages of a graph, read from their bytes; one that is not whole, or far too large, is None."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NS = 1_000_000_000
# The largest message that is read (bytes): an ensemble of forecasts has some hundred thousand.
_MAX_BYTES = 8_000_000
# Of one array of /diagnostics: statuses, values of each, and characters of each text. An array of
# this package has under ten statuses; its longest value is a list of a hundred numbers.
_STATUSES, _VALUES, _TEXT = 1000, 100, 20_000


@dataclass(frozen=True)
class WireStatus:
    """One status of /diagnostics.

    Attributes:
        name: fully qualified name of a node; for a part of it, followed by ``": "`` and the part.
        level: 0 OK, 1 WARN, 2 ERROR, 3 STALE.
        message: a sentence.
        values: as on the wire: JSON texts from this package's nodes, plain texts from their parts.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def _read_message(type_name: str, message: bytes) -> Any:
    """Return a message as an object of its ROS class; None if it is not whole, or too large."""
    from rclpy.serialization import deserialize_message  # only who joins a graph has ROS

    from greenroof_ros.graph.messages import message_class

    if len(message) > _MAX_BYTES:
        return None
    with suppress(Exception):  # of the middleware, or a text that is not UTF-8
        return deserialize_message(message, message_class(type_name))
    return None


def read_number(message: bytes) -> float | None:
    """Return the value of a ``std_msgs/msg/Float64``."""
    read = _read_message("std_msgs/msg/Float64", message)
    return None if read is None else float(read.data)


def read_clock(message: bytes) -> int | None:
    """Return the time of a ``rosgraph_msgs/msg/Clock`` (ns since 1970)."""
    read = _read_message("rosgraph_msgs/msg/Clock", message)
    return None if read is None else _read_stamp(read.clock)


def read_rows(message: bytes) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the numbers of a ``std_msgs/msg/Float64MultiArray``, and those in front of them.

    The numbers have the shape of the layout, if that has at least two dimensions. ``data_offset``
    skips those in front: for a forecast when it was issued and when its steps end.
    """
    read = _read_message("std_msgs/msg/Float64MultiArray", message)
    if read is None:
        return None
    front, numbers = np.split(np.asarray(read.data, np.float64), [read.layout.data_offset])
    shape = [dimension.size for dimension in read.layout.dim]
    with suppress(ValueError):  # of another size
        return numbers.reshape(shape) if len(shape) >= 2 else numbers, front
    return None


def read_statuses(message: bytes) -> tuple[int, list[WireStatus]] | None:
    """Return the time (ns) and the statuses of a ``diagnostic_msgs/msg/DiagnosticArray``.

    Texts and lists that are longer than the limits above are cut: no honest sender has such.
    """
    read = _read_message("diagnostic_msgs/msg/DiagnosticArray", message)
    if read is None:
        return None
    return _read_stamp(read.header.stamp), [
        # An unknown level is treated as ERROR, the worst that someone can do something about.
        WireStatus(
            status.name[:_TEXT], level if (level := status.level[0]) <= 3 else 2,
            status.message[:_TEXT],
            {pair.key[:_TEXT]: pair.value[:_TEXT] for pair in status.values[:_VALUES]},
        )
        for status in read.status[:_STATUSES]
    ]


def _read_stamp(time: Any) -> int:
    return int(time.sec) * _NS + int(time.nanosec)
