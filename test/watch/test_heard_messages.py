"""Messages as rosbags writes them; and what is not whole."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.watch import wire

STORE = get_typestore(Stores.ROS2_JAZZY)
NUMBER, CLOCK = "std_msgs/msg/Float64", "rosgraph_msgs/msg/Clock"


def written(name: str, *fields: Any) -> bytes:
    """Return a message of a type in CDR."""
    package, _, kind = name.partition("/")
    name = f"{package}/msg/{kind}"
    return bytes(STORE.serialize_cdr(STORE.types[name](*fields), name))


def made(name: str, *fields: Any) -> Any:
    package, _, kind = name.partition("/")
    return STORE.types[f"{package}/msg/{kind}"](*fields)


def rows_message(values: np.ndarray[Any, Any], shape: tuple[int, ...], offset: int = 0) -> Any:
    dimensions = [
        made("std_msgs/MultiArrayDimension", label, size, 0)
        for label, size in zip(("member", "step", "third"), shape, strict=False)
    ]
    return made("std_msgs/MultiArrayLayout", dimensions, offset), values


def test_messages_are_read_as_written() -> None:
    """Of each type, with rows of any shape."""
    assert wire.read_value(NUMBER, written("std_msgs/Float64", -1.5e300)) == -1.5e300
    clock = written(
        "rosgraph_msgs/Clock", made("builtin_interfaces/Time", 1_700_000_000, 7)
    )
    assert wire.read_value(CLOCK, clock) == 1_700_000_000_000_000_007
    values = np.arange(6.0)
    for shape, offset, expected in (
        ((), 0, values), ((6,), 0, values), ((2, 2), 2, values[2:].reshape(2, 2)),
        ((), 6, values[:0]),
    ):
        message = written(
            "std_msgs/Float64MultiArray", *rows_message(values, shape, offset)
        )
        read = wire.read_rows(message)
        assert read is not None
        np.testing.assert_array_equal(np.asarray(read.values), expected, strict=True)
        np.testing.assert_array_equal(np.asarray(read.front), values[:offset], strict=True)


READERS: list[tuple[Callable[[bytes], Any], bytes]] = [
    (partial(wire.read_value, NUMBER), written("std_msgs/Float64", 1.0)),
    (
        partial(wire.read_value, CLOCK),
        written("rosgraph_msgs/Clock", made("builtin_interfaces/Time", 1, 2)),
    ),
    (
        wire.read_rows,
        written("std_msgs/Float64MultiArray", *rows_message(np.arange(6.0), (2, 3))),
    ),
]


@pytest.mark.parametrize(("reader", "message"), READERS)
def test_what_is_not_whole_is_none(reader: Callable[[bytes], Any], message: bytes) -> None:
    """Cut anywhere, it is None; with any bytes changed, it is a value or None, and never raises."""
    assert reader(message) is not None
    for length in range(len(message)):
        # Padding at the end of a message may be missing.
        assert reader(message[:length]) is None or message[length:].strip(b"\0") == b""
    random = Random(1)
    for _ in range(1000):
        changed = bytearray(message)
        for _ in range(random.randint(1, 4)):
            changed[random.randrange(len(changed))] = random.choice((0, 1, 127, 255))
        reader(bytes(changed))


def test_a_layout_of_another_size_is_none() -> None:
    """The nodes refuse it, too."""
    message = written("std_msgs/Float64MultiArray", *rows_message(np.arange(6.0), (2, 4)))
    assert wire.read_rows(message) is None


def test_a_message_that_is_far_too_large_is_none() -> None:
    numbers = written("std_msgs/Float64MultiArray", *rows_message(np.zeros(1_000_000), ()))
    assert wire.read_rows(numbers) is None
