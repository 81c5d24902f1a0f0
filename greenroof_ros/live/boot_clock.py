"""The clock of the machine since it started, which cannot be set and also counts a suspend."""

from __future__ import annotations

import functools
import time
from pathlib import Path


def boot_time() -> float:
    """Return the time since the machine started (s), including time spent suspended.

    ``time.monotonic()`` stops during a suspend, so values measured before a suspend would still
    seem new after it.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@functools.cache
def boot_id() -> str:
    """Return an identifier of the machine's current boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def suspended_time() -> float:
    """Return the total time for which the machine has been suspended since it started (s)."""
    return boot_time() - time.monotonic()
