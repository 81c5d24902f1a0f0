"""Which values of a bag can be true: the limits of the interface, and those of the site."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.times import from_epoch_ns
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.recording.bag_topics import Stamps, Values
from greenroof_ros.weather.records import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES

# Fewer wrong values than this share of a topic's are outliers of a sensor; more are a mistake.
_MOST_OUTLIERS = 0.01

# What a person or another rounding adds to a limit that is met exactly.
_ROUNDING = 1 + 1e-9

# A live graph says by a NaN that it does not know: the interface's meaning of the topic.
_MAY_BE_UNKNOWN = ("/weather/frost",)


class Limit(NamedTuple):
    """What a topic's values can be."""

    low: float
    high: float
    unit: str
    why: str
    """what the highest is; empty where it is the interface's"""


def refuse(values: dict[str, Values], *, external_pump: bool) -> list[str]:
    """Do with the values of a run of this package what its plant did: what it refused acted as 0.

    What the plant itself says is as it is: the run's own numbers are of it.

    Args:
        values: of each topic; those of the plant's inputs change.
        external_pump: whether the flow is one of them; else it is the plant's.

    Returns:
        What was refused, for people.
    """
    notes = []
    interface = read_topics()
    for topic, column in values.items():
        known = interface[topic]
        if "plant" not in known.subscribers or (topic == "/pump/flow" and not external_pump):
            continue
        fine = (column >= known.low) & (column <= known.high)  # a NaN is neither
        refused = np.count_nonzero(~fine)
        if refused:
            values[topic] = np.where(fine, column, 0.0)
            notes.append(
                f"{refused} of {len(column)} values of {topic} were refused in the run, and acted "
                f"as 0: not from {known.low:g} to {known.high:g} {known.unit}"
            )
    return notes


def limits_of(site: Site, values: Mapping[str, Values]) -> dict[str, Limit]:
    """Return what the values of each topic in a bag can be: by the interface, and by the site."""
    full = maximum_pump_flow(site, site.a1 * site.z_o)
    _, _, rain = QUANTITIES[PRECIPITATION]
    _, _, evaporation = QUANTITIES[EVAPOTRANSPIRATION]
    # A crop takes that many times the most that grass does.
    evaporation *= max(1.0, site.crop_coefficient)
    highs = {
        "/roof/level": (site.highest_roof_level, f"twice the soil's depth of {site.z_soil:g} m"),
        "/cistern/level": (
            site.highest_cistern_level, f"three times the outlet's level of {site.z_o:g} m"
        ),
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
            limits[topic] = Limit(low, of_site * _ROUNDING, unit, f" ({why})")
        else:
            limits[topic] = Limit(low, high, unit, "")
    return limits


def plausible(
    bag: Path, topic: str, limit: Limit, stamps: Stamps, column: Values
) -> NDArray[np.bool_]:
    """Return which values of a topic can be true.

    Raises:
        ConfigurationError: too many cannot, or most of those that are not 0 are too large: a pump
            or rain in a wrong unit may be at work for less than a hundredth of the time.
    """
    fine = (column >= limit.low) & (column <= limit.high)  # a NaN is neither
    unknown = np.isnan(column) & (topic in _MAY_BE_UNKNOWN)
    wrong = np.flatnonzero(~fine & ~unknown)
    large = np.count_nonzero(column > limit.high)
    if len(wrong) and (
        len(wrong) >= _MOST_OUTLIERS * len(column) or 2 * large >= np.count_nonzero(column)
    ):
        time = from_epoch_ns(int(stamps[wrong[0]]))
        raise ConfigurationError(
            f"must be from {limit.low:g} to {limit.high:g} {limit.unit}{limit.why}, but is "
            f"{column[wrong[0]]:g} {limit.unit} at {time.isoformat()}; "
            "is a unit wrong?",
            file=bag, key=topic,
        )
    return fine
