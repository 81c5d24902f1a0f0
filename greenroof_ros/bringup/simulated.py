"""A simulated run as a graph: its directory, its nodes watched until the end, and its summary."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from greenroof_ros.bringup.drive import chosen_drive, own_parameters, refuse_unknown
from greenroof_ros.bringup.in_the_loop import exchange_period, speed_of, wait_for_drive
from greenroof_ros.bringup.live_options import EXTERNAL
from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED, EXIT_INTERRUPTED
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.signals import InterruptedRun, Signals
from greenroof_ros.controllers.registry import controller_names
from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.incidents import INCIDENTS, IncidentLog
from greenroof_ros.experiment.options import run_from_arguments
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.experiment.run import Run
from greenroof_ros.experiment.run_directory import make_run_directory, write_configuration
from greenroof_ros.graph.domain import only_bringup, refuse_other_nodes
from greenroof_ros.graph.node_processes import NodeFailed
from greenroof_ros.graph.states import FINISHED, PUMP, READY, RECORDER, ROLES
from greenroof_ros.graph.supervisor import Supervisor
from greenroof_ros.recording.bag_reader import count_ticks

_NODES = "greenroof_ros.nodes"
_SHOWN = {"tick", "cistern_level", "roof_level", "command"}  # of what the plant says
# From the start of the processes to all being ready (s): imports on a busy machine take seconds.
_START_LIMIT_S = 30.0


def simulated_run(arguments: argparse.Namespace) -> Run:
    """Build and check the run that a command line asks for.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong.
    """
    run = run_from_arguments(arguments)
    if arguments.pump == EXTERNAL or arguments.drive is not None:
        run.sensor_pump_errors.refuse_external_pump()
    if arguments.state is not None and arguments.drive is None:
        raise ConfigurationError("is of a drive, or a live site", key="--state")
    return run


def run_simulated(run: Run, arguments: argparse.Namespace, signals: Signals) -> int:
    """Make the run's directory, start the nodes, watch them, end them, and say how it went.

    Returns:
        The exit code.

    Raises:
        ConfigurationError: there is a graph already, no ROS 2, or the directory cannot be made.
        OSError: the summary cannot be written.
        OutputError: it cannot be printed.
    """
    namespace: str = arguments.namespace
    controller = run.controller
    drive, own = chosen_drive(arguments), own_parameters(arguments)
    stop_drive = drive.stopper() if drive is not None else None
    nodes = {
        **({} if drive is None else {PUMP: f"{_NODES}.pump"}),
        "plant": f"{_NODES}.plant",
        "weather": f"{_NODES}.weather",
        controller.name: f"{_NODES}.controller",
        **({} if arguments.no_record else {RECORDER: f"{_NODES}.recorder"}),
    }
    refuse_unknown(own, namespace, nodes, controller)
    speed = speed_of(arguments.speed, drive)
    if drive is not None:
        drive.refuse_speed(speed, signals.check)
    names = {*nodes, RECORDER, *controller_names()}
    with only_bringup(namespace):
        refuse_other_nodes(namespace, names, signals.check)
        directory = make_run_directory(arguments.output, controller.name)
        of_drive = {} if drive is None else drive.parameters(arguments.state)
        parameters = write_configuration(
            directory, run,
            {
                "speed": speed,
                "pump": arguments.pump if drive is None else "external",
                "record": not arguments.no_record,
                "peer_limit": arguments.peer_limit,
            },
            {} if drive is None else {PUMP: {
                **of_drive,
                "exchange_period": exchange_period(run, speed),
            }},
        )
        summary.write(summary.build_unfinished(run, summary.RUNNING), directory)
        supervisor = Supervisor(
            directory / "log", [parameters, *([] if own is None else [own])], namespace, stop_drive
        )
        progress = RunProgress(run.steps, run.site.tau)
        log = IncidentLog(progress.say, directory / INCIDENTS)
        try:
            with supervisor:
                if drive is not None:
                    supervisor.add(PUMP, nodes[PUMP])
                    print(
                        f"stops and faults of the drive are kept in {of_drive['state_file']}",
                        file=sys.stderr,
                    )
                with progress:
                    if drive is not None:
                        wait_for_drive(
                            supervisor, signals, of_drive["state_file"], progress, _START_LIMIT_S
                        )
                    for name, module in nodes.items():
                        if name == controller.name:
                            supervisor.add(name, module, "--controller", controller.reference)
                        elif name != PUMP:
                            supervisor.add(name, module)
                    _watch(run, arguments.peer_limit, supervisor, signals, log, progress)
        except InterruptedRun as error:
            signals.ignore()
            print(error, file=sys.stderr)
            _end_early(run, directory, supervisor, log, summary.INTERRUPTED, str(error))
            return EXIT_FAILED if supervisor.may_run else EXIT_INTERRUPTED
        except NodeFailed as error:
            signals.ignore()
            print(f"error: {error}", file=sys.stderr)
            _end_early(run, directory, supervisor, log, summary.FAILED, error.reason)
            return EXIT_FAILED if supervisor.may_run else error.code
        _end_whole(run, directory, supervisor, log, as_json=arguments.json)
        return EXIT_FAILED if supervisor.may_run or log.count else EXIT_DONE


def _watch(
    run: Run, limit: float, supervisor: Supervisor, signals: Signals, log: IncidentLog,
    progress: RunProgress,
) -> None:
    """Watch the nodes until all have reported the end of the run.

    Args:
        run: what was asked for.
        limit: longest silence of a node (s).
        supervisor: has started the nodes.
        signals: looked at ten times a second.
        log: finds what is lost in the run.
        progress: the bar.

    Raises:
        NodeFailed: one ended, hangs, or is not ready in time.
        InterruptedRun: a signal came.
    """
    waiting = set(supervisor.nodes)
    running = set(supervisor.nodes)
    while running:
        signals.check()
        supervisor.permit.tell("waiting for nodes" if waiting - {RECORDER} else "")
        for node, report in supervisor.reports():
            progress.warn(report["warnings"])
            if report["state"] in (READY, FINISHED):
                waiting.discard(node)
            if report["state"] == FINISHED:
                running.discard(node)
            if node == "plant" and not waiting and report.keys() >= _SHOWN:
                progress.update(
                    report["tick"], report["cistern_level"], report["roof_level"],
                    report["command"],
                )
        if not waiting:
            log.look(supervisor.last, _tick(supervisor))
        if waiting:
            progress.waiting(f"waiting for {', '.join(_missing(run, waiting, supervisor))}")
        supervisor.check(_START_LIMIT_S if waiting else limit)


def _tick(supervisor: Supervisor) -> int:
    """Return the tick that the plant has reached."""
    return int(supervisor.last["plant"].get("tick", -1))


def _missing(run: Run, waiting: set[str], supervisor: Supervisor) -> list[str]:
    """Return who has not come yet: nodes that say nothing, and for whom the others wait."""
    names = {**ROLES, "controller": run.controller.name}
    missing = {
        names.get(role, role)
        for report in supervisor.last.values() for role in report.get("waiting", [])
    }
    return sorted(missing | (waiting - supervisor.last.keys()) or waiting)


def _refused(supervisor: Supervisor) -> dict[str, int]:
    """Return how many values of each topic the nodes refused."""
    refused: dict[str, int] = {}
    for report in supervisor.last.values():
        for topic, count in report["refused"].items():
            refused[topic] = refused.get(topic, 0) + count
    return refused


def _parameter_changes(run: Run, supervisor: Supervisor) -> list[dict[str, Any]]:
    """Return the parameters of the controller that changed in the run."""
    changes: list[dict[str, Any]] = supervisor.last.get(run.controller.name, {}).get(
        "parameter_changes", []
    )
    return changes


def _end_whole(
    run: Run, directory: Path, supervisor: Supervisor, log: IncidentLog, *, as_json: bool,
) -> None:
    """Write and print the summary of a run that is done."""
    plant, controller = supervisor.last["plant"], supervisor.last[run.controller.name]
    result = summary.build(
        run,
        plant["metrics"],
        plant["weeks"],
        wall_s=plant["wall_s"],
        solver=controller["solver"],
        messages=supervisor.last.get(RECORDER, {}).get("messages"),
        refused=_refused(supervisor),
        parameter_changes=_parameter_changes(run, supervisor),
        incidents=log.as_dicts(),
    )
    summary.write(result, directory)
    summary_table.show(result, directory, as_json=as_json)


def _end_early(
    run: Run, directory: Path, supervisor: Supervisor, log: IncidentLog, status: str, reason: str,
) -> None:
    """Write how far a run came that is not done, and say how its bag is opened."""
    bag = directory / "bag"
    ticks = count_ticks(bag)
    for line in _bag_lines(directory, bag, ticks):
        print(line, file=sys.stderr)
    last = supervisor.last
    # A plant that was killed came further than it had said, and the recorder heard of it.
    reached = max(last.get("plant", {}).get("tick", -1), (ticks or 0) - 1)
    summary.write(
        summary.build_unfinished(
            run, status, reason=reason, last_tick=reached if reached >= 0 else None,
            refused=_refused(supervisor),
            parameter_changes=_parameter_changes(run, supervisor),
            incidents=log.as_dicts(),
        ),
        directory,
    )


def _bag_lines(directory: Path, bag: Path, ticks: int | None) -> list[str]:
    """Say what is in the bag of a run that is not done, and how it is opened.

    Args:
        directory: of the run.
        bag: in it.
        ticks: that it holds; None where there is none, or it was not closed.
    """
    recover, report, info = (
        f"  {tool} {shlex.quote(str(path))}"
        for tool, path in (
            ("greenroof recover", directory),
            ("greenroof report", directory),
            ("ros2 bag info", bag),
        )
    )
    if ticks:
        return [f"ticks in {bag}: {ticks}; to look at them:", report, info]
    if ticks is None and bag.is_dir():
        return [f"{bag} was not closed; to restore its ticks and look at them:", recover, report]
    return ["no tick was recorded"]
