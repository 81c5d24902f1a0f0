"""The interface that a user's class may leave out or change, added to the class when it is used."""

from __future__ import annotations

import functools
import inspect
import types
from datetime import tzinfo
from typing import Any, get_type_hints

import numpy as np

from greenroof_ros.base.times import from_epoch_ns

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
        f"{kind.__name__}.command() receives its forecasts as array.array, for which * repeats; a "
        "future version passes numpy arrays, as it does now to arguments annotated numpy.ndarray"
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
