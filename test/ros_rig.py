"""A node of the test's own in a real graph: what it hears, says and asks; and nodes beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graphs import environment, wait_for
from places import CONFIG
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from greenroof_ros.common.files import read_yaml
from greenroof_ros.common.interface import read_live_topics, read_topics
from greenroof_ros.graph.messages import message_class, qos_profile

OK, WARN, ERROR, STALE = b"\x00", b"\x01", b"\x02", b"\x03"
TAU = 0.2
# What a busy machine may take (s). That each bound holds, test_input_rules.py shows by a clock of
# its own, and so does the campaign of faults.
LATE = 60.0
FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
# What evaporates off the paper's bed, 68.8 m2, in each month (m3/s).
USUAL_EVAPOTRANSPIRATION = {
    month / 1000 / 86400 * 68.8
    for month in read_yaml(CONFIG / "site.yaml")["monthly_evapotranspiration"]
}
_TOPICS = {**read_topics(), **read_live_topics()}


def qos(topic: str) -> Any:
    """Return a topic's profile in the interface."""
    return qos_profile(_TOPICS[topic].qos)


def ros_arguments(**parameters: object) -> list[str]:
    """Return ROS arguments that set parameters; those that are None are left out."""
    settings = [f"{name}:={value}" for name, value in parameters.items() if value is not None]
    words = [word for setting in settings for word in ("-p", setting)]
    return ["--ros-args", *words] if words else []


class Observer:
    """A node of the test's own.

    Attributes:
        domain: that it is in.
        cwd: where nodes beside it are started.
        started: these, which end with it.
        diagnoses: of each name on /diagnostics what was said last.
        said: all sentences that came there.
    """

    def __init__(self, domain: int, cwd: Path) -> None:
        self.domain, self.cwd = domain, cwd
        self.started: list[subprocess.Popen[Any]] = []
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = Node("observer", context=self.context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.diagnoses: dict[str, DiagnosticStatus] = {}
        self.said: list[str] = []
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, qos("/diagnostics")
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnoses[status.name] = status
            self.said.append(status.message)

    def start(
        self, command: str, *, popen: dict[str, Any] | None = None, **parameters: object
    ) -> subprocess.Popen[Any]:
        """Start a node beside it: its module, with arguments."""
        words = [*f"greenroof_ros.nodes.{command}".split(), *ros_arguments(**parameters)]
        process = subprocess.Popen(
            [sys.executable, "-m", *words], cwd=self.cwd,
            **{"env": environment(self.domain), **(popen or {})},
        )
        self.started.append(process)
        return process

    def until(self, condition: Callable[[], Any], seconds: float, event: str) -> Any:
        """Spin until a condition holds."""

        def spun() -> Any:
            self.executor.spin_once(timeout_sec=0.05)
            return condition()

        return wait_for(spun, seconds, event)

    def hear(
        self, topic: str, value: Callable[[Any], Any] = lambda message: message.data,
        namespace: str = "",
    ) -> list[Any]:
        """Return the list in which the values of a topic are from now on."""
        values: list[Any] = []
        self.node.create_subscription(
            message_class(_TOPICS[topic].type), namespace + topic,
            lambda message: values.append(value(message)), qos(topic),
        )
        return values

    def times(self, topic: str) -> list[float]:
        """Return the list of when each message of a topic was sent (s), from now on."""
        times: list[float] = []

        def note(_: Any, info: Any) -> None:
            times.append(info["source_timestamp"] / 1e9)

        self.node.create_subscription(
            message_class(_TOPICS[topic].type), topic, note, qos(topic)
        )
        return times

    def publisher(self, topic: str, node: Node | None = None) -> Any:
        """Open a topic, for the observer or another node."""
        kind = message_class(_TOPICS[topic].type)
        return (node or self.node).create_publisher(kind, topic, qos(topic))

    def call(self, kind: Any, service: str, **fields: object) -> Any:
        """Call a service, once it is there."""
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, 60, service)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, 60, f"an answer of {service}")
        return future.result()

    def says(self, part: str, level: bytes, *words: str) -> Callable[[], bool]:
        """Return whether a part is at a level, with some words."""

        def said() -> bool:
            status = self.diagnoses.get(part)
            return status is not None and status.level == level and (
                all(word in status.message for word in words)
            )

        return said

    def values(self, name: str) -> dict[str, Any]:
        """Return what a node said last of itself, or a part's code and what goes with it."""
        status = self.diagnoses.get(name)
        if status is None:
            return {}
        pairs = {pair.key: pair.value for pair in status.values}
        return pairs if ": " in name else {key: json.loads(text) for key, text in pairs.items()}

    def close(self) -> None:
        for number in (signal.SIGCONT, signal.SIGTERM):
            for process in self.started:
                process.send_signal(number)
        for process in self.started:
            process.wait(300)
        self.node.destroy_node()
        self.context.try_shutdown()


