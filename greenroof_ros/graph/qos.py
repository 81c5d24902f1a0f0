"""The rclpy message class and QoS profile of a topic of the interface."""

from __future__ import annotations

import importlib
import math
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from greenroof_ros.common.interface import Qos


def message_class(type_name: str) -> Any:
    """Return the Python class of a message type such as ``std_msgs/msg/Float64``."""
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_profile(qos: Qos, *, lease: bool = True) -> QoSProfile:
    """Return the rclpy profile of a profile of the interface, with its lease or without."""
    profile = QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
        liveliness=LivelinessPolicy.AUTOMATIC,
    )
    if lease and math.isfinite(qos.lease_s):
        profile.liveliness_lease_duration = Duration(seconds=qos.lease_s)
    return profile
