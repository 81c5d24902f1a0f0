"""Nodes of the tests in a real graph, which listen, publish and call services; and other nodes."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import rclpy
from commands import Forked
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graphs import environment, wait_for
from places import CONFIG
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from greenroof_ros.base.errors import MalformedMessageError
from greenroof_ros.base.files import read_yaml
from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.interface.topics import read_live_topics, read_topics
from greenroof_ros.ros.domain import prepare_ros
from greenroof_ros.ros.messages import deserialize, message_class, qos_profile

OK, WARN, ERROR, STALE = b"\x00", b"\x01", b"\x02", b"\x03"
TAU = 0.2
# How long a busy machine may take (s). That each bound holds is shown by test_input_rules.py with
# its own clock, and by the fault campaign.
LATE = 60.0
FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
# Evapotranspiration from the paper's bed, 68.8 m2, in each month (m3/s).
USUAL_EVAPOTRANSPIRATION = {
    month / 1000 / 86400 * 68.8
    for month in read_yaml(CONFIG / "site.yaml")["monthly_evapotranspiration"]
}
_TOPICS = {**read_topics(), **read_live_topics()}


def qos(topic: str) -> Any:
    """Return a topic's QoS profile in the interface."""
    return qos_profile(_TOPICS[topic].qos)


def ros_arguments(**parameters: object) -> list[str]:
    """Return ROS arguments that set parameters; parameters that are None are left out."""
    settings = [f"{name}:={value}" for name, value in parameters.items() if value is not None]
    words = [word for setting in settings for word in ("-p", setting)]
    return ["--ros-args", *words] if words else []


HERE = socket.gethostname()


def check_diagnostics(arrays: list[DiagnosticArray]) -> None:
    """Check in every message what tools rely on: each name belongs to one thing only.

    This also holds for tools that show names without slashes, or make codes of them.
    """
    statuses = [status for array in arrays for status in array.status]
    for status in statuses:
        assert re.fullmatch(r"(/\w+)+(: \w[\w ]*)?", status.name) and status.message
        assert status.hardware_id == HERE
        values = {entry.key: entry.value.strip('"') for entry in status.values}
        assert len(values) == len(status.values)
        # A status that is not OK has a code.
        assert (status.level == OK) or (values["code"] in read_conditions() and values["since"])
    names = {status.name for status in statuses}
    codes = {re.sub(r"\W+", "_", name).strip("_").upper() for name in names}
    assert len(codes) == len(names) and "" not in codes


