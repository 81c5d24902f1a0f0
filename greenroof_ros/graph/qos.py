"""The rclpy message class and QoS profile of a topic of the interface."""

from __future__ import annotations

import importlib
import math
from typing import Any

from rclpy.duration import Duration, Infinite
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


def lacks(offered: QoSProfile, required: Qos) -> list[str]:
    """Return what an end of a topic has less than is required, each as a verb and its object."""
    found = []
    if required.reliability == "reliable" and offered.reliability != ReliabilityPolicy.RELIABLE:
        found.append("is best effort")
    if (
        required.durability == "transient_local"
        and offered.durability != DurabilityPolicy.TRANSIENT_LOCAL
    ):
        found.append("is volatile")
    lease = offered.liveliness_lease_duration
    if math.isfinite(required.lease_s) and lease > Duration(seconds=required.lease_s):
        found.append(
            "has no liveliness lease" if lease == Infinite
            else f"has a liveliness lease of {lease.nanoseconds / 1e9:g} s"
        )
    return found


def requirements(qos: Qos) -> str:
    """Return a profile in words."""
    words = f"{qos.reliability.replace('_', ' ')}, {qos.durability.replace('_', ' ')}, "
    words += f"keep last {qos.depth}"
    if math.isfinite(qos.lease_s):
        words += f", with a liveliness lease of {qos.lease_s:g} s"
    return words
