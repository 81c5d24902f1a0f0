"""The command ``greenroof run``, which runs a simulated site as a ROS 2 graph."""

from __future__ import annotations

from functools import partial

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.interface.states import EXTERNAL
from greenroof_ros.ros.domain import add_graph_arguments, bring_up, prepare_ros
from greenroof_ros.simulation import screen
from greenroof_ros.simulation.options import add_output_arguments, add_run_arguments, build_run


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog="greenroof run",
        description="Run the plant, weather, controller and recorder as ROS 2 nodes in one "
        "process, in lockstep with simulated time. For a real site, use 'greenroof live'.",
        epilog="examples:\n"
        "  greenroof run --controller lookahead --initial high-low --horizon 12\n"
        "  greenroof run --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  greenroof run --controller external    # your node runs alongside it\n\n"
        "exit codes: 0 done, 1 a node failed, 2 bad usage or configuration, or an error in a "
        "controller's code, 3 a graph is already running, 130 interrupted",
    )
    add_run_arguments(parser)
    output = add_output_arguments(parser)
    output.add_argument(
        "--speed", type=make_number_type(1e-9, 1e9, word="max"), default=0.0,
        metavar="{max|FACTOR}",
        help="set the ratio of simulated time to wall-clock time; 1 is real time (default: max)",
    )
    output.add_argument("--no-record", action="store_true", help="do not write a bag")
    add_graph_arguments(parser, "internal")
    return parser


@command
def main() -> int:
    """Start the graph, supervise it until the run is over, and stop it."""
    arguments = make_parser().parse_args()
    run = build_run(arguments)
    screen.print_weather(run.series.summary)
    if arguments.pump == EXTERNAL:
        run.sensor_and_pump.refuse_external_pump()
    prepare_ros()
    from greenroof_ros.bringup.composition import run_graph
    return bring_up(arguments, partial(run_graph, run, arguments))