class Observer:
    """A node of the test.

    Attributes:
        domain: its ROS domain.
        cwd: directory in which nodes next to it are started.
        started: these nodes, which end with it.
        diagnoses: the latest status of each name on /diagnostics.
        messages: all messages received there.
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
        self.messages: list[str] = []
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, qos("/diagnostics"), raw=True
        )

    def _on_diagnostics(self, message: bytes) -> None:
        with suppress(MalformedMessageError):
            for status in deserialize(DiagnosticArray, message).status:
                self.diagnoses[status.name] = status
                self.messages.append(status.message)

    def start(
        self, command: str, *, popen: dict[str, Any] | None = None, **parameters: object
    ) -> subprocess.Popen[Any]:
        """Start a node next to it: its module in the package, with arguments."""
        words = [*f"greenroof_ros.{command}".split(), *ros_arguments(**parameters)]
        process = Forked(
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

    def collect(
        self, topic: str, value: Callable[[Any], Any] = lambda message: message.data,
        namespace: str = "",
    ) -> list[Any]:
        """Return a list that collects the values of a topic from now on."""
        values: list[Any] = []
        self.node.create_subscription(
            message_class(_TOPICS[topic].type), namespace + topic,
            lambda message: values.append(value(message)), qos(topic),
        )
        return values

    def times(self, topic: str) -> list[float]:
        """Return a list that collects when each message of a topic is sent (s), from now on."""
        times: list[float] = []

        def note(_: Any, info: Any) -> None:
            times.append(info["source_timestamp"] / 1e9)

        self.node.create_subscription(
            message_class(_TOPICS[topic].type), topic, note, qos(topic)
        )
        return times

    def publisher(self, topic: str, node: Node | None = None) -> Any:
        """Create a publisher for a topic, of the observer or of another node."""
        kind = message_class(_TOPICS[topic].type)
        return (node or self.node).create_publisher(kind, topic, qos(topic))

    def call(self, kind: Any, service: str, **fields: object) -> Any:
        """Call a service as soon as it is available."""
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, 60, service)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, 60, f"an answer of {service}")
        return future.result()

    def shows(self, part: str, level: bytes, *words: str) -> Callable[[], bool]:
        """Return whether a part shows this level with these words."""

        def is_shown() -> bool:
            status = self.diagnoses.get(part)
            return status is not None and status.level == level and (
                all(word in status.message for word in words)
            )

        return is_shown

    def values(self, name: str) -> dict[str, Any]:
        """Return the latest values that a node reported, or a part's code with its details."""
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
    """The sensors and the weather of a site, and what the node under test publishes.

    Attributes:
        values: published ten times a second; a value can be a function of time.
    """

    def __init__(self, watcher: Observer) -> None:
        """Publish nothing yet."""
        self.watcher, self.cwd = watcher, watcher.cwd
        self.node, self.shows = watcher.node, watcher.shows
        self.messages, self.diagnoses = watcher.messages, watcher.diagnoses
        self.values: dict[str, Any] = {}
        self.publishers: dict[str, Any] = {}
        self._next = time.monotonic()

    @contextmanager
    def live(self, command: str, **parameters: object) -> Iterator[subprocess.Popen[Any]]:
        """Start a node with a tick of 0.2 s in a live graph, and end it; it must end well."""
        file = self.cwd / "site.yaml"
        file.write_text((CONFIG / "site.yaml").read_text().replace("tau: 1.0 ", f"tau: {TAU} "))
        process = self.watcher.start(f"live.{command}", **{"site_file": file, **parameters})
        try:
            yield process
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGINT)
            # If the middleware is slow to end, as on a busy machine, the kernel ends the node.
            code = process.wait(300)
            assert code in (0, -signal.SIGALRM), code

    def listen(self, topic: str) -> list[tuple[float, Any]]:
        """Record each value of a topic and when it came; without the part that its layout skips."""

        def value_of(message: Any) -> tuple[float, Any]:
            skipped = message.layout.data_offset if hasattr(message, "layout") else None
            return time.monotonic(), message.data if not skipped else message.data[skipped:]

        return self.watcher.collect(topic, value_of)

    def play(self) -> None:
        """Publish the present values."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + 0.1
        for topic, value in self.values.items():
            if topic not in self.publishers:
                self.publishers[topic] = self.watcher.publisher(topic, self.node)
            data = value(time.monotonic()) if callable(value) else value
            self.publishers[topic].publish(message_class(_TOPICS[topic].type)(data=data))

    def until(self, condition: Callable[[], Any], seconds: float, event: str) -> None:
        """Publish values until a condition holds."""

        def played() -> Any:
            self.play()
            return condition()

        messages = {name: status.message for name, status in self.diagnoses.items()}
        self.watcher.until(played, seconds, f"{event} (before: {messages})")

    def call(self, kind: Any, service: str, **fields: object) -> Any:
        """Call a service as soon as it is available, and go on publishing."""
        client = self.watcher.node.create_client(kind, service)
        self.until(client.service_is_ready, LATE, service)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, LATE, f"an answer of {service}")
        return future.result()

    def during(self, seconds: float) -> None:
        """Publish values for this long (s); a pause of the machine counts for at most 0.1 s."""
        played = 0.0
        while played < seconds:
            began = time.monotonic()
            self.play()
            self.watcher.executor.spin_once(timeout_sec=0.05)
            played += min(time.monotonic() - began, 0.1)

    def be_dry(self) -> list[tuple[float, Any]]:
        """Simulate a dry roof and enough water, both levels moving, and return the commands."""
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
    """Return the newest value; None if there is none yet."""
    return values[-1][1] if values else None


FORECAST_HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"


def write_forecast(
    path: Path, ago: timedelta = timedelta(0), rain: float = 0.0, temperature: float = 15.0,
    *, hours: int = 12,
) -> None:
    """Write a file with one issue of some hours, in one step."""
    issued = datetime.now(UTC).replace(microsecond=0) - ago
    lines = [
        f"{issued.isoformat()},{(issued + timedelta(hours=hour)).isoformat()},{rain},"
        f"2.0,{temperature}"
        for hour in range(hours)
    ]
    draft = path.with_suffix(".new")
    draft.write_text("\n".join([FORECAST_HEADER, *lines, ""]))
    draft.replace(path)


# --- nodes inside the tests' process, in a separate domain ----------------------------------------


@contextmanager
def in_domain(domain: int) -> Iterator[None]:
    """Set the environment that nodes of this process need, and restore it afterwards."""
    before = dict(os.environ)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class Peer:
    """A foreign node that publishes and offers services."""

    def __init__(self, domain: int, name: str, namespace: str = "") -> None:
        self.context = rclpy.Context()
        prepare_ros()
        rclpy.init(
            args=[], context=self.context, domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node(name, namespace=namespace or None, context=self.context)

    def close(self) -> None:
        self.node.destroy_node()
        self.context.try_shutdown()
