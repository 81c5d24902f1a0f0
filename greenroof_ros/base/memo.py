"""A cache of a function's latest result, for objects that must be copied and pickled."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Memo(Generic[_T]):
    """A function with a cache of its latest result.

    Unlike this class, ``functools.lru_cache`` prevents an object that has it as an attribute from
    being copied or pickled.
    """

    def __init__(self, function: Callable[..., _T]) -> None:
        """Store the function."""
        self._function = function
        self._latest: dict[Hashable, _T] = {}

    def __call__(self, *given: Hashable) -> _T:
        """Return the function's result, either from the cache or computed now."""
        if given not in self._latest:
            self._latest = {given: self._function(*given)}
        return self._latest[given]
