"""The site as a ROS 2 graph: ``greenroof run`` and ``greenroof live``."""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    command,
    within,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.namespace import namespace
from greenroof_ros.common.signals import InterruptedRun, Signals
from greenroof_ros.controllers.registry import ControllerChoice, controller_names
from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.incidents import INCIDENTS, IncidentLog
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    parse_run_arguments,
    run_from_arguments,
)
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.experiment.run import Run
from greenroof_ros.experiment.run_directory import make_run_directory, write_configuration
from greenroof_ros.graph.domain import only_bringup, refuse_other_nodes
from greenroof_ros.graph.errors import no_ros
from greenroof_ros.graph.node_processes import NodeFailed
from greenroof_ros.graph.states import FINISHED, PUMP, READY, RECORDER, ROLES
from greenroof_ros.graph.supervisor import Supervisor
from greenroof_ros.live.drive import (
    DriveChoice,
    add_drive_arguments,
    chosen_drive,
    own_parameters,
)
from greenroof_ros.live.run import nodes_of, run_live
from greenroof_ros.live.site import EXTERNAL, add_live_arguments, live_site, refuse_live_options
from greenroof_ros.recording.bag_reader import count_ticks
from greenroof_ros.watch.beside import watcher

_NODES = "greenroof_ros.nodes"
_SHOWN = {"tick", "cistern_level", "roof_level", "command"}  # of what the plant says
# From the start of the processes to all being ready (s): imports on a busy machine take seconds.
_START_LIMIT_S = 30.0
# How long a drive may take until it may run (s); an ABB's timeout guards 30 s after power-up only.
_DRIVE_LIMIT_S = 60.0


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof {run,live}",
        usage="%(prog)s [options]",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own\n"
        "process, run them in lockstep on simulated time, and end them. While it runs,\n"
        "'ros2 topic echo --qos-durability volatile /roof/level' shows the roof.\n\n"
        "Three ways to run:\n"
        "  simulated             run, with any option but those below\n"
        "  hardware in the loop  run with --drive and --drive-at: a drive, not a simulated pump\n"
        "  live                  live: a site with sensors, nothing is simulated\n\n"
        "python -m greenroof_ros.bringup is both, by its option --plant.",
        epilog="examples:\n"
        "  greenroof run --controller planning_mpc --initial high-low\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --namespace site1 --site site1.yaml\n"
        "  greenroof run --speed 60 --no-record\n"
        "  greenroof run --drive danfoss_fc202 --drive-at gateway://127.0.0.1:5020\n"
        "  greenroof live --sensors sensors.yaml --forecast forecast.csv \\\n"
        "    --drive danfoss_fc202 --drive-at /dev/ttyUSB0\n\n"
        "exit codes: 0 done, or live and asked to stop, 1 a node failed, the pump may run on, or\n"
        "done with incidents: a drive or a sensor was lost for a while, 2 bad usage or\n"
        "configuration, 3 a graph is there already, 130 interrupted",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_run_arguments(parser)
    add_output_arguments(parser)
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=["internal", "external"], default="internal",
        help="external: /pump/flow comes from a pump driver that you start yourself "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="put the whole graph, its clock too, under /NAME, so that several run side by side "
        "in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, 2 s at least: nodes that join listen for a "
        "second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the run on a page in a browser, whose address is printed. It ends with the run, "
        "which goes on without it; greenroof watch is a page that stays. Needs "
        "greenroof_ros[watch]",
    )
    add_drive_arguments(parser)
    add_live_arguments(parser)
    parser.set_defaults(speed=None)
    return parser


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


def _run_graph(run: Run, arguments: argparse.Namespace, signals: Signals) -> int:
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
    _refuse_unknown(own, namespace, nodes, controller)
    speed = _speed(arguments.speed, drive)
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
                "exchange_period": _exchange_period(run, speed),
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
                        _wait_for_drive(supervisor, signals, of_drive["state_file"], progress)
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


