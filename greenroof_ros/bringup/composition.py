"""Composition of the nodes of a simulated run, and of the alarms node, in one process."""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED, explain
from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.processes import InterruptedRun, Signals, Watchdog
from greenroof_ros.base.standard_error import LINES, print_line
from greenroof_ros.base.times import hours_minutes_seconds
from greenroof_ros.interface.states import EXTERNAL, PLANT, RECORDER
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.nodes.controller import SimulatedController
from greenroof_ros.nodes.plant import PlantNode
from greenroof_ros.nodes.recorder import RecorderNode
from greenroof_ros.nodes.weather import RecordedWeather
from greenroof_ros.ros.alarms import ROLE
from greenroof_ros.ros.domain import lock_bringup, ros_arguments
from greenroof_ros.ros.spin import destroy_nodes, end_nodes, ros, spin
from greenroof_ros.simulation import output, screen
from greenroof_ros.simulation.run import Run

# How long messages of a node that is not composed here are still received after the last tick (s):
# a node that publishes twice per tick can be found only then.
_EXTRA_S = 0.5
_TICK = (
    "{}, cistern {cistern_level:.3f} m, roof {roof_level:.4f} m, command {command:.3f}"
)


def run_graph(run: Run, arguments: argparse.Namespace, signals: Signals) -> int:
    """Create the run's directory, run the nodes, write the summary, and return the exit code.

    Args:
        run: the run.
        arguments: the parsed command line.
        signals: the signals that end the run.

    Raises:
        ConfigurationError: if an option is invalid, or a graph is already running.
        OSError: if the directory cannot be created, or the summary cannot be written.
    """
    with lock_bringup(arguments.namespace):
        directory = output.make_run_directory(arguments.output, run.controller.name)
        parameters = output.write_configuration(directory, run, {
            "speed": arguments.speed, "pump": arguments.pump, "record": not arguments.no_record,
            "peer_limit": arguments.peer_limit,
        })
        output.write_summary(output.make_unfinished_summary(run, output.RUNNING), directory)
        words = ros_arguments([parameters], arguments.namespace)
        nodes: dict[str, Any] = {}
        status, reason, code = output.DONE, "", EXIT_DONE
        with ros(["greenroof", *words, "--disable-stdout-logs"]):
            try:
                _run_nodes(nodes, run, arguments, signals)
            except InterruptedRun as error:
                status, reason, code = output.INTERRUPTED, str(error), EXIT_INTERRUPTED
                print_line(reason)
            except Exception as error:
                status, reason, code = output.FAILED, *explain(error)
                print_line(f"error: {reason}")
            try:
                if end_nodes([*nodes.values()], reason or None) is not None:
                    code = EXIT_FAILED  # the bag cannot be closed
                _summarize(nodes, run, status, reason, arguments, directory)
            finally:
                destroy_nodes([*nodes.values()])
        return code


def _run_nodes(
    nodes: dict[str, Any], run: Run, arguments: argparse.Namespace, signals: Signals
) -> None:
    """Create the nodes of a run, and run them to its end.

    Args:
        nodes: receives the nodes, by their names. The plant is the first; the alarms node takes no
            part in the lockstep.
        run: the run.
        arguments: the parsed command line.
        signals: the signals that end the run.
    """
    plant = nodes[PLANT] = PlantNode()
    nodes["weather"] = RecordedWeather()
    if run.controller.reference != EXTERNAL:
        nodes[run.controller.name] = SimulatedController(run.controller.reference)
    if not arguments.no_record:
        nodes[RECORDER] = RecorderNode()
    in_lockstep = [*nodes.values()]
    nodes[ROLE] = AlarmsNode()
    beside = [nodes[ROLE]]
    extra_s = _EXTRA_S if EXTERNAL in (run.controller.reference, arguments.pump) else 0.0
    watchdog, finished_at = Watchdog(exits=True), math.inf

    def may_end() -> bool:
        nonlocal finished_at
        watchdog.report(plant.limit())
        signals.check()
        for node in beside:
            try:
                node.check(time.monotonic())
            except Exception as error:  # whatever it is, it does not end the run
                progress.print_line(f"warning: there are no more alarms: {explain(error)[0]}")
                beside.clear()
        if plant.acted:
            tick = plant.progress()
            progress.show(_TICK.format(
                hours_minutes_seconds(tick["tick"] * run.site.tau), **tick
            ), tick["tick"] / run.steps)
        else:
            missing = ", ".join(plant.absent())
            progress.show(f"waiting for {missing}" if missing else "starting", 0.0)
        if all(node.finished for node in in_lockstep):
            finished_at = min(finished_at, time.monotonic())
        return time.monotonic() - finished_at >= extra_s

    with ProgressBar(LINES) as progress:
        try:
            spin(in_lockstep, may_end, beside)
        finally:
            watchdog.stop()


def _summarize(
    nodes: dict[str, Any], run: Run, status: str, reason: str, arguments: argparse.Namespace,
    directory: Path,
) -> None:
    """Write the summary of a run, and print it if the run is complete."""
    plant, controller = map(nodes.get, (PLANT, run.controller.name))
    refused = sum((Counter(node.refused) for node in nodes.values()), Counter[str]())
    happened = {
        "refused": dict(refused),
        "last_tick": plant.progress()["tick"] if plant is not None and plant.acted else None,
        **({} if controller is None else controller.progress()),
    }
    if status != output.DONE:
        print_line(f"the unfinished run is in {directory}")
        happened["reason"] = reason
        output.write_summary(output.make_unfinished_summary(run, status, **happened), directory)
        return
    results: dict[str, Any] = {"solver": None, "messages": None}
    for name, node in nodes.items():
        results |= {} if name == ROLE else node.result
    result = output.make_summary(run, **results, **happened)
    output.write_summary(result, directory)
    screen.show_summary(result, directory, as_json=arguments.json)
