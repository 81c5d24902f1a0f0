"""A cache of a function's newest results, for objects that must be copied and pickled."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Memo(Generic[_T]):
    """A function that remembers its newest results.

    So does ``functools.lru_cache``, but an object that has one can be neither copied nor pickled.
    """

    def __init__(self, function: Callable[..., _T], size: int = 1) -> None:
        """Set the function and the number of results to remember."""
        self._function, self._size = function, size
        self._results: dict[Hashable, _T] = {}

    def __call__(self, *given: Hashable) -> _T:
        """Return the function's result, either remembered or computed now."""
        results = self._results
        if given not in results:
            if len(results) == self._size:
                del results[next(iter(results))]
            results[given] = self._function(*given)
        return results[given]
