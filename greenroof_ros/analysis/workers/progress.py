"""The progress of a task: its worker writes the share that is done to a file of its own."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_REFRESH_S = 0.5


@dataclass
class ShareFile:
    """The share of a task that is done, 0 to 1; on another machine nobody reads it."""

    path: Path
    _written: float = 0.0

    def write(self, share: float) -> None:
        """Write the share, at most twice a second."""
        if time.monotonic() - self._written > _REFRESH_S:
            self._written = time.monotonic()
            with suppress(OSError):
                self.path.write_text(f"{share:.3f}")

    def read(self) -> float:
        """Return the share; 0 before the first is written."""
        with suppress(OSError, ValueError):  # not there yet, or just being written
            return float(self.path.read_text())
        return 0.0
