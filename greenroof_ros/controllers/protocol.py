"""What every controller is asked, and answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np


class Controller(Protocol):
    """Anything that decides once a tick how much to pump."""

    def command(
        self,
        cistern_level: float,
        roof_level: float,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
    ) -> float:
        """Decide the command for the present tick.

        Args:
            cistern_level: water depth in the cistern (m).
            roof_level: water depth on the roof (m).
            precipitation: forecast of rain (m/s), first entry = now: of the M ticks that come, or
                means over the steps of :func:`greenroof_ros.model.look_ahead.growing_steps`; of an
                ensemble one member after the other.
            evapotranspiration: forecast of evapotranspiration (m3/s), likewise, of one member.

        Returns:
            Share of the pumps' maximum flow (1), finite and not negative.
        """
        ...

    def skip(self) -> None:
        """Let a tick pass in which the command is 0: in frost, or where an input was refused."""
        ...

    def statistics(self) -> dict[str, float] | None:
        """Return what its solver did: ``solves``, ``fallbacks``, and times in seconds.

        ``mean_s``, ``p99_s`` and ``max_s`` are those of a tick, whether something was solved in it
        or not.

        None where it has no solver.
        """
        ...


def solver_statistics(solves: int, fallbacks: int, seconds: Sequence[float]) -> dict[str, float]:
    """Return what :meth:`Controller.statistics` says of a solver.

    Args:
        solves: how many programs were solved, or tried.
        fallbacks: how many of them had no solution.
        seconds: wall time of each tick (s).
    """
    times = np.array(seconds or [0.0])
    return {
        "solves": solves,
        "fallbacks": fallbacks,
        "mean_s": float(times.mean()),
        "p99_s": float(np.percentile(times, 99)),
        "max_s": float(times.max()),
    }
