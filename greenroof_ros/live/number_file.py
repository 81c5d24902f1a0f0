"""A file of numbers that a live node learns, kept across restarts."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.files import read_yaml, replace_text
from greenroof_ros.base.ranges import Range
from greenroof_ros.live.latest_writer import LatestWriter

_CLOSE_S = 2.0
_FINITE = Range(-sys.float_info.max, sys.float_info.max)


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
