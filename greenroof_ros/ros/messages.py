"""Topics of the interface in ROS terms: class, quality of service, serialised values, and inputs.

Messages are serialised in the wire format (CDR, XCDR version 1). This module encodes and decodes
numbers, rows of numbers and the clock in a third of the time that the generated code of the message
types needs, because the generated code first creates a Python object for every field. The generated
code also leaves the padding of a message uninitialised; this module sets it to 0, so that two
identical runs write identical bags. All messages are written in little-endian byte order, which
every machine that runs ROS 2 uses; a number or a clock in another order is malformed. The generated
code decodes all other messages, such as those with a layout. A publisher may send any bytes: if
they do not form a message of the type, decoding raises a
:class:`~greenroof_ros.base.errors.MalformedMessageError`, and no other error.
"""

from __future__ import annotations

import importlib
import math
import struct
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64MultiArray, String

from greenroof_ros.base.errors import MalformedMessageError
from greenroof_ros.interface.topics import Qos, Topic

_HEADER = b"\x00\x01\x00\x00"  # little-endian, no options
_NUMBER = struct.Struct("<4sd")
_CLOCK = struct.Struct("<4siI")
# Number of dimensions, data offset, length of the data, and padding.
_ROW = struct.Struct("<4sIII4x")
_NS = 1_000_000_000


class WithFront(NamedTuple):
    """An array of numbers, preceded by other numbers that the layout's ``data_offset`` skips.

    A forecast is preceded by the time of its issue and the ends of its steps. A reader that
    respects the layout, as ROS defines it, sees only the forecast.
    """

    front: array[float]
    values: array[float] | NDArray[np.float64]


