"""Composition of the nodes of a simulated run, and of the alarms node, in one process."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from greenroof_ros.bringup.progress import RunProgress
from greenroof_ros.controllers.registry import EXTERNAL
from greenroof_ros.interface.states import PLANT, RECORDER
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.nodes.controller import SimulatedController
from greenroof_ros.nodes.plant import PlantNode
from greenroof_ros.nodes.recorder import RecorderNode
from greenroof_ros.nodes.weather import RecordedWeather
from greenroof_ros.ros.alarms import ROLE
from greenroof_ros.ros.spin import spin
from greenroof_ros.ros.watchdog import Watchdog
from greenroof_ros.simulation.run import Run

# How long messages of a node that is not composed here are still received after the last tick (s):
# a node that publishes twice per tick can be found only then.
_EXTRA_S = 0.5


class Composition:
    """The plant, weather, controller and recorder nodes of one run, in this process.

    Attributes:
        nodes: the nodes, by their names. The plant is the first; the alarms node takes no part in
            the lockstep.
    """

    def __init__(self, run: Run, *, external_pump: bool, progress: RunProgress) -> None:
        """Store the run, without creating nodes.

        Args:
            run: the run to simulate.
            external_pump: True if the pump driver is in another process.
            progress: progress bar that shows the run.
        """
        self.nodes: dict[str, Any] = {}
        self._controller = run.controller
        self._progress = progress
        is_external = external_pump or run.controller.reference == EXTERNAL
        self._extra_s = _EXTRA_S if is_external else 0.0
        self._finished_at = time.monotonic()

    def spin(self, check: Callable[[], None], *, record: bool) -> None:
        """Create the nodes, and run them to the end of the run.

        Args:
            check: callback that is called 20 times a second; it can raise an error to end the run.
            record: True to include a recorder.

        Raises:
            LockstepError: if the graph cannot continue.
            ConfigurationError: if a parameter is invalid.
            OSError: if a node cannot continue, for instance because the disk is full.
        """
        plant = self.nodes[PLANT] = PlantNode()
        self.nodes["weather"] = RecordedWeather()
        if self._controller.reference != EXTERNAL:
            self.nodes[self._controller.name] = SimulatedController(self._controller.reference)
        if record:
            self.nodes[RECORDER] = RecorderNode()
        self.nodes[ROLE] = AlarmsNode()
        watchdog = Watchdog(exits=True)

        def may_end() -> bool:
            watchdog.report(plant.limit())
            check()
            self._show(plant)
            return self._is_over()

        try:
            spin([*self.nodes.values()], may_end)
        finally:
            watchdog.stop()

    def _is_over(self) -> bool:
        """Return True if the run is over for all nodes and the wait for late messages is over."""
        now = time.monotonic()
        if not all(node.finished for node in self.nodes.values()):
            self._finished_at = now
            return False
        return now - self._finished_at >= self._extra_s

    def _show(self, plant: PlantNode) -> None:
        for node in self.nodes.values():
            self._progress.warn(node.warnings)
        if plant.acted:
            self._progress.show_tick(**plant.progress())
        else:
            missing = ", ".join(map(plant.peers.name_of, plant.peers.absent()))
            self._progress.show(f"waiting for {missing}" if missing else "starting", 0.0)

    def happened(self) -> dict[str, Any]:
        """Return the run's refused values and parameter changes so far, and its last tick."""
        refused: Counter[str] = Counter()
        for node in self.nodes.values():
            refused.update({name: entry.refused for name, entry in node.inputs.items()})
        plant, controller = map(self.nodes.get, (PLANT, self._controller.name))
        return {
            "refused": dict(+refused),
            "last_tick": plant.progress()["tick"] if plant is not None and plant.acted else None,
            **({} if controller is None else controller.progress()),
        }

    def results(self) -> dict[str, Any]:
        """Return the results of a completed run, for its summary."""
        absent: dict[str, Any] = {"solver": None, "messages": None}
        return absent | {
            key: value for name, node in self.nodes.items() if name != ROLE
            for key, value in node.result.items()
        }
