"""The water account so far: water that came to the roof and left it, from values as they come."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.model.metrics import METRICS, Samples
from greenroof_ros.model.plant import mains_flow, outlet_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.watch.history import Stamps, Values
from greenroof_ros.watch.words import SPACE

# How long a value of a live site holds at most (ns); after that there is a gap, as in a report.
HOLDS_NS = 600_000_000_000

_ROOF, _CISTERN, _RAIN = "/roof/level", "/cistern/level", "/weather/precipitation"
_EVAPORATED, _FLOW = "/weather/evapotranspiration", "/pump/flow"
# Only the plant publishes these: if they are received, it is a simulation.
_OUTFLOW, _DRAINAGE = "/cistern/outflow", "/roof/drainage"
_OF_PLANT = (_OUTFLOW, _DRAINAGE)
TOPICS = (_ROOF, _CISTERN, _RAIN, _EVAPORATED, _FLOW, *_OF_PLANT)

# When this many values wait, they are counted even if no one asks for totals.
_MOST_WAITING = 200_000

_OF_RAIN = _RAIN, _FLOW, _DRAINAGE


class Entry(NamedTuple):
    """A row of the account, and how it is shown.

    Attributes:
        label: in words.
        metric: the metric that gives it; empty if it follows from other rows.
        needs: topics that must be known for it.
        unit: as it is shown.
        decimals: of the shown number.
        factor: from the metric's unit to the shown unit.
    """

    label: str
    metric: str = ""
    needs: tuple[str, ...] = ()
    unit: str = "m³"
    decimals: int = 3
    factor: float = 1.0


ENTRIES = {
    "stress": Entry("Water stress of the plants", "stress_hours", (_ROOF,), "h", 1),
    "evapotranspiration_ratio": Entry(
        "Evapotranspiration, share of the plants' demand", "evapotranspiration_ratio",
        (_EVAPORATED, _ROOF), "%", 0, 100.0,
    ),
    "kept": Entry("Rain kept on the roof", "rain_kept_share", _OF_RAIN, "%", 0, 100.0),
    "kept_hour": Entry(
        f"Rain kept in storms above 20{SPACE}mm/h", "rain_kept_share_hour", _OF_RAIN, "%", 0, 100.0
    ),
    "kept_day": Entry(
        f"Rain kept in storms above 10{SPACE}mm in 24{SPACE}h", "rain_kept_share_day", _OF_RAIN,
        "%", 0, 100.0,
    ),
    "deviation": Entry("Mean deviation from the target", "mean_deviation_mm", (_ROOF,), "mm", 1),
    "rain": Entry("Rain on the roof", "rain_roof_m3", (_RAIN,)),
    "pumped": Entry("Pumped onto the roof", "pumped_m3", (_FLOW,)),
    "drained": Entry("Drained off the roof", "drainage_m3", (_DRAINAGE,)),
    "evapotranspired": Entry("Evapotranspired", "evapotranspiration_m3", (_EVAPORATED,)),
    "stored": Entry("Change of the water on the roof"),
    "unexplained": Entry("Unexplained"),
    "inflow": Entry("Rain into the cistern", "rain_cistern_m3", (_RAIN,)),
    "overflow": Entry("Outflow to the sewer", "outflow_m3", (_OUTFLOW,)),
    "mains": Entry(
        "Mains water into the cistern, computed from the level", "mains_m3", (_CISTERN,)
    ),
    "saved": Entry("Potable water saved"),
    "energy": Entry("Energy of the pump", "electric_energy_kwh", (_FLOW, _CISTERN), "kWh"),
}
"""Rows of the account, in order."""
_BY_NAME = {metric.name: metric for metric in METRICS}


class _Pending:
    """The newest counted value of a topic, and all values that are not counted yet."""

    def __init__(self) -> None:
        self.times: Stamps = np.empty(0, dtype=np.int64)
        self.values: Values = np.empty(0)
        self.first = self.last = 0  # times of the first value ever, and of the newest
        self.adds = 0  # the account's count of additions at the last one here

    def add(self, times: Stamps, values: Values) -> None:
        if not len(self.times):
            self.first = int(times[0])
        self.last = int(times[-1])
        self.times = np.concatenate((self.times, times))
        self.values = np.concatenate((self.values, values))

    def drop_before(self, time: int) -> None:
        """Drop the values before a time (ns) except the newest, which holds at that time."""
        place = max(0, int(np.searchsorted(self.times, time, side="right")) - 1)
        # Copies: a view would keep the whole batch.
        self.times, self.values = self.times[place:].copy(), self.values[place:].copy()


class Account:
    """The sums of one run, or of a live site since the watcher began.

    A value holds until the next value of its topic. In a simulation that is one tick, and the sums
    equal the run's summary; a tick that was not received is a gap. On a live site a value holds for
    10 min at most, and then there is a gap, too. Nothing is guessed in a gap. All is summed up to
    the roof's last level.

    Flows that no one measures on a live site are computed from the levels: the overflow by Eq. (2),
    and the drainage by Eq. (4), which begins at the soil's capacity, or for a measured soil by
    :mod:`greenroof_ros.model.soil`. The drainage layer of a measured soil holds the site's
    ``initial_layer`` when the account begins.

    Attributes:
        live: whether it is a live site: drainage and overflow are not waited for.
        since: begin of the account (ns); None if it has not begun.
        until: its end (ns).
        gap_s: total time in which something was unknown (s).
    """

    def __init__(self, site: Site) -> None:
        """Start an empty account.

        Args:
            site: gives the areas, the outlets, the soil and the pump.
        """
        self._site, self._soil = site, soil_of(site)
        self._topics: dict[str, _Pending] = {}
        self._combined: dict[str, Any] = {}  # results of metrics.Metric.combine
        self._roofs: tuple[float, float] | None = None  # first and last volume (m3)
        self._layer = site.initial_layer  # in the drainage layer of a measured soil (m3)
        self._adds = 0
        self._waiting = 0  # values added since `add` last counted
        self._ended = False
        self.live = False
        self.since: int | None = None
        self.until = 0
        self.gap_s = 0.0

    @property
    def measured(self) -> bool:
        """Whether drainage or overflow is received; on a live site both are computed."""
        return any(topic in self._topics for topic in _OF_PLANT)

    def add(self, topic: str, times: Stamps, values: Values) -> None:
        """Take values of a topic, in the order of time and newer than those before.

        Args:
            topic: one of :data:`TOPICS`.
            times: since 1970 (ns), shape (n,).
            values: shape (n,), NaN for a value that is not plausible.
        """
        self._adds += 1
        self._ended = False
        pending = self._topics.setdefault(topic, _Pending())
        pending.adds = self._adds
        pending.add(times, values)
        self._waiting += len(times)
        if self._waiting > _MOST_WAITING:
            self._waiting = 0
            self._count()

    def end(self) -> None:
        """Note that nothing more comes for now: no topic is waited for."""
        self._ended = True

    def totals(self) -> Mapping[str, float]:
        """Return the known metrics so far, in their units.

        The keys are as in the document's account. ``stored`` is the change of the water on the
        roof, and ``unexplained`` the part of it that the flows do not explain.
        """
        self._count()
        totals = {}
        for key, combined in self._combined.items():
            value = _BY_NAME[ENTRIES[key].metric].finish(self._site, combined)
            if value is not None:
                totals[key] = value
        if self._roofs is not None:
            totals["stored"] = (
                self._roofs[1] - self._roofs[0] + self._layer - self._site.initial_layer
            )
            flows = [totals.get(key) for key in ("rain", "pumped", "drained", "evapotranspired")]
            if None not in flows:
                rain, pumped, drained, evaporated = (flow or 0.0 for flow in flows)
                totals["unexplained"] = totals["stored"] - (rain + pumped - drained - evaporated)
        if "pumped" in totals:
            totals["saved"] = totals["pumped"] - totals.get("mains", 0.0)
        return totals

    def _complete(self) -> int | None:
        """Return the time (ns) up to which all awaited topics have come."""
        if not self._topics:
            return None
        newest = max(pending.last for pending in self._topics.values())
        # A topic that was never received is treated as silent since the first value of any topic.
        oldest = min(pending.first for pending in self._topics.values())
        if self._ended:
            return newest
        wanted = TOPICS if self.measured or not self.live else TOPICS[:-len(_OF_PLANT)]
        complete = newest
        for topic in wanted:
            pending = self._topics.get(topic)
            last = -math.inf if pending is None else pending.last
            received_after = self._adds - (0 if pending is None else pending.adds)
            # Batches come topic by topic: a topic that is behind will catch up. But a topic that is
            # silent for HOLDS_NS, while others are received, is not waited for.
            silent = newest - max(last, oldest) > HOLDS_NS and received_after > 2 * len(TOPICS)
            if not silent:
                if pending is None:
                    return None
                complete = min(complete, pending.last)
        return complete

    def _count(self) -> None:
        """Add up everything up to the time that is complete."""
        end = self._complete()
        if end is None:
            return
        if self.since is None:
            begin = max(
                pending.first for pending in self._topics.values() if pending.first <= end
            )
            self.since = self.until = begin
        # Up to the roof's last level: what flowed after it is not in that level.
        levels = self._topics[_ROOF].times if _ROOF in self._topics else np.empty(0)
        levels = levels[(levels <= end) & (end - levels < HOLDS_NS)]
        end = int(levels[-1]) if len(levels) else end
        if end > self.until:
            self._add_up(self.until, end)
            self.until = end
            for pending in self._topics.values():
                pending.drop_before(end)
        level = float(self._at(_ROOF, np.array([self.until]), math.inf)[0])
        if math.isfinite(level):
            volume = self._site.roof_volume(level)
            self._roofs = (volume if self._roofs is None else self._roofs[0], volume)

    def _at(self, topic: str, times: Stamps, holds: float) -> Values:
        """Return the value of a topic at each time; NaN if it is unknown."""
        if topic not in self._topics:
            return np.full(len(times), np.nan)
        pending = self._topics[topic]
        place = np.searchsorted(pending.times, times, side="right") - 1
        known = (place >= 0) & (times - pending.times[np.maximum(place, 0)] < holds)
        last = pending.values[np.maximum(place, 0)]
        if self.measured and topic in (_RAIN, _EVAPORATED, _FLOW):
            # As in the plant: a refused value acts as 0.
            last = np.nan_to_num(last)
        return np.where(known, last, np.nan)

    def _add_up(self, begin: int, end: int) -> None:
        """Add what happened from one time to another (ns)."""
        site, since = self._site, self.since
        assert since is not None
        holds = round(site.tau * 1e9) if self.measured else HOLDS_NS
        edges = self._edges(begin, end, holds)
        times = edges[:-1]
        duration = np.diff(edges) / 1e9
        known = {topic: self._at(topic, times, holds) for topic in TOPICS}
        if self._roofs is None:
            first = known[_ROOF][np.isfinite(known[_ROOF])][:1]
            if len(first):
                self._roofs = (site.roof_volume(float(first[0])),) * 2
        roof, cistern = known[_ROOF] * site.a2, known[_CISTERN] * site.a1
        if not self.measured:
            known[_DRAINAGE] = roof  # if it is known, the drainage can be computed
            known[_OUTFLOW] = _outflow(site, cistern)
        unknown = np.any([np.isnan(values) for values in known.values()], axis=0)
        self.gap_s += float(duration[unknown].sum())
        rain, outflow = np.nan_to_num(known[_RAIN]), np.nan_to_num(known[_OUTFLOW])
        # As in plant.Plant.flows: a tank gives no more than it holds. The measured drainage and
        # outflow are within that limit already; the other flows get the rest.
        flow = np.nan_to_num(known[_FLOW])
        if self.measured:  # a driver may report a greater flow than the plant gave it
            left = cistern / duration + rain * site.effective_catchment - outflow
            left = left + mains_flow(site, cistern)
            flow = np.fmin(flow, np.maximum(left, 0.0))
        drainage = np.nan_to_num(known[_DRAINAGE]) if self.measured else None
        followed = self._soil.follow(
            self._layer, roof, rain, flow, np.nan_to_num(known[_EVAPORATED]), drainage, duration
        )
        self._layer = followed.remaining
        samples = Samples(
            duration=duration,
            cistern=np.nan_to_num(cistern),
            roof=np.nan_to_num(roof),
            command=np.zeros(len(times)),
            precipitation=rain,
            outflow=outflow,
            pump=flow,
            drainage=followed.drained if drainage is None else drainage,
            evapotranspiration=followed.evaporated,
            layer=followed.layer,
            mains=mains_flow(site, np.nan_to_num(cistern)),
            potential=np.nan_to_num(known[_EVAPORATED]),
            time=(times - since) / 1e9,
        )
        for key, entry in ENTRIES.items():
            if not entry.metric:
                continue
            there = np.all([np.isfinite(known[topic]) for topic in entry.needs], axis=0)
            metric = _BY_NAME[entry.metric]
            values = metric.function(site, samples)
            if values is not None and there.any():
                values = np.where(there, values, 0.0)
                self._combined[key] = metric.combine(self._combined.get(key, 0.0), values)

    def _edges(self, begin: int, end: int, holds: int) -> Stamps:
        """Return the times (ns) between which no value changes or stops holding."""
        edges: list[Stamps] = [np.array([begin, end])]
        for pending in self._topics.values():
            over = pending.times + holds
            edges += [over[:-1][over[:-1] < pending.times[1:]], over[-1:], pending.times]
        between = np.unique(np.concatenate(edges))
        return between[(between >= begin) & (between <= end)]


def _outflow(site: Site, x1: Values) -> Values:
    """Return the flow through the outlets (m3/s) at each of these volumes (m3); NaN at NaN.

    Only volumes above the lowest outlet, which are rare, are computed one by one.
    """
    flows = np.where(np.isnan(x1), np.nan, 0.0)
    for place in np.flatnonzero(x1 >= site.cistern_volume(site.lowest_outlet)):
        flows[place] = outlet_flow(site, float(x1[place]))
    return flows