def message_class(type_name: str) -> Any:
    """Return the Python class of a message type such as ``std_msgs/msg/Float64``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_profile(qos: Qos) -> QoSProfile:
    """Return the rclpy profile for a quality-of-service profile of the interface."""
    profile = QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
    )
    if math.isfinite(qos.lease_s):
        profile.liveliness_lease_duration = Duration(seconds=qos.lease_s)
    return profile


def find_lacking(offered: QoSProfile, required: Qos) -> str:
    """Return what the quality of service of an endpoint must have, but lacks; empty if nothing.

    Args:
        offered: quality of service of the endpoint.
        required: the least that is required.
    """
    needs = qos_profile(required)
    lacking = {
        "reliable delivery": needs.reliability == ReliabilityPolicy.RELIABLE != offered.reliability,
        "transient local durability":
            needs.durability == DurabilityPolicy.TRANSIENT_LOCAL != offered.durability,
        f"a liveliness lease of at most {required.lease_s:g} s": math.isfinite(required.lease_s)
            and offered.liveliness_lease_duration > needs.liveliness_lease_duration,
    }
    return " and ".join(name for name, lacks in lacking.items() if lacks)


def encoder(type_name: str, dimensions: tuple[str, ...] = ()) -> Callable[[Any], bytes]:
    """Return a function that serialises values as messages of a given type.

    Args:
        type_name: ``std_msgs/msg/Float64`` for a number; ``std_msgs/msg/Float64MultiArray`` for an
            ``array("d")``, a 2-D numpy array or a :class:`WithFront` containing either (the layout
            contains the shape of an array that has more than one row); ``rosgraph_msgs/msg/Clock``
            for nanoseconds since 1970; ``std_msgs/msg/String`` for a string; any other type for the
            message itself.
        dimensions: labels of the rows and columns of a 2-D array.
    """
    encoders: dict[str, Callable[[Any], bytes]] = {
        "std_msgs/msg/Float64": partial(_NUMBER.pack, _HEADER),
        "std_msgs/msg/Float64MultiArray": partial(_encode_numbers, dimensions),
        "rosgraph_msgs/msg/Clock": lambda time_ns: _CLOCK.pack(_HEADER, *divmod(time_ns, _NS)),
        "std_msgs/msg/String": lambda text: serialize_message(String(data=text)),
    }
    return encoders.get(type_name, serialize_message)


def decoder(type_name: str) -> Callable[[bytes], Any]:
    """Return a function that reads the value in a message of a given type; see :func:`encoder`.

    For a type that has no encoder, the value is the message itself. The function raises
    MalformedMessageError if the bytes are not a message of the type.
    """
    return {
        "std_msgs/msg/Float64": lambda message: _unpack(_NUMBER, message)[0],
        "std_msgs/msg/Float64MultiArray": lambda message: decode_numbers(message).values,
        "rosgraph_msgs/msg/Clock": decode_clock,
    }.get(type_name, partial(deserialize, message_class(type_name)))


def deserialize(kind: Any, message: bytes) -> Any:
    """Deserialise the bytes of a message, and return an object of its class.

    Args:
        kind: class of the message.
        message: bytes of the message.

    Raises:
        MalformedMessageError: if the bytes do not form a message of the class.
    """
    with suppress(Exception):  # errors of the middleware or of the class
        return deserialize_message(message, kind)
    raise MalformedMessageError(f"{len(message)} bytes are not a valid {kind.__name__} message")


def _unpack(layout: struct.Struct, message: bytes) -> tuple[Any, ...]:
    """Return what follows the header of a little-endian message."""
    if len(message) == layout.size and message.startswith(_HEADER):
        return layout.unpack(message)[1:]
    raise MalformedMessageError(f"{len(message)} bytes are not such a little-endian message")


def decode_clock(message: bytes) -> int:
    """Return the time of a clock message (ns since 1970).

    Raises:
        MalformedMessageError: if the bytes are not a clock message, or if the time is before 1970.
    """
    seconds, nanoseconds = _unpack(_CLOCK, message)
    if seconds < 0:
        raise MalformedMessageError(f"the time {seconds} s is before 1970")
    return int(seconds) * _NS + int(nanoseconds)


def _encode_numbers(
    dimensions: tuple[str, ...], values: array[float] | NDArray[np.float64] | WithFront
) -> bytes:
    front, rows = values if isinstance(values, WithFront) else (array("d"), values)
    if isinstance(rows, np.ndarray) and len(rows) <= 1:
        rows = array("d", rows.tobytes())  # a single forecast does not count as an ensemble
    if isinstance(rows, array):
        size = len(front) + len(rows)
        return _ROW.pack(_HEADER, 0, len(front), size) + front.tobytes() + rows.tobytes()
    head = _HEADER + struct.pack("<I", 2)
    strides = rows.size, rows.shape[1]
    for label, length, stride in zip(dimensions, rows.shape, strides, strict=True):
        text = label.encode() + b"\0"
        head += struct.pack("<I", len(text)) + text + bytes(-len(text) % 4)
        head += struct.pack("<II", length, stride)
    head += struct.pack("<II", len(front), len(front) + rows.size)
    head += bytes((len(_HEADER) - len(head)) % 8)  # pad to a multiple of 8 after the header
    return head + front.tobytes() + rows.astype("<f8").tobytes()


def decode_numbers(message: bytes) -> WithFront:
    """Return the numbers of a message in the shape of its layout, and the numbers in front of them.

    Raises:
        MalformedMessageError: if the bytes are not a message with an array of numbers, or if the
            layout does not match the number of values.
    """
    if len(message) >= _ROW.size:
        header, dimensions, offset, size = _ROW.unpack_from(message)
        if (header, dimensions, _ROW.size + 8 * size) == (_HEADER, 0, len(message)):
            numbers = array("d", message[_ROW.size :])
            return WithFront(numbers[:offset], numbers[offset:])
    received = deserialize(Float64MultiArray, message)
    offset, shape = received.layout.data_offset, [each.size for each in received.layout.dim]
    front, data = received.data[:offset], received.data[offset:]
    if len(shape) < 2:
        return WithFront(front, data)
    if len(shape) > 2 or math.prod(shape) != len(data):
        raise MalformedMessageError(
            f"the layout {shape} does not match the number of values, {len(data)}"
        )
    return WithFront(front, np.asarray(data).reshape(shape))


class Input:
    """A topic that a node subscribes to, with the latest value received.

    A value that is not finite, or is outside the range in the interface, is rejected: the input
    then has the value 0, or no numbers, until the next message arrives. A message that is malformed
    is rejected as well, since any program may publish on the topic.

    Attributes:
        topic: the topic in the interface.
        name: the topic's full name in ROS, with its namespace.
        value: the latest value: nanoseconds for a clock, otherwise a number or an array of numbers.
        refusal: the reason why the latest value was rejected; empty if the node may act on it.
        refused: number of values rejected so far.
    """

    def __init__(self, topic: Topic, name: str) -> None:
        """Create an input with the value 0.

        Args:
            topic: the topic in the interface.
            name: the topic's full name in ROS, with its namespace.
        """
        self.topic = topic
        self.name = name
        self.value: Any = 0.0
        self.refusal = ""
        self.refused = 0
        self._decode = decoder(self.topic.type)
        self._is_array = "Array" in topic.type

    @property
    def good(self) -> bool:
        """Whether the node may act on the latest value."""
        return not self.refusal

    def receive(self, message: bytes) -> None:
        """Store the value of a message, or 0 or no numbers if the value has to be rejected."""
        low, high = self.topic.low, self.topic.high
        try:
            value = self._decode(message)
        except MalformedMessageError as error:
            self._refuse(math.inf, str(error))
            return
        if not self._is_array:
            wrong: Any = () if low <= value <= high else (value,)  # it is wrong if it is NaN
        elif isinstance(value, np.ndarray):
            wrong = value[~((low <= value) & (value <= high))]
        else:  # about ten numbers: numpy would take longer
            wrong = [number for number in value if not low <= number <= high]
        if len(wrong):
            worst = float(wrong[0])
            self._refuse(worst, f"{worst!r}; it {self.topic.range.expected()}")
        else:
            self.value, self.refusal = value, ""

    def _refuse(self, value: float, why: str) -> None:
        self.refused += 1
        self.value, self.refusal = array("d") if self._is_array else 0.0, why


# --- private parts of rclpy -----------------------------------------------------------------------
# All that this package uses. A new version of rclpy can remove any of them without notice:
# test/ros/test_messages.py uses all of them, and fails if one is missing.


def raw_publish(publisher: Any) -> Callable[[bytes], None]:
    """Return a function that publishes serialised messages on a publisher.

    For every message, rclpy's own ``publish`` compares types and locks the publisher against
    destruction by another thread; these steps take a quarter of the time of ``publish``.
    """
    return publisher.handle.publish_raw


def take_messages(subscription: Any) -> Iterator[tuple[bytes, Any]]:
    """Yield the waiting messages, each as serialised bytes with rclpy's metadata.

    rclpy passes messages only to callbacks. The fast executor of rclpy calls no callback for
    messages that arrived before the executor began to listen, and does not pass the publisher's
    sequence number to callbacks.
    """
    with subscription.handle:
        while (sample := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield sample
