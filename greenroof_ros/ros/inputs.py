"""Inputs of a node: the latest value on each topic, and a check of that value."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

from greenroof_ros.interface.topics import Topic
from greenroof_ros.ros.messages import decoder


class Input:
    """A topic that a node subscribes to, with the latest value received.

    A value that is not finite, or is outside the range in the interface, is rejected: the input
    then has the value 0 until the next message arrives.

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
        self._low, self._high = self.topic.low, self.topic.high

    @property
    def good(self) -> bool:
        """Whether the node may act on the latest value."""
        return not self.refusal

    def receive(self, message: bytes) -> None:
        """Store the value of a message, or 0 if the value has to be rejected."""
        value = self._decode(message)
        low, high = self._low, self._high
        if isinstance(value, (float, int)):
            if low <= value <= high:  # False for NaN
                self.value, self.refusal = value, ""
            else:
                self._refuse(value, 0.0)
            return
        ensemble = isinstance(value, np.ndarray)
        if ensemble:
            wrong: Any = value[~((low <= value) & (value <= high))]
        else:  # about ten numbers: numpy would take longer
            wrong = [number for number in value if not low <= number <= high]
        if len(wrong):
            zeros = np.zeros(value.shape) if ensemble else array("d", [0.0] * len(value))
            self._refuse(float(wrong[0]), zeros)
        else:
            self.value, self.refusal = value, ""

    def _refuse(self, value: float, instead: Any) -> None:
        self.refused += 1
        self.refusal = f"{value!r}; it {self.topic.range.expected()}"
        self.value = instead
