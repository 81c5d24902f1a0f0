"""Writing of values of which only the latest counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from greenroof_ros.base.disk import DISK

_T = TypeVar("_T")


class LatestWriter(Generic[_T]):
    """Writer of a changing value; a newer value replaces a value that has not been written yet.

    Attributes:
        problem: reason why the last value could not be written; empty if it was written.
    """

    def __init__(self, write: Callable[[_T], None]) -> None:
        """Create the writer without a value.

        Args:
            write: function that writes a value; it is called in the disk thread.
        """
        self.problem = ""
        self._write = write

    def write(self, value: _T) -> None:
        """Queue a value for writing."""
        self._value = value
        if not DISK.do(self._write_latest):
            self.problem = "the queue of the disk is full"

    def _write_latest(self) -> None:
        try:
            self._write(self._value)
            self.problem = ""
        except Exception as error:  # whatever it is, the next value is still tried
            self.problem = str(error)
