"""The site as a ROS 2 graph, from one command: ``python -m greenroof_ros.bringup``."""

from __future__ import annotations

import argparse
import re
import shlex
import signal
import sys
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_INTERRUPTED, command, within
from greenroof_ros.controllers.registry import controller_names
from greenroof_ros.experiment import summary, summary_table
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
from greenroof_ros.graph.states import FINISHED, READY, ROLES
from greenroof_ros.graph.supervisor import NodeFailed, Supervisor
from greenroof_ros.recording.bag_reader import count_ticks

# From the start of the processes to all being ready (s): imports on a busy machine take seconds.
_START_LIMIT_S = 30.0


class _Interrupted(Exception):
    """Ctrl-C, or SIGTERM, or the terminal was closed; the message says which."""


class _Signals:
    """Notes that a signal came; the run looks at it where it can end cleanly.

    An exception out of the handler could fall into the middle of anything, the end of the nodes
    among it. A signal that is ignored stays so: ``nohup`` ignores the end of the terminal, and a
    shell Ctrl-C for what it starts in the background.
    """

    def __init__(self) -> None:
        self._came: signal.Signals | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def _on_signal(self, signum: int, frame: Any) -> None:
        self._came = signal.Signals(signum)

    def ignore(self) -> None:
        """Take no further one: the end of the interpreter would be ended by it."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)

    def check(self) -> None:
        """Raise :class:`_Interrupted` if one came."""
        if self._came is not None:
            raise _Interrupted(f"interrupted by {self._came.name}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m greenroof_ros.bringup",
        usage="%(prog)s [options]",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own\n"
        "process, run them in lockstep on simulated time, and end them. While it runs,\n"
        "'ros2 topic echo --qos-durability volatile /roof/level' shows the roof.",
        epilog="examples:\n"
        "  python -m greenroof_ros.bringup --controller planning_mpc --initial high-low\n"
        "  python -m greenroof_ros.bringup --weather mine.csv --start 2024-06-01 --hours 24\n"
        "  python -m greenroof_ros.bringup --namespace site1 --site site1.yaml\n"
        "  python -m greenroof_ros.bringup --speed 60 --no-record\n\n"
        "exit codes: 0 done, 1 a node failed, 2 bad usage or configuration,\n"
        "3 a graph is there already, 130 interrupted",
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
        "--namespace", type=_namespace, default="", metavar="NAME",
        help="put the whole graph, its clock too, under /NAME, so that several run side by side "
        "in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, 2 s at least: nodes that join listen for a "
        "second (default: %(default)s s)",
    )
    return parser


def _namespace(text: str) -> str:
    """Return a namespace as ROS writes it, ``/site1``; empty for none."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


_namespace.__name__ = "namespace: letters, digits and _, no digit first, such as site1"


def _watch(run: Run, limit: float, supervisor: Supervisor, signals: _Signals) -> None:
    """Watch the nodes until all have reported the end of the run.

    Args:
        run: what was asked for.
        limit: longest silence of a node (s).
        supervisor: has started the nodes.
        signals: looked at ten times a second.

    Raises:
        NodeFailed: one ended, hangs, or is not ready in time.
        _Interrupted: a signal came.
    """
    waiting = set(supervisor.nodes)
    running = set(supervisor.nodes)
    with RunProgress(run.steps, run.site.tau) as progress:
        while running:
            signals.check()
            for node, report in supervisor.reports():
                progress.warn(report["warnings"])
                if report["state"] in (READY, FINISHED):
                    waiting.discard(node)
                if report["state"] == FINISHED:
                    running.discard(node)
                if node == "plant" and not waiting:
                    progress.update(
                        report["tick"], report["cistern_level"], report["roof_level"],
                        report["command"],
                    )
            if waiting:
                progress.waiting(f"waiting for {', '.join(_missing(run, waiting, supervisor))}")
                supervisor.check(_START_LIMIT_S)
            else:
                supervisor.check(limit)


def _missing(run: Run, waiting: set[str], supervisor: Supervisor) -> list[str]:
    """Return who has not come yet: nodes that say nothing, and for whom the others wait."""
    names = {**ROLES, "controller": run.controller.name}
    missing = {
        names.get(role, role)
        for report in supervisor.last.values() for role in report.get("waiting", [])
    }
    return sorted(missing | (waiting - supervisor.last.keys()) or waiting)


def _run_graph(run: Run, arguments: argparse.Namespace, signals: _Signals) -> int:
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
    names = {"plant", "weather", "recorder", controller.name, *controller_names()}
    with only_bringup(namespace):
        refuse_other_nodes(namespace, names, signals.check)
        directory = make_run_directory(arguments.output, controller.name)
        parameters = write_configuration(
            directory, run,
            {
                "speed": arguments.speed,
                "pump": arguments.pump,
                "record": not arguments.no_record,
                "peer_limit": arguments.peer_limit,
            },
        )
        summary.write(summary.build_unfinished(run, summary.RUNNING), directory)
        supervisor = Supervisor(directory / "log", parameters, namespace)
        try:
            with supervisor:
                supervisor.start("plant", "plant")
                supervisor.start("weather", "weather")
                supervisor.start(
                    controller.name, "controller", "--controller", controller.reference
                )
                if not arguments.no_record:
                    supervisor.start("recorder", "recorder")
                _watch(run, arguments.peer_limit, supervisor, signals)
        except _Interrupted as error:
            signals.ignore()
            print(error, file=sys.stderr)
            _end_early(run, directory, supervisor, summary.INTERRUPTED, str(error))
            return EXIT_INTERRUPTED
        except NodeFailed as error:
            signals.ignore()
            print(f"error: {error}", file=sys.stderr)
            _end_early(run, directory, supervisor, summary.FAILED, error.reason)
            return error.code
        _end_whole(run, directory, supervisor, as_json=arguments.json)
        return EXIT_DONE


def _refused(supervisor: Supervisor) -> dict[str, int]:
    """Return how many values of each topic the nodes refused."""
    refused: dict[str, int] = {}
    for report in supervisor.last.values():
        for topic, count in report["refused"].items():
            refused[topic] = refused.get(topic, 0) + count
    return refused


def _end_whole(run: Run, directory: Path, supervisor: Supervisor, *, as_json: bool) -> None:
    """Write and print the summary of a run that is done."""
    plant, controller = supervisor.last["plant"], supervisor.last[run.controller.name]
    result = summary.build(
        run,
        plant["metrics"],
        wall_s=plant["wall_s"],
        solver=controller["solver"],
        messages=supervisor.last.get("recorder", {}).get("messages"),
        refused=_refused(supervisor),
        parameter_changes=controller["parameter_changes"],
    )
    summary.write(result, directory)
    summary_table.show(result, directory, as_json=as_json)


def _end_early(
    run: Run, directory: Path, supervisor: Supervisor, status: str, reason: str
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
            parameter_changes=last.get(run.controller.name, {}).get("parameter_changes"),
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
            ("python -m greenroof_ros.recover", directory),
            ("python -m greenroof_ros.report", directory),
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
    arguments = parse_run_arguments(_parser())
    signals = _Signals()
    run = run_from_arguments(arguments)
    if arguments.pump == "external":
        run.sensor_pump_errors.refuse_external_pump()
    try:
        return _run_graph(run, arguments, signals)
    except _Interrupted as error:  # before a node was started
        print(error, file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    main()
