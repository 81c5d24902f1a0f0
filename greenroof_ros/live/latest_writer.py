"""Writing of values of which only the latest counts, such as numbers that a live node learns."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Generic, TypeVar

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.files import read_yaml, replace_text
from greenroof_ros.base.ranges import Range

_CLOSE_S = 2.0
_FINITE = Range(-sys.float_info.max, sys.float_info.max)
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
        self._write = write

    def write(self, value: _T) -> None:
        """Queue a value for writing; if that fails, only the next value is tried again."""
        self._value = value
        DISK.do(self._write_latest)

    def _write_latest(self) -> None:
        with suppress(Exception):  # the recorder and the pump's state report a bad disk
            self._write(self._value)


class NumberFile(LatestWriter[Mapping[str, float]]):
    """A file of named numbers.

    The file is replaced as a whole, so that a power cut leaves either the old or the new file.
    """

    def __init__(self, file: Path) -> None:
        """Store the path of the file, which need not exist yet."""
        self._file = file
        super().__init__(
            lambda values: replace_text(file, json.dumps(values, indent=1), parents=True)
        )

    def read(self) -> dict[str, float]:
        """Return the numbers in the file; an empty mapping if there is no file.

        Raises:
            ConfigurationError: if the file cannot be read, or is not a mapping of names to finite
                numbers.
        """
        if not self._file.exists():
            return {}
        return {
            name: _FINITE.read(value, key=name, file=self._file)
            for name, value in read_yaml(self._file).items()  # JSON is YAML
        }

    def close(self) -> None:
        """Wait at most two seconds until all numbers are written."""
        DISK.wait(_CLOSE_S)
