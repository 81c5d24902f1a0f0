"""Controllers in Python, specified by name or as a class, an instance or a function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from numbers import Real
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import ControllerChoice, choose_class, find_controller
from greenroof_ros.site.horizon import MAX_HORIZON
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]


class SiteState(NamedTuple):
    """The state of a site at a tick."""

    time: datetime
    """time of the tick, with its offset from UTC"""
    cistern_level: float
    """m"""
    roof_level: float
    """m"""
    site: Site
    """the site's parameters, such as ``z_veg``, the target of the roof's level (m)"""

    @property
    def cistern(self) -> float:
        """Volume in the cistern (m3)."""
        return self.site.cistern_volume(self.cistern_level)

    @property
    def roof(self) -> float:
        """Volume on the roof (m3)."""
        return self.site.roof_volume(self.roof_level)


class ForecastSteps(NamedTuple):
    """A forecast divided into steps, the first of which begins now.

    Each value is the mean over a step.
    """

    rain: Values
    """rain (m/s), shape (steps,)"""
    evapotranspiration: Values
    """evapotranspiration from the whole bed (m3/s), shape (steps,)"""
    ends: Values
    """ends of the steps (s from now), the first 0, shape (steps + 1,); step i lasts from
    ``ends[i]`` to ``ends[i + 1]``"""


Function = Callable[[SiteState, ForecastSteps], float]
"""A controller: a function that returns the command, as a share of the pumps' maximum flow (1)."""


def read_number(value: Any) -> float | None:
    """Return a real number, or the only real number in an array; None for any other value."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    return float(value) if isinstance(value, Real) else None


class FunctionController:
    """A controller that calls a function; a subclass provides the function."""

    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter(
        "horizon", 24.0, "h", 0.1, MAX_HORIZON,
        "length of the forecast, which is divided into steps of increasing length",
    ),)
    function: ClassVar[Function]
    forecast_ends: Values

    def __init__(self, site: Site, horizon: float) -> None:
        self._site = site
        self._tick = -1
        self.forecast_ends = np.empty(0)
        self.start: datetime
        """start of the run, which is set before the run"""

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Return the result of the function, as a float if it is a number."""
        self._tick += 1
        time = self.start + timedelta(seconds=self._tick * self._site.tau)
        value = type(self).function(
            SiteState(time, cistern_level, roof_level, self._site),
            ForecastSteps(
                np.asarray(precipitation), np.asarray(evapotranspiration), self.forecast_ends
            ),
        )
        number = read_number(value)
        return value if number is None else number  # anything else is rejected, and named

    def skip(self) -> None:
        """Count a tick in which the pump must not run."""
        self._tick += 1

    def statistics(self) -> None:
        """Return None, since the controller has no solver."""


def choose_controller(controller: Any) -> tuple[ControllerChoice, Controller | None]:
    """Return the choice of controller, and the controller itself if it is an instance.

    Args:
        controller: a name, ``package.module:Class``, a class, an instance, or a function of a
            :class:`SiteState` and :class:`ForecastSteps`.

    Raises:
        ConfigurationError: if the controller is not of any of these kinds.
    """
    if isinstance(controller, str):
        return find_controller(controller), None
    if isinstance(controller, type):
        return choose_class(controller), None
    if hasattr(controller, "command"):
        return choose_class(type(controller)), controller
    if not callable(controller):
        raise ConfigurationError(
            "must be a name, a class, an instance, or a function of (state, forecast)",
            key="controller", value=controller,
        )
    name = getattr(controller, "__name__", type(controller).__name__).strip("<>")
    members = {
        "function": staticmethod(controller), "__module__": controller.__module__,
        "__wrapped__": controller,  # so that errors name its place
    }
    return choose_class(type(name, (FunctionController,), members)), None


def read_parameters(instance: Controller, choice: ControllerChoice) -> dict[str, float]:
    """Return the parameters of a controller's class for which the instance has an attribute.

    Raises:
        ConfigurationError: if the class has a parameter ``horizon``, but the instance has no such
            attribute.
    """
    names = [parameter.name for parameter in choice.kind.parameters]
    values = {name: getattr(instance, name) for name in names if hasattr(instance, name)}
    if "horizon" in names and "horizon" not in values:
        raise ConfigurationError(
            "must have its parameter horizon as an attribute, since the length of its forecast "
            "is otherwise unknown; alternatively, pass the class and "
            "horizon=", key=f"an instance of {choice.name}",
        )
    return values
