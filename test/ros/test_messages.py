"""Messages as bytes, equal to the generated code's bit for bit; what a node accepts of them."""

from __future__ import annotations

import math
import random
import struct
from array import array
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from doc_commands.blocks import fences

rclpy = pytest.importorskip("rclpy", reason="the message types come with ROS 2")

from builtin_interfaces.msg import Time  # noqa: E402
from rclpy.duration import Duration, Infinite  # noqa: E402
from rclpy.qos import (  # noqa: E402
    DurabilityPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_msgs.msg import (  # noqa: E402
    Float64,
    Float64MultiArray,
    MultiArrayDimension,
    MultiArrayLayout,
)

from greenroof_ros.interface.topics import Qos, read_topics  # noqa: E402
from greenroof_ros.ros.errors import MalformedMessageError  # noqa: E402
from greenroof_ros.ros.inputs import Input  # noqa: E402
from greenroof_ros.ros.messages import (  # noqa: E402
    WithFront,
    decoder,
    encoder,
    find_lacking,
    qos_profile,
)

NUMBER, NUMBERS, CLOCK = (
    "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray", "rosgraph_msgs/msg/Clock"
)
REPORTS = "diagnostic_msgs/msg/DiagnosticArray"
KINDS = (NUMBER, NUMBERS, CLOCK, REPORTS)
ENSEMBLE = ("member", "step")
VALUES = [-0.0, -1 / 3, 5e-324, 1.7976931348623157e308, -math.inf, math.nan]


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        *((NUMBER, value, Float64(data=value)) for value in VALUES),
        *(
            (NUMBERS, array("d", VALUES[:size]), Float64MultiArray(data=VALUES[:size]))
            for size in range(len(VALUES))
        ),
        (CLOCK, 1_625_641_200_123_456_789,
         Clock(clock=Time(sec=1_625_641_200, nanosec=123_456_789))),
        (CLOCK, 0, Clock()),
    ],
)
def test_bytes_of_the_generated_code(kind: str, value: Any, message: Any) -> None:
    """The bytes equal the generated code's, and are read back bit for bit."""
    written = encoder(kind)(value)
    generated = serialize_message(message)
    if kind == NUMBERS:
        # Between the length and the numbers are four padding bytes: 0 in ours, arbitrary in theirs.
        assert written[16:20] == bytes(4)
        generated = generated[:16] + bytes(4) + generated[20:]
    assert written == generated
    again = decoder(kind)(written)
    assert type(again) is type(value)
    if kind == CLOCK:
        assert again == value
    else:
        assert np.asarray(again).tobytes() == np.asarray(value).tobytes()


def test_the_tutorials_function_reads_an_ensemble() -> None:
    """Steps of 10, 10 and 40 s: 0 + 10 + 80 m and 30 + 40 + 200 m."""
    (block,) = (
        text for _, language, text in fences("doc/tutorials/your-node.md")
        if language == "python" and "def rain_depth" in text
    )
    names: dict[str, Any] = {}
    exec(compile(block, "your-node.md", "exec"), names)
    front = array("d", [1_625_641_200.0, 10.0, 20.0, 60.0])
    written = encoder(NUMBERS, ENSEMBLE)(WithFront(front, np.arange(6.0).reshape(2, 3)))
    depth = names["rain_depth"](deserialize_message(written, Float64MultiArray))
    assert depth.tolist() == [90.0, 270.0]


