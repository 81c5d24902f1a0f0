"""What happened, from a bag alone: of this package, or of a real site with holes and strays."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import find_namespace, read_topics
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.weather.records import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES

_TYPE = "std_msgs/msg/Float64"

# Topic: attribute of a trajectory. A sample needs the first four; the others count as 0.
_NEEDED = {
    "/roof/level": "roof",
    "/cistern/level": "cistern",
    "/pump/command": "command",
    "/pump/flow": "pump_flow",
}

_OPTIONAL = {
    "/weather/precipitation": "precipitation",
    "/weather/evapotranspiration": "evapotranspiration",
    "/cistern/outflow": "outflow",
    "/roof/drainage": "drainage",
    "/weather/frost": "frost",
}

_EPOCH = datetime.fromisoformat("1970-01-01T00:00+00:00")

# Fewer wrong values than this share of a topic's are strays of a sensor; more are a mistake.
_MOST_STRAYS = 0.01

# No message for longer than both is a hole: in seconds, and in median spacings.
_HOLE_S, _HOLE_SPACINGS = 600, 10

_MOST_NAMED = 10

# What a person or another rounding adds to a limit that is met exactly.
_ROUNDING = 1 + 1e-9

_Stamps = NDArray[np.int64]

_Values = NDArray[np.float64]


def load_bag(
    bag: Path, site: Site, zone: tzinfo, mend: str, own: bool
) -> tuple[Trajectory, tuple[str, ...]]:
    """Read what happened from a bag alone.

    A sample is a time at which a message of any topic that is used here was logged; every topic
    has its last value at or before it. The bags of this package have all topics of a tick at one
    time, so that their samples are the ticks.

    Args:
        bag: its directory.
        site: where it was.
        zone: offset from UTC of the times.
        mend: how a damaged one can be mended, for the message.
        own: whether this package wrote down that the run is its own.

    Raises:
        ConfigurationError: the bag is damaged, foreign, or its values cannot be true.
    """
    times, values = _read_topics(bag, mend)
    notes = [f"{topic} is not in the bag and counts as 0" for topic in _OPTIONAL
             if topic not in times]
    for topic, limit in _limits(site, values, own).items():
        fine = _fine(bag, topic, limit, times[topic], values[topic])
        strays = np.count_nonzero(~fine)
        if strays:
            notes.append(
                f"{strays} of {len(fine)} values of {topic} are not finite or out of range, and "
                "are left out"
            )
            times[topic], values[topic] = times[topic][fine], values[topic][fine]
    stamps = np.unique(np.concatenate(list(times.values())))
    samples = stamps[stamps >= max(times[topic][0] for topic in _NEEDED)]
    if len(samples) < 2:
        raise ConfigurationError(
            f"must hold two samples of {', '.join(_NEEDED)} at least, not {len(samples)}",
            file=bag,
        )
    holes = _holes(samples)
    columns: dict[str, _Values] = {}
    for topic, name in {**_NEEDED, **_OPTIONAL}.items():
        columns[name] = np.zeros(len(samples))
        if topic in times:
            # Of messages with one stamp the last counts.
            index = np.searchsorted(times[topic], samples, side="right") - 1
            columns[name] = np.where(index >= 0, values[topic][np.maximum(index, 0)], 0.0)
        if name not in ("roof", "cistern"):
            columns[name][holes] = 0.0
    columns["roof"] = columns["roof"] * site.a2
    columns["cistern"] = columns["cistern"] * site.a1
    if len(holes):
        notes.append(_hole_note(samples, holes, zone))
    time = (samples - samples[0]) / 1e9
    return Trajectory(_when(samples[0]).astimezone(zone), time, **columns), tuple(notes)


def _when(stamp: np.int64) -> datetime:
    """Return the time of a stamp (ns)."""
    return _EPOCH + timedelta(microseconds=int(stamp) // 1000)


class _Limit(NamedTuple):
    """What a topic's values can be."""

    low: float
    high: float
    unit: str
    why: str
    """what the highest is; empty where it is the interface's"""


def _limits(site: Site, values: Mapping[str, _Values], own: bool) -> dict[str, _Limit]:
    """Return what the values of each topic in a bag can be: by the interface, and by the site.

    A run of this package may begin with more water than a site's cistern holds, and give commands
    far above 1; its flows and levels are then as far above those of the site.
    """
    full, outlet = maximum_pump_flow(site, site.a1 * site.z_o), site.z_o
    if own:
        full *= max(1.0, float(np.max(values["/pump/command"])))
        outlet = max(outlet, float(values["/cistern/level"][0]))
    _, _, rain = QUANTITIES[PRECIPITATION]
    _, _, evaporation = QUANTITIES[EVAPOTRANSPIRATION]
    # A crop takes that many times the most that grass does.
    evaporation *= max(1.0, site.crop_coefficient)
    highs = {
        "/roof/level": (2 * site.z_soil, f"twice the soil's depth of {site.z_soil:g} m"),
        "/cistern/level": (3 * outlet, f"three times the outlet's level of {site.z_o:g} m"),
        "/pump/flow": (3 * full, "three times what the pumps can give"),
        "/weather/precipitation": (rain / 3.6e6, f"{rain:g} mm/h"),
        "/weather/evapotranspiration": (
            evaporation / 8.64e7 * site.a2, f"{evaporation:g} mm/day over a2"
        ),
    }
    limits = {}
    interface = read_topics()
    for topic in values:
        low, high, unit = interface[topic].low, interface[topic].high, interface[topic].unit
        of_site, why = highs.get(topic, (high, ""))
        # Not a number, where a command of the bag is none: the interface's limit holds.
        if of_site * _ROUNDING < high:
            limits[topic] = _Limit(low, of_site * _ROUNDING, unit, f" ({why})")
        else:
            limits[topic] = _Limit(low, high, unit, "")
    return limits


