"""Run a simulated site as a ROS 2 graph, with or without a drive in the loop: ``greenroof run``.

See :mod:`greenroof_ros.bringup.in_the_loop` for what a drive adds.
"""

from __future__ import annotations

import argparse
import shlex
import signal
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.bringup.drive import (
    EXTERNAL,
    add_graph_arguments,
    bring_up,
    chosen_drive,
    own_parameters,
    refuse,
)
from greenroof_ros.bringup.in_the_loop import drive_parameters, wait_for_drive
from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    Parser,
    command,
)
from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.common.standard_error import LINES, say
from greenroof_ros.controllers.registry import controller_names
from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.incidents import INCIDENTS, IncidentLog
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    run_from_arguments,
)
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.experiment.run import Run
from greenroof_ros.experiment.run_directory import make_run_directory, write_configuration
from greenroof_ros.graph.domain import only_bringup, refuse_other_nodes
from greenroof_ros.graph.supervision import FINISHED, PUMP, READY, RECORDER, ROLES
from greenroof_ros.graph.supervisor import START_LIMIT_S, NodeFailed, NodeStart, Supervisor
from greenroof_ros.recording.bag_reader import count_ticks

_NODES = "greenroof_ros.nodes"
_SHOWN = ("tick", "cistern_level", "roof_level", "command")  # entries of the plant's report


def make_parser() -> Parser:
    """Return the parser for the command line."""
    parser = Parser(
        prog="greenroof run",
        usage="%(prog)s [options]",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own "
        "process, run them in lockstep on simulated time, and end them. While it runs, "
        "'ros2 topic echo --qos-durability volatile /roof/level' shows the roof.\n\n"
        "With --drive and --drive-at there is hardware in the loop: a drive instead of the "
        "simulated pump, in real time, or with the drive simulator at another --speed.\n\n"
        "A site with sensors, at which nothing is simulated, is 'greenroof live', or "
        "'python -m greenroof_ros.bringup --plant external'.",
        epilog="examples:\n"
        "  greenroof run --controller lookahead --initial high-low --horizon 12\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --namespace site1 --site site1.yaml\n"
        "  greenroof run --speed 60 --no-record\n"
        "  greenroof run --drive danfoss_fc202 --drive-at gateway://127.0.0.1:5020\n\n"
        "exit codes: 0 done, 1 a node failed, the pump may run on, or done with incidents: a "
        "drive was lost for a while, 2 bad usage or configuration, 3 a graph is already "
        "running, 130 interrupted",
    )
    add_run_arguments(parser)
    add_output_arguments(parser, None, "max; with --drive 1")
    add_graph_arguments(parser, "internal")
    return parser


def simulated_run(arguments: argparse.Namespace) -> Run:
    """Build and check the run that the command line describes.

    Raises:
        ConfigurationError: an option or a file that it names is wrong.
    """
    run = run_from_arguments(arguments)
    if arguments.pump == EXTERNAL or arguments.drive is not None:
        run.sensor_pump_errors.refuse_external_pump()
    no_drive = arguments.state is not None and arguments.drive is None
    refuse((no_drive, "--state", None, "is for a drive"))
    return run


