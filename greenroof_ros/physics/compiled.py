"""Compilation of the package's functions of numbers with numba, where it is installed.

Both ways have the same text, which is plain Python: :func:`compiled` compiles a function, and with
it every function of this package that it calls. Without numba, the functions run as they are, with
the same results bit for bit. numba is imported only when something is compiled.

numba keeps compiled code in a cache, which does not notice an edit in the file of a function that
is called. The names under which this package's functions are cached therefore end with a digest of
all functions that take part, and of the constants and named tuples that they use, as they are in
this process: its files may have been edited since it began.
"""

from __future__ import annotations

import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing import parent_process
from types import FunctionType
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

_PACKAGE = __name__.partition(".")[0]
_Function = TypeVar("_Function", bound=Callable[..., Any])

# numba reads this when it is imported. Intel's functions of vectors (SVML) round in other ways than
# the C library, which plain Python uses. A program that sets the variable, or has imported numba,
# has made its own choice.
_NO_SVML = "NUMBA_DISABLE_INTEL_SVML"
_IMPORTING = threading.Lock()  # held by the thread that imports numba

# Number of ticks that take a second or more without numba.
_MANY_TICKS = 100_000
MIN_COMPILED = 20_000
"""number of ticks that take less time in plain Python than loading numba does"""


@functools.cache
def can_compile() -> bool:
    """Return whether numba is installed."""
    return find_spec("numba") is not None


def pays_to_compile(ticks: int) -> bool:
    """Return whether numba is installed, and the ticks of all sites are worth loading it."""
    return can_compile() and ticks >= MIN_COMPILED


def note_if_slow(ticks: int) -> None:
    """Print once what to install, if many ticks are about to be simulated without numba.

    Worker processes print nothing, because the process that starts them does.

    Args:
        ticks: number of ticks of all sites.
    """
    if ticks > _MANY_TICKS and not can_compile() and parent_process() is None:
        _note_slow()


@functools.cache
def _note_slow() -> None:
    text = "note: numba would make this about a hundred times faster: pip install "
    print(f"{text}'greenroof_ros[study]'", file=sys.stderr)


@functools.cache
def compiled(function: _Function) -> _Function:
    """Return a function compiled, or unchanged if numba is not installed.

    Args:
        function: function that takes and returns numbers, named tuples and arrays only, and so do
            all functions that it calls.
    """
    if not can_compile():
        return function
    with _IMPORTING:
        own = _NO_SVML in os.environ
        os.environ.setdefault(_NO_SVML, "1")
        import numba

        if not own:
            del os.environ[_NO_SVML]
    together, copies = _called_by(function, {}), {}
    described = repr([getattr(numba.config, "USING_SVML", None), *map(_describe, together)])
    digest = hashlib.sha256(described.encode()).hexdigest()[:12]
    for each in together:
        copy = FunctionType(each.__code__, dict(each.__globals__), each.__name__, each.__defaults__)
        copy.__qualname__ = f"{each.__qualname__}_{digest}"
        copies[each] = copy
    made: dict[Any, Any] = {
        each: numba.njit(**_options(each), forceinline=True)(copy) for each, copy in copies.items()
    }
    for copy in copies.values():
        for name, value in copy.__globals__.items():
            if isinstance(value, FunctionType) and value in made:
                copy.__globals__[name] = made[value]
    result: Any = made[function]  # without a cache, if no directory for one can be written
    with suppress(RuntimeError):
        result = numba.njit(**_options(function), cache=True)(copies[function])  # type: ignore[index]
    return cast(_Function, result)


def _options(function: Any) -> dict[str, Any]:
    """Return the options with which a function is compiled.

    If neither the function nor one that it calls uses NumPy, no arrays are made, and references to
    arrays need not be counted, which took more than a third of the time of a season.
    """
    makes_arrays = any("np" in each.__code__.co_names for each in _called_by(function, {}))
    return {"nogil": True, "_nrt": makes_arrays}


def _called_by(function: Any, found: dict[FunctionType, None]) -> dict[FunctionType, None]:
    """Return a function and the functions of this package that it calls, directly or not."""
    found[function] = None
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        own = isinstance(value, FunctionType) and value.__module__.startswith(_PACKAGE)
        if own and value not in found:
            _called_by(value, found)
    return found


def _describe(function: FunctionType) -> tuple[Any, ...]:
    """Return the code of a function, and the globals that it uses: values, fields and names."""
    code, names = function.__code__, function.__globals__
    used = [names[name] for name in code.co_names if name in names]
    return (
        function.__qualname__, code.co_code, code.co_consts, code.co_names, code.co_varnames,
        function.__defaults__,
        [getattr(value, "_fields", getattr(value, "__qualname__", value)) for value in used],
    )


def records(tuples: Sequence[NamedTuple]) -> Any:
    """Return named tuples of one class in the form in which compiled functions index them.

    Args:
        tuples: at least one named tuple of numbers.

    Returns:
        A structured array, whose entries have the same attributes.
    """
    kind = np.dtype([(name, np.float64) for name in tuples[0]._fields])
    return np.array([tuple(each) for each in tuples], kind)
