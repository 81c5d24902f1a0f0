"""Checks that exercise a class to verify that it meets all requirements for a controller."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import islice, product
from typing import Any

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.decide import COMMANDS, ControllerError, TickTimes, locate_error
from greenroof_ros.controllers.outlet import requested_share
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.interface.topics import optional_topics
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

# Levels, as shares of the cistern's outlet level and of the roof's target, and rates of rain (m/s)
# and evapotranspiration (m3/s): dry, usual, a cloudburst, and what a faulty sensor can read.
_CISTERN = (0.0, 0.2, 0.25, 0.8, 1.0, 1.5)
_ROOF = (0.0, 0.5, 0.999, 1.0, 1.001, 2.0)
_RAIN = (0.0, 1e-7, 2e-5)
_EVAPOTRANSPIRATION = (0.0, 3e-6)


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise ControllerError(problem)


def trial_values(site: Site) -> Iterator[tuple[float, float, float, float]]:
    """Yield levels (m), rain (m/s) and evapotranspiration (m3/s) for sites from dry to flooded."""
    for cistern, roof, rain, evaporated in product(_CISTERN, _ROOF, _RAIN, _EVAPOTRANSPIRATION):
        yield cistern * site.z_o, roof * site.z_veg, rain, evaporated


class _Trial:
    """A controller, and the site for which it is tested."""

    def __init__(self, choice: ControllerChoice, site: Site) -> None:
        self.choice, self.site, self.parameters = choice, site, choice.kind.parameters
        self.defaults = choice.complete_parameters(site, {})
        self.steps = len(look_ahead_ends(site, self.defaults.get("horizon", 0.0))) - 1

    def forecast(self, rate: float, members: int = 1) -> Any:
        """Return a forecast with rain from the second step on, in the shape that is expected."""
        rates = np.full((members, self.steps), rate)
        rates[:, 0] = 0.0
        return rates if self.choice.ensemble else array("d", rates[0])

    def make(self, **changes: float) -> Controller:
        return self.choice.make(self.site, {**self.defaults, **changes})

    def inputs(self, stride: int = 1) -> Iterator[tuple[float, float, Any, Any]]:
        """Yield every ``stride``-th combination of levels and forecasts."""
        for *levels, rain, evaporated in islice(trial_values(self.site), 0, None, stride):
            yield *levels, self.forecast(rain), array("d", [evaporated]) * self.steps

    def ticks(self, controller: Controller, stride: int = 1, skips: int = 0) -> Iterator[float]:
        """Yield the commands for :meth:`inputs`, and 0 for each tick that is skipped.

        Args:
            controller: the controller.
            stride: as for :meth:`inputs`.
            skips: number of ticks that are skipped before each command.
        """
        for inputs in self.inputs(stride):
            for _ in range(skips):
                controller.skip()
                yield 0.0
            yield _check_command(controller, *inputs)

    def decided(self) -> Controller:
        """Return a new controller after its first command."""
        controller = self.make()
        next(self.ticks(controller))
        return controller


def check_controller(choice: ControllerChoice, site: Site) -> dict[str, str]:
    """Check a controller against :class:`~greenroof_ros.controllers.protocol.Controller`.

    Each check requests commands from new controller objects, for levels and forecasts that range
    from those of a dry site to those of a flooded site. The checks cover the properties on which
    the node graph, ``simulate``, studies and reports rely.

    Args:
        choice: the controller.
        site: site for which the controller is tested.

    Returns:
        The problem that each check found, in the order in which a user should fix failures; empty
        for a check that passed. The keys are the requirements.

    Raises:
        ConfigurationError: if the class cannot be imported, or lacks an attribute that every
            controller needs.
    """
    _ = choice.kind
    results, reported = dict[str, str](), set[str]()
    for name, check in _CHECKS.items():
        problem = ""
        try:
            check(_Trial(choice, site))
        except Exception as error:  # anything that a user's class raises
            known = isinstance(error, ConfigurationError)
            problem = str(error if known else locate_error(choice.kind, error))
            if problem in reported:  # one fault often fails many checks
                problem = "fails as above"
            reported.add(problem)
        results[name] = problem
    return results


def _check_command(controller: Controller, *inputs: Any) -> float:
    command = controller.command(*inputs)
    _require(
        command in COMMANDS, f"command() returns {command!r} at levels of {inputs[0]:g} m in the "
        f"cistern and {inputs[1]:g} m on the roof; the command {COMMANDS.expected()}",
    )
    return float(command)


def _parameters(trial: _Trial) -> None:
    names = [parameter.name for parameter in trial.parameters]
    _require(
        len(set(names)) == len(names), f"two parameters have the same name: {', '.join(names)}"
    )
    for parameter in trial.parameters:
        name, default = parameter.name, parameter.default
        _require(
            name.isidentifier() and name == name.lower(), f"{name!r} is not a valid name: use a-z, "
            "0-9 and _, and do not begin with a digit",
        )
        described = bool(parameter.unit and parameter.meaning)
        _require(described, f"{name} lacks a unit ('1' for none) or a meaning")
        expected = parameter.range.expected(default)
        _require(default in parameter.range, f"the default of {name}, {default}, {expected}")


def _whole_range(trial: _Trial) -> None:
    for parameter in trial.parameters:
        if parameter.name == "horizon":
            continue  # a different horizon needs a different forecast
        for value in (parameter.low, parameter.high):
            controller = trial.make(**{parameter.name: value})
            try:
                list(trial.ticks(controller, stride=7))
                if not trial.choice.of_valve:
                    requested_share(controller)
            except ControllerError as error:
                raise ControllerError(f"with {parameter.name} = {value:g}, {error}") from None


def _agree(what: str, request: Callable[[], Iterable[float]]) -> None:
    for one, other in zip(request(), request(), strict=True):
        _require(one == other, f"two instances {what} {one!r} and {other!r} for the same inputs")


def _inputs_unchanged(trial: _Trial) -> None:
    controller = trial.make()
    for given, same in zip(trial.inputs(), trial.inputs(), strict=True):
        _check_command(controller, *given)
        unchanged = all(map(np.array_equal, given, same))
        _require(unchanged, "command() modifies the forecasts passed to it; copy them first")


def _wrong_forecasts(trial: _Trial) -> None:
    choice, steps = trial.choice, trial.steps
    levels = 0.8 * trial.site.z_o, 0.5 * trial.site.z_veg
    empty: Any = np.empty((1, 0)) if choice.ensemble else []
    for rain, evaporated in (
        (empty, []), (trial.forecast(0.0), [0.0] * (steps + 1)),
        (trial.forecast(math.nan), [math.nan] * steps),
    ):
        try:
            _check_command(trial.make(), *levels, rain, evaporated)
        except ControllerError:
            raise
        except ConfigurationError:
            _require(
                choice.needs_forecast or rain is not empty,
                "command() raises an error without a forecast, although needs_forecast is False",
            )
    if choice.ensemble:
        controller = trial.make()
        for members in (1, 3):
            _check_command(controller, *levels, trial.forecast(1e-6, members), [0.0] * steps)


def _may_change(trial: _Trial) -> None:
    for parameter in trial.parameters:
        if not parameter.may_change:
            continue
        name, controller = parameter.name, trial.make()
        has_value = getattr(controller, name, None) == trial.defaults[name]
        _require(has_value, f"the object has no attribute {name} with the value of the parameter")
        for value in (parameter.low, parameter.high):
            setattr(controller, name, value)
            list(trial.ticks(controller, stride=11))


def _outputs(trial: _Trial) -> None:
    controller = trial.decided()
    for topic, attribute in optional_topics(trial.choice.outputs):
        value, expected = getattr(controller, attribute, None), "number"
        right = isinstance(value, (int, float))
        if isinstance(topic.undecided, array):
            shape = (len(topic.undecided),)
            expected = f"numpy array of floats of shape (n, {shape[0]})"
            right = isinstance(value, np.ndarray) and (
                (value.dtype, value.shape[1:]) == (float, shape)
            )
        _require(right, f"{topic.name}: the attribute {attribute} must be a {expected}")


def _outlet(trial: _Trial) -> None:
    """Also check the outlet after skipped ticks, because the valve operates in frost as well."""

    def request_shares() -> Iterator[float]:
        controller = trial.make()
        return (requested_share(controller) for _ in trial.ticks(controller, skips=1))

    if not trial.choice.of_valve:
        _agree("open the valve to", request_shares)
        return
    _require(
        not hasattr(trial.decided(), "outlet"), "the object has an attribute outlet, but its class "
        "does not; define it in the class as well, for example outlet = 0.0",
    )


def _statistics(trial: _Trial) -> None:
    statistics = trial.decided().statistics()
    figures = TickTimes().statistics(0, 0)
    _require(
        statistics is None or statistics.keys() == figures.keys(),
        f"statistics() must return None, or a value for each of {', '.join(sorted(figures))}",
    )


# Every check, by what it shows, in the order in which a user should fix failures. A check that
# fails raises a ControllerError, or whatever the controller raises.
_CHECKS: dict[str, Callable[[_Trial], object]] = {
    "its parameters have distinct names; each has a unit, a meaning and a default within its range":
        _parameters,
    "it can be constructed with the site and a value for each parameter": _Trial.make,
    "its commands are finite and not negative, at all levels and for all forecasts":
        lambda trial: list(trial.ticks(trial.make())),
    "its commands are also valid with each parameter at either end of its range": _whole_range,
    "two instances give the same commands for the same inputs":
        lambda trial: _agree("return the commands", lambda: trial.ticks(trial.make())),
    "it does not modify the forecasts passed to it": _inputs_unchanged,
    "its commands remain valid if ticks are skipped, at the start or later":
        lambda trial: list(trial.ticks(trial.make(), stride=5, skips=2)),
    "a missing or invalid forecast leads only to a valid command or a ConfigurationError":
        _wrong_forecasts,
    "each parameter that can change during a run is an attribute that can be set": _may_change,
    "each of its outputs is a topic of the interface and has a value after a command": _outputs,
    "if it commands the outlet valve itself, its attribute outlet is between 0 and 1 in every tick":
        _outlet,
    "statistics() returns None, or the statistics of its solver": _statistics,
}
