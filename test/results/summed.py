"""The sums of ticks that a test makes up."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import NamedTuple

from greenroof_ros.physics.parameters import Flows, State
from greenroof_ros.results.metrics import Metrics, Results
from greenroof_ros.site.site import Site

STILL, END = Flows(0.0, 0.0, 0.0, 0.0, False, 0.0, 0.0, 0.0, 0.0), State(50.0, 1.0, 0.0)


class Tick(NamedTuple):
    """A tick; rain in m/s, potential evapotranspiration in m3/s."""

    flows: Flows = STILL
    rain: float = 0.0
    command: float = 0.0
    state: State = END
    potential: float = 0.0


def summed(
    site: Site, ticks: Iterable[Tick], end: State = END, start: str = "2021-07-07T00:00-05:00",
) -> Results:
    """Add up ticks.

    Args:
        site: the site.
        ticks: the ticks.
        end: state after them.
        start: time of the first tick.
    """
    ticks = list(ticks)
    time = datetime.fromisoformat(start).timestamp()
    metrics = Metrics(site, len(ticks), time)
    for flows, rain, command, state, potential in ticks:
        metrics.add(state, command, rain, potential, flows)
    return metrics.results(end)