def _refuse_unknown(
    file: Path | None, namespace: str, nodes: Mapping[str, str], controller: ControllerChoice
) -> None:
    """Refuse what would have no effect in a parameter file of a user's own.

    Args:
        file: which, if there is one.
        namespace: of the graph.
        nodes: of each node the module.
        controller: of the graph.

    Raises:
        ConfigurationError: there is something, or no ROS 2.
    """
    if file is None:
        return
    try:
        from greenroof_ros.nodes.parameter_file import refuse_unknown_in
    except ImportError as error:
        raise no_ros(error) from error
    whole = {f"{namespace}/{name}": module for name, module in nodes.items()}
    refuse_unknown_in(file, whole, controller)


def _wait_for_drive(
    supervisor: Supervisor, signals: Signals, state_file: str, progress: RunProgress
) -> None:
    """Wait until the pump node may run its drive: no run begins that could not pump.

    What was latched in another run holds the pump in this one, and is said.

    Raises:
        NodeFailed: it ended, or something speaks against the drive for too long.
        InterruptedRun: a signal came.
    """
    until = time.monotonic() + _DRIVE_LIMIT_S
    while not supervisor.last.get(PUMP, {}).get("active"):
        signals.check()
        supervisor.permit.tell("waiting for nodes")
        supervisor.reports()
        said = supervisor.last.get(PUMP, {}).get("diagnoses", {})
        trouble = "; ".join(
            message for part in ("drive", "drive timeout", "state file")
            for level, message, _ in [said.get(part, ("OK", "", ""))] if level != "OK"
        )
        progress.waiting(f"waiting for the drive: {trouble or 'the pump node starts'}")
        supervisor.check(_START_LIMIT_S)
        if time.monotonic() > until:
            reason = (
                f"the drive cannot be run, after {_DRIVE_LIMIT_S:g} s: {trouble}; check its power "
                "and cable, and the address of --drive-at"
            )
            raise NodeFailed(reason, "", EXIT_FAILED, [PUMP], "no drive")
    said = supervisor.last[PUMP]
    latched = said.get("fault") or said.get("held")
    if latched:
        print(
            f"warning: the pump stays off, by {state_file}: {latched}; a fault is cleared by the "
            "service /pump/reset, a stop by /pump/stop with false, and --state DIR is another's",
            file=sys.stderr,
        )


def _exchange_period(run: Run, speed: float) -> float:
    """Return the time between two rounds of requests to the drive (s): a tick, within limits."""
    return min(max(run.site.tau / speed, 0.02), 0.1) if speed else 0.02


def _speed(asked: float | None, drive: DriveChoice | None) -> float:
    """Return the simulated time per wall time; 0 for as fast as it goes, which no drive does."""
    if asked is not None:
        return asked
    return 0.0 if drive is None else 1.0


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


@command
def main() -> int:
    """Bring the graph up, watch it, and end it."""
    parser = make_parser()
    arguments = parse_run_arguments(parser)
    signals = Signals()
    try:
        if arguments.plant == EXTERNAL:
            site = live_site(parser, arguments)
            nodes = {name: module for name, module, *_ in nodes_of(site)}
            _refuse_unknown(site.node_parameters, site.namespace, nodes, site.controller)
            with _watcher(arguments, site.site_file):
                return run_live(site, signals)
        refuse_live_options(parser, arguments)
        run = _simulated_run(arguments)
        with _watcher(arguments, run.site_file):
            return _run_graph(run, arguments, signals)
    except InterruptedRun as error:  # before a node was started
        print(error, file=sys.stderr)
        return EXIT_INTERRUPTED


def _watcher(
    arguments: argparse.Namespace, site_file: Path
) -> contextlib.AbstractContextManager[None]:
    """Return what keeps a page beside the run, where one is asked for."""
    if not arguments.watch:
        return contextlib.nullcontext()
    return watcher(arguments.namespace, site_file)


def _simulated_run(arguments: argparse.Namespace) -> Run:
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


if __name__ == "__main__":
    main()
