"""When a controller decides, and when the pumps stand still whatever it would decide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from greenroof_ros.controllers.protocol import Controller


def decide(
    controller: Controller,
    allowed: bool,
    cistern_level: float,
    roof_level: float,
    precipitation: Any,
    evapotranspiration: Sequence[float],
) -> float:
    """Return the command of a tick: the controller's where pumping is allowed, 0 elsewhere.

    It is not allowed in frost, which bursts a running pump's pipe, and where an input was refused:
    the command that follows from a level which was not measured must not reach the pump.

    Args:
        controller: decides, or skips the tick.
        allowed: whether pumping is.
        cistern_level: m.
        roof_level: m.
        precipitation: forecast of rain (m/s), in the shape that the controller takes.
        evapotranspiration: forecast of evapotranspiration (m3/s).
    """
    if allowed:
        return controller.command(cistern_level, roof_level, precipitation, evapotranspiration)
    controller.skip()
    return 0.0
