"""The interface of every controller: the class that a user writes, and how it is called."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

from greenroof_ros.common.parameter import Parameter


class Controller(Protocol):
    """Anything that decides once a tick how much to pump.

    It is constructed as ``Class(site, **parameters)``, with a value for each of its parameters. The
    same inputs must lead to the same commands, at any time and on any machine. ``greenroof
    check-controller package.module:Class`` checks a class against all of these rules.

    Nine more attributes of the class are optional:

    - ``ensemble = True``: it takes all members of an ensemble of forecasts. ``precipitation`` is
      then an array of shape (members, steps); a single forecast has one member.
    - ``needs_forecast = False``: levels are enough. It is also called without a usable forecast;
      both forecasts are then empty. Any other class is not called then: on a live site, the on/off
      controller takes over if the forecast stays missing.
    - ``outputs``: topics of ``msg_defs/topics.yaml`` that its node publishes after every command,
      each with the attribute that holds the value: ``{"/controller/cost": "cost"}``. The value is a
      number; for ``/controller/plan`` it is a numpy array of shape (steps, 4).
    - ``learned``: a readable and settable property that holds, by name, the numbers that would take
      weeks to learn again. After a restart, the node of a live site sets it to what it was before.
    - ``time_ns``: the time (ns since 1970), set before every command at a site with quiet hours. A
      class that has it is also called in quiet hours, when its command is replaced by 0; it can
      plan with ``site.quiet``. Any other class skips these ticks.
    - ``forecast_ends``: an array that is set after construction: the ends of the forecasts' steps
      (s from the present tick), the first 0, shape (steps + 1,). Entry i of a forecast is the mean
      from ``forecast_ends[i]`` to ``forecast_ends[i + 1]``.
    - ``outlet``: for a class that commands the valve of a site's low outlet itself, the share to
      which it is open (1), from 0 to 1. It is read in every tick, after ``command`` or ``skip``:
      the valve also works in frost and in quiet hours, and stays as it was unless ``skip`` sets it.
      The class must have it, not only its objects. At a site with a valve, any other class has the
      parameters of :mod:`greenroof_ros.controllers.outlet`.
    - ``outlet_policy``: the name of the policy that commands the valve by default; ``drain`` if it
      is not set.
    - ``gauge_rain``: what the rain gauge of a live site measures (m/s; 0 without a gauge), set
      before every command. It is the present rain if there is no forecast.

    Attributes:
        parameters: its parameters. One named ``horizon`` (h) sets how far the forecasts reach; they
            are then means over the steps of :func:`greenroof_ros.model.look_ahead.growing_steps`.
            Without it they cover M ticks. One named ``min_on`` (s) is at least the ``pump_min_on``
            of a simulation's pumps.
    """

    parameters: ClassVar[tuple[Parameter, ...]]

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[Any],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Decide the command for the present tick.

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water in the roof's substrate, as a depth (m).
            precipitation: forecast of rain (m/s), whose first entry is now, shape (steps,); with
                ``ensemble = True`` shape (members, steps).
            evapotranspiration: forecast of evapotranspiration from the whole bed (m3/s), whose
                first entry is now, shape (steps,).

        A forecast can be missing: empty, of another length, or with entries that are NaN. The
        method must then return a command or raise a
        :class:`~greenroof_ros.common.errors.ConfigurationError`, which ends a simulated run; a live
        site treats it as a missing forecast. Any other error also ends a simulated run, with its
        file and line; on a live site, on/off then takes over.

        Returns:
            Share of the pumps' maximum flow (1), finite and not negative.
        """
        ...

    def skip(self) -> None:
        """Let a tick pass in which the command is 0: in frost, or if an input was rejected.

        If an input was rejected, the command to a valve is 0, too.

        A class without ``time_ns`` also skips the ticks of quiet hours. A class that needs a
        forecast also skips the ticks of a live site without one; if on/off has pumped during these
        ticks, the node replaces the object with a new one.
        """
        ...

    def statistics(self) -> dict[str, float] | None:
        """Return the solver's figures, or None if there is no solver.

        They are ``solves``, ``fallbacks``, and the times of a tick (s) ``mean_s``, ``p99_s`` and
        ``max_s``, whether or not anything was solved in it.
        """
        ...


class ControllerClass(Protocol):
    """A controller class, as the registry returns it."""

    parameters: tuple[Parameter, ...]

    def __call__(self, site: Any, **parameters: float) -> Controller:
        """Make a controller for a site, with a value for each parameter."""
        ...


def set_optional(controller: Controller, **values: Any) -> None:
    """Set those attributes that a controller has, such as ``time_ns`` and ``forecast_ends``."""
    for name, value in values.items():
        if hasattr(controller, name):
            setattr(controller, name, value)
