"""A simulation in one process, from its first tick to its summary."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.closed_loop import Tick, closed_loop
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.metrics import Metrics


class Simulation:
    """A run that is simulated once; studies, the command and Python all simulate with it."""

    def __init__(self, run: Run, controller: Controller | None = None) -> None:
        """Begin nothing yet.

        Args:
            run: what to simulate.
            controller: decides instead of a new one of the run's class.
        """
        self._run = run
        self._controller = run.make_controller() if controller is None else controller
        self._metrics = Metrics()
        self._wall_s = 0.0

    def ticks(self) -> Iterator[Tick]:
        """Run the ticks 0..N; each is yielded before its step."""
        began = time.monotonic()
        yield from closed_loop(self._run, self._controller, self._metrics)
        self._wall_s = time.monotonic() - began

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``, after the last tick."""
        return summary.build(
            self._run, self._metrics.results(), self._metrics.weekly_deviations(),
            wall_s=self._wall_s, solver=self._controller.statistics(),
        )
