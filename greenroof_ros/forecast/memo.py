"""A cache of a function's latest results, for objects that must be copied and pickled."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Memo(Generic[_T]):
    """A function with a cache of its latest results.

    Unlike this class, ``functools.lru_cache`` prevents an object that has it as an attribute from
    being copied or pickled.
    """

    def __init__(self, function: Callable[..., _T], size: int = 1) -> None:
        """Store the function and the maximum number of cached results."""
        self._function, self._size = function, size
        self._results: dict[Hashable, _T] = {}

    def __call__(self, *given: Hashable) -> _T:
        """Return the function's result, either from the cache or computed now."""
        results = self._results
        if given not in results:
            if len(results) == self._size:
                del results[next(iter(results))]
            results[given] = self._function(*given)
        return results[given]
