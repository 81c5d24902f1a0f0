"""Composition of the nodes of a simulated run, and of the alarms node, in one process."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from greenroof_ros.bringup.progress import RunProgress
from greenroof_ros.controllers.registry import EXTERNAL
from greenroof_ros.interface.states import RECORDER
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.nodes.controller import SimulatedController
from greenroof_ros.nodes.plant import PlantNode
from greenroof_ros.nodes.recorder import RecorderNode
from greenroof_ros.nodes.weather import RecordedWeather
from greenroof_ros.ros.lockstep import LockstepNode
from greenroof_ros.ros.spin import destroy_nodes, end_nodes, ros, spin
from greenroof_ros.ros.watchdog import Watchdog
from greenroof_ros.simulation.run import Run

# How long messages of a node that is not composed here are still received after the last tick (s):
# a node that publishes twice per tick can be found only then.
_EXTRA_S = 0.5
# How often the progress is shown: at every this many checks of the steady clock.
_SHOWN_EVERY = 4


class Composition:
    """The plant, weather, controller and recorder nodes of one run, in this process.

    The alarms node runs beside them, outside the lockstep.

    The object is used in a ``with`` statement, in which :meth:`end` must be called regardless of
    how the run ends.

    Attributes:
        refused: number of values that the nodes rejected, by topic.
        tick: number of the tick that the plant has reached; -1 before the first tick.
    """

    def __init__(
        self, run: Run, arguments: Sequence[str], *, record: bool, external: bool,
        progress: RunProgress,
    ) -> None:
        """Store the run, without creating nodes.

        Args:
            run: the run to simulate.
            arguments: ROS arguments for all nodes.
            record: True to include a recorder.
            external: True if a node of the run is in another process.
            progress: progress bar that shows the run.
        """
        self._run, self._record = run, record
        self._external = external
        self._progress = progress
        self._arguments = ["greenroof", *arguments, "--disable-stdout-logs"]
        self._nodes: dict[str, LockstepNode] = {}
        self._beside: list[AlarmsNode] = []
        self._checks = 0
        self._finished_at = time.monotonic()
        self._ends = ExitStack()

    def __enter__(self) -> Composition:
        """Initialise ROS, and return the composition."""
        self._ends.enter_context(ros(self._arguments))
        return self

    def __exit__(self, *_: object) -> None:
        """Let the nodes leave the graph, and shut ROS down; the process must then exit soon."""
        with self._ends:
            destroy_nodes(self._all)

    def end(self, failure: str | None) -> str | None:
        """Stop the nodes, and close the bag.

        Args:
            failure: reason why the run failed; None if it did not fail.

        Returns:
            The description of the first error, either the given failure or an error raised while a
            node was stopping; None if there was no error.
        """
        return end_nodes(self._all, failure)

    def spin(self, check: Callable[[], None]) -> None:
        """Create the nodes, and run them to the end of the run.

        Args:
            check: callback that is called 20 times a second; it can raise an error to end the run.

        Raises:
            LockstepError: if the graph cannot continue.
            ConfigurationError: if a parameter is invalid.
            OSError: if a node cannot continue, for instance because the disk is full.
        """
        run = self._run
        plant = self._nodes["plant"] = PlantNode()
        self._nodes["weather"] = RecordedWeather()
        if run.controller.reference != EXTERNAL:
            self._nodes[run.controller.name] = SimulatedController(run.controller.reference)
        if self._record:
            self._nodes[RECORDER] = RecorderNode()
        self._beside.append(AlarmsNode())
        with Watchdog(plant.limit, exits=True) as watchdog:

            def may_end() -> bool:
                watchdog.report()
                check()
                ended = self._finished()
                self._show(ended)
                return ended

            spin(self._all, may_end)

    @property
    def _all(self) -> list[Any]:
        """The nodes of the run, beginning with the plant, and those beside them."""
        return [*self._nodes.values(), *self._beside]

    def _finished(self) -> bool:
        """Return True if the run is over for all nodes and the wait for late messages is over."""
        now = time.monotonic()
        if not all(node.finished for node in self._nodes.values()):
            self._finished_at = now
            return False
        return now - self._finished_at >= (_EXTRA_S if self._external else 0.0)

    def _show(self, ended: bool) -> None:
        self._checks += 1
        if self._checks % _SHOWN_EVERY and not ended:
            return
        for node in self._nodes.values():
            self._progress.warn(node.warnings)
        plant = self._nodes["plant"]
        if not plant.acted:
            missing = ", ".join(map(plant.peers.name_of, plant.peers.absent()))
            self._progress.show(f"waiting for {missing}" if missing else "starting", 0.0)
            return
        shown = plant.progress()
        self._progress.show_tick(
            shown["tick"], shown["cistern_level"], shown["roof_level"], shown["command"]
        )

    # --- results ----------------------------------------------------------------------------

    @property
    def tick(self) -> int:
        """The number of the tick that the plant has reached; -1 before the first tick."""
        plant = self._nodes.get("plant")
        return plant.progress()["tick"] if plant is not None and plant.acted else -1

    @property
    def refused(self) -> dict[str, int]:
        """The number of values that the nodes have rejected, by topic."""
        refused: Counter[str] = Counter()
        for node in self._nodes.values():
            refused.update({
                name: entry.refused for name, entry in node.inputs.items() if entry.refused
            })
        return refused

    @property
    def parameter_changes(self) -> dict[str, Any]:
        """The changes to the controller's parameters during the run, and their number."""
        controller = self._nodes.get(self._run.controller.name)
        return {} if controller is None else controller.progress()

    @property
    def results(self) -> dict[str, Any]:
        """The results of a completed run, for its summary."""
        controller = self._nodes.get(self._run.controller.name)
        solver = {"solver": None} if controller is None else controller.result
        recorder = self._nodes[RECORDER].result if self._record else {"messages": None}
        return {**self._nodes["plant"].result, **solver, **recorder}
