"""What controllers estimate and predict of the water on a roof, from the model and the sensor."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.physics.soil import ALMOST_FULL, water_to_fill
from greenroof_ros.site.site import Site

Array = NDArray[np.float64]

ABOVE_M = 0.15
"""water above the target of the paper's soil of which plans take account [assumed] (m)"""
# lasting_share adds at least this share of the water that plants can take (1): smaller differences
# would be rounding errors.
_MIN_ADDED = 0.005
# Minimum result of lasting_share (1): a storm that fills the soil leaves no difference.
_MIN_LASTING = 1e-3
# Distance of the nodes in -ln(1 - S) of the table of an exponent that has no closed form.
_STEP = 0.02


def drain(p: PlantParameters, volumes: Any, seconds: float) -> Any:
    """Return the volumes in the cistern after its low outlet has been open for a time (m3).

    The square root of the head above the outlet falls linearly with time.

    Args:
        p: numbers of the site.
        volumes: a volume in the cistern (m3), or an array of volumes.
        seconds: the time (s).
    """
    outlet = p.a1 * p.low_outlet_level
    root = np.sqrt(np.maximum(volumes - outlet, 0.0) / p.a1)
    root = np.maximum(root - p.c_low / (2 * p.a1) * seconds, 0.0)
    return np.minimum(volumes, outlet + p.a1 * root * root)


class RoofPrediction:
    """Predicts the water on a roof, with the soil's equations of :mod:`..physics.soil`.

    Percolation through a field-capacity soil follows dS/du = 1 - S^beta. With W(S), the water that
    fills an empty soil to S, the water u fills it from S to the share whose W is W(S) + u. For beta
    = 2, W is the inverse of the hyperbolic tangent; for other exponents, W is tabulated.

    Attributes:
        above_target: volume above the roof's target that plans take into account (m3).
    """

    def __init__(self, p: PlantParameters) -> None:
        """Set the numbers of the site."""
        self._p = p
        self.above_target = p.z_cap - p.x2_star if p.has_field_capacity else p.a2 * ABOVE_M
        self._drying = p.stress_onset * p.available_volume
        self._water_of: Any = np.arctanh  # W of a share S (1, as a share of TAW)
        self._share_of: Any = np.tanh  # its inverse
        if p.has_field_capacity and p.percolation_exponent != 2:
            ends = np.arange(0.0, -np.log1p(-ALMOST_FULL) + _STEP, _STEP)
            water = np.cumsum([0.0, *(
                water_to_fill(p.percolation_exponent, float(first), float(last))
                for first, last in pairwise(-np.expm1(-ends))
            )])
            self._water_of = lambda filled: np.interp(-np.log1p(-filled), ends, water)
            self._share_of = lambda arrived: -np.expm1(-np.interp(arrived, water, ends))

    def predict_volume(self, x2: Any, arriving: Any, potential: Any, seconds: Any) -> Array:
        """Return the volume on the roof after a step of any length (m3).

        Rain falls at the start of the step. On the paper's soil, water above the capacity drains at
        the end of the step. On a field-capacity soil, plants take up water at the potential rate
        down to the onset of stress, and the rest decays.

        Args:
            x2: volume on the roof before the step (m3).
            arriving: rain and pumped water in the step (m3); its shape must be broadcastable with
                those of x2, potential and seconds.
            potential: potential evapotranspiration (m3).
            seconds: length of the step (s).
        """
        p = self._p
        if not p.has_field_capacity:
            remaining = x2 + (arriving - potential)
            drained = p.K / p.z_soil * (remaining + p.a2 * p.z_soil) * seconds
            remaining = np.minimum(remaining, np.maximum(remaining - drained, p.z_cap))
            return np.asarray(np.maximum(remaining, 0.0))
        water = x2
        if np.any(arriving):
            water = self.fill_empty(self.water_to_fill(x2) + arriving)
        easy = np.maximum(water - (p.wilting_volume + self._drying), 0.0)
        easy = np.minimum(easy, potential)
        water = water - easy
        decay = np.expm1((easy - potential) / self._drying)
        return np.asarray(water + np.maximum(water - p.wilting_volume, 0.0) * decay)

    def water_to_fill(self, x2: Any) -> Any:
        """Return the water needed to fill an empty roof to a volume x2 (m3, any shape)."""
        p = self._p
        if not p.has_field_capacity:
            return x2
        filled = np.clip((x2 - p.wilting_volume) / p.available_volume, 0.0, ALMOST_FULL)
        return np.minimum(x2, p.wilting_volume) + p.available_volume * self._water_of(filled)

    def fill_empty(self, arrived: Array) -> Array:
        """Return the volume on an initially empty roof after a volume of water has arrived (m3)."""
        p = self._p
        if not p.has_field_capacity:
            return arrived
        water = np.maximum(arrived - p.wilting_volume, 0.0) / p.available_volume
        filled = p.available_volume * self._share_of(water)
        return np.asarray(np.minimum(arrived, p.wilting_volume) + filled)

    def predict_changes(self, x2: float, rain: Array, potential: Array, lengths: Array) -> Array:
        """Predict the changes in the volume on the roof in steps without pumping (m3).

        Args:
            x2: volume on the roof at the beginning (m3).
            rain: mean rain in every step (m/s), shape (n,).
            potential: potential evapotranspiration from the whole bed (m3/s), shape (n,).
            lengths: lengths of the steps (s), shape (n,).

        Returns:
            The changes, shape (n,).
        """
        if not self._p.has_field_capacity:
            return np.asarray((rain * self._p.a2 - potential) * lengths)
        volumes = [x2]
        steps = rain * self._p.a2 * lengths, potential * lengths, lengths
        for fallen, demand, seconds in zip(*(part.tolist() for part in steps), strict=True):
            volumes.append(float(self.predict_volume(volumes[-1], fallen, demand, seconds)))
        return np.diff(volumes)

    def predict_lasting_share(self, x2: float, changes: Array, *weather: Array) -> Array:
        """Predict the mean share of water added now that remains on the roof in later steps (1).

        On the paper's soil, all of it remains. On a field-capacity soil, two roofs are simulated
        with :meth:`predict_changes`: a roof without pumping, and a roof that is filled to its
        target now. The share is the difference between their volumes, divided by its initial value,
        but at least 0.001. The share decreases, because more rain percolates through the fuller
        substrate, and because plants that lack water take up more from a fuller substrate. After a
        storm that fills both roofs, the difference vanishes.

        Args:
            x2: volume on the roof at the beginning (m3).
            changes: changes without pumping, as returned by :meth:`predict_changes` (m3).
            weather: arguments rain, potential and lengths of :meth:`predict_changes`.

        Returns:
            The share, shape (n,).
        """
        if not self._p.has_field_capacity:
            return np.ones_like(changes)
        added = max(self._p.x2_star - x2, _MIN_ADDED * self._p.available_volume)
        fades = self.predict_changes(x2 + added, *weather) - changes
        ends = 1 + np.cumsum(fades) / added
        return np.asarray(np.maximum(ends - fades / added / 2, _MIN_LASTING))


