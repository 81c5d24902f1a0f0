"""The progress of a task: the share that is done, which its worker writes to a file."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_REFRESH_S = 0.5


@dataclass
class ShareFile:
    """The share of a task that is done, 0 to 1.

    A share written by another machine cannot be read.
    """

    path: Path
    _written: float = 0.0

    def write(self, share: float) -> None:
        """Write the share, at most twice a second."""
        if time.monotonic() - self._written > _REFRESH_S:
            self._written = time.monotonic()
            with suppress(OSError):
                self.path.write_text(f"{share:.3f}")

    def read(self) -> float:
        """Return the share, or 0 if no share has been written yet."""
        with suppress(OSError, ValueError):  # the file does not exist yet or is being written
            return float(self.path.read_text())
        return 0.0
