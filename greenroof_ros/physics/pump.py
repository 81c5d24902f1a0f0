"""The pumps in series, Eqs. (3a) and (3e), their speed, and imperfections that the paper neglects.

Eq. (3e) is Eqs. (3b) to (3d) solved for the flow. Its coefficients b and pipe_resistance are those
of :class:`.Site`.

A pump that delivers the flow y at the head phi(y) and at its rated speed delivers the flow s y at
the head s^2 phi(y) and at the share s of this speed (affinity laws, e.g. White, Fluid Mechanics,
Sec. 11.3). Therefore Eq. (3b) becomes phi_s(q) = s^2 c_hat + a_hat q^2. This head equals the head
loss L(q) of Eq. (3c) if s^2 c_hat = (pipe_resistance - a_hat) q^2 + d - x1/a1. The curve represents
all of the site's pumps together, which run at the same speed.

The level sensor of the roof and the pumps can be imperfect. The plant and all sums of a run remain
exact: only the roof level that the controller receives, and the times at which the pumps follow
commands, are imperfect.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import entry, parameters_of
from greenroof_ros.physics.parameters import PlantParameters
from greenroof_ros.site.site import Site

PumpCurve = PlantParameters | Site
"""the numbers of a site that determine the flow of its pumps"""

STANDSTILL = 0.02
"""share of the rated speed up to which a pump counts as stopped, because readings are noisy"""
RUNNING_SHARE = 0.01
"""share of their maximum flow above which the pumps count as running"""


def maximum_pump_flow(p: PumpCurve, x1: float) -> float:
    """Return the pumps' flow (m3/s) at command 1 from a cistern with x1 (m3), Eq. (3e).

    The flow is 0 if the pumps cannot lift water to the roof; they must not run at such a level.
    """
    head = x1 / p.a1 + p.c_hat - p.d
    return p.b * math.sqrt(head) if head > 0 else 0.0


def pump_flow(p: PlantParameters, x1: float, x2: float, command: float) -> float:
    """Return q_pump (m3/s) for volumes (m3) and a command (share of the maximum flow), Eq. (3a)."""
    if x2 / p.a2 >= p.z_veg or x1 / p.a1 < p.suction_level:
        return 0.0
    return command * maximum_pump_flow(p, x1)


def running_flow(p: PlantParameters) -> float:
    """Return the flow (m3/s) above which the pumps count as running: 1 % of the maximum flow.

    The maximum flow is that from a cistern filled to its overflow. Smaller flows are caused by a
    lag whose output never quite reaches 0, or by the noise of a flow meter.
    """
    return RUNNING_SHARE * maximum_pump_flow(p, p.a1 * p.z_o)


def flow_at(p: PumpCurve, speed: float, cistern_level: float) -> float:
    """Return the flow (m3/s) of the pumps at a given speed; 0 if no water reaches the roof.

    Stopped pumps deliver nothing, even from a cistern above the roof, because a check valve is
    assumed. At speed 1, the result is bit-identical to that of :func:`maximum_pump_flow`.

    Args:
        p: parameters of the plant.
        speed: share of the rated speed, at least 0.
        cistern_level: depth of water in the cistern (m).
    """
    head = cistern_level + speed**2 * p.c_hat - p.d
    return p.b * math.sqrt(head) if speed > 0 and head > 0 else 0.0


def speed_for(p: PumpCurve, share: float, cistern_level: float) -> float:
    """Return the speed (share of the rated speed) that yields a share of the maximum flow.

    The speed is 0 if the share is 0, or if the pumps cannot lift water to the roof at their rated
    speed. If the cistern is above the roof, even a slow pump delivers more than a small share. For
    such a share, the speed is the smallest positive number, so that a positive share never stops
    the pumps.

    Args:
        p: parameters of the plant.
        share: share of the maximum flow at this level, 0 to 1.
        cistern_level: depth of water in the cistern (m).
    """
    max_head = cistern_level + p.c_hat - p.d
    if share <= 0 or max_head <= 0:
        return 0.0
    squared = (share**2 * max_head + p.d - cistern_level) / p.c_hat
    return max(math.sqrt(max(squared, 0.0)), math.ulp(0.0))


# --- imperfections --------------------------------------------------------------------------------

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
