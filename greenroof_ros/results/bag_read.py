"""Reading a trajectory from a bag of this package, or of a real site with gaps and wrong values."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Sequence
from datetime import tzinfo
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.files import read_yaml
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import from_epoch_ns
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.results.bag_write import METADATA
from greenroof_ros.results.trajectory import COLUMNS, Samples, Trajectory, recorded_columns
from greenroof_ros.site.site import MAX_EVAPOTRANSPIRATION, MAX_RAIN, Site

Stamps = NDArray[np.int64]

# Attribute of a trajectory, by topic. A sample needs the topics below; the others count as 0 if
# they are missing.
_ATTRIBUTES = {column.topic: column.attribute for column in COLUMNS if column.topic}
_NEEDED = ("/roof/level", "/cistern/level", "/pump/command", "/pump/flow")
_TYPE = "std_msgs/msg/Float64"
_CLOCK, _CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"

# A time without messages is a gap if it exceeds both: in seconds, and in median spacings.
_GAP_S, _GAP_SPACINGS = 600, 10
# A gap this long (h) is probably a change of the clock.
_CLOCK_GAP_H = 366 * 24


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
    values: Samples


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
            values out of their topic's range and used 0 instead. In other bags, values that are out
            of the topic's or the site's range are left out.
        external_pump: True if a pump driver sent the flow to the plant.
        repair: instruction for repairing a damaged bag, for use in the error message; empty if
            repair is impossible.

    Raises:
        ConfigurationError: if the bag is damaged, or lacks usable messages on a needed topic.
    """
    interface, highest = read_topics(), {} if own else _compute_maxima(site)
    series, notes = dict[str, _Series](), list[str]()
    for name, of_topic in _read_series(bag, repair).items():
        topic = interface[name]
        limits = Range(topic.low, min(topic.high, highest.get(name, math.inf)), topic.unit)
        # What the plant itself published are the results of the run.
        by_plant = "plant" not in topic.subscribers or (name == "/pump/flow" and not external_pump)
        wrong = ~((of_topic.values >= limits.low) & (of_topic.values <= limits.high))  # or NaN
        if wrong.any() and not (own and by_plant):
            notes.append(
                f"{np.count_nonzero(wrong)} of {len(wrong)} values of {name} "
                + ("were rejected in the run and replaced by 0" if own else "are left out")
                + f", because a value {limits.expected()}; the first is "
                f"{of_topic.values[wrong][0]:g} at {_name_time(of_topic.times[wrong][0], zone)}"
            )
            of_topic = (
                of_topic._replace(values=np.where(wrong, 0.0, of_topic.values)) if own
                else _Series(of_topic.times[~wrong], of_topic.values[~wrong])
            )
        if len(of_topic.times):
            series[name] = of_topic
    if silent := [topic for topic in _NEEDED if topic not in series]:
        raise ConfigurationError(
            "; ".join([f"contains no usable messages ({_TYPE}) on {', '.join(silent)}", *notes]),
            file=bag,
        )
    of_site = {column.topic: column.attribute for column in recorded_columns(site)}
    unknown = {topic: name for topic, name in of_site.items() if topic not in series}
    notes += [
        f"{topic} has no usable values in the bag; its value is assumed to be 0"
        for topic in unknown
    ]
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
    columns: dict[str, Samples] = {}
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
        tuple(notes), frozenset(unknown.values()),
    )


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
    return {
        "/roof/level": site.max_roof_level,
        "/cistern/level": site.max_cistern_level,
        "/pump/flow": 3 * maximum_pump_flow(site, site.a1 * site.z_o),
        "/weather/precipitation": MAX_RAIN / 3.6e6,
        # The crop coefficient scales the evapotranspiration of grass.
        "/weather/evapotranspiration":
            MAX_EVAPOTRANSPIRATION * max(1.0, site.crop_coefficient) / 8.64e7 * site.a2,
    }


def _describe_gaps(samples: Stamps, gaps: NDArray[np.intp], zone: tzinfo) -> str:
    hours = (samples[gaps + 1] - samples[gaps]) / 3.6e12
    longest = gaps[hours.argmax()]
    return (
        f"there are no messages in {len(gaps)} gaps, {hours.sum():.3g} h in total, the longest "
        f"from {_name_time(samples[longest], zone)} to {_name_time(samples[longest + 1], zone)} "
        f"({hours.max():.3g} h): in gaps, the command, the weather and the flows are unknown and "
        "are treated as 0, and the levels keep their last values"
        + ("; was a clock not set?" if hours.max() > _CLOCK_GAP_H else "")
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
