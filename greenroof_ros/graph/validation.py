"""The newest value of a topic, and the refusal of values that cannot be true."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.serialization import decoder


class Input:
    """One topic that a node subscribes to, with its newest value.

    A value that is not finite, or outside the interface's range, is refused: 0 stands in its place
    until the next one comes. The first of them is logged, further ones are only counted.

    Attributes:
        topic: what the interface says of it.
        name: of the topic on the wire, with its namespace.
        value: the newest; nanoseconds of a clock, otherwise a number or a row of numbers.
        good: whether the newest was not refused; in a live graph, whether it keeps all rules.
        why: why it is not, for a sentence that begins with its name.
        code: of that condition; empty where it is good.
        refused: how many were.
        heard: live: whether anything ever came.
    """

    def __init__(self, topic: Topic, name: str, logger: RcutilsLogger) -> None:
        """Start with the value 0.

        Args:
            topic: the interface's.
            name: on the wire.
            logger: of the node.
        """
        self.topic = topic
        self.name = name
        self.value: Any = 0.0
        self.good = True
        self.why = ""
        self.code = ""
        self.refused = 0
        self.heard = False
        self._logger = logger
        self._decode: Callable[[bytes], Any] = decoder(topic.type)
        self._low, self._high = topic.low, topic.high

    def receive(self, message: bytes) -> None:
        """Read a message's value and keep it, or 0 where it must be refused."""
        value = self._decode(message)
        if not self.good:
            self.why = self.code = ""
        low, high = self._low, self._high
        if isinstance(value, float):
            if low <= value <= high:  # a NaN is neither
                self.value = value
                self.good = True
            else:
                self._refuse(value, 0.0)
        elif isinstance(value, int):
            self.value = value
        elif isinstance(value, np.ndarray):
            wrong = value[~((low <= value) & (value <= high))]
            if len(wrong):
                self._refuse(float(wrong[0]), np.zeros_like(value))
            else:
                self.value = value
                self.good = True
        else:
            for number in value:
                if not low <= number <= high:
                    self._refuse(number, [0.0] * len(value))
                    return
            self.value = value
            self.good = True

    def _refuse(self, value: float, instead: Any) -> None:
        unit = "" if self.topic.unit == "1" else f" {self.topic.unit}"
        limits = f"must be from {self.topic.low:g} to {self.topic.high:g}{unit}"
        if not self.refused:
            self._logger.error(
                f"refused {value!r} on {self.name}: it {limits}; it acts as 0, and further ones "
                "are only counted"
            )
        self.refused += 1
        self.good = False
        self.code = "input_refused"
        self.why = f"was refused: {value!r}, and {limits}"
        self.value = instead
