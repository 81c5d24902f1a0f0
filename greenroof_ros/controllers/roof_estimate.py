"""How much water is on the roof, by model and sensor together."""

from __future__ import annotations

from greenroof_ros.plant import drainage_flow
from greenroof_ros.site import Site

# Where the readings of about so long (s) are so far (m) off what is predicted on average, that is
# no noise but something that the model does not know of: pumps of another flow, a hand valve.
_RECENT_S = 10.0
_LOST_M = 0.002


class RoofEstimate:
    """Follows the roof's mass balance, Eq. (1), and moves toward what the sensor reads.

    A controller that pumps whenever the level is read below its target follows the lowest of the
    readings: with a noise of 0.5 mm it soon has a millimetre too much on the roof, and nothing
    takes it off again. So the volume is predicted from rain, evapotranspiration, drainage and what
    was pumped, and each reading corrects it by one part in (smoothing / tau) of the difference: an
    observer of first order, which is the steady-state Kalman filter for that ratio of trust in
    model and sensor. It begins with the mean of the first readings, as that filter would that knows
    nothing before them. Where both are exact it is the reading, but for roundings.

    Pumps that give more than the model has them give would be left on while the estimate catches
    up. So where the readings of the last ten seconds are 2 mm off on average, it follows them at
    once, and after a tick without a reading it begins anew.
    """

    def __init__(self, site: Site, smoothing: float) -> None:
        """Take the site, and over how long (s) readings are averaged; 0 takes each as it is."""
        self._site = site
        self._gain = min(1.0, site.tau / smoothing) if smoothing > 0 else 1.0
        self._recent_gain = min(1.0, site.tau / _RECENT_S)
        self._lost = site.roof_volume(_LOST_M)
        self._predicted: float | None = None
        self._recent = 0.0  # mean of the last readings less what was predicted (m3)
        self._readings = 0  # since it began

    def correct(self, roof_level: float) -> float:
        """Return the volume (m3) in the present tick, in which the sensor reads a level (m)."""
        reading = self._site.roof_volume(roof_level)
        self._readings += 1
        if self._gain == 1.0 or self._predicted is None:
            return reading
        surprise = reading - self._predicted
        self._recent += self._recent_gain * (surprise - self._recent)
        correction = max(self._gain, 1 / self._readings) * surprise
        if abs(self._recent) > self._lost:
            correction, self._recent, self._readings = surprise, 0.0, 1
        return max(0.0, self._predicted + correction)

    def forget(self) -> None:
        """Take the next reading as it is: a tick has passed unseen."""
        self._predicted = None
        self._recent = 0.0
        self._readings = 0

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
