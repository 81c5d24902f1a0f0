"""Fast DDS's shared memory: what a process that was killed leaves of it in ``/dev/shm``.

A segment ``NAME`` comes with ``NAME_el``, on which Fast DDS holds a lock as long as the owner
lives, and with a mutex. A process that ends well removes its own; one killed by ``kill -9`` cannot.
"""

from __future__ import annotations

import contextlib
import fcntl
import sys
import time
from collections.abc import Iterable
from pathlib import Path

_DIRECTORY = Path("/dev/shm")
# What Boost writes into the first four bytes of a segment when it is ready for use.
_READY = 2
# Making a segment takes some microseconds; one that is not ready after so long (s) never will be.
_MAKING_S = 1.0


def segments_of(pid: int) -> set[str]:
    """Return the names of the segments that a process owns: it has their lock files open."""
    owned = set()
    with contextlib.suppress(OSError):  # it ends just now
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            target = entry.readlink()
            if target.parent == _DIRECTORY and target.name.endswith("_el"):
                owned.add(target.name.removesuffix("_el"))
    return owned


def remove_left(names: Iterable[str]) -> None:
    """Remove those of the segments that no living process owns."""
    for name in names:
        try:
            with (_DIRECTORY / f"{name}_el").open("rb") as stream:
                # As long as it is held, no other process takes the segment over.
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove(name)
        except FileNotFoundError:
            _remove(name)
        except OSError:
            continue  # its owner lives


def remove_unfinished() -> None:
    """Remove the segments whose maker was killed while it made them.

    Whoever opens one waits for its maker for ever, in the constructor of a node and without a word:
    https://github.com/eProsima/Fast-DDS/issues/3878. Ports have the same names from run to run, so
    that no graph of the domain would ever start again.
    """
    for file in _DIRECTORY.glob("fastrtps_*"):
        if file.name.endswith("_el"):
            continue
        with contextlib.suppress(OSError):  # it has just gone, or is another user's
            with file.open("rb") as stream:
                state = int.from_bytes(stream.read(4), sys.byteorder)
            if state < _READY and time.time() - file.stat().st_mtime > _MAKING_S:
                _remove(file.name)


def _remove(name: str) -> None:
    for file in (f"{name}_el", name, f"sem.{name}_mutex"):
        (_DIRECTORY / file).unlink(missing_ok=True)
