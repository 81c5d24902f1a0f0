"""Design storms: the rain in each step of a storm with a given depth for every duration.

- **block**: constant rain.
- **euler**: Euler's type II (DWA-A 118, 2006, section 5.2.2.1). The increments of the depth in the
  steps of the storm are sorted. The largest begins at 0.3 of the duration, rounded down to a step.
  The next smaller ones are before it, up to the beginning of the storm, and the others after it.
- **chicago**: Keifer and Chu (1957). Every part of the storm that contains the peak, and of which
  the share ``peak`` is before it, has the depth of its own duration. The default is 0.375, which
  they found for Chicago. The peak is in the step in which the share ``peak`` of the duration ends,
  as in programs of practice, so the wettest step has the depth of its duration.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.ranges import Range
from greenroof_ros.weather.depths import Depths

Values = NDArray[np.float64]

KINDS = BLOCK, EULER, CHICAGO = "block", "euler", "chicago"
PEAKS = {BLOCK: 0.5, EULER: 0.3, CHICAGO: 0.375}
"""default position of the peak, as a share of the duration"""
_ROUNDING = 1e-9


def make_storm(
    depths: Depths, period: float, kind: str, duration: int, step: int, peak: float | None = None
) -> Values:
    """Return the rain in each step of a storm (mm), whose sum is the depth of its duration.

    Args:
        depths: depths by duration and return period.
        period: return period (years).
        kind: one of :data:`KINDS`.
        duration: duration of the storm (min).
        step: duration of a step (min).
        peak: position of the peak as a share of the duration; None for that of :data:`PEAKS`.

    Raises:
        ConfigurationError: if a value is invalid; its key is that of the value.
    """
    low, high = depths.durations[[0, -1]].tolist()
    if kind not in KINDS:
        raise ConfigurationError(f"must be one of {', '.join(KINDS)}", key="kind", value=kind)
    if not step or 60 % step or (kind != BLOCK and step < low):
        expected = f"must divide an hour; the shortest duration of the table is {low:g} min"
        raise ConfigurationError(expected, key="step", value=step)
    if duration % step or not low <= duration <= high:
        expected = f"must be a multiple of the step, {step} min, from {low:g} to {high:g} min"
        raise ConfigurationError(expected, key="duration", value=duration)
    share, count = Range(0.01, 0.99).read(peak or PEAKS[kind], key="peak"), duration // step
    whole = depths.depth(np.array([float(duration)]), period)
    if kind == BLOCK or count == 1:
        return np.repeat(whole / count, count)
    if kind == EULER:
        increments = np.diff(depths.depth(step * np.arange(1.0, count + 1), period), prepend=0.0)
        rain, before = np.sort(increments)[::-1], math.floor(share * count + _ROUNDING)
        return np.concatenate((rain[before::-1], rain[before + 1:]))
    before = math.ceil(share * count - _ROUNDING) - 1
    earlier = step * (np.arange(before + 1) / share + 1)
    later = step * (np.arange(count - before) / (1 - share) + 1)
    rising, falling = (depths.depth(each, period) for each in (earlier, later))
    # Both begin with the wettest step. The others are scaled, by a thousandth, to the whole depth.
    others = np.concatenate((share * np.diff(rising)[::-1], (1 - share) * np.diff(falling)))
    scaled = others * (whole - rising[0]) / others.sum()
    return np.insert(scaled, before, rising[0])