# --- observation ----------------------------------------------------------------------------------

# If all readings over this time (s), and at least this many, differ from the prediction by more
# than this (m) in the same direction, it is not noise but something unknown to the model: pumps
# with another flow, a manual valve. With noise alone, however large, less than half is that far off
# on either side.
_LOST_S = 15.0
_LOST_READINGS = 10
_LOST_M = 0.001
# A gap of up to this long (s) is bridged: too little happens in it to show in the next readings.
_GAP_S = 15.0

OBSERVER_TIME_CONSTANT = Parameter(
    "observer_time_constant", 300.0, "s", 0.0, 3600.0,
    "averaging time of the roof's level readings; 0 disables averaging",
)


class RoofObserver:
    """Follows the roof's mass balance, Eq. (1), and corrects it toward the sensor's readings.

    A controller that pumps whenever a reading is below the target follows the lowest readings: with
    noise of 0.5 mm, the roof soon holds a millimetre too much, and nothing removes this excess. The
    observer therefore starts from the volume that the model predicts for a tick, and
    every reading corrects the prediction by tau / observer_time_constant of the difference. This is
    a first-order observer, or the steady-state Kalman filter for this weighting of the model
    against the sensor. The observer starts with the mean of the first readings, like a Kalman
    filter without prior knowledge. If both the model and the sensor are exact, the estimate equals
    the reading, apart from rounding.

    If the pumps delivered more than the model assumes, the observer would lag behind, and the pumps
    would stay on too long. Therefore, if all readings over fifteen seconds (at least ten readings)
    are off by more than a millimetre in the same direction, the estimate moves by their mean
    difference in one step. A single outlier counts like any other reading. After more than fifteen
    seconds without a reading, the observer restarts.

    Attributes:
        predicted: volume that the model predicts for the current tick (m3).
    """

    def __init__(self, site: Site, observer_time_constant: float) -> None:
        """Set the site and the averaging time of the readings (s); 0 disables averaging."""
        self._site, self._gain = site, 1.0
        if observer_time_constant > 0:
            self._gain = min(1.0, site.tau / observer_time_constant)
        self._lost = site.roof_volume(_LOST_M)
        self.predicted = 0.0
        self._readings = 0  # since its start
        self._surprises: deque[float] = deque(  # the last readings minus their predictions (m3)
            maxlen=max(_LOST_READINGS, round(_LOST_S / site.tau))
        )

    def correct(self, roof_level: float, seconds: float) -> float:
        """Return the volume (m3) in the current tick.

        Args:
            roof_level: level that the sensor reads (m).
            seconds: time since the last reading (s), one tick if none was skipped.
        """
        reading, last = self._site.roof_volume(roof_level), self._surprises
        if not self._readings or seconds - self._site.tau > _GAP_S:
            self.predicted, self._readings = reading, 0
            last.clear()
        self._readings += 1
        surprise = reading - self.predicted
        last.append(surprise)
        gain = max(self._gain, 1 / self._readings)
        excess = (1 - gain) * surprise  # the part of the surprise that counts as noise
        if gain < 1 and abs(surprise) > self._lost and len(last) == last.maxlen and (
            min(last) > self._lost or max(last) < -self._lost
        ):
            excess, self._readings = surprise - fmean(last), len(last)
            last.clear()
        return max(0.0, reading - excess)
