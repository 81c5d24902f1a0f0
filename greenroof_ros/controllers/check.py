"""Whether a class is a controller: what every other part relies on, tried out."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.findings import Finding
from greenroof_ros.common.interface import optional_topics
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.site import Site

Array = NDArray[np.float64]

# Levels (m) as shares of the cistern's outlet and of the roof's target, and rates of rain (m/s) and
# evapotranspiration (m3/s): dry, usual, a cloudburst, and what a wrong sensor may read.
_CISTERN = (0.0, 0.2, 0.25, 0.8, 1.0, 1.5)
_ROOF = (0.0, 0.5, 0.999, 1.0, 1.001, 2.0)
_RAIN = (0.0, 1e-7, 2e-5)
_EVAPOTRANSPIRATION = (0.0, 3e-6)
_SOLVER_FIGURES = {"solves", "fallbacks", "mean_s", "p99_s", "max_s"}


class _ProblemError(Exception):
    """A controller does not keep to a rule; the message says how."""


def check_controller(choice: ControllerChoice, site: Site) -> list[Finding]:
    """Hold a controller to :class:`~greenroof_ros.controllers.protocol.Controller`.

    Every check makes its own controllers and asks them over levels and forecasts from a dry to a
    flooded site. What it relies on is what node graph, ``simulate``, studies and reports rely on.

    Args:
        choice: the controller.
        site: at which it is tried.

    Returns:
        A finding for each check, in the order in which a user should repair them.

    Raises:
        ConfigurationError: the class cannot be imported, or lacks what every controller has.
    """
    _ = choice.kind
    findings = []
    for title, check in _CHECKS.items():
        problem = ""
        try:
            check(choice, site)
        except _ProblemError as error:
            problem = str(error)
        except Exception as error:  # whatever a user's class raises
            problem = f"raises {type(error).__name__}: {error}"
        findings.append(Finding(title, problem))
    return findings


def _inputs(choice: ControllerChoice, site: Site) -> Iterator[tuple[float, float, Any, Any]]:
    """Yield levels and forecasts in the shape that the controller gets."""
    target = site.z_veg
    for cistern, roof, rain, evaporated in product(_CISTERN, _ROOF, _RAIN, _EVAPOTRANSPIRATION):
        rates = _forecast(choice, site, rain)
        yield (
            cistern * site.z_o, roof * target, rates,
            np.full(np.shape(rates)[-1], evaporated).tolist(),
        )


def _steps(choice: ControllerChoice, site: Site) -> int:
    """Return how many entries a forecast has."""
    horizon = choice.defaults(site).get("horizon")
    return site.M if horizon is None else len(growing_steps(horizon)) - 1


def _forecast(choice: ControllerChoice, site: Site, rate: float, members: int = 1) -> Any:
    """Return a forecast of rain from the second step on."""
    rates = np.full((members, _steps(choice, site)), rate)
    rates[:, 0] = 0.0
    return rates if choice.ensemble else rates[0].tolist()


def _made(choice: ControllerChoice, site: Site, **changes: float) -> Controller:
    return choice.make(site, {**choice.defaults(site), **changes})


def _asked(controller: Controller, *inputs: Any) -> float:
    """Ask for a command and hold it to the rule."""
    command = controller.command(*inputs)
    if isinstance(command, bool) or not isinstance(command, (int, float)):
        raise _ProblemError(f"command() returns {command!r}; it must return a float")
    if not (math.isfinite(command) and command >= 0):
        cistern, roof = inputs[:2]
        raise _ProblemError(
            f"command() returns {command!r} at levels {cistern:g} m and {roof:g} m; it must be "
            "finite and not negative"
        )
    return float(command)


def _parameters(choice: ControllerChoice, site: Site) -> None:
    names = [parameter.name for parameter in choice.kind.parameters]
    if len(set(names)) < len(names):
        raise _ProblemError(f"two parameters have one name: {', '.join(names)}")
    for parameter in choice.kind.parameters:
        if not parameter.name.isidentifier() or parameter.name != parameter.name.lower():
            raise _ProblemError(f"{parameter.name!r} is no name of a parameter: lower case and _")
        if not (parameter.unit and parameter.meaning):
            raise _ProblemError(f"{parameter.name} has no unit ('1' if none) or no meaning")
        if not parameter.accepts(parameter.default):
            raise _ProblemError(
                f"the default of {parameter.name}, {parameter.default:g}, {parameter.expected}"
            )


def _constructor(choice: ControllerChoice, site: Site) -> None:
    _made(choice, site)


def _commands(choice: ControllerChoice, site: Site) -> None:
    controller = _made(choice, site)
    for inputs in _inputs(choice, site):
        _asked(controller, *inputs)


def _whole_range(choice: ControllerChoice, site: Site) -> None:
    for parameter in choice.kind.parameters:
        if parameter.name == "horizon":
            continue  # another one needs another forecast
        for value in (parameter.low, parameter.high):
            controller = _made(choice, site, **{parameter.name: value})
            for inputs in list(_inputs(choice, site))[::7]:
                try:
                    _asked(controller, *inputs)
                except _ProblemError as error:
                    raise _ProblemError(f"with {parameter.name} = {value:g} {error}") from None


def _deterministic(choice: ControllerChoice, site: Site) -> None:
    first, second = _made(choice, site), _made(choice, site)
    for inputs in _inputs(choice, site):
        one, other = _asked(first, *inputs), _asked(second, *inputs)
        if one != other:
            raise _ProblemError(f"two controllers command {one!r} and {other!r} on equal inputs")


def _inputs_kept(choice: ControllerChoice, site: Site) -> None:
    controller = _made(choice, site)
    for cistern, roof, rain, evaporated in _inputs(choice, site):
        rain_before, evaporated_before = np.array(rain), np.array(evaporated)
        _asked(controller, cistern, roof, rain, evaporated)
        if not (
            np.array_equal(rain_before, rain) and np.array_equal(evaporated_before, evaporated)
        ):
            raise _ProblemError("command() changes the forecasts that it gets; copy them first")


def _skip(choice: ControllerChoice, site: Site) -> None:
    controller = _made(choice, site)
    controller.skip()
    for inputs in list(_inputs(choice, site))[::5]:
        _asked(controller, *inputs)
        controller.skip()
        controller.skip()


def _wrong_forecasts(choice: ControllerChoice, site: Site) -> None:
    empty: Any = np.empty((1, 0)) if choice.ensemble else []
    steps = _steps(choice, site)
    unknown = _forecast(choice, site, math.nan)
    for rain, evaporated in (
        (empty, []), (_forecast(choice, site, 0.0), [0.0] * (steps + 1)),
        (unknown, [math.nan] * steps),
    ):
        controller = _made(choice, site)
        try:
            _asked(controller, 0.8 * site.z_o, 0.5 * site.z_veg, rain, evaporated)
        except ConfigurationError:
            if choice.needs_forecast or rain is not empty:
                continue
            raise _ProblemError("with needs_forecast = False it must command without one") from None
    if choice.ensemble:
        controller = _made(choice, site)
        for members in (1, 3):
            _asked(
                controller, 0.8 * site.z_o, 0.5 * site.z_veg,
                _forecast(choice, site, 1e-6, members), [0.0] * steps,
            )


def _may_change(choice: ControllerChoice, site: Site) -> None:
    for parameter in choice.kind.parameters:
        if not parameter.may_change:
            continue
        controller = _made(choice, site)
        if getattr(controller, parameter.name, None) != choice.defaults(site)[parameter.name]:
            raise _ProblemError(f"it has no attribute {parameter.name} with the parameter's value")
        for value in (parameter.low, parameter.high):
            setattr(controller, parameter.name, value)
            for inputs in list(_inputs(choice, site))[::11]:
                _asked(controller, *inputs)


def _outputs(choice: ControllerChoice, site: Site) -> None:
    try:
        topics = optional_topics(choice.outputs)
    except ConfigurationError as error:
        raise _ProblemError(str(error)) from error
    controller = _made(choice, site)
    _asked(controller, *next(_inputs(choice, site)))
    for topic, attribute in topics:
        value = getattr(controller, attribute, None)
        if not isinstance(topic.undecided, array):
            if not isinstance(value, (int, float)):
                raise _ProblemError(
                    f"{topic.name}: there is no number in the attribute {attribute}"
                )
            continue
        columns = len(topic.undecided)
        if not isinstance(value, np.ndarray) or value.dtype != float or (
            value.shape[1:] != (columns,)
        ):
            raise _ProblemError(
                f"{topic.name}: there is no numpy array of floats, of shape (n, {columns}), in the "
                f"attribute {attribute}"
            )


def _statistics(choice: ControllerChoice, site: Site) -> None:
    controller = _made(choice, site)
    _asked(controller, *next(_inputs(choice, site)))
    found = controller.statistics()
    if found is not None and set(found) != _SOLVER_FIGURES:
        raise _ProblemError(
            f"statistics() must be None or have {', '.join(sorted(_SOLVER_FIGURES))}"
        )


# In the order in which a user should repair them.
_CHECKS: dict[str, Callable[[ControllerChoice, Site], None]] = {
    "its parameters have distinct names, units, meanings, and defaults within their ranges":
        _parameters,
    "it is made with the site and a value for each parameter":
        _constructor,
    "its commands are finite and not negative, at all levels and forecasts":
        _commands,
    "so they are with each parameter at either end of its range":
        _whole_range,
    "two of it give the same commands to the same inputs":
        _deterministic,
    "it leaves the forecasts that it gets as they are":
        _inputs_kept,
    "a tick may be skipped, at first and later, and commands are as before after it":
        _skip,
    "a missing or wrong forecast gives a valid command or a ConfigurationError, nothing else":
        _wrong_forecasts,
    "a parameter that may change is an attribute, and it may":
        _may_change,
    "each of its outputs is a topic of the interface and has its value after a command":
        _outputs,
    "its statistics are None, or the figures of its solver":
        _statistics,
}
