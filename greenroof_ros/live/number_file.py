"""A file of numbers that a live node learns, kept across restarts."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.files import read_yaml, replace_text
from greenroof_ros.base.ranges import Range

_CLOSE_S = 2.0
_FINITE = Range(-sys.float_info.max, sys.float_info.max)


class NumberFile:
    """A file of named numbers, of which only the latest count.

    The disk thread writes, because a disk may stop responding. The file is replaced as a whole, so
    that a power cut leaves either the old or the new file.
    """

    def __init__(self, file: Path) -> None:
        """Store the path of the file, which need not exist yet."""
        self._file, self._problem = file, ""

    @property
    def problem(self) -> str:
        """The reason why the latest numbers are not being written; empty for no problem."""
        return "the disk does not respond" if DISK.late else self._problem

    def write(self, values: Mapping[str, float]) -> None:
        """Queue numbers for writing; they replace those that have not been written yet."""
        self._values = values
        if not DISK.do(self._write_latest):
            self._problem = "the queue of the disk is full"

    def _write_latest(self) -> None:
        try:
            replace_text(self._file, json.dumps(self._values, indent=1), parents=True)
            self._problem = ""
        except Exception as error:  # whatever it is, the next numbers are still tried
            self._problem = str(error)

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
