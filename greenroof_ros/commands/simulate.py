"""Simulate a run in one process, without ROS: ``greenroof simulate``."""

from __future__ import annotations

import csv
import time
from contextlib import ExitStack
from datetime import timedelta
from operator import attrgetter
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_DONE, Parser, command, within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import naming
from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    run_from_arguments,
)
from greenroof_ros.experiment.progress import INTERVAL_S, RunProgress
from greenroof_ros.experiment.run_directory import make_run_directory, write_configuration
from greenroof_ros.model.metrics import Metrics

# Columns of the trajectory file besides the times, with the attribute of a tick in each.
_COLUMNS = {
    "cistern_m3": "x1",
    "roof_m3": "x2",
    "cistern_level_m": "cistern_level",
    "roof_level_m": "roof_level",
    "precipitation_m_per_s": "precipitation",
    "evapotranspiration_m3_per_s": "evapotranspiration",
    "command": "command",
    "pump_flow_m3_per_s": "flows.pump",
    "outflow_m3_per_s": "flows.outflow",
    "drainage_m3_per_s": "flows.drainage",
    "frost": "frost",
}
# The additional column for a measured roof.
_LAYER = {"drainage_layer_m3": "layer"}


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof simulate",
        usage="%(prog)s [options]",
        description="Run cistern, roof, pumps and controller over real weather in one process, "
        "without ROS. The numbers equal the node graph's (greenroof run), bit for bit.",
        epilog="examples:\n"
        "  greenroof simulate --controller lookahead --horizon 12 --trajectory run.csv\n"
        "  greenroof simulate --start 2021-07-08T05:00 --hours 6\n"
        "  greenroof simulate --controller lookahead --horizon 24 \\\n"
        "      --forecast errors --forecast-skill real --forecast-seed 3\n"
        "  greenroof simulate --weather 'hourly_*.csv' --start 2021-07-01\n\n"
        "exit codes: 0 done, 2 bad usage or configuration, 130 interrupted",
    )
    add_run_arguments(parser)
    group = add_output_arguments(parser)
    group.add_argument(
        "--trajectory", type=Path, metavar="FILE.csv",
        help="write every tick 0..N to a new CSV file; the digits are exact",
    )
    group.add_argument(
        "--trajectory-every", type=within(0, 1e9), default=0.0, metavar="S",
        help="write a tick every S seconds, and the last, instead of all: at a hundred bytes per "
        "tick a year takes gigabytes",
    )
    return parser


@command
def main() -> int:
    """Simulate the run that the command line asks for."""
    arguments = make_parser().parse_args()
    run = run_from_arguments(arguments)
    tau = run.site.tau
    if arguments.trajectory_every and arguments.trajectory is None:
        raise ConfigurationError("needs --trajectory", key="--trajectory-every")
    every = max(1, round(arguments.trajectory_every / tau))
    with ExitStack() as stack:
        directory = make_run_directory(arguments.output, run.controller.name)
        write_configuration(directory, run, {})
        rows: Any = None
        columns = {**_COLUMNS, **(_LAYER if run.site.drainage_storage is not None else {})}
        values = attrgetter(*columns.values())
        if arguments.trajectory is not None:
            stack.enter_context(naming(arguments.trajectory))
            try:
                stream = stack.enter_context(arguments.trajectory.open("x", newline=""))
            except OSError as error:
                raise ConfigurationError(
                    f"cannot be written: {error.strerror}",
                    key="--trajectory", value=str(arguments.trajectory),
                ) from error
            rows = csv.writer(stream)
            rows.writerow(("time", "time_s", *columns))
        controller = run.make_controller()
        metrics = Metrics()
        progress = stack.enter_context(RunProgress(run.steps, tau))
        began = shown = time.monotonic()
        for tick in closed_loop(run, controller, metrics):
            if rows is not None and (tick.k % every == 0 or tick.k == run.steps):
                seconds = tick.k * tau
                time_of = run.start + timedelta(seconds=seconds)
                rows.writerow((time_of.isoformat(), seconds, *values(tick)))
            now = time.monotonic()
            if arguments.speed:
                due = began + tick.k * tau / arguments.speed
                time.sleep(max(0.0, due - now))
            if now - shown > INTERVAL_S or tick.k == run.steps:
                shown = now
                progress.show(tick.k, tick.cistern_level, tick.roof_level, tick.command)
        wall = time.monotonic() - began
    result = summary.build(
        run,
        metrics.results(),
        metrics.weekly_deviations(),
        wall_s=wall,
        solver=controller.statistics(),
    )
    summary.write(result, directory)
    summary_table.show(result, directory, as_json=arguments.json)
    return EXIT_DONE


if __name__ == "__main__":
    main()
