"""What every controller is: the class that a user writes, and what it is asked each tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

from greenroof_ros.common.parameter import Parameter


class Controller(Protocol):
    """Anything that decides once a tick how much to pump.

    It is made as ``Class(site, **parameters)``, with a value for each of its parameters, and keeps
    to one rule: the same inputs give the same commands, whenever and wherever. ``greenroof
    check-controller package.module:Class`` holds a class to all of this.

    Five more attributes of the class are optional:

    - ``ensemble = True``: it takes all members of an ensemble of forecasts. ``precipitation`` is
      then an array of shape (members, steps); a single forecast has one member.
    - ``needs_forecast = False``: levels are enough. It is asked without a usable forecast, too,
      and both forecasts are then empty. Of any other class the on/off controller commands on a
      live site while there is none; the class is not asked.
    - ``outputs``: topics of ``msg_defs/topics.yaml`` that its node publishes after each command,
      each with the attribute that holds the value: ``{"/controller/cost": "cost"}``. It is a
      number, of ``/controller/plan`` a numpy array of shape (steps, 4).
    - ``learned``: a property, numbers by name that it knows from what has happened and would need
      weeks to know again. The node of a live site sets it after a restart, to what it was before.
    - ``time_ns``: the time (ns since 1970), set before each command at a site with quiet hours. A
      class that has it is asked in quiet hours, too, where its command becomes 0; it may plan by
      ``site.quiet``. Any other class skips these ticks.

    Attributes:
        parameters: its parameters. One named ``horizon`` (h) says how far the forecasts reach, as
            means over the steps of :func:`greenroof_ros.model.look_ahead.growing_steps`; without
            it they are of the M ticks that come.
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
            roof_level: water depth on the roof (m).
            precipitation: forecast of rain (m/s), the first entry now, shape (steps,); with
                ``ensemble = True`` shape (members, steps).
            evapotranspiration: forecast of evapotranspiration off the whole bed (m3/s), likewise,
                shape (steps,).

        A forecast may be missing: empty, of another length, or with entries that are no numbers.
        The answer to it is a command or a
        :class:`~greenroof_ros.common.errors.ConfigurationError`, which ends a simulated run; on a
        live site it counts as no forecast.

        Returns:
            Share of the pumps' maximum flow (1), finite and not negative.
        """
        ...

    def skip(self) -> None:
        """Let a tick pass in which the command is 0: in frost, or where an input was refused.

        In quiet hours, too, of a class without ``time_ns``.

        Or in which on/off commands, on a live site without a forecast; an object of the class that
        has let it pump is not asked again: a new object is.
        """
        ...

    def statistics(self) -> dict[str, float] | None:
        """Return the solver's figures: ``solves``, ``fallbacks``, and times in seconds.

        ``mean_s``, ``p99_s`` and ``max_s`` are of a tick, whether something was solved in it
        or not.

        None where it has no solver.
        """
        ...


class ControllerClass(Protocol):
    """A class of controllers, as the registry finds it."""

    parameters: tuple[Parameter, ...]

    def __call__(self, site: Any, **parameters: float) -> Controller:
        """Make a controller for a site, with a value for each parameter."""
        ...


def learned_by(controller: Controller) -> dict[str, float] | None:
    """Return what a controller has learned; None of one that learns nothing."""
    learned: dict[str, float] | None = getattr(controller, "learned", None)
    return learned


def set_learned(controller: Any, learned: Mapping[str, float]) -> None:
    """Let a controller go on with what another of its kind had learned.

    Raises:
        KeyError: something is missing.
    """
    controller.learned = learned


def knows_time(controller: Controller) -> bool:
    """Whether a controller is given the time, so that it can plan for quiet hours."""
    return hasattr(controller, "time_ns")


def set_time(controller: Any, time_ns: int) -> None:
    """Let a controller that asks for it know the time (ns since 1970)."""
    if knows_time(controller):
        controller.time_ns = time_ns
