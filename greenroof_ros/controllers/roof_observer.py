"""Estimation of the volume of water on the roof from the model and the level sensor."""

from __future__ import annotations

from collections import deque
from statistics import fmean

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.site.site import Site

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
