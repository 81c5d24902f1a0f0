"""The fit of a site's pump curve to the mean fall of the cistern's level while the pumps run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.calibration.fit import FittedParameter, compute_half_intervals
from greenroof_ros.analysis.calibration.step_record import StepRecord, Steps, Values, prolong_steps
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.site.site import Site
from greenroof_ros.weather.records import find_gaps

# For this long after rain, the catchment still feeds the cistern (s). At this distance from the
# levels of outlet, valve and suction, a sensor's noise does not matter (m).
_WET_S = 3600
_MARGIN_M = 0.05
# How long the pumps are off before and after a run, at least: the pump state can be late or early,
# a logger's by a step or two, a drive's by minutes.
_STANDING_STEPS, _STANDING_S = 3, 900
_MIN_RUNS = 10
# Something else moved the level in a run whose flow is this many typical deviations off.
_OFF = 5.0
# No pump lifts this many times the flow of its curve, or less than that flow divided by this.
_BELIEVABLE = 10.0


class PumpRun(NamedTuple):
    """A run of the pumps in which nothing else changes the cistern's level."""

    seconds: float
    """time at full command (s), according to the pump state"""
    fall: float
    """fall of the cistern's level (m)"""
    level: float
    """mean level (m)"""


class PumpFit(NamedTuple):
    """The result of a fit of the pump curve."""

    site: Site
    """site with the fitted curve; unchanged if the record does not identify it"""
    parameters: Sequence[FittedParameter] = ()
    """``a_hat`` and ``c_hat``; empty if the record does not identify them"""
    runs: int = 0
    """number of runs that count"""
    flow: float = np.nan
    """flow at full command (m3/s)"""
    half: float = np.nan
    """half of its 95 % interval (m3/s)"""
    level: float = np.nan
    """mean level of the cistern in these runs (m)"""


def find_runs(record: StepRecord, site: Site, command: Values, cistern: Values) -> list[PumpRun]:
    """Return the pump runs in which nothing else changes the cistern's level.

    In such a run, it has not rained for an hour, no value is missing, and the level lies below the
    outlet and above the levels of the suction and the mains valve. Runs with short breaks between
    them count as one run.
    """
    standing = max(_STANDING_STEPS, round(_STANDING_S / record.step_s))
    count = standing // 3 + 1  # number of levels averaged, before and after
    low = max(site.suction_level, site.mains_level or 0.0) + _MARGIN_M
    recent = prolong_steps(~(record.rain == 0), round(_WET_S / record.step_s) + 1)
    between = (cistern > low) & (cistern < site.min_outlet_level - _MARGIN_M)
    quiet: Steps = between & ~recent & ~np.isnan(command)
    near = np.convolve(command > 0, np.ones(2 * standing + 1), "same") > 0
    runs = []
    for first, end in find_gaps(near):
        if first > 0 and end < record.steps and quiet[first:end + 1].all():
            levels = cistern[first:end + 1]
            runs.append(PumpRun(
                record.step_s * float(np.sum(command[first:end])),
                float(np.mean(levels[:count]) - np.mean(levels[-count:])), float(np.mean(levels)),
            ))
    return runs


def fit_pumps(site: Site, record: StepRecord) -> PumpFit:
    """Fit the pump curve to the mean fall of the cistern's level in undisturbed pump runs.

    The flow Q at command 1 is the total fall in all runs times the cistern's area, divided by the
    equivalent time at full command. ``a_hat`` is fixed, and ``c_hat`` follows from Q at the mean
    level Z with Eqs. (3b)-(3e): Z + c_hat - d = Q^2 (pipe_resistance - a_hat). A sensor's offset
    has no effect, nor does a pump state that is recorded slightly late. The interval comes from
    :func:`.fit.compute_half_intervals` with runs as groups. Runs whose flow is far from the median
    are left out, because the level must have changed for another reason as well.

    With fewer than ten runs no curve is fitted.

    Args:
        site: site with its cistern, pipe and pump curve.
        record: the measurements; without a command or a cistern level, nothing is fitted.

    Raises:
        ConfigurationError: if the flow is far from that given by the site's pump curve.
    """
    if record.command is None or record.cistern is None:
        return PumpFit(site)
    runs = find_runs(record, site, record.command, record.cistern)
    if len(runs) < _MIN_RUNS:
        return PumpFit(site)
    seconds, falls, levels = np.array(runs).T
    off = np.abs(falls / seconds - np.median(falls / seconds))
    counts = off <= _OFF * np.median(off)
    seconds, falls, levels = seconds[counts], falls[counts], levels[counts]
    level = float(np.average(levels, weights=seconds))
    flow = site.a1 * float(np.sum(falls) / np.sum(seconds))
    curve = maximum_pump_flow(site, level * site.a1)
    if not curve / _BELIEVABLE < flow < curve * _BELIEVABLE:
        raise ConfigurationError(
            f"falls while the pumps run as if they lifted {1000 * flow:.2g} l/s at full command; "
            f"according to the site's curve, they lift {1000 * curve:.2g} l/s: is the sensor "
            "stuck, a unit wrong, a clock shifted, or does the pump state belong to other pumps?",
            file=record.source, key="cistern level",
        )
    without = site.a1 * (np.sum(falls) - falls) / (np.sum(seconds) - seconds)

    def heights(flows: Values) -> Values:
        return flows**2 * (site.pipe_resistance - site.a_hat) + site.d - level

    [c_hat] = heights(np.array([flow])).tolist()
    moved = np.stack([without, heights(without)], axis=-1)
    half, of_height = compute_half_intervals(moved, len(moved) - 1).tolist()
    held = "the data cannot distinguish this parameter from c_hat"
    return PumpFit(
        replace(site, c_hat=c_hat),
        [
            FittedParameter("a_hat", site.a_hat, np.nan, np.nan, held),
            FittedParameter("c_hat", c_hat, c_hat - of_height, c_hat + of_height, ""),
        ],
        runs=len(falls), flow=flow, half=half, level=level,
    )
