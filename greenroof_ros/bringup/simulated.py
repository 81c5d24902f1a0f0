"""The command ``greenroof run``, which runs a simulated site as a ROS 2 graph."""

from __future__ import annotations

import argparse
import sys
from functools import partial

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
from greenroof_ros.controllers.registry import EXTERNAL, ControllerChoice, find_controller
from greenroof_ros.interface.states import RECORDER
from greenroof_ros.ros.arguments import add_graph_arguments
from greenroof_ros.ros.domain import (
    lock_bringup,
    require_ros,
    ros_arguments,
)
from greenroof_ros.ros.errors import explain
from greenroof_ros.ros.parameter_file import node_parameter_files
from greenroof_ros.ros.ros_arguments import find_options, remove_ros_arguments
from greenroof_ros.simulation import screen, summary
from greenroof_ros.simulation.directory import make_run_directory, write_configuration
from greenroof_ros.simulation.options import (
    add_output_arguments,
    add_run_arguments,
    build_run,
)
from greenroof_ros.simulation.run import Run

_NODES = "greenroof_ros.nodes"


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog="greenroof run",
        usage="%(prog)s [options] [--ros-args ...]",
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
        "                                         # greenroof check-controller --help\n"
        "  greenroof run --ros-args -r plant:/roof/level:=/raw\n\n"
        "ROS arguments: all nodes of the run receive them, as rclpy defines them. -p NAME:=VALUE "
        "and --params-file FILE set parameters of the controller. Nodes cannot be renamed. Other "
        "commands, such as watch, do not recognize a remapped topic.\n\n"
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
        from greenroof_ros.ros.spin import destroy_nodes, end_nodes, ros
    modules = _modules(run.controller, arguments)
    user_files = node_parameter_files(arguments, modules, run.controller, run.parameters)
    with lock_bringup(arguments.namespace):
        directory = make_run_directory(arguments.output, run.controller.name)
        parameters = write_configuration(directory, run, {
            "speed": arguments.speed,
            "pump": arguments.pump,
            "record": not arguments.no_record,
            "peer_limit": arguments.peer_limit,
        })
        summary.write(summary.make_unfinished_summary(run, summary.RUNNING), directory)
        progress = RunProgress(run.steps, run.site.tau, LINES)
        graph = Composition(run, external_pump=arguments.pump == EXTERNAL, progress=progress)
        words = ros_arguments([parameters, *user_files], arguments.namespace, sys.argv[1:])
        status, reason, code = summary.DONE, "", EXIT_DONE
        with ros(["greenroof", *words, "--disable-stdout-logs"]):
            try:
                with progress:
                    graph.spin(signals.check, record=not arguments.no_record)
            except InterruptedRun as error:
                status, reason, code = summary.INTERRUPTED, str(error), EXIT_INTERRUPTED
                print_line(reason)
            except Exception as error:
                status, reason, code = summary.FAILED, *explain(error)
                print_line(f"error: {reason}")
            nodes = [*graph.nodes.values()]
            try:
                if end_nodes(nodes, reason or None) != (reason or None):  # the bag is not closed
                    code = EXIT_FAILED
                if status == summary.DONE:
                    result = summary.make_summary(run, **graph.results(), **graph.happened())
                else:
                    result = summary.make_unfinished_summary(
                        run, status, reason=reason, **graph.happened()
                    )
                    print_line(f"the unfinished run is in {directory}")
                summary.write(result, directory)
                if status == summary.DONE:
                    screen.show_summary(result, directory, as_json=arguments.json)
            finally:
                destroy_nodes(nodes)
        return code


def _modules(controller: ControllerChoice, arguments: argparse.Namespace) -> dict[str, str]:
    """Return the module of every node of the run, by the node's name."""
    is_external = controller.reference == EXTERNAL
    return {
        "plant": f"{_NODES}.plant",
        "weather": f"{_NODES}.weather",
        **({} if is_external else {controller.name: f"{_NODES}.controller"}),
        **({} if arguments.no_record else {RECORDER: f"{_NODES}.recorder"}),
    }


@command
def main() -> int:
    """Start the graph, supervise it until the run is over, and stop it."""
    parser, words = make_parser(), sys.argv[1:]
    if "--ros-args" in words:
        own = remove_ros_arguments(words)
        arguments = parser.parse_args(own)
        controller = find_controller(arguments.controller)
        nodes = _modules(controller, arguments)
        options = find_options(words, arguments.namespace, nodes, controller)
        arguments = parser.parse_args([*own, *options])
    else:
        arguments = parser.parse_args(words)
    run = simulated_run(arguments)
    return bring_up(arguments, partial(run_graph, run, arguments))
