"""Reading a trajectory from a bag of this package, or of a real site with gaps and outliers."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.files import read_yaml
from greenroof_ros.base.times import from_epoch_ns
from greenroof_ros.interface.topics import Topic, read_topics
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.results.bag_write import METADATA
from greenroof_ros.results.trajectory import COLUMNS, Trajectory, recorded_columns
from greenroof_ros.site.site import Site
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES

Stamps = NDArray[np.int64]
Values = NDArray[np.float64]

# Attribute of a trajectory, by topic. A sample needs the topics below; the others count as 0 if
# they are missing.
_ATTRIBUTES = {column.topic: column.attribute for column in COLUMNS if column.attribute}
_NEEDED = ("/roof/level", "/cistern/level", "/pump/command", "/pump/flow")
_TYPE = "std_msgs/msg/Float64"
_CLOCK, _CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"

# A smaller share of wrong values in a topic counts as outliers of a sensor; a larger one is a
# mistake.
_MAX_OUTLIERS = 0.01

# Tolerance for a value at the limit that was rounded elsewhere.
_ROUNDING = 1 + 1e-9

# A time without messages is a gap if it exceeds both: in seconds, and in median spacings.
_GAP_S, _GAP_SPACINGS = 600, 10

# If there are no messages for longer than this (ns), a clock is wrong.
_MAX_GAP_NS = 366 * 86400e9


def count_ticks(bag: Path) -> int | None:
    """Return the number of complete ticks in a bag written by this package.

    Return None if the bag was not closed, because its recorder was killed or its disk was full.
    """
    if not (bag / METADATA).is_file():
        return None
    about = read_yaml(bag / METADATA)["rosbag2_bagfile_information"]
    return min(int(topic["message_count"]) for topic in about["topics_with_message_count"])


class RecordedTrajectory(NamedTuple):
    """The trajectory of a run, and notes about its reconstruction from the bag."""

    trajectory: Trajectory
    notes: tuple[str, ...] = ()
    unknown: frozenset[str] = frozenset()
    """attributes of the trajectory that are 0 because the bag contains nothing about them"""


class _Series(NamedTuple):
    """The values of a topic, and the times at which they were logged (ns since 1970)."""

    times: Stamps
    values: Values


def load_bag(
    bag: Path, site: Site, zone: tzinfo, *, own: bool, external_pump: bool = False,
    repair: str = "",
) -> RecordedTrajectory:
    """Read a trajectory from a bag.

    The trajectory has a sample at every time at which a message of a used topic was logged, with
    the last value of every topic at or before that time. Bags written by this package log all
    topics of a tick at the same time, so their samples are the ticks.

    Args:
        bag: directory of the bag, or a single MCAP file.
        site: site at which the bag was recorded.
        zone: time zone of the result.
        own: True if the run is known to be a simulation by this package, whose plant rejected
            implausible values and used 0 instead. In other bags, implausible values are left out or
            cause an error.
        external_pump: True if a pump driver sent the flow to the plant.
        repair: instruction for repairing a damaged bag, for use in the error message; empty if
            repair is impossible.

    Raises:
        ConfigurationError: if the bag is damaged, lacks a needed topic, or contains implausible
            values.
    """
    recorded, notes = _keep_one_time(_read_series(bag, repair), zone)
    if silent := [topic for topic in _NEEDED if topic not in recorded]:
        raise ConfigurationError(
            "; ".join([f"contains no messages ({_TYPE}) on {', '.join(silent)}", *notes]), file=bag
        )
    of_site = {column.topic: column.attribute for column in recorded_columns(site)}
    notes += [
        f"{topic} is not in the bag; its value is assumed to be 0"
        for topic in of_site if topic not in recorded
    ]
    interface, highest = read_topics(), {} if own else _compute_maxima(site)
    series = {}
    for name, of_topic in recorded.items():
        topic = replace(
            interface[name], high=min(interface[name].high, highest.get(name, math.inf))
        )
        # What the plant itself published are the results of the run.
        by_plant = "plant" not in topic.subscribers or (name == "/pump/flow" and not external_pump)
        fine = (of_topic.values >= topic.low) & (of_topic.values <= topic.high)  # a NaN is neither
        if own and not by_plant and not fine.all():
            of_topic = of_topic._replace(values=np.where(fine, of_topic.values, 0.0))
            notes.append(
                f"{np.count_nonzero(~fine)} of {len(fine)} values of {name} were rejected in the "
                f"run and replaced by 0, because a value {topic.range.expected()}"
            )
        elif not own and not fine.all():
            of_topic = _drop_wrong(bag, topic, of_topic, fine)
            notes.append(
                f"{np.count_nonzero(~fine)} of {len(fine)} values of {name} are left out because "
                "they are not finite or are out of range"
            )
        if len(of_topic.times):  # otherwise it was never known
            series[name] = of_topic
    stamps = np.unique(np.concatenate([of_topic.times for of_topic in series.values()]))
    samples = stamps[stamps >= max(series[topic].times[0] for topic in _NEEDED)]
    if len(samples) < 2:
        raise ConfigurationError(
            f"must contain at least two samples of {', '.join(_NEEDED)}, not {len(samples)}",
            file=bag,
        )
    spacings = np.diff(samples)
    longest = max(_GAP_S * 1e9, _GAP_SPACINGS * float(np.median(spacings)))
    gaps = np.flatnonzero(spacings > longest)  # the last sample before each gap
    columns: dict[str, Values] = {}
    for topic_name, name in of_site.items():
        columns[name] = np.zeros(len(samples))
        if topic_name in series:
            times, values = series[topic_name]
            # If several messages have the same time, the last one counts.
            columns[name] = np.append(0.0, values)[np.searchsorted(times, samples, side="right")]
        if name not in ("roof", "cistern"):
            columns[name][gaps] = 0.0
    columns["roof"] = columns["roof"] * site.a2
    columns["cistern"] = columns["cistern"] * site.a1
    if len(gaps):
        notes.append(_describe_gaps(samples, gaps, zone))
    return RecordedTrajectory(
        Trajectory(
            start=from_epoch_ns(int(samples[0])).astimezone(zone),
            time=(samples - samples[0]) / 1e9, **columns,
        ),
        tuple(notes), frozenset(name for topic, name in of_site.items() if topic not in series),
    )


def _keep_one_time(
    recorded: dict[str, _Series], zone: tzinfo
) -> tuple[dict[str, _Series], list[str]]:
    """Remove messages that are more than a year away from most others, and return the rest.

    A clock that is not set yet stamps messages with 0, or with its year of manufacture; no site
    has a gap of a year in a bag.
    """
    every = [series.times for series in recorded.values()]
    stamps = np.sort(np.concatenate([*every, np.empty(0, dtype=np.int64)]))
    far = np.flatnonzero(np.diff(stamps.astype(np.float64)) > _MAX_GAP_NS) + 1
    if not far.size:
        return recorded, []
    most = max(np.split(stamps, far), key=len)
    kept = {}
    for topic, (times, values) in recorded.items():
        there = (times >= most[0]) & (times <= most[-1])
        if there.any():
            kept[topic] = _Series(times[there], values[there])
    return kept, [
        f"{len(stamps) - len(most)} of {len(stamps)} messages are more than a year before or after "
        f"the other messages, {_name_time(most[0], zone)} to {_name_time(most[-1], zone)}, and "
        "were left out: was a clock not set?"
    ]


def _name_time(stamp: np.int64, zone: tzinfo) -> str:
    return from_epoch_ns(int(stamp)).astimezone(zone).isoformat(timespec="seconds")


def _read_series(bag: Path, repair: str) -> dict[str, _Series]:
    """Read all used topics of a bag, in chronological order.

    The topics may be in a namespace, such as /site1/roof/level; the result contains their names
    without the namespace.

    Raises:
        ConfigurationError: if the bag is damaged, lacks a needed topic, or contains the times of
            arrival of a simulation's messages instead of simulated times.
    """
    with require_extra("study"):
        from rosbags import typesys
        from rosbags.highlevel import AnyReader
    typestore = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    times, values = defaultdict[str, list[int]](list), defaultdict[str, list[float]](list)
    clock = set[int]()  # the simulated times (ns)
    try:
        with AnyReader([bag], default_typestore=typestore) as reader:
            types = {each.topic: each.msgtype for each in reader.connections}
            namespace = find_namespace(types, _NEEDED, bag)
            names = {f"{namespace}{topic}": topic for topic in _ATTRIBUTES}
            if missing := [topic for topic in _NEEDED if namespace + topic not in types]:
                raise ConfigurationError(
                    f"lacks {', '.join(missing)}, which the report needs; the topics in the bag "
                    f"are: {', '.join(sorted(types)) or 'none'}", file=bag,
                )
            for name in names:
                if types.get(name, _TYPE) != _TYPE:
                    raise ConfigurationError(
                        f"must be of type {_TYPE}, not {types[name]}", file=bag, key=name
                    )
            if types.get(f"{namespace}{_CLOCK}") == _CLOCK_TYPE:  # otherwise of another program
                names[f"{namespace}{_CLOCK}"] = _CLOCK
            wanted = [each for each in reader.connections if each.topic in names]
            for connection, stamp, raw in reader.messages(connections=wanted):
                message: Any = reader.deserialize(raw, connection.msgtype)
                times[names[connection.topic]].append(stamp)
                if connection.msgtype == _CLOCK_TYPE:
                    clock.add(message.clock.sec * 10**9 + message.clock.nanosec)
                else:
                    values[names[connection.topic]].append(message.data)
    except ConfigurationError:
        raise
    except Exception as error:  # the readers pass on any error of storages and codecs
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigurationError(
            f"cannot be read as a bag: {reason.rstrip('.')}"
            + (repair and f". If it is damaged, {repair}"),
            file=bag,
        ) from error
    # A recorder with simulated time stamps every message with a value of the clock.
    if clock and not clock.intersection(times[_CLOCK]):
        raise ConfigurationError(
            "contains the times of arrival of a simulation's messages, not simulated times: "
            "record with 'ros2 bag record --use-sim-time', or use the bag in the run's directory",
            file=bag,
        )
    return {topic: _Series(np.array(times[topic]), np.array(values[topic])) for topic in values}


def _compute_maxima(site: Site) -> dict[str, float]:
    """Return the maximum plausible values of topics at a site.

    They are twice the depth of the soil, three times the overflow level and the maximum flow of the
    pumps, and the most rain and evapotranspiration that a weather file may contain.
    """
    rain, evaporation = (QUANTITIES[name].high for name in (PRECIPITATION, EVAPOTRANSPIRATION))
    maxima = {
        "/roof/level": site.max_roof_level,
        "/cistern/level": site.max_cistern_level,
        "/pump/flow": 3 * maximum_pump_flow(site, site.a1 * site.z_o),
        "/weather/precipitation": rain / 3.6e6,
        # The crop coefficient scales the evapotranspiration of grass.
        "/weather/evapotranspiration":
            evaporation * max(1.0, site.crop_coefficient) / 8.64e7 * site.a2,
    }
    return {topic: high * _ROUNDING for topic, high in maxima.items()}


def _drop_wrong(
    bag: Path, topic: Topic, series: _Series, fine: NDArray[np.bool_]
) -> _Series:
    """Remove implausible values of a topic, and return the others.

    Raises:
        ConfigurationError: if the implausible values are too many to be outliers, or if at least
            half of the non-zero values are too large. The second condition detects a wrong unit of
            rain, or of a pump that is active for less than a hundredth of the time.
    """
    times, values = series
    unknown = np.isnan(values) & topic.may_be_unknown  # a NaN of a live graph
    wrong = np.flatnonzero(~fine & ~unknown)
    large = np.count_nonzero(values > topic.high)
    if len(wrong) and (
        len(wrong) >= _MAX_OUTLIERS * len(values) or 2 * large >= np.count_nonzero(values)
    ):
        raise ConfigurationError(
            f"{topic.range.expected()}, but is {values[wrong[0]]:g} {topic.unit} at "
            f"{from_epoch_ns(int(times[wrong[0]])).isoformat()}; is a unit wrong?",
            file=bag, key=topic.name,
        )
    return _Series(times[fine], values[fine])


def _describe_gaps(samples: Stamps, gaps: NDArray[np.intp], zone: tzinfo) -> str:
    hours = (samples[gaps + 1] - samples[gaps]) / 3.6e12
    longest = gaps[hours.argmax()]
    return (
        f"there are no messages in {len(gaps)} gaps, {hours.sum():.3g} h in total, the longest "
        f"from {_name_time(samples[longest], zone)} to {_name_time(samples[longest + 1], zone)} "
        f"({hours.max():.3g} h): in gaps, the command, the weather and the flows are unknown and "
        "are treated as 0, and the levels keep their last values"
    )


def find_namespace(names: Collection[str], needed: Sequence[str], bag: Path) -> str:
    """Return the namespace of a graph, derived from the full names of its topics.

    Args:
        names: full topic names, such as ``/site1/roof/level``.
        needed: names of the topics in the interface, such as ``/roof/level``, that the graph must
            have.
        bag: the bag that contains the topics, for messages.

    Returns:
        The prefix of the names, such as ``/site1``; empty if there is no prefix, or if no namespace
        contains all needed topics.

    Raises:
        ConfigurationError: if more than one namespace contains all needed topics.
    """
    prefixes = sorted({name.removesuffix(needed[0]) for name in names})
    namespaces = [
        prefix for prefix in prefixes if all(prefix + topic in names for topic in needed)
    ]
    if len(namespaces) > 1:
        raise ConfigurationError(
            "must be from a single graph, but contains topics from the namespaces "
            + ", ".join(namespace or "/" for namespace in namespaces), file=bag,
        )
    return namespaces[0] if namespaces else ""