class Site:
    """The sensors and the weather of a site, and what is heard from the node under test.

    Attributes:
        values: what is published ten times a second; one may be a function of time.
    """

    def __init__(self, watcher: Observer) -> None:
        """Publish nothing yet."""
        self.watcher, self.cwd = watcher, watcher.cwd
        self.node, self.says, self.call = watcher.node, watcher.says, watcher.call
        self.said, self.diagnoses = watcher.said, watcher.diagnoses
        self.values: dict[str, Any] = {}
        self.publishers: dict[str, Any] = {}
        self._next = time.monotonic()

    @contextmanager
    def live(self, command: str, **parameters: object) -> Iterator[subprocess.Popen[Any]]:
        """Start a node with a tick of 0.2 s in a live graph, and end it; it must end well."""
        file = self.cwd / "site.yaml"
        file.write_text((CONFIG / "site.yaml").read_text().replace("tau: 1.0 ", f"tau: {TAU} "))
        process = self.watcher.start(command, **{"live": "true", "site_file": file, **parameters})
        try:
            yield process
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
            # The kernel ends a node whose middleware takes long to go, as on a busy machine.
            code = process.wait(300)
            assert code in (0, -signal.SIGALRM), code

    def listen(self, topic: str) -> list[tuple[float, Any]]:
        """Note when each value of a topic comes; of a row what its layout does not skip."""

        def value_of(message: Any) -> tuple[float, Any]:
            skipped = message.layout.data_offset if hasattr(message, "layout") else None
            return time.monotonic(), message.data if not skipped else message.data[skipped:]

        return self.watcher.hear(topic, value_of)

    def play(self) -> None:
        """Publish the present values."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + 0.1
        for topic, value in self.values.items():
            if topic not in self.publishers:
                self.publishers[topic] = self.watcher.publisher(topic)
            data = value(time.monotonic()) if callable(value) else value
            self.publishers[topic].publish(message_class(_TOPICS[topic].type)(data=data))

    def until(self, condition: Callable[[], Any], seconds: float, event: str) -> None:
        """Play until a condition holds."""

        def played() -> Any:
            self.play()
            return condition()

        messages = {name: status.message for name, status in self.diagnoses.items()}
        self.watcher.until(played, seconds, f"{event} (before: {messages})")

    def during(self, seconds: float) -> None:
        """Play for so long; a moment in which the machine stands still counts for 0.1 s."""
        played = 0.0
        while played < seconds:
            began = time.monotonic()
            self.play()
            self.watcher.executor.spin_once(timeout_sec=0.05)
            played += min(time.monotonic() - began, 0.1)

    def be_dry(self) -> list[tuple[float, Any]]:
        """Have a dry roof and enough water, both moving, and return the commands."""
        began = time.monotonic()
        self.values = {
            "/cistern/level": lambda now: 2.5 - 1.6e-4 * (now - began),
            "/roof/level": lambda now: 0.02 + 1e-5 * (now - began),
            "/weather/frost": 0.0,
            "/forecast/precipitation": [0.0] * 10,
            "/forecast/evapotranspiration": [1e-6] * 10,
        }
        return self.listen("/pump/command")


def newest(values: list[tuple[float, Any]]) -> Any:
    """Return the value that came last; None before there is one."""
    return values[-1][1] if values else None


def policies(process: int) -> set[int]:
    """Return by which policies the kernel lets the threads of a process run."""
    threads = [int(thread.name) for thread in Path(f"/proc/{process}/task").iterdir()]
    assert len(threads) > 1
    return {os.sched_getscheduler(thread) for thread in threads}


FORECAST_HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"


def write_forecast(
    path: Path, ago: timedelta = timedelta(0), rain: float = 0.0, temperature: float = 15.0,
    *, evapotranspiration: float = 2.0, hours: int = 12,
) -> None:
    """Put a file with one issue of some hours in place, whole."""
    issued = datetime.now(UTC).replace(microsecond=0) - ago
    lines = [
        f"{issued.isoformat()},{(issued + timedelta(hours=hour)).isoformat()},{rain},"
        f"{evapotranspiration},{temperature}"
        for hour in range(hours)
    ]
    draft = path.with_suffix(".new")
    draft.write_text("\n".join([FORECAST_HEADER, *lines, ""]))
    draft.replace(path)


# Lets a process find, each time there is a file *suspended* or *suspended_in_a_decision*, that the
# machine was suspended for an hour: between two decisions of a node, or in the middle of one,
# before and after which it looks how long that was.
SUSPENDED = """
import os
import sys
import time
from contextlib import suppress
awake, slept, looks = time.clock_gettime, 0.0, 0
def clock_gettime(clock):
    global slept, looks
    if clock != time.CLOCK_BOOTTIME:
        return awake(clock)
    decides = sys._getframe(2).f_code.co_name == "suspended_time"
    looks += decides
    for file, now in (("suspended", True), ("suspended_in_a_decision", decides and looks % 2 == 0)):
        with suppress(FileNotFoundError):
            if now:
                os.unlink(file)
                slept += 3600.0
    return awake(clock) + slept
time.clock_gettime = clock_gettime
"""
