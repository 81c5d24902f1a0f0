"""What outlives a process in a file, and whose writing nothing waits for."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from greenroof_ros.common.disk import DISK, Newest
from greenroof_ros.common.errors import ConfigurationError

_CLOSE_S = 2.0


class Kept:
    """A file of numbers by name, or of other text; the disk's thread writes it: a disk may hang.

    The file is replaced as a whole: after a power cut it is the old one or the new one.
    """

    def __init__(self, file: Path) -> None:
        """Take the file, which need not be there."""
        self._file = file
        self._newest = Newest(self._replace, str)

    @property
    def problem(self) -> str:
        """Why what was last given is not written; empty where it is, or soon will be."""
        return "the disk takes nothing" if DISK.late else self._newest.problem

    def read(self) -> dict[str, float]:
        """Return what was kept; nothing where there is no file.

        Raises:
            ConfigurationError: it cannot be read, or is no mapping of finite numbers.
        """
        try:
            content: Any = json.loads(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"cannot be read: {error}", file=self._file) from error
        if not isinstance(content, dict) or not all(
            isinstance(each, float) and math.isfinite(each) for each in content.values()
        ):
            raise ConfigurationError("must be a mapping of names to numbers", file=self._file)
        return content

    def write(self, values: Mapping[str, float]) -> None:
        """Have numbers written."""
        kept = dict(values)
        self.write_text(lambda: json.dumps(kept, indent=1))

    def write_text(self, text: Callable[[], str]) -> None:
        """Have a text written, which the disk's thread asks for."""
        self._newest.give(text)

    def close(self) -> None:
        """Wait two seconds at most for what is being written."""
        DISK.wait(_CLOSE_S)

    def _replace(self, text: Callable[[], str]) -> None:
        part = self._file.with_suffix(".part")
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with part.open("w", encoding="utf-8") as stream:
            stream.write(text())
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(self._file)
