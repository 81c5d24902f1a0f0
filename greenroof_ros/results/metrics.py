"""The metrics of a run, as used by all summaries, tables and reports.

:mod:`.sums` adds up the ticks of a run; a metric is computed from these sums.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any, NamedTuple

import numpy as np

from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.pump import RUNNING_SHARE
from greenroof_ros.physics.storm_water import (
    HOUR_S,
    Event,
    connected_area,
    is_wet,
    time_without_rain,
)
from greenroof_ros.results import sums as s
from greenroof_ros.results.sums import NEAR_TARGET, PEAKS_MIN
from greenroof_ros.site.site import Site

_JOULES_PER_KWH = 3.6e6
_RUNS = f"above {RUNNING_SHARE:.0%} of the maximum flow or of the commanded flow"


@dataclass(frozen=True)
class Metric:
    """A metric of a run.

    Attributes:
        name: key in ``summary.json``, and column in ``results.csv``.
        unit: unit in tables; 1 for a dimensionless number.
        label: name in tables.
        meaning: short description.
        value: place of the metric's sum, in the unit or, for a unit of h, in ticks; or a function
            that computes the metric from the site and the sums of a run, or returns NaN if the
            metric is undefined for the run.
        form: format of the number in tables; ``d`` for a whole number.
        max: highest acceptable value; higher values are shown as warnings.
    """

    name: str
    unit: str
    label: str
    form: str
    value: int | Callable[[Site, Any], float]
    meaning: str
    max: float = math.inf

    @property
    def description(self) -> str:
        """Unit and meaning, as shown in tables next to the number."""
        return self.meaning if self.unit == "1" else f"{self.unit}, {self.meaning}"


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _demand_met(site: Site, sums: Any) -> float:
    """Return the share of the pumped water that was rain.

    With other uses, it is the share of all the water that roof and other uses needed. The rest came
    from the mains, or was in the cistern at the start. Of the mains water, the part
    that raised the water below the float valve's level is still there. Of the initial water above
    this level, what remains or may have flowed to the sewer was not pumped. If drainage flows back
    into the cistern, water is pumped more than once, but no more rain than fell.
    """
    used = sums[s.PUMPED] + sums[s.OTHER]
    if site.mains_level is None or not used:
        return math.nan
    supplied = site.cistern_volume(site.mains_level)
    first, last = sums[s.FIRST_CISTERN], sums[s.CISTERN]
    from_mains = max(0.0, sums[s.MAINS] - (min(last, supplied) - min(first, supplied)))
    fallen = max(first, supplied) - max(last, supplied)
    other = from_mains + max(0.0, fallen - sums[s.OUTFLOW])
    collected = site.effective_catchment + site.drainage_to_cistern * site.a2
    rain = min(max(0.0, used - other), sums[s.RAIN] * collected)
    other += sums[s.OTHER_MAINS]
    return rain / (rain + other) if rain > 0 else 0.0


def _peaks(unit: str, label: str, meaning: str, factor: Callable[[Site], float]) -> list[Metric]:
    """Return the peaks in a unit: the factor times m3/s."""

    def peak(place: int, minutes: int) -> Metric:
        name = f"peak_discharge_{minutes}min_{unit.replace('/', '_').lower()}"
        return Metric(
            name, unit, f"{label}, {minutes} min", ".4g",
            lambda site, sums: factor(site) * sums[place] / (60 * minutes),
            meaning.format(minutes),
        )

    return [peak(s.PEAK_5 + number, minutes) for number, minutes in enumerate(PEAKS_MIN)]


def _volume(name: str, place: int, meaning: str) -> Metric:
    return Metric(f"{name}_m3", "m3", name, ".4g", place, meaning)


METRICS = (
    Metric(
        "total_deviation_m3", "m3", "total deviation", ".2f", s.DEVIATION,
        "absolute deviation of the water on the roof from its target, summed over the time steps",
    ),
    Metric(
        "near_target_hours", "h", "near the target", ".2f", s.NEAR,
        f"time during which the water on the roof is within {NEAR_TARGET:.0%} of its target",
    ),
    Metric(
        "mean_deviation_mm", "mm", "mean deviation", ".2f",
        lambda site, sums: 1000 * sums[s.DEVIATION] / (sums[s.TICKS] + 1) / site.a2,
        "mean absolute deviation of the water on the roof from its target, as a depth",
    ),
    Metric(
        "stress_hours", "h", "water stress", ".2f", s.STRESSED,
        "time in which K_s of FAO-56 is below 1, or the roof contains no water",
    ),
    Metric(
        "evapotranspiration_ratio", "1", "evapotranspiration ratio", ".1%",
        lambda site, sums: _share(sums[s.EVAPORATED], sums[s.POTENTIAL]),
        "actual evapotranspiration divided by potential evapotranspiration",
    ),
    Metric(
        "roof_retention_share", "1", "retention of the roof", ".1%",
        lambda site, sums: 1 - _share(sums[s.DRAINED], sums[s.RAIN] * site.a2 + sums[s.PUMPED]),
        "share of the rain and the irrigation on the roof that did not drain",
    ),
    Metric(
        "mains_m3", "m3", "mains water used", ".4g",
        lambda site, sums: (
            math.nan if site.mains_level is None and site.monthly_other_demand is None
            else sums[s.MAINS] + sums[s.OTHER_MAINS]
        ),
        "mains water that flowed into the cistern, or to other uses when the cistern was empty",
    ),
    Metric(
        "demand_met_share", "1", "irrigation with rain", ".1%", _demand_met,
        "share of the water for roof and other uses that was not mains water, nor there at first",
    ),
    Metric(
        "final_cistern_m3", "m3", "cistern at the end", ".6g", s.CISTERN,
        "water in the cistern at the end of the run",
    ),
    Metric(
        "final_roof_m3", "m3", "roof at the end", ".6g", s.ROOF,
        "water on the roof at the end of the run",
    ),
    Metric(
        "final_layer_m3", "m3", "drainage layer at the end", ".6g",
        lambda site, sums: sums[s.LAYER] if site.layer_storage else math.nan,
        "water in the drainage layer at the end of the run",
    ),
    _volume("pumped", s.PUMPED, "water pumped from the cistern to the roof"),
    Metric(
        "other_m3", "m3", "other uses", ".4g",
        lambda site, sums: math.nan if site.monthly_other_demand is None else sums[s.OTHER],
        "water that other uses than the roof drew from the cistern",
    ),
    _volume("outflow", s.OUTFLOW, "water that flowed from the cistern to the sewer"),
    _volume("drainage", s.DRAINED, "water that drained off the roof"),
    _volume(
        "discharge", s.DISCHARGE,
        "water that reached the sewer: outflow, and drainage except into the cistern",
    ),
    Metric(
        "wet_discharge_m3", "m3", "discharge in wet weather", ".4g", s.WET_DISCHARGE,
        "water that reached the sewer during rain or within wet_after hours after rain",
    ),
    *_peaks("L/s", "peak discharge", "highest mean discharge over {} min", lambda site: 1000.0),
    *_peaks(
        "mm/h", "peak discharge per area",
        "highest mean discharge over {} min, per connected area",
        lambda site: 1000 * HOUR_S / connected_area(site),
    ),
    _volume("overflow", s.OVERFLOW, "water that left the cistern through its upper outlet"),
    Metric(
        "overflow_days", "1", "days of overflow", "d", s.OVERFLOW_DAYS,
        "days with an overflow of at least 0.1 mm over the connected area",
    ),
    Metric(
        "retention_share", "1", "retention", ".1%",
        lambda site, sums: 1 - _share(sums[s.DISCHARGE], sums[s.RAIN] * connected_area(site)),
        "share of the rain on the connected area that did not reach the sewer",
    ),
    Metric(
        "rain_m3", "m3", "rain", ".4g", lambda site, sums: sums[s.RAIN] * connected_area(site),
        "rain that flowed into the cistern or fell on the roof",
    ),
    Metric(
        "rain_cistern_m3", "m3", "rain into the cistern", ".4g",
        lambda site, sums: sums[s.RAIN] * site.effective_catchment,
        "rain that flowed into the cistern from the catchment",
    ),
    Metric(
        "rain_roof_m3", "m3", "rain on the roof", ".4g", lambda site, sums: sums[s.RAIN] * site.a2,
        "rain that fell on the whole roof",
    ),
    _volume(
        "evapotranspiration", s.EVAPORATED, "water that evaporated from the soil and the plants",
    ),
    Metric(
        "max_command", "1", "maximum command", ".6g", s.MAX_COMMAND,
        "highest command, as a share of the maximum flow", max=1,
    ),
    Metric(
        "beyond_hours", "h", "beyond the pump", ".4f", s.BEYOND,
        "time during which the command is above 1", max=0,
    ),
    Metric(
        "limited_steps", "1", "limited ticks", "d", s.LIMITED,
        "time steps in which a tank contained less water than was demanded", max=0,
    ),
    Metric(
        "pump_starts", "1", "pump starts", "d", s.STARTS,
        f"times that the flow of the pumps rose {_RUNS}",
    ),
    Metric(
        "busiest_hour_starts", "1", "starts in an hour", "d", s.BUSIEST_HOUR,
        "maximum number of pump starts in 60 minutes",
    ),
    Metric(
        "excess_starts", "1", "too many starts", "d", s.EXCESS_STARTS,
        "number of pump starts in excess of starts_per_hour", max=0,
    ),
    Metric(
        "pump_hours", "h", "pump running", ".3f", s.PUMP_TICKS,
        f"time during which the flow of the pumps is {_RUNS}",
    ),
    Metric(
        "hydraulic_energy_kwh", "kWh", "hydraulic energy", ".4g",
        lambda site, sums: sums[s.ENERGY_J] * (1 / _JOULES_PER_KWH),
        "energy that the pumps add to the water",
    ),
    Metric(
        "electric_energy_kwh", "kWh", "electric energy", ".4g",
        lambda site, sums: sums[s.ENERGY_J] / _JOULES_PER_KWH / site.pump_efficiency,
        "hydraulic energy divided by pump_efficiency",
    ),
)


def compute_metrics(site: Site, sums: Any) -> dict[str, float]:
    """Return the metrics of a run by name, without those that are undefined.

    Args:
        site: parameters of the site.
        sums: sums of the run after :func:`.sums.finish`; NaN for what is not known.
    """
    metrics: dict[str, float] = {}
    for metric in METRICS:
        value = metric.value(site, sums) if callable(metric.value) else sums[metric.value]
        if not math.isnan(value):
            value = value * site.tau / HOUR_S if metric.unit == "h" else value
            metrics[metric.name] = int(value) if metric.form == "d" else float(value)
    return metrics


def find_new_days(site: Site, start: float, ticks: int) -> list[int]:
    """Return the first tick of every day of the site's clock that begins within a run.

    A tick belongs to the day that contains its midpoint.

    Args:
        site: site with its clock and the duration of a tick.
        start: start of the run (s since 1970).
        ticks: number of ticks.
    """
    middle = start + site.tau / 2
    first, last = (
        datetime.fromtimestamp(time, site.zone).toordinal()
        for time in (middle, middle + (ticks - 1) * site.tau)
    )
    midnights = (
        datetime.combine(date.fromordinal(day), datetime.min.time(), site.zone).timestamp()
        for day in range(first + 1, last + 1)
    )
    return [math.ceil((midnight - middle) / site.tau) for midnight in midnights]


class Results(NamedTuple):
    """What a run leaves."""

    metrics: dict[str, float]
    """metrics by name"""
    events: list[Event]
    """rain events in chronological order, excluding traces below 0.1 mm"""


def end_run(site: Site, sums: Any, events: Any, state: State) -> Results:
    """End a run, and return its results.

    Args:
        site: parameters of the site.
        sums: sums of the run; NaN for what is not known.
        events: table of the events.
        state: state after the last tick.
    """
    s.finish(plant_parameters(site), sums, events, state)
    rows = np.asarray(events)[: int(sums[s.EVENTS])].tolist()
    return Results(compute_metrics(site, sums), [
        Event._make((*values, None if math.isnan(delay) else delay, complete > 0))
        for *values, delay, complete in rows
    ])


class Metrics:
    """The metrics of a run in progress."""

    def __init__(
        self, site: Site, ticks: int, start: float = 0.0, without_rain: float = math.inf
    ) -> None:
        """Begin with the pumps stopped.

        Args:
            site: parameters of the site.
            ticks: number of ticks of the run.
            start: start of the run (s since 1970).
            without_rain: time without rain at the start (s).
        """
        self._site, self._parameters = site, plant_parameters(site)
        self._sums = [0.0] * s.count_places(self._parameters)
        self._events = np.zeros((s.count_events(self._parameters, ticks), len(Event._fields)))
        self._new_days = set(find_new_days(site, start, ticks))
        self._tick, self._without_rain = 0, without_rain

    def add(
        self, state: State, command: float, rain: float, potential: float, flows: Flows
    ) -> None:
        """Add the next tick; see :func:`.sums.add`."""
        wet = self.is_wet(rain)
        self._without_rain = time_without_rain(self._without_rain, rain, self._site.tau)
        s.add(
            self._parameters, self._sums, self._events, state, command, rain, potential, flows,
            wet, self._tick in self._new_days,
        )
        self._tick += 1

    def is_wet(self, rain: float) -> bool:
        """Return whether the weather is wet in the next tick, with its rain (m/s)."""
        tau = self._site.tau
        without_rain = time_without_rain(self._without_rain, rain, tau)
        return bool(is_wet(without_rain, tau, self._parameters.wet_after_s))

    def results(self, state: State) -> Results:
        """Return the results, as if the run ended in a state."""
        return end_run(self._site, [*self._sums], self._events.copy(), state)
