"""What happened, from a bag alone: of this package, or of a real site with gaps and outliers."""

from __future__ import annotations

from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import from_epoch_ns
from greenroof_ros.model.site import Site
from greenroof_ros.recording.bag_files import content_of
from greenroof_ros.recording.bag_limits import limits_of, plausible, refuse
from greenroof_ros.recording.bag_topics import NEEDED, OPTIONAL, Stamps, Values, read_topics
from greenroof_ros.recording.trajectory import Trajectory

# No message for longer than both is a gap: in seconds, and in median spacings.
_GAP_S, _GAP_SPACINGS = 600, 10

_MOST_NAMED = 10


def count_ticks(bag: Path) -> int | None:
    """Return how many ticks a bag of this package holds, by its index.

    None where it was not closed: its recorder was killed, or its disk was full.
    """
    if not (bag / "metadata.yaml").is_file():
        return None
    ticks = 0
    for file in bag.glob("*.mcap"):
        content = content_of(file)
        if content is None:
            return None
        ticks += content.ticks
    return ticks


class Recorded(NamedTuple):
    """What happened in a run, and what a reader should know of how that was found."""

    trajectory: Trajectory
    notes: tuple[str, ...] = ()


def load_bag(
    bag: Path, site: Site, zone: tzinfo, *, own: bool, external_pump: bool = False,
    repair: str = "",
) -> Recorded:
    """Read what happened from a bag alone.

    A sample is a time at which a message of any topic that is used here was logged; every topic
    has its last value at or before it. The bags of this package have all topics of a tick at one
    time, so that their samples are the ticks.

    Args:
        bag: its directory.
        site: where it was.
        zone: offset from UTC of the times.
        own: whether this package wrote down that the run is its own: what is not plausible was
            then refused by its plant, and acted as 0; elsewhere it is left out, or is an error.
        external_pump: whether its plant was given the flow by a pump driver.
        repair: how a damaged one can be repaired, for the message.

    Raises:
        ConfigurationError: the bag is damaged, foreign, or its values cannot be true.
    """
    times, values = read_topics(bag, repair)
    notes = [f"{topic} is not in the bag and counts as 0" for topic in OPTIONAL
             if topic not in times]
    if own:
        notes += refuse(values, external_pump=external_pump)
    for topic, limit in ({} if own else limits_of(site, values)).items():
        fine = plausible(bag, topic, limit, times[topic], values[topic])
        outliers = np.count_nonzero(~fine)
        if outliers:
            notes.append(
                f"{outliers} of {len(fine)} values of {topic} are not finite or out of range, and "
                "are left out"
            )
            times[topic], values[topic] = times[topic][fine], values[topic][fine]
        if not len(times[topic]):  # what was never known
            del times[topic], values[topic]
    stamps = np.unique(np.concatenate(list(times.values())))
    samples = stamps[stamps >= max(times[topic][0] for topic in NEEDED)]
    if len(samples) < 2:
        raise ConfigurationError(
            f"must hold two samples of {', '.join(NEEDED)} at least, not {len(samples)}",
            file=bag,
        )
    gaps = _gaps(samples)
    columns: dict[str, Values] = {}
    for topic, name in {**NEEDED, **OPTIONAL}.items():
        columns[name] = np.zeros(len(samples))
        if topic in times:
            # Of messages with one stamp the last counts.
            index = np.searchsorted(times[topic], samples, side="right") - 1
            columns[name] = np.where(index >= 0, values[topic][np.maximum(index, 0)], 0.0)
        if name not in ("roof", "cistern"):
            columns[name][gaps] = 0.0
    columns["roof"] = columns["roof"] * site.a2
    columns["cistern"] = columns["cistern"] * site.a1
    if len(gaps):
        notes.append(_gap_note(samples, gaps, zone))
    time = (samples - samples[0]) / 1e9
    start = from_epoch_ns(int(samples[0])).astimezone(zone)
    return Recorded(Trajectory(start=start, time=time, **columns), tuple(notes))


def _gaps(samples: Stamps) -> NDArray[np.intp]:
    """Return the samples after which no message came for long."""
    spacings = np.diff(samples)
    longest = max(_GAP_S * 1e9, _GAP_SPACINGS * float(np.median(spacings)))
    return np.flatnonzero(spacings > longest)


def _gap_note(samples: Stamps, gaps: NDArray[np.intp], zone: tzinfo) -> str:
    """Name the gaps, by the samples before them."""
    hours = (samples[gaps + 1] - samples[gaps]) / 3.6e12
    named = [
        " to ".join(
            from_epoch_ns(int(samples[place])).astimezone(zone).isoformat(timespec="seconds")
            for place in (gap, gap + 1)
        ) + f" ({length:.3g} h)"
        for gap, length in zip(gaps[:_MOST_NAMED], hours, strict=False)
    ]
    if len(gaps) > _MOST_NAMED:
        named.append(f"and {len(gaps) - _MOST_NAMED} more, {hours.sum():.3g} h in all")
    return (
        f"no message came from {', '.join(named)}: command, weather and flows are unknown there "
        "and count as 0, and the levels as they were before"
    )
