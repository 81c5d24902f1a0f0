"""The topics of a bag that a trajectory is made from: times and values of their messages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import find_namespace

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

# Topic: column of a trajectory. A sample needs the first four; the others count as 0.
NEEDED = {
    "/roof/level": "roof",
    "/cistern/level": "cistern",
    "/pump/command": "command",
    "/pump/flow": "pump_flow",
}
OPTIONAL = {
    "/weather/precipitation": "precipitation",
    "/weather/evapotranspiration": "evapotranspiration",
    "/cistern/outflow": "outflow",
    "/roof/drainage": "drainage",
    "/weather/frost": "frost",
}

_TYPE = "std_msgs/msg/Float64"


def read_topics(bag: Path, repair: str) -> tuple[dict[str, Stamps], dict[str, Values]]:
    """Read the log times (ns) and values of each topic of a bag that is used, in time's order.

    The topics may be under a namespace, as in /site1/roof/level; the result has their plain names.

    Args:
        bag: its directory.
        repair: how a damaged one can be repaired, for the message.

    Raises:
        ConfigurationError: the bag is damaged, or lacks what is needed.
    """
    highlevel, typesys = _rosbags()
    times: dict[str, list[int]] = {}
    values: dict[str, list[float]] = {}
    try:
        with highlevel.AnyReader(
            [bag], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        ) as reader:
            found = {connection.topic: connection.msgtype for connection in reader.connections}
            namespace = find_namespace(found, list(NEEDED), bag)
            names = {f"{namespace}{topic}": topic for topic in (*NEEDED, *OPTIONAL)}
            _check_topics(bag, found, namespace)
            connections = [one for one in reader.connections if one.topic in names]
            for connection, stamp, raw in reader.messages(connections=connections):
                value = reader.deserialize(raw, connection.msgtype).data
                topic = names[connection.topic]
                times.setdefault(topic, []).append(stamp)
                values.setdefault(topic, []).append(value)
    except ConfigurationError:
        raise
    except Exception as error:  # rosbags hands on whatever its storages and codecs raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigurationError(
            f"cannot be read as a bag: {reason} If its recorder was killed, {repair}", file=bag
        ) from error
    silent = [topic for topic in NEEDED if topic not in times]
    if silent:
        raise ConfigurationError(f"holds no message of {', '.join(silent)}", file=bag)
    return (
        {topic: np.array(stamps) for topic, stamps in times.items()},
        {topic: np.array(column) for topic, column in values.items()},
    )


def _check_topics(bag: Path, found: Mapping[str, str], namespace: str) -> None:
    """Refuse a bag that lacks a needed topic, or has one of another type."""
    missing = [topic for topic in NEEDED if f"{namespace}{topic}" not in found]
    if missing:
        there = ", ".join(sorted(found)) or "none"
        raise ConfigurationError(
            f"has no {', '.join(missing)}, which the report needs; its topics are: {there}",
            file=bag,
        )
    for topic in (*NEEDED, *OPTIONAL):
        name = f"{namespace}{topic}"
        if found.get(name, _TYPE) != _TYPE:
            raise ConfigurationError(
                f"must be of type {_TYPE}, not {found[name]}", file=bag, key=name
            )


def _rosbags() -> tuple[ModuleType, ModuleType]:
    """Import rosbags, which a plain installation does not have."""
    try:
        from rosbags import highlevel, typesys
    except ModuleNotFoundError as error:
        raise ConfigurationError("needs rosbags: pip install 'greenroof_ros[study]'") from error
    return highlevel, typesys