def _fine(
    bag: Path, topic: str, limit: _Limit, stamps: _Stamps, column: _Values
) -> NDArray[np.bool_]:
    """Return which values of a topic can be true.

    Raises:
        ConfigurationError: too many cannot, or most of those that are not 0 are too large: a pump
            or rain in a wrong unit may be at work for less than a hundredth of the time.
    """
    fine = (column >= limit.low) & (column <= limit.high)  # a NaN is neither
    wrong = np.flatnonzero(~fine)
    large = np.count_nonzero(column > limit.high)
    if len(wrong) and (
        len(wrong) >= _MOST_STRAYS * len(column) or 2 * large >= np.count_nonzero(column)
    ):
        raise ConfigurationError(
            f"must be from {limit.low:g} to {limit.high:g} {limit.unit}{limit.why}, but is "
            f"{column[wrong[0]]:g} {limit.unit} at {_when(stamps[wrong[0]]).isoformat()}; "
            "is a unit wrong?",
            file=bag, key=topic,
        )
    return fine


def _holes(samples: _Stamps) -> NDArray[np.intp]:
    """Return the samples after which no message came for long."""
    spacings = np.diff(samples)
    longest = max(_HOLE_S * 1e9, _HOLE_SPACINGS * float(np.median(spacings)))
    return np.flatnonzero(spacings > longest)


def _hole_note(samples: _Stamps, holes: NDArray[np.intp], zone: tzinfo) -> str:
    """Name the holes, by the samples before them."""
    hours = (samples[holes + 1] - samples[holes]) / 3.6e12
    named = [
        " to ".join(
            _when(samples[place]).astimezone(zone).isoformat(timespec="seconds")
            for place in (hole, hole + 1)
        ) + f" ({length:.3g} h)"
        for hole, length in zip(holes[:_MOST_NAMED], hours, strict=False)
    ]
    if len(holes) > _MOST_NAMED:
        named.append(f"and {len(holes) - _MOST_NAMED} more, {hours.sum():.3g} h in all")
    return (
        f"no message came from {', '.join(named)}: command, weather and flows are unknown there "
        "and count as 0, and the levels as they were before"
    )


def _read_topics(bag: Path, mend: str) -> tuple[dict[str, _Stamps], dict[str, _Values]]:
    """Return the log times (ns) and values of each topic that the report uses, in time's order."""
    highlevel, typesys = _rosbags()
    times: dict[str, list[int]] = {}
    values: dict[str, list[float]] = {}
    try:
        with highlevel.AnyReader(
            [bag], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        ) as reader:
            found = {connection.topic: connection.msgtype for connection in reader.connections}
            # /site1/roof/level is /roof/level of a graph in the namespace /site1.
            namespace = find_namespace(found, list(_NEEDED), bag)
            topics = {namespace + topic: topic for topic in (*_NEEDED, *_OPTIONAL)}
            _check_topics(bag, {topics.get(name, name): kind for name, kind in found.items()})
            connections = [one for one in reader.connections if one.topic in topics]
            for connection, stamp, raw in reader.messages(connections=connections):
                topic = topics[connection.topic]
                value = reader.deserialize(raw, connection.msgtype).data
                times.setdefault(topic, []).append(stamp)
                values.setdefault(topic, []).append(value)
    except ConfigurationError:
        raise
    except Exception as error:  # rosbags hands on whatever its storages and codecs raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigurationError(
            f"cannot be read as a bag: {reason} If its recorder was killed, {mend}", file=bag
        ) from error
    silent = [topic for topic in _NEEDED if topic not in times]
    if silent:
        raise ConfigurationError(f"holds no message of {', '.join(silent)}", file=bag)
    return (
        {topic: np.array(stamps) for topic, stamps in times.items()},
        {topic: np.array(column) for topic, column in values.items()},
    )


def _check_topics(bag: Path, found: Mapping[str, str]) -> None:
    """Refuse a bag that lacks a needed topic, or has one of another type."""
    missing = [topic for topic in _NEEDED if topic not in found]
    if missing:
        there = ", ".join(sorted(found)) or "none"
        raise ConfigurationError(
            f"has no {', '.join(missing)}, which the report needs; its topics are: {there}",
            file=bag,
        )
    for topic in (*_NEEDED, *_OPTIONAL):
        if found.get(topic, _TYPE) != _TYPE:
            raise ConfigurationError(
                f"must be of type {_TYPE}, not {found[topic]}", file=bag, key=topic
            )


def _rosbags() -> tuple[ModuleType, ModuleType]:
    """Import rosbags, which a plain installation does not have."""
    try:
        from rosbags import highlevel, typesys
    except ModuleNotFoundError as error:
        raise ConfigurationError("needs rosbags: pip install 'greenroof_ros[study]'") from error
    return highlevel, typesys