def run_graph(run: Run, arguments: argparse.Namespace, signals: Signals) -> int:
    """Create the run's directory, start, watch and end the nodes; return the exit code.

    Raises:
        ConfigurationError: an option is wrong, a graph runs already, ROS 2 is missing, or the
            directory cannot be created.
        OSError: the summary cannot be written.
        OutputError: the summary cannot be printed.
    """
    drive = chosen_drive(arguments)
    stop_drive = drive.stopper() if drive is not None else None
    of_controller = ("--controller", run.controller.reference)
    nodes = [
        *([] if drive is None else [NodeStart(PUMP, f"{_NODES}.pump")]),
        NodeStart("plant", f"{_NODES}.plant"),
        NodeStart("weather", f"{_NODES}.weather"),
        NodeStart(run.controller.name, f"{_NODES}.controller", of_controller),
        *([] if arguments.no_record else [NodeStart(RECORDER, f"{_NODES}.recorder")]),
    ]
    own_files = own_parameters(arguments, nodes, run.controller)
    speed = arguments.speed
    if speed is None:  # real time with a drive, otherwise as fast as possible
        speed = 0.0 if drive is None else 1.0
    if drive is not None:
        drive.refuse_speed(speed, signals.check)
    with only_bringup(arguments.namespace):
        refuse_other_nodes(
            arguments.namespace, {*(node.name for node in nodes), RECORDER, *controller_names()},
            signals.check,
        )
        directory = make_run_directory(arguments.output, run.controller.name)
        of_drive = {} if drive is None else drive_parameters(
            drive, arguments.state, run.site.tau, speed
        )
        parameters = write_configuration(
            directory, run,
            {
                "speed": speed,
                "pump": arguments.pump if drive is None else EXTERNAL,
                "record": not arguments.no_record,
                "peer_limit": arguments.peer_limit,
            },
            {} if drive is None else {PUMP: of_drive},
        )
        (directory / "log").mkdir()
        supervisor = Supervisor(
            directory / "log", [parameters, *own_files], arguments.namespace, stop_drive,
            lambda node, problem: say(f"{node}: {problem}"),
        )
        # LINES, because this loop gives the pump's permit and a hung terminal must not delay it.
        progress = RunProgress(run.steps, run.site.tau, LINES)
        log = IncidentLog(progress.say, directory / INCIDENTS)
        status, reason, code = summary.DONE, "", EXIT_DONE
        summary.write(summary.build_unfinished(run, summary.RUNNING), directory)
        try:
            with supervisor, progress:
                for node in nodes:
                    supervisor.start(node)
                    if node.name == PUMP:
                        wait_for_drive(supervisor, signals, str(of_drive["state_file"]), progress)
                _watch(run, arguments.peer_limit, supervisor, signals, log, progress)
        except InterruptedRun as error:
            signals.ignore()
            say(str(error))
            status, reason, code = summary.INTERRUPTED, str(error), EXIT_INTERRUPTED
        except NodeFailed as error:
            signals.ignore()
            say(f"error: {error}")
            status, reason, code = summary.FAILED, error.reason, error.code
        except Exception as error:
            signals.ignore()
            why = f"{type(error).__name__}: {error}"
            _end(run, directory, supervisor, log, summary.FAILED, why, as_json=False)
            raise
        if status != summary.FAILED:
            _say_unclosed_bag(supervisor)
        if supervisor.may_run:
            code = EXIT_FAILED
        _end(run, directory, supervisor, log, status, reason, as_json=arguments.json)
        return code or (EXIT_FAILED if log.count else EXIT_DONE)


def _watch(
    run: Run, limit: float, supervisor: Supervisor, signals: Signals, log: IncidentLog,
    progress: RunProgress,
) -> None:
    """Watch the nodes until all have reported the end of the run.

    Args:
        run: the run.
        limit: longest silence of a node once all are ready (s).
        supervisor: the supervisor that started the nodes.
        signals: checked ten times a second.
        log: records incidents during the run.
        progress: the progress bar.

    Raises:
        NodeFailed: a node ended or hangs.
        InterruptedRun: a signal came.
    """
    waiting, running, tick = set(supervisor.nodes), set(supervisor.nodes), -1
    while running:
        signals.check()
        supervisor.permit("waiting for nodes" if waiting - {RECORDER} else "")
        supervisor.listen()
        last = supervisor.last
        waiting -= {name for name in last if last[name]["state"] in (READY, FINISHED)}
        running -= {name for name in last if last[name]["state"] == FINISHED}
        for report in last.values():
            progress.warn(report["warnings"])
        if waiting:
            names = ", ".join(_missing(run, waiting, supervisor))
            progress.waiting(f"waiting for {names}")
        else:
            before, tick = tick, _tick(supervisor)
            if tick != before and last["plant"].keys() >= set(_SHOWN):
                progress.show(*(last["plant"][name] for name in _SHOWN))
            log.look(last, tick)
        supervisor.check(START_LIMIT_S if waiting else limit)


