"""Inputs of a node: the latest value on each topic, and a check of that value."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np

from greenroof_ros.interface.topics import Topic
from greenroof_ros.ros.errors import MalformedMessageError
from greenroof_ros.ros.messages import decoder


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
