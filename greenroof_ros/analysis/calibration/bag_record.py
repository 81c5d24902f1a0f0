"""Measured records from bags that this project recorded at a live site or in a simulation."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.step_record import StepRecord, Values
from greenroof_ros.analysis.report.runs import read_about, run_directory
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import COMPUTED

# Duration of the steps (s): short relative to storms, long relative to a sensor's noise.
_STEP_S = 300.0
# A longer time without messages is a gap (s).
_GAP_S = 600.0


def read_bag_record(bag: Path, site: Site) -> StepRecord:
    """Read a bag as steps of five minutes.

    Rain, evapotranspiration and pumped water are summed over every step; the level is
    ``/roof/level`` at the beginning of the step. If ``/roof/drainage`` is not recorded, or is
    always 0, the record has no runoff.

    Evapotranspiration that the run computed (``fao56`` in the files next to its bag) includes the
    crop coefficient of the run's site, and is therefore divided by this coefficient. The column of
    a weather file and the forecasts of a live site do not include the crop coefficient, so all
    other evapotranspiration is used unchanged.

    In a gap only evapotranspiration is filled in, because the roof continues to dry. The fill value
    is the value at the same time on the previous day or, on the first day, the last value before
    the gap.

    Raises:
        ConfigurationError: if the bag cannot be read, is shorter than two steps, or contains no
            evapotranspiration.
    """
    trajectory, notes, _ = load_bag(bag, site, site.zone, own=False)
    steps = int(trajectory.time[-1] // _STEP_S)
    if steps < 2:
        raise ConfigurationError(
            f"is {trajectory.time[-1]:g} s long; it must cover at least two steps of {_STEP_S:g} s",
            file=bag,
        )
    edges = _STEP_S * np.arange(steps + 1)
    spacing = np.diff(trajectory.time)
    gap = np.zeros(steps, dtype=bool)
    for place in np.flatnonzero(spacing > _GAP_S):
        low, high = trajectory.time[place] // _STEP_S, np.ceil(trajectory.time[place + 1] / _STEP_S)
        gap[int(low):int(high)] = True

    def summed(flow: Values) -> Values:
        """Return the volume of a flow in every step, with the flow constant between samples."""
        total = np.concatenate(([0.0], np.cumsum(flow[:-1] * spacing)))
        amounts = np.diff(np.interp(edges, trajectory.time, total))
        return np.where(gap, np.nan, amounts)

    mm = 1000 / site.a2
    first = np.searchsorted(trajectory.time, edges[:-1], side="right") - 1
    reference = summed(trajectory.evapotranspiration) * mm
    run = run_directory(bag)
    if read_about(run).get("evapotranspiration_method") in COMPUTED:
        own = run / "configuration" / "site.yaml"
        reference /= (read_site(own) if own.is_file() else site).crop_coefficient
    if not np.any(reference > 0):
        raise ConfigurationError(
            "is not in the bag, or is always 0; without it, the drying of the roof cannot be "
            "fitted", file=bag, key="/weather/evapotranspiration",
        )
    return StepRecord(
        source=bag, start=trajectory.start, step_s=_STEP_S,
        rain=summed(trajectory.precipitation) * 1000,
        reference=_fill_gaps(reference),
        pumped=summed(trajectory.pump_flow) * mm,
        runoff=summed(trajectory.drainage) * mm if np.any(trajectory.drainage > 0) else None,
        level=np.where(gap, np.nan, trajectory.roof[first] / site.a2), notes=notes,
    )


def _fill_gaps(reference: Values) -> Values:
    """Fill the gaps in evapotranspiration (mm per step)."""
    day = round(86400 / _STEP_S)
    filled = reference.tolist()  # a gap can last for years, if a clock was not set
    for step in np.flatnonzero(np.isnan(reference)).tolist():
        # A bag begins with a message, but a gap can begin in its first step.
        before = step - day if step >= day else max(step - 1, 0)
        filled[step] = 0.0 if math.isnan(filled[before]) else filled[before]
    return np.array(filled)
