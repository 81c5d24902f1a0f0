"""How much water is on the roof, by model and sensor together."""

from __future__ import annotations

from greenroof_ros.plant import drainage_flow
from greenroof_ros.site import Site

# No sensor's noise: a level (m) this far from the predicted one is taken as it is read. Something
# happened that the model does not know of, a hand valve or hours of frost in which nobody asked.
_LOST_M = 0.01


class RoofEstimate:
    """Follows the roof's mass balance, Eq. (1), and moves toward what the sensor reads.

    A controller that pumps whenever the level is read below its target follows the lowest of the
    readings: with a noise of 0.5 mm it soon has a millimetre too much on the roof, and nothing
    takes it off again. So the volume is predicted from rain, evapotranspiration, drainage and what
    was pumped, and each reading corrects it by one part in (smoothing / tau) of the difference: an
    observer of first order, which is the steady-state Kalman filter for that ratio of trust in
    model and sensor. Where both are exact it is the reading, but for roundings.
    """

    def __init__(self, site: Site, smoothing: float) -> None:
        """Take the site, and over how long (s) readings are averaged; 0 takes each as it is."""
        self._site = site
        self._gain = min(1.0, site.tau / smoothing) if smoothing > 0 else 1.0
        self._predicted: float | None = None

    def correct(self, roof_level: float) -> float:
        """Return the volume (m3) in the present tick, in which the sensor reads a level (m)."""
        reading = self._site.roof_volume(roof_level)
        if self._gain == 1.0 or self._predicted is None:
            return reading
        surprise = reading - self._predicted
        if abs(surprise) > self._site.roof_volume(_LOST_M):
            return reading
        return max(0.0, self._predicted + self._gain * surprise)

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
        site = self._site
        into = precipitation * site.a2 + pumped
        self._predicted = x2 + site.tau * (into - evapotranspiration - drainage_flow(site, x2))
        return self._predicted
