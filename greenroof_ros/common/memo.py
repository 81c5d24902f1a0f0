"""The newest results of a function, in objects that can be copied and pickled."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Memo(Generic[_T]):
    """A function that remembers its newest results.

    ``functools.lru_cache`` does, too, but an object that has one can be neither copied nor pickled.
    """

    def __init__(self, function: Callable[..., _T], size: int = 1) -> None:
        """Set the function, and how many results are remembered."""
        self._function, self._size = function, size
        self._results: dict[Hashable, _T] = {}

    def __call__(self, *given: Hashable) -> _T:
        """Return the function's result, remembered or new."""
        results = self._results
        if given not in results:
            if len(results) == self._size:
                del results[next(iter(results))]
            results[given] = self._function(*given)
        return results[given]
