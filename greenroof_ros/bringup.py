"""The site as a ROS 2 graph, from one command: ``python -m greenroof_ros.bringup``."""

from __future__ import annotations

import argparse
import fcntl
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_INTERRUPTED, command, within
from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    run_from_arguments,
)
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.experiment.run import Run
from greenroof_ros.experiment.run_directory import make_run_directory, write_configuration
from greenroof_ros.graph.reports import FINISHED, STARTING
from greenroof_ros.graph.shared_memory import remove_unfinished
from greenroof_ros.graph.supervisor import NodeFailed, Supervisor

# How long to listen for nodes that are in the graph already (s). On loopback they answer in well
# under half of it; whom this misses is met by the check for two publishers.
_LISTEN_S = 1.0
# From the start of the processes to all being ready (s): imports on a busy machine take seconds.
_START_LIMIT_S = 30.0
# Above it the ports of a domain run into those that the system lends.
_LAST_DOMAIN = 101


class _Interrupted(Exception):
    """Ctrl-C, or SIGTERM, or the terminal was closed."""


class _Signals:
    """Notes that a signal came; the run looks at it where it can end cleanly.

    An exception out of the handler could fall into the middle of anything, the end of the nodes
    among it.
    """

    def __init__(self) -> None:
        self._came = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._on_signal)

    def _on_signal(self, signum: int, frame: Any) -> None:
        self._came = True

    def ignore(self) -> None:
        """Take no further one: the end of the interpreter would be ended by it."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)

    def check(self) -> None:
        """Raise :class:`_Interrupted` if one came."""
        if self._came:
            raise _Interrupted


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m greenroof_ros.bringup",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own "
        "process, run them in lockstep on simulated time, and end them. While it runs, "
        "'ros2 topic echo /roof/level' shows the roof.",
        epilog="exit codes: 0 done, 1 a node failed, 2 bad usage or configuration, "
        "3 the ROS domain has another graph, 130 interrupted",
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
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, 2 s at least: nodes that join listen for a "
        "second (default: %(default)s s)",
    )
    return parser


def _company(what: str) -> OccupiedError:
    domain = _domain()
    return OccupiedError(
        f"{what} already in ROS domain {domain}; end it, or take another domain: "
        f"ROS_DOMAIN_ID={domain % 100 + 1} python -m greenroof_ros.bringup ..."
    )


def _domain() -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > _LAST_DOMAIN:
        raise ConfigurationError(
            f"must be a number from 0 to {_LAST_DOMAIN}", key="ROS_DOMAIN_ID", value=text
        )
    return int(text)


@contextmanager
def _only_bringup() -> Iterator[None]:
    """Hold the ROS domain against another bringup on this machine.

    Discovery would find its nodes, too, but on a busy machine not always in time.

    Raises:
        ConfigurationError: one runs already.
    """
    name = f"greenroof_ros-{os.getuid()}-domain-{_domain()}.lock"
    path = Path(tempfile.gettempdir()) / name
    with path.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise _company("a bringup runs") from None
        yield


def _refuse_company(signals: _Signals) -> None:
    """Listen whether nodes of the same names are in the graph already.

    The node that listens leaves the graph again: nothing of this process takes part in the run.

    Raises:
        ConfigurationError: they are, or ROS 2 is not installed.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    try:
        import rclpy
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise ConfigurationError(
            "ROS 2 is not here: source an installed ROS 2, or pip install 'greenroof_ros[ros]'; "
            f"python -m greenroof_ros.simulate needs none ({error})"
        ) from error
    ours = {"plant", "weather", *CONTROLLERS, "recorder"}
    remove_unfinished()
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("bringup", context=context, start_parameter_services=False, enable_rosout=False)
    try:
        until = time.monotonic() + _LISTEN_S
        while time.monotonic() < until:
            signals.check()
            time.sleep(0.05)
            present = node.get_node_names_and_namespaces()
            found = sorted(
                name for name, namespace in present if namespace == "/" and name in ours
            )
            if found:
                raise _company(f"a graph with {', '.join(found)} runs")
    finally:
        node.destroy_node()
        context.try_shutdown()


def _watch(
    run: Run, limit: float, supervisor: Supervisor, signals: _Signals
) -> dict[str, dict[str, Any]]:
    """Watch the nodes until all have reported the end of the run.

    Args:
        run: what was asked for.
        limit: longest silence of a node (s).
        supervisor: has started the nodes.
        signals: looked at ten times a second.

    Returns:
        The final report of each node.

    Raises:
        NodeFailed: one ended, hangs, or is not ready in time.
    """
    waiting = set(supervisor.nodes)
    final: dict[str, dict[str, Any]] = {}
    with RunProgress(run.steps, run.site.tau) as progress:
        while len(final) < len(supervisor.nodes):
            signals.check()
            for node, report in supervisor.reports():
                if report["state"] != STARTING:
                    waiting.discard(node)
                if report["state"] == FINISHED:
                    final[node] = report
                if node == "plant" and not waiting:
                    progress.update(
                        report["tick"], report["cistern_level"], report["roof_level"],
                        report["command"],
                    )
            if waiting:
                progress.waiting(f"waiting for {', '.join(sorted(waiting))}")
                supervisor.check(_START_LIMIT_S)
            else:
                supervisor.check(limit)
    return final


def _run_graph(
    run: Run, arguments: argparse.Namespace, signals: _Signals
) -> tuple[Path, dict[str, dict[str, Any]]]:
    """Make the run's directory, start the nodes, watch them, and end them.

    Returns:
        The directory and the final report of each node.

    Raises:
        ConfigurationError: there is a graph already, no ROS 2, or the directory cannot be made.
        NodeFailed: a node ended or hangs.
    """
    with _only_bringup():
        _refuse_company(signals)
        directory = make_run_directory(arguments.output, run.controller)
        parameters = write_configuration(
            directory, run,
            {
                "speed": arguments.speed,
                "pump": arguments.pump,
                "record": not arguments.no_record,
                "peer_limit": arguments.peer_limit,
            },
        )
        with Supervisor(directory / "log") as supervisor:
            for node in ("plant", "weather", run.controller):
                supervisor.start(node, parameters)
            if not arguments.no_record:
                supervisor.start("recorder", parameters)
            return directory, _watch(run, arguments.peer_limit, supervisor, signals)


@command
def main() -> int:
    """Bring the graph up, watch it, and end it."""
    arguments = _parser().parse_args()
    signals = _Signals()
    run = run_from_arguments(arguments)
    if arguments.pump == "external":
        run.sensor_pump_errors.refuse_external_pump()
    try:
        directory, final = _run_graph(run, arguments, signals)
    except _Interrupted:
        signals.ignore()
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except NodeFailed as error:
        signals.ignore()
        print(f"error: {error}", file=sys.stderr)
        return error.code
    controller = final[run.controller]
    plant = final["plant"]
    refused: dict[str, int] = {}
    for report in final.values():
        for topic, count in report.get("refused", {}).items():
            refused[topic] = refused.get(topic, 0) + count
    result = summary.build(
        run,
        plant["metrics"],
        wall_s=plant["wall_s"],
        solver=controller["solver"],
        messages=final["recorder"]["messages"] if "recorder" in final else None,
        refused=refused,
        parameter_changes=controller["parameter_changes"],
    )
    summary.write(result, directory / "summary.json")
    summary_table.show(result, as_json=arguments.json, path=directory)
    return EXIT_DONE


if __name__ == "__main__":
    main()
