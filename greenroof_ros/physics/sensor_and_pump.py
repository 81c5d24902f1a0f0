"""Imperfections of the roof's level sensor and of the pumps, which the paper neglects.

The plant and all sums of a run remain exact. Only the roof level that the controller receives, and
the times at which the pumps follow commands, are imperfect.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import entry, parameters_of

# Ticks whose noise is drawn together: one draw at a time takes ten times as long.
_BLOCK = 4096
# A time that is a whole number of ticks, apart from rounding, must not take another tick.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class SensorAndPump:
    """Imperfections of the level sensor and the pumps; by default, there are none."""

    roof_noise: float = entry(
        "standard deviation of the noise of the roof's level sensor in a tick", 0.0, 1.0, unit="m",
        default=0.0,
    )
    roof_offset: float = entry(
        "excess of the roof's level sensor over the true level", -1.0, 1.0,
        unit="m", default=0.0,
    )
    noise_seed: int = entry("random seed of the noise", 0, 2**31 - 1, default=0)
    pump_min_on: float = entry(
        "minimum time for which the pumps stay on, except in frost or quiet hours, or if the roof "
        "is full or the cistern empty", 0.0, 86_400.0, unit="s", default=0.0,
    )
    pump_min_off: float = entry(
        "minimum time for which the pumps stay off", 0.0, 86_400.0, unit="s", default=0.0
    )

    def values(self) -> dict[str, float]:
        """Return the values of all :data:`PARAMETERS`, by name."""
        return asdict(self)

    def refuse_external_pump(self) -> None:
        """Reject minimum times if the pump is controlled by a driver, which has its own settings.

        Raises:
            ConfigurationError: if minimum times are set.
        """
        if self.pump_min_on or self.pump_min_off:
            raise ConfigurationError(
                "must be set in the pump driver, because the pump is external",
                key="minimum on and off times",
            )


PARAMETERS = {parameter.name: parameter for parameter in parameters_of(SensorAndPump)}
"""parameters of :class:`SensorAndPump`, by name"""


def read_errors(sensor: SensorAndPump, ticks: int) -> NDArray[np.float64]:
    """Return the error of the roof's sensor in the first ticks (m), shape (ticks,); (0,) if exact.

    The noise of a tick depends only on the seed and the tick.
    """
    if sensor.roof_noise == sensor.roof_offset == 0:
        return np.empty(0)
    noise = [
        np.random.default_rng([sensor.noise_seed, block]).standard_normal(_BLOCK)
        for block in range(math.ceil(ticks / _BLOCK))
    ]
    return sensor.roof_offset + sensor.roof_noise * np.concatenate([*noise, np.empty(0)])[:ticks]


# A pump switch: whether the pumps are on, the ticks since they were switched, the command that last
# passed, and the minimum times of the pumps (ticks).
ON, SINCE, PASSED, MIN_ON, MIN_OFF = range(5)


def make_switch(sensor_and_pump: SensorAndPump, tau: float) -> tuple[float, ...]:
    """Return the switch of pumps that have been off for long enough.

    Args:
        sensor_and_pump: the minimum times, which are rounded up to whole ticks.
        tau: duration of a tick (s).
    """
    min_on, min_off = (
        float(math.ceil(seconds / tau - _ROUNDING))
        for seconds in (sensor_and_pump.pump_min_on, sensor_and_pump.pump_min_off)
    )
    return 0.0, min_off, 0.0, min_on, min_off


def switch_pump(switch: Any, command: float, may_run: bool) -> float:
    """Return the command that reaches the pumps in a tick, through the switch that protects them.

    After a start, the pumps stay on for at least their minimum time; if the command becomes 0
    earlier, they continue to run at the last positive command. After a stop, the pumps stay off for
    at least their minimum time, regardless of the command. The switch monitors the delivered flow
    (:func:`observe_pump`) instead of the command. If Eq. (3a) stops the flow because of the true
    levels, the on-time ends even if it is too short, and an off-time begins, as with a float
    switch. Otherwise, the pumps would restart whenever a drop evaporated from a full roof. Frost
    switches the pumps off immediately, because a burst pipe is worse than an on-time that is too
    short. Quiet hours also switch the pumps off immediately, as at a real site.

    Args:
        switch: the switch, from :func:`make_switch`.
        command: command of the controller (share of the maximum flow).
        may_run: whether pumping is allowed; frost and quiet hours forbid it.
    """
    if not may_run or (switch[ON] == 0 and switch[SINCE] < switch[MIN_OFF]):
        return 0.0
    if switch[ON] > 0 and command == 0 and switch[SINCE] < switch[MIN_ON]:
        passed: float = switch[PASSED]
        return passed
    switch[PASSED] = command
    return command


def observe_pump(switch: Any, flow: float) -> None:
    """Record the flow (m3/s) that the pumps deliver in a tick."""
    on = 1.0 if flow > 0 else 0.0
    if on != switch[ON]:
        switch[ON], switch[SINCE] = on, 0.0
    switch[SINCE] += 1