def _tick(supervisor: Supervisor) -> int:
    """Return the tick that the plant has reached; -1 before the first."""
    return int(supervisor.last.get("plant", {}).get("tick", -1))


def _missing(run: Run, waiting: set[str], supervisor: Supervisor) -> list[str]:
    """Return the nodes that are silent or awaited by others; if none, those that are not ready."""
    names = {**ROLES, "controller": run.controller.name}
    missing = {
        names.get(role, role)
        for report in supervisor.last.values() for role in report.get("waiting", [])
    }
    return sorted(missing | (waiting - supervisor.last.keys()) or waiting)


def _say_unclosed_bag(supervisor: Supervisor) -> None:
    """Print an error if the recorder had started and could not close its bag.

    If its middleware locked up (SIGALRM), it had closed the bag before, or logged why it could not.
    """
    recorder = supervisor.nodes.get(RECORDER)
    if recorder is not None and recorder.spoke and (
        recorder.process.returncode not in (EXIT_DONE, -signal.SIGALRM)
    ):
        say(f"error: the recorder could not close its bag\n{supervisor.quoted(RECORDER)}")


def _end(
    run: Run, directory: Path, supervisor: Supervisor, log: IncidentLog, status: str, reason: str,
    *, as_json: bool,
) -> None:
    """Write the summary; print it if the run is done, otherwise print how to open the bag."""
    last = supervisor.last
    refused: Counter[str] = Counter()
    for report in last.values():
        refused.update(report["refused"])
    controller = last.get(run.controller.name, {})
    notes: dict[str, Any] = {
        "refused": refused,
        "parameter_changes": controller.get("parameter_changes", []),
        "parameter_change_count": controller.get("parameter_change_count", 0),
        "incidents": log.as_dicts(),
        "incident_count": log.count,
    }
    if status == summary.DONE:
        plant = last["plant"]
        result = summary.build(
            run, plant["metrics"], plant["weeks"], wall_s=plant["wall_s"],
            solver=controller["solver"], messages=last.get(RECORDER, {}).get("messages"), **notes,
        )
        summary.write(result, directory)
        summary_table.show(result, directory, as_json=as_json)
        return
    ticks = count_ticks(directory / "bag")
    _say_what_is_in_bag(directory, ticks)
    # A plant that was killed may have got further than it reported; the bag shows how far.
    reached = max(_tick(supervisor), (ticks or 0) - 1)
    result = summary.build_unfinished(
        run, status, reason=reason, last_tick=reached if reached >= 0 else None, **notes
    )
    summary.write(result, directory)


def _say_what_is_in_bag(directory: Path, ticks: int | None) -> None:
    """Print what is in the bag of an unfinished run, and how to open it.

    Args:
        directory: the run's directory.
        ticks: number of ticks in the bag; None if there is no bag or it was not closed.
    """
    bag, run = directory / "bag", shlex.quote(str(directory))
    report = f"  greenroof report {run}"
    lines = ["no tick was recorded"]
    if ticks:
        info = f"  ros2 bag info {shlex.quote(str(bag))}"
        lines = [f"ticks in {bag}: {ticks}; to look at them:", report, info]
    elif ticks is None and bag.is_dir():
        lines = [
            f"{bag} was not closed; to restore its ticks and look at them:",
            f"  greenroof recover {run}", report,
        ]
    say("\n".join(lines))


@command
def main() -> int:
    """Start the graph, watch it, and end it."""
    arguments = make_parser().parse_args()
    run = simulated_run(arguments)
    return bring_up(arguments, run.site_file, partial(run_graph, run, arguments))
