"""The interface of every controller: the methods and attributes that its class must have.

What a user's class may leave out or change is added to the class when it is used.
"""

from __future__ import annotations

import functools
import inspect
import types
from collections.abc import Sequence
from datetime import tzinfo
from typing import Any, ClassVar, Protocol, get_type_hints

import numpy as np

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import from_epoch_ns


class Controller(Protocol):
    """A controller, which decides how much to pump in each tick.

    A controller is constructed as ``Class(site, **parameters)``, with a value for each of its
    parameters. The same inputs must lead to the same commands, at any time and on any machine.
    ``greenroof check-controller package.module:Class`` checks a class against all of these rules.

    A class may leave out ``skip``, which then does nothing, and ``statistics``, which then returns
    None. If ``command`` has a parameter ``time``, it also receives the time as a datetime in the
    site's time zone. If its forecasts are annotated as numpy arrays, it receives numpy arrays. A
    class that commands the valve may return (command, outlet).

    Nine other attributes of the class are optional:

    - ``ensemble = True``: the controller takes all members of an ensemble of forecasts.
      ``precipitation`` is then an array of shape (members, steps); a single forecast has one
      member.
    - ``needs_forecast = False``: the controller can decide from the levels alone. A class with this
      setting is also called without a usable forecast; both forecasts are then empty. Any other
      class is not called without a forecast; on a live site, the on/off controller takes over if
      the forecast stays missing.
    - ``outputs``: topics of ``msg_defs/topics.yaml`` that the controller's node publishes after
      every command, each with the attribute that holds the value: ``{"/controller/cost": "cost"}``.
      The value is a number; for ``/controller/plan`` it is a numpy array of shape (steps, 4).
    - ``learned``: a readable and settable property with a dictionary of the numbers that would take
      weeks to learn again. After a restart, the node of a live site restores the last value of this
      property.
    - ``time_ns``: the current time (ns since 1970), set before every command. A class with this
      attribute, or with a parameter ``time``, is also called in quiet hours, when its command is
      replaced by 0, and can plan with ``site.quiet``. Any other class skips the ticks in quiet
      hours.
    - ``forecast_ends``: an array that is set after construction. The array contains the boundaries
      of the forecasts' steps (s from the current tick), starting at 0, shape (steps + 1,). Entry
      i of a forecast is the mean from ``forecast_ends[i]`` to ``forecast_ends[i + 1]``.
    - ``outlet``: the share to which the valve of the low outlet is open, from 0 to 1, for a class
      that commands this valve itself. The attribute is read in every tick, after ``command`` or
      ``skip``, because the valve also operates in frost and in quiet hours. The valve keeps its
      position unless ``skip`` changes the attribute. The class itself must have the attribute, not
      just its instances. At a site with a valve, any other class also has the parameters of
      :mod:`greenroof_ros.controllers.outlet`.
    - ``outlet_policy``: the name of the policy that commands the valve by default; ``drain`` if the
      attribute is not set.
    - ``gauge_rain``: rain measured by the gauge of a live site (m/s; 0 without a gauge), set before
      every command. Without a forecast, this measurement serves as the current rain.

    Attributes:
        parameters: parameters of the controller. A parameter named ``horizon`` (h) sets the length
            of the forecasts, which are then means over the steps of
            :func:`greenroof_ros.site.horizon.growing_steps`. Without this parameter, the
            forecasts cover M ticks. A parameter named ``min_on`` (s) is raised to at least the
            ``pump_min_on`` of a simulation's pumps.
    """

    parameters: ClassVar[tuple[Parameter, ...]]

    def command(
        self, cistern_level: float, roof_level: float, precipitation: Sequence[Any],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Compute the command for the current tick.

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water in the roof's substrate, as a depth (m).
            precipitation: forecast of rain (m/s), shape (steps,), or (members, steps) with
                ``ensemble = True``; the first entry is the current rain.
            evapotranspiration: forecast of evapotranspiration from the whole bed (m3/s), shape
                (steps,); the first entry is the current value.

        A forecast can be missing, which means that it is empty, has another length, or contains
        NaN. In this case, the method must return a command or raise a
        :class:`~greenroof_ros.base.errors.ConfigurationError`, which ends a simulated run; a live
        site treats this error as a missing forecast. Any other error also ends a simulated run,
        with a message that names the file and the line; on a live site, on/off control then takes
        over.

        Returns:
            Share of the pumps' maximum flow (1), finite and not negative.
        """
        ...

    def skip(self) -> None:
        """Skip a tick in which the command is 0 because of frost or a rejected input.

        If an input was rejected, the command to the valve is also 0.

        A class without ``time_ns`` also skips the ticks of quiet hours. A class that needs a
        forecast also skips the ticks in which a live site has no forecast; if on/off control has
        pumped in these ticks, the node replaces the object with a new one.
        """
        ...

    def statistics(self) -> dict[str, float] | None:
        """Return the solver's statistics, or None if there is no solver.

        The statistics are ``solves``, ``fallbacks``, and the wall times of ticks (s) ``mean_s``,
        ``p99_s`` and ``max_s``, which also cover ticks without a solve.
        """
        ...


def set_optional(controller: Controller, **values: Any) -> None:
    """Set optional attributes of a controller, such as ``time_ns``, if the controller has them."""
    for name, value in values.items():
        if hasattr(controller, name):
            setattr(controller, name, value)


_DEFAULTS: dict[str, Any] = {"skip": lambda self: None, "statistics": lambda self: None}


def is_own(kind: Any) -> bool:
    """Return whether the method ``command`` of a class is code of this package."""
    return str(getattr(kind.command, "__module__", "")).startswith("greenroof_ros.")


def takes_numpy(kind: Any) -> bool:
    """Return whether an argument of the method ``command`` is annotated as a numpy array."""
    try:
        hints = get_type_hints(kind.command)
    except (NameError, TypeError, AttributeError):  # names that are known only to a type checker
        hints = getattr(kind.command, "__annotations__", {})
    return any("ndarray" in str(hint).lower() for name, hint in hints.items() if name != "return")


def note_arrays(kind: Any) -> list[str]:
    """Return a note if the forecasts of a class are not yet numpy arrays."""
    if is_own(kind) or takes_numpy(kind):
        return []
    return [
        f"{kind.__name__}.command() receives its forecasts as array.array, with which 2 * rain is "
        "twice as long, not twice as much; annotate them as numpy.ndarray to receive numpy arrays, "
        "which a future version always passes"
    ]


def adapt(kind: Any, zone: tzinfo) -> Any:
    """Return a class with the whole interface of :class:`.protocol.Controller`.

    ``skip`` does nothing and ``statistics`` returns None unless the class has them. If ``command``
    is annotated with numpy arrays, it receives them; if it has a parameter ``time``, it receives
    the time; and if the class commands the valve, ``command`` may return (command, outlet).

    Args:
        kind: the class; one of this package is returned unchanged.
        zone: time zone of the site's clock, in which the time is passed.
    """
    if is_own(kind):
        return kind
    members = {name: each for name, each in _DEFAULTS.items() if not hasattr(kind, name)}
    arrays, of_valve = takes_numpy(kind), hasattr(kind, "outlet")
    timed = "time" in inspect.signature(kind.command).parameters
    if timed and not hasattr(kind, "time_ns"):
        members["time_ns"] = 0

    @functools.wraps(kind.command)
    def command(self: Any, *inputs: Any, **named: Any) -> Any:
        if arrays:
            inputs = *inputs[:2], *(np.asarray(each, np.float64) for each in inputs[2:])
        if timed:
            named.setdefault("time", from_epoch_ns(self.time_ns).astimezone(zone))
        returned = kind.command(self, *inputs, **named)
        if of_valve and isinstance(returned, tuple) and len(returned) == 2:
            returned, self.outlet = returned
        return returned

    named = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "command": command}
    return types.new_class(kind.__name__, (kind,), {}, lambda own: own.update(members | named))
