"""The interface of every controller: the methods and attributes that its class must have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

from greenroof_ros.base.parameter import Parameter


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
