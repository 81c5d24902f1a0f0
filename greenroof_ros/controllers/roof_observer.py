"""How much water is on the roof, by model and sensor together."""

from __future__ import annotations

from collections import deque
from statistics import fmean

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import left_after_tick, soil_of

# Where all readings of so long (s), and so many at least, are further (m) off what was predicted,
# and to the same side, that is no noise but something that the model does not know of: pumps of
# another flow, a hand valve. Of noise, however large, less than half is so far off on either side.
_LOST_S = 15.0
_LOST_READINGS = 10
_LOST_M = 0.001
# What happens in a gap of so long (s) is less than what the next readings need to show.
_GAP_S = 15.0

OBSERVER_TIME_CONSTANT = Parameter(
    "observer_time_constant", 300.0, "s", 0.0, 3600.0,
    "time over which readings of the roof's level are averaged; 0 takes each as it is",
)


class RoofObserver:
    """Follows the roof's mass balance, Eq. (1), and moves toward what the sensor reads.

    A controller that pumps whenever the level is read below its target follows the lowest of the
    readings: with a noise of 0.5 mm it soon has a millimetre too much on the roof, and nothing
    takes it off again. So the volume is predicted from rain, evapotranspiration, drainage and what
    was pumped, and each reading corrects it by one part in (observer_time_constant / tau) of the
    difference: an observer of first order, which is the steady-state Kalman filter for that ratio
    of trust in model and sensor. It begins with the mean of the first readings, as that filter
    would that knows nothing before them. Where both are exact it is the reading, but for roundings.

    Pumps that give more than the model has them give would be left on while the observer catches
    up. So where all readings of fifteen seconds, or ten of them if ticks are long, are more than a
    millimetre off to the same side, it moves by their mean at once; a single one, however far off,
    does no more than any other. After more than fifteen seconds without a reading it begins again.
    """

    def __init__(self, site: Site, observer_time_constant: float) -> None:
        """Take the site, and over how long (s) readings are averaged; 0 takes each as it is."""
        self._site, self._soil = site, soil_of(site)
        self._gain = 1.0
        if observer_time_constant > 0:
            self._gain = min(1.0, site.tau / observer_time_constant)
        self._lost = site.roof_volume(_LOST_M)
        self._predicted: float | None = None
        self._readings = 0  # since it began
        self._surprises: deque[float] = deque(  # the last readings less what was predicted (m3)
            maxlen=max(_LOST_READINGS, round(_LOST_S / site.tau))
        )
        self._gap = 0.0  # since the last reading (s)

    def correct(self, roof_level: float) -> float:
        """Return the volume (m3) in the present tick, in which the sensor reads a level (m)."""
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
        """Whether the last readings cannot be noise about what was predicted."""
        last = self._surprises
        if abs(last[-1]) <= self._lost or len(last) != last.maxlen:
            return False
        return min(last) > self._lost or max(last) < -self._lost

    def skip(self) -> None:
        """Let a tick pass without a reading, in which nothing is pumped."""
        self._gap += self._site.tau

    def predict(
        self, x2: float, precipitation: float, evapotranspiration: float, pumped: float
    ) -> float:
        """Move on by one tick.

        Args:
            x2: what :meth:`correct` returned (m3).
            precipitation: rain in the tick (m/s).
            evapotranspiration: off the whole bed (m3/s).
            pumped: flow onto the roof (m3/s).

        Returns:
            The volume that is expected then (m3).
        """
        arriving = precipitation * self._site.a2 + pumped
        self._predicted = left_after_tick(
            self._soil, self._site.tau, x2, arriving, evapotranspiration
        )
        return self._predicted
