"""A few numbers in a file that outlive a process, and whose writing nothing waits for."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError

_CLOSE_S = 2.0


class Kept:
    """The numbers in a file, by name; a thread of its own writes it, so that a disk may hang.

    The file is replaced as a whole: after a power cut it is the old one or the new one.
    """

    def __init__(self, file: Path) -> None:
        """Take the file, which need not be there."""
        self._file = file
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="kept")
        self._writing: Future[None] | None = None

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

    def write(self, values: Mapping[str, float]) -> str:
        """Write, unless the last writing still goes on; return what went wrong with that."""
        if self._writing is not None:
            if not self._writing.done():
                return ""
            error = self._writing.exception()
            if error is not None:
                self._writing = None
                return str(error)
        self._writing = self._thread.submit(self._replace, dict(values))
        return ""

    def close(self) -> None:
        """Wait two seconds at most for what is being written."""
        if self._writing is not None:
            wait([self._writing], _CLOSE_S)
        self._thread.shutdown(wait=False)

    def _replace(self, values: dict[str, float]) -> None:
        self._file.parent.mkdir(parents=True, exist_ok=True)
        part = self._file.with_suffix(".part")
        part.write_text(json.dumps(values, indent=1), encoding="utf-8")
        part.replace(self._file)
