"""Estimation of the volume of water on the roof from the model and the level sensor."""

from __future__ import annotations

from collections import deque
from statistics import fmean

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.soil import roof_after_tick
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
    observer therefore predicts the volume from rain, evapotranspiration, drainage and pumping, and
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
    """

    def __init__(self, site: Site, observer_time_constant: float) -> None:
        """Set the site and the averaging time of the readings (s); 0 disables averaging."""
        self._site, self._p = site, plant_parameters(site)
        self._gain = 1.0
        if observer_time_constant > 0:
            self._gain = min(1.0, site.tau / observer_time_constant)
        self._lost = site.roof_volume(_LOST_M)
        self._predicted: float | None = None
        self._readings = 0  # since its start
        self._surprises: deque[float] = deque(  # the last readings minus their predictions (m3)
            maxlen=max(_LOST_READINGS, round(_LOST_S / site.tau))
        )
        self._gap = 0.0  # since the last reading (s)

    def correct(self, roof_level: float) -> float:
        """Return the volume (m3) in the current tick, given the sensor's level (m)."""
        reading = self._site.roof_volume(roof_level)
        if self._gain == 1.0:
            return reading
        if self._predicted is None or self._gap > _GAP_S:
            self._readings, self._gap = 1, 0.0
            self._surprises.clear()
            return reading
        self._readings += 1
        self._gap = 0.0
        surprise = reading - self._predicted
        self._surprises.append(surprise)
        correction = max(self._gain, 1 / self._readings) * surprise
        if self._is_lost():
            correction, self._readings = fmean(self._surprises), len(self._surprises)
            self._surprises.clear()
        return max(0.0, self._predicted + correction)

    def _is_lost(self) -> bool:
        """Return whether the last readings differ from their predictions by more than noise."""
        last = self._surprises
        if abs(last[-1]) <= self._lost or len(last) != last.maxlen:
            return False
        return min(last) > self._lost or max(last) < -self._lost

    def skip(self) -> None:
        """Skip a tick without a reading and without pumping."""
        self._gap += self._site.tau

    def predict(
        self, x2: float, precipitation: float, evapotranspiration: float, pumped: float
    ) -> None:
        """Advance the estimate by one tick.

        Args:
            x2: volume that :meth:`correct` returned (m3).
            precipitation: rain in the tick (m/s).
            evapotranspiration: evapotranspiration from the whole bed (m3/s).
            pumped: flow pumped onto the roof (m3/s).
        """
        arriving = precipitation * self._site.a2 + pumped
        self._predicted = roof_after_tick(self._p, x2, arriving, evapotranspiration)
