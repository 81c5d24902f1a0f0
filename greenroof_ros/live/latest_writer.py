"""Writing of values of which only the latest counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from greenroof_ros.base.disk import DISK

_T = TypeVar("_T")


class LatestWriter(Generic[_T]):
    """Writer of a changing value; a newer value replaces a value that has not been written yet.

    The disk thread writes, because a disk may stop responding.
    """

    def __init__(self, write: Callable[[_T], None]) -> None:
        """Create the writer without a value.

        Args:
            write: function that writes a value; it is called in the disk thread.
        """
        self._problem, self._write = "", write

    @property
    def problem(self) -> str:
        """The reason why the latest value is not being written; empty if there is no problem."""
        return "the disk does not respond" if DISK.late else self._problem

    def write(self, value: _T) -> None:
        """Queue a value for writing."""
        self._value = value
        if not DISK.do(self._write_latest):
            self._problem = "the queue of the disk is full"

    def _write_latest(self) -> None:
        try:
            self._write(self._value)
            self._problem = ""
        except Exception as error:  # whatever it is, the next value is still tried
            self._problem = str(error)
