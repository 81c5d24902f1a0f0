"""When a controller decides, and when the pumps stand still whatever it would decide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.protocol import Controller, knows_time


class NoCommandError(ConfigurationError):
    """What a controller returns is no command: the controller is broken, not its inputs."""


def decide(
    controller: Controller,
    allowed: bool,
    cistern_level: float,
    roof_level: float,
    precipitation: Any,
    evapotranspiration: Sequence[float],
    quiet: bool = False,
) -> float:
    """Return the command of a tick: the controller's where pumping is allowed, 0 elsewhere.

    It is not allowed in frost, which bursts a running pump's pipe, and where an input was refused:
    the command that follows from a level which was not measured must not reach the pump. In quiet
    hours it is 0, too; a controller that knows the time then decides all the same, so that it goes
    on learning and planning.

    Args:
        controller: decides, or skips the tick.
        allowed: whether pumping is.
        cistern_level: m.
        roof_level: m.
        precipitation: forecast of rain (m/s), in the shape that the controller takes.
        evapotranspiration: forecast of evapotranspiration (m3/s).
        quiet: whether it is in the site's quiet hours.

    Raises:
        NoCommandError: what the controller returns is no command.
        ConfigurationError: it cannot use the forecast.
    """
    if not allowed or (quiet and not knows_time(controller)):
        controller.skip()
        return 0.0
    command = controller.command(cistern_level, roof_level, precipitation, evapotranspiration)
    if isinstance(command, (float, int)) and 0 <= command < math.inf:
        return 0.0 if quiet else command
    raise NoCommandError(
        "must be a finite number, not negative (greenroof check-controller finds this before a "
        "run)",
        key=f"the command of {type(controller).__name__}", value=command,
    )
