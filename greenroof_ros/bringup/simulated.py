"""The command ``greenroof run``, which runs a simulated site as a ROS 2 graph."""

from __future__ import annotations

import argparse
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    Parser,
    command,
)
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.standard_error import LINES, print_line
from greenroof_ros.bringup.progress import RunProgress
from greenroof_ros.bringup.start import bring_up
from greenroof_ros.controllers.registry import BUILT_IN, EXTERNAL
from greenroof_ros.interface.states import RECORDER
from greenroof_ros.results.bag_read import count_ticks
from greenroof_ros.ros.arguments import add_graph_arguments
from greenroof_ros.ros.domain import (
    lock_namespace,
    refuse_other_nodes,
    require_ros,
    ros_arguments,
)
from greenroof_ros.ros.errors import explain
from greenroof_ros.simulation import screen, summary
from greenroof_ros.simulation.directory import make_run_directory, write_configuration
from greenroof_ros.simulation.options import (
    add_output_arguments,
    add_run_arguments,
    build_run,
)
from greenroof_ros.simulation.run import Run

if TYPE_CHECKING:
    from greenroof_ros.bringup.composition import Composition


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog="greenroof run",
        usage="%(prog)s [options]",
        description="Run the plant, weather, controller and recorder as ROS 2 nodes in one "
        "process, in lockstep with simulated time. During the run, 'ros2 topic echo "
        "--qos-durability volatile /roof/level' shows the level on the roof.\n\n"
        "For a real site with sensors, use 'greenroof live'.",
        epilog="examples:\n"
        "  greenroof run --controller lookahead --initial high-low --horizon 12\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --namespace site1 --site site1.yaml\n"
        "  greenroof run --speed 60 --no-record\n"
        "  greenroof run --controller external    # your node runs alongside it; for the four "
        "rules, see\n"
        "                                         # greenroof check-controller --help\n\n"
        "exit codes: 0 done, 1 a node failed, 2 bad usage or configuration, or an error in a "
        "controller's code, 3 a graph is already running, 130 interrupted",
    )
    add_run_arguments(parser)
    output = add_output_arguments(parser)
    output.add_argument("--no-record", action="store_true", help="do not write a bag")
    add_graph_arguments(parser, "internal")
    return parser


def simulated_run(arguments: argparse.Namespace) -> Run:
    """Create the run that the command line describes, and check it.

    Raises:
        ConfigurationError: if an option, or a file given by an option, is invalid.
    """
    run = build_run(arguments)
    screen.print_weather(run.series.summary)
    if arguments.pump == EXTERNAL:
        run.sensor_and_pump.refuse_external_pump()
    return run


def run_graph(run: Run, arguments: argparse.Namespace, signals: Signals) -> int:
    """Create the run's directory, run the nodes, write the summary, and return the exit code.

    Raises:
        ConfigurationError: if an option is invalid, a graph is already running, or ROS 2 is
            missing.
        OSError: if the directory cannot be created, or the summary cannot be written.
    """
    with require_ros():
        from greenroof_ros.bringup.composition import Composition
    is_external = run.controller.reference == EXTERNAL
    controllers = [] if is_external else [run.controller.name, *BUILT_IN]
    with lock_namespace(arguments.namespace):
        names = {"plant", "weather", RECORDER, *controllers}
        refuse_other_nodes(arguments.namespace, names, signals.check)
        directory = make_run_directory(arguments.output, run.controller.name)
        parameters = write_configuration(directory, run, {
            "speed": arguments.speed,
            "pump": arguments.pump,
            "record": not arguments.no_record,
            "peer_limit": arguments.peer_limit,
        })
        summary.write(summary.make_unfinished_summary(run, summary.RUNNING), directory)
        progress = RunProgress(run.steps, run.site.tau, LINES)
        graph = Composition(
            run, ros_arguments([parameters], arguments.namespace),
            record=not arguments.no_record, external=is_external or arguments.pump == EXTERNAL,
            progress=progress,
        )
        status, reason, code = summary.DONE, "", EXIT_DONE
        with graph:
            try:
                with progress:
                    graph.spin(signals.check)
            except InterruptedRun as error:
                status, reason, code = summary.INTERRUPTED, str(error), EXIT_INTERRUPTED
                print_line(reason)
            except Exception as error:
                status, reason, code = summary.FAILED, *explain(error)
                print_line(f"error: {reason}")
            failure = reason or None
            if graph.end(failure) != failure:  # the bag cannot be closed
                code = EXIT_FAILED
            _end(run, directory, graph, status, reason, arguments)
        return code


def _end(
    run: Run, directory: Path, graph: Composition, status: str, reason: str,
    arguments: argparse.Namespace,
) -> None:
    """Write the summary; print it if the run is complete, or else commands to open the bag."""
    notes: dict[str, Any] = {"refused": graph.refused, **graph.parameter_changes}
    if status == summary.DONE:
        result = summary.make_summary(run, **graph.results, **notes)
        summary.write(result, directory)
        screen.show_summary(result, directory, as_json=arguments.json)
        return
    if not arguments.no_record:
        _print_bag_contents(directory, count_ticks(directory / "bag"))
    tick = graph.tick
    result = summary.make_unfinished_summary(
        run, status, reason=reason, last_tick=tick if tick >= 0 else None, **notes
    )
    summary.write(result, directory)


def _print_bag_contents(directory: Path, ticks: int | None) -> None:
    """Print the contents of the bag of an unfinished run, and the commands to open it.

    Args:
        directory: the run's directory.
        ticks: number of ticks in the bag; None if there is no bag or it was not closed.
    """
    bag, run = directory / "bag", shlex.quote(str(directory))
    report = f"  greenroof report {run}"
    lines = ["no tick was recorded"]
    if ticks:
        info = f"  ros2 bag info {shlex.quote(str(bag))}"
        lines = [f"ticks in {bag}: {ticks}; to view them:", report, info]
    elif ticks is None and bag.is_dir():
        lines = [
            f"{bag} was not closed; to restore its ticks and view them:",
            f"  greenroof recover {run}", report,
        ]
    print_line("\n".join(lines))


@command
def main() -> int:
    """Start the graph, supervise it until the run is over, and stop it."""
    arguments = make_parser().parse_args()
    run = simulated_run(arguments)
    return bring_up(arguments, partial(run_graph, run, arguments))
