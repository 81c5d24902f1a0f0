"""Progress where there is no terminal for a bar: a line every ten seconds on standard error."""

from __future__ import annotations

import sys
import time

_EVERY_S = 10.0


class ProgressLines:
    """Prints how far something is, every ten seconds, and nothing before the first ten."""

    def __init__(self) -> None:
        """Begin to count."""
        self._due = time.monotonic() + _EVERY_S

    def tell(self, text: str) -> None:
        """Say how far it is; printed where a line is due."""
        now = time.monotonic()
        if now >= self._due:
            self._due = now + _EVERY_S
            print(text, file=sys.stderr, flush=True)
