"""Data frames, which some forked processes cannot create."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.base.errors import ConfigurationError, require_extra

if TYPE_CHECKING:
    import polars

# Whether this process was forked from one in which polars was running threads.
_lost_threads = False


def _note_lost_threads() -> None:
    """In a forked process, look for threads of polars in its parent."""
    global _lost_threads
    if "polars" in sys.modules:
        for task in Path(f"/proc/{os.getppid()}/task").glob("*/comm"):
            with contextlib.suppress(OSError):  # it has just ended
                _lost_threads |= task.read_text() == "polars-0\n"


def refuse_forked_polars() -> None:
    """Raise an error if polars would wait forever for threads that a fork did not copy.

    Raises:
        ConfigurationError: if this process was forked after polars had been used.
    """
    if _lost_threads:
        raise ConfigurationError(
            "cannot be created in a process that was forked after polars was used; start the "
            "processes with spawn: multiprocessing.get_context('spawn')", key="a data frame",
        )


def make_frame(data: Any, **options: Any) -> polars.DataFrame:
    """Return a data frame, from the arguments of ``polars.DataFrame``.

    Raises:
        ConfigurationError: if polars is not installed, or would wait forever.
    """
    refuse_forked_polars()
    with require_extra("study"):
        import polars
    return polars.DataFrame(data, **options)


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_note_lost_threads)