@pytest.mark.parametrize("front", [[], [1_625_641_200.0, 10.0, 20.0, 60.0]])
def test_members_travel_in_the_layout(front: list[float]) -> None:
    """Rows of an ensemble: dimensions, sizes and strides as defined by Float64MultiArray.

    The layout skips a forecast's issue and the ends of its steps. Each byte is the generated
    code's, except where that leaves arbitrary memory: after the header of four bytes the labels'
    ends, at 19 and 37, are padded to multiples of four, and the numbers begin at a multiple of
    eight. A single row has no layout.
    """
    values, before = np.arange(6.0).reshape(2, 3), array("d", front)
    written = encoder(NUMBERS, ENSEMBLE)(WithFront(before, values))
    message = deserialize_message(written, Float64MultiArray)
    assert message.layout.data_offset == len(front)
    labels = [
        (dimension.label, dimension.size, dimension.stride) for dimension in message.layout.dim
    ]
    assert labels == [("member", 2, 6), ("step", 3, 3)]
    assert list(message.data) == [*front, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    again = decoder(NUMBERS)(written)
    assert again.shape == (2, 3) and again.tobytes() == values.tobytes()
    generated = bytearray(serialize_message(message))
    for first, end in ((19, 20), (37, 40), (56, 60)):
        assert written[first:end] == bytes(end - first)
        generated[first:end] = bytes(end - first)
    assert written == bytes(generated)
    row = encoder(NUMBERS, ENSEMBLE)(WithFront(before, values[:1]))
    assert row == encoder(NUMBERS)(WithFront(before, array("d", values[0])))
    assert decoder(NUMBERS)(row) == array("d", values[0])


def layout(*sizes: int) -> bytes:
    """Return six numbers with a layout of these sizes."""
    dimensions = [MultiArrayDimension(size=size) for size in sizes]
    message: bytes = serialize_message(
        Float64MultiArray(layout=MultiArrayLayout(dim=dimensions), data=[1.0] * 6)
    )
    return message


HEAD = b"\0\1\0\0"  # little-endian
# Bytes that are no message of any type here, and some that are none of one type.
MALFORMED = (b"", b"\0", HEAD, bytes(7), HEAD + bytes(7), b"x" * 1_000_000)


@pytest.mark.parametrize(("kind", "message"), [
    *((kind, message) for kind in KINDS for message in MALFORMED),
    (NUMBER, HEAD + bytes(16)), (NUMBER, HEAD + bytes(1_000_000)), (CLOCK, HEAD + bytes(12)),
    (CLOCK, encoder(CLOCK)(-1)),
    (NUMBERS, HEAD + struct.pack("<III", 0, 0, 2**31) + bytes(4)),
    (NUMBERS, HEAD + struct.pack("<I", 2**32 - 1)),
    (NUMBERS, layout(4, 3)), (NUMBERS, layout(1, 2, 3)),
    (REPORTS, HEAD + struct.pack("<iIII", 0, 0, 0, 2**26) + bytes(100)),
], ids=lambda value: value if isinstance(value, str) else f"{len(value)} bytes")
def test_other_bytes_are_malformed(kind: str, message: bytes) -> None:
    """A wrong length, huge counts, a layout of other sizes, another encoding."""
    with pytest.raises(MalformedMessageError):
        decoder(kind)(message)


@pytest.mark.parametrize("kind", KINDS)
def test_changed_bytes_are_read_or_malformed(kind: str) -> None:
    """No other error comes out."""
    rng = random.Random(0)
    for _ in range(2000):
        changed = bytearray(rng.choice((layout(2, 3), HEAD + bytes(rng.randrange(64)))))
        for _ in range(3):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        with suppress(MalformedMessageError):
            decoder(kind)(bytes(changed))


def test_big_endian() -> None:
    """A publisher on a big-endian machine is understood, too."""
    assert decoder(NUMBER)(struct.pack(">4xd", 2.5)) == 2.5
    rows = struct.pack(">4xIII4xdd", 0, 0, 2, 2.5, -1.0)
    assert list(decoder(NUMBERS)(rows)) == [2.5, -1.0]
    assert decoder(CLOCK)(struct.pack(">4xiI", 7, 8)) == 7_000_000_008


# --- what a node accepts as input -----------------------------------------------------------------


RELIABLE, BEST, LATCHED, VOLATILE = (
    ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT,
    DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE,
)


@pytest.mark.parametrize(
    ("required", "offered", "lacking"),
    [
        (Qos("reliable", "transient_local", 64, 2.0), (RELIABLE, LATCHED, 2.0), ""),
        (Qos("reliable", "transient_local", 64, 2.0), (BEST, VOLATILE, None),
         "reliable delivery and transient local durability and a liveliness lease of at most 2 s"),
        (Qos("reliable", "transient_local", 64, 2.0), (RELIABLE, LATCHED, 3.0),
         "a liveliness lease of at most 2 s"),
        (Qos("best_effort", "volatile", 1, math.inf), (RELIABLE, LATCHED, None), ""),
        (Qos("best_effort", "volatile", 1, math.inf), (BEST, VOLATILE, None), ""),
    ],
)
def test_what_a_publisher_offers_less_than_is_required(
    required: Qos, offered: tuple[ReliabilityPolicy, DurabilityPolicy, float | None],
    lacking: str,
) -> None:
    """As DDS does, which connects what offers at least what is required."""
    reliability, durability, lease_s = offered
    profile = QoSProfile(depth=1, reliability=reliability, durability=durability)
    profile.liveliness_lease_duration = Infinite if lease_s is None else Duration(seconds=lease_s)
    assert find_lacking(profile, required) == lacking
    compatibility, _ = qos_check_compatible(profile, qos_profile(required))
    assert (compatibility == QoSCompatibility.ERROR) == bool(lacking)


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize(
    ("value", "good"),
    [(0.0, True), (3.0, True), (-1e-300, False), (3.0000001, False), (math.nan, False),
     (math.inf, False)],
)
def test_the_ends_of_a_range_belong_to_it(value: float, good: bool, rows: int) -> None:
    """For a number, a row, and each member of an ensemble; a refused value acts as 0."""
    topics = read_topics()
    for name, message, nothing in (
        ("/pump/command", value, 0.0), ("/forecast/precipitation", np.full((rows, 4), value), []),
    ):
        topic = replace(topics[name], low=0.0, high=3.0)
        entry = Input(topic, name)
        entry.receive(encoder(topic.type, topic.dimensions)(message))
        assert (entry.good, entry.refused) == (good, int(not good))
        assert np.all(np.equal(entry.value, value)) if good else (
            np.asarray(entry.value).tolist() == nothing
        )
        entry.receive(HEAD)
        assert not entry.good and entry.refused == 1 + int(not good)
