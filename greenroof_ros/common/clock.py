"""Clocks that nobody sets."""

from __future__ import annotations

import time


def boot_time() -> float:
    """Return the time since the machine started (s), that in which it was suspended included.

    ``time.monotonic()`` stands still in a suspend: by it what was measured before is still new
    afterwards.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def suspended_time() -> float:
    """Return for how long the machine was suspended since it started (s)."""
    return boot_time() - time.monotonic()
