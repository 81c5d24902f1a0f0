"""Imperfections of the roof's level sensor and of the pumps, which the paper neglects.

The plant and all sums of a run remain exact. Only the roof level that the controller receives, and
the times at which the pumps follow commands, are imperfect.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import entry, parameters_of

# Ticks whose noise is drawn together: one draw at a time takes ten times as long.
_BLOCK = 4096
# A time that is a whole number of ticks, apart from rounding, must not take another tick.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class SensorAndPump:
    """Imperfections of the level sensor and the pumps; by default, there are none."""

    roof_noise: float = entry(
        "standard deviation of the noise of the roof's level sensor; the noise of every tick is "
        "independent", 0.0, 1.0, unit="m",
        default=0.0,
    )
    roof_offset: float = entry(
        "amount by which the reading of the roof's level sensor exceeds the true "
        "level", -1.0, 1.0, unit="m",
        default=0.0,
    )
    noise_seed: int = entry("random seed of the noise", 0, 2**31 - 1, default=0)
    pump_min_on: float = entry(
        "minimum time for which the pumps stay on, except during frost or quiet hours, or if the "
        "roof is full or the cistern is empty", 0.0, 86_400.0, unit="s", default=0.0,
    )
    pump_min_off: float = entry(
        "minimum time for which the pumps stay off", 0.0, 86_400.0, unit="s", default=0.0
    )

    @property
    def exact_sensor(self) -> bool:
        """Whether the sensor reads the true level."""
        return self.roof_noise == 0 and self.roof_offset == 0

    @property
    def instant_pump(self) -> bool:
        """Whether the pumps follow every command immediately."""
        return self.pump_min_on == 0 and self.pump_min_off == 0

    def values(self) -> dict[str, float]:
        """Return the values of all :data:`PARAMETERS`, by name."""
        return asdict(self)

    def refuse_external_pump(self) -> None:
        """Reject minimum times if the pump is controlled by a driver, which has its own settings.

        Raises:
            ConfigurationError: if minimum times are set.
        """
        if not self.instant_pump:
            raise ConfigurationError(
                "must be set in the pump driver, because the pump is external",
                key="minimum on and off times",
            )


PARAMETERS = {parameter.name: parameter for parameter in parameters_of(SensorAndPump)}
"""parameters of :class:`SensorAndPump`, by name"""


class RoofSensor:
    """The level sensor of the roof; its noise in a tick depends only on the seed and the tick."""

    def __init__(self, sensor: SensorAndPump) -> None:
        """Set the sensor's noise and offset."""
        self._model = sensor
        self._block = -1
        self._errors = [sensor.roof_offset] * _BLOCK

    def reading(self, tick: int, level: float) -> float:
        """Return the reading (m, at least 0) in a tick for a true level (m)."""
        block, index = divmod(tick, _BLOCK)
        if block != self._block and self._model.roof_noise:
            drawn = np.random.default_rng([self._model.noise_seed, block]).standard_normal(_BLOCK)
            self._errors = (self._model.roof_offset + self._model.roof_noise * drawn).tolist()
            self._block = block
        return max(0.0, level + self._errors[index])


class Pump:
    """The pumps, and the switch that protects them.

    After a start, the pumps stay on for at least ``pump_min_on``; if the command becomes 0 earlier,
    they continue to run at the last positive command. After a stop, the pumps stay off for at least
    ``pump_min_off``, regardless of the command. At the start of a run, the pumps are assumed to
    have been off for long enough. The switch monitors the delivered flow instead of the command. If
    Eq. (3a) stops the flow because of the true levels, the on-time ends even if it is too short,
    and an off-time begins, as with a float switch. Otherwise, the pumps would restart whenever a
    drop evaporated from a full roof. Frost switches the pumps off immediately, because a burst pipe
    is worse than an on-time that is too short. Quiet hours also switch the pumps off immediately,
    as at a real site.
    """

    def __init__(self, pump: SensorAndPump, tau: float) -> None:
        """Set the minimum times, rounded up to whole ticks, and the duration of a tick (s)."""
        self._min_on = math.ceil(pump.pump_min_on / tau - _ROUNDING)
        self._min_off = math.ceil(pump.pump_min_off / tau - _ROUNDING)
        self._on = False
        self._ticks = self._min_off  # ticks since they were switched
        self._passed = 0.0

    def switch(self, command: float, may_run: bool) -> float:
        """Return the command that reaches the pumps in the current tick.

        Args:
            command: command of the controller (share of the maximum flow).
            may_run: whether pumping is allowed; frost and quiet hours forbid it.
        """
        if not may_run or (not self._on and self._ticks < self._min_off):
            return 0.0
        if self._on and command == 0 and self._ticks < self._min_on:
            return self._passed
        self._passed = command
        return command

    def observe(self, flow: float) -> None:
        """Record the flow (m3/s) that the pumps deliver in the current tick."""
        if (flow > 0) != self._on:
            self._on = flow > 0
            self._ticks = 0
        self._ticks += 1
