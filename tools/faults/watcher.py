"""The campaign's own node: it hears a graph's reports, plays sensors, and is the intruder."""

from __future__ import annotations

import json
import os
import threading
import time
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from faults.cases import Sign
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.pumping.state_file import GUARD
from greenroof_ros.ros.domain import prepare_ros
from greenroof_ros.ros.messages import message_class, qos_profile


@contextmanager
def _transport() -> Iterator[None]:
    """Use the nodes' transport, and restore the environment for processes started later."""
    before = dict(os.environ)
    prepare_ros()
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


class Watcher:
    """A node in a thread of its own.

    Attributes:
        texts: reports of changed states, as text: the time, the status, its level and sentence.
        last: the newest of these texts, by status.
        codes: code of each status when it was last received; empty if all is well.
        signs: conditions that came up: the time, the status and the code.
        state: the actuator's state in a word, from its node.
    """

    def __init__(self, domain: int, name: str = "watcher", actuator: str = "pump") -> None:
        self.texts: list[tuple[float, str, str]] = []
        self.last: dict[str, str] = {}
        self.signs: list[tuple[float, Sign]] = []
        self.state, self._actuator = "", actuator
        self.codes: dict[str, str] = {}
        self._context = rclpy.Context()
        with _transport():
            rclpy.init(
                args=[], context=self._context, domain_id=domain,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self.node = Node(
                name, context=self._context, start_parameter_services=False, enable_rosout=False
            )
        self._topics = read_topics()
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        topic = self._topics["/diagnostics"]
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, qos_profile(topic.qos)
        )
        self._reset = self.node.create_client(Trigger, f"/{actuator}/reset")
        self._stops = {
            name: self.node.create_client(SetBool, f"/{name}/stop") for name in (actuator, GUARD)
        }
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._ended = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ended:
            # An intruder's publisher may go while the executor looks at it.
            with suppress(InvalidHandle):
                self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._ended = True
        self._thread.join(3)
        self.node.destroy_node()
        self._context.try_shutdown()

    def _on_diagnostics(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            self._receive(now, status)

    def _receive(self, now: float, status: Any) -> None:
        who, values = status.name.lstrip("/"), {entry.key: entry.value for entry in status.values}
        if ": " in who:  # a part of a node; values of the nodes themselves are JSON
            code = values.get("code", "")
            text = f"{('OK', 'WARN', 'ERROR', 'STALE')[status.level[0]]} {status.message}"
            if self.last.get(who) != text:
                self.last[who] = text
                self.texts.append((now, who, text))
        else:
            code = json.loads(values.get("code", '""'))
            if who == self._actuator:
                self.state = json.loads(values.get(f"{who}_state", '""'))
        if code and self.codes.get(who) != code:
            self.signs.append((now, (who, code)))
        self.codes[who] = code

    def publishers(self, topic: str) -> int:
        """Return how many publishers of a topic are known."""
        return self.node.count_publishers(topic)

    # --- publishing -----------------------------------------------------------------------------

    def publish(self, topic: str, value: float | Sequence[float] | str) -> None:
        """Publish on a topic of the interface, with its profile."""
        self.open(topic)
        message = message_class(self._topics[topic].type)()
        message.data = value if isinstance(value, (float, str)) else array("d", value)
        with self._lock:
            self._publishers[topic].publish(message)

    def publish_any(self, topic: str, value: Any) -> None:
        """Publish on a topic of any type; None for a message with default values."""
        if value is not None:
            self.publish(topic, value)
        elif self._topics[topic].type.endswith("DiagnosticArray"):
            status = DiagnosticStatus(
                name="/onoff", message="ready", hardware_id="none",
                values=[KeyValue(key="role", value="controller"), KeyValue(key="x", value="{")],
            )
            self._publishers[topic].publish(DiagnosticArray(status=[status]))
        else:
            self._publishers[topic].publish(message_class(self._topics[topic].type)())

    def open(self, topic: str) -> None:
        """Create a publisher of a topic, without publishing."""
        with self._lock:
            if topic not in self._publishers:
                described = self._topics[topic]
                self._publishers[topic] = self.node.create_publisher(
                    message_class(described.type), topic, qos_profile(described.qos)
                )

    def withdraw(self, topic: str) -> None:
        """Remove the publisher of a topic."""
        with self._lock:
            publisher = self._publishers.pop(topic, None)
            if publisher is not None:
                self.node.destroy_publisher(publisher)

    # --- services -------------------------------------------------------------------------------

    def reset(self, seconds: float = 5.0) -> str:
        """Call ~/reset of the actuator's node, and return its answer; empty if there was none."""
        return self._call(self._reset, Trigger.Request(), seconds)

    def stop(self, on: bool, seconds: float = 5.0, node: str = "") -> str:
        """Call ~/stop of the actuator's node, or of the guard of a user's own driver."""
        return self._call(self._stops[node or self._actuator], SetBool.Request(data=on), seconds)

    def open_until(self, until: float, seconds: float = 5.0) -> str:
        """Call ~/open of the valve's node: open it by hand until a time (s since 1970)."""
        client = self.node.create_client(SetParametersAtomically, "/valve/open")
        values = {"owner": "the campaign", "until": until}
        answer = self._answer(client, SetParametersAtomically.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]), seconds)
        self.node.destroy_client(client)
        return "" if answer is None else answer.result.reason or "answered"

    def set_parameter(self, node: str, name: str, values: Sequence[float | bool]) -> list[bool]:
        """Set a node's parameter to one value after another; return which it accepted."""
        client = self.node.create_client(SetParameters, f"/{node}/set_parameters")
        try:
            answer = self._answer(client, SetParameters.Request(parameters=[
                Parameter(name, value=value).to_parameter_msg() for value in values
            ]), 20.0)
        finally:
            self.node.destroy_client(client)
        return [] if answer is None else [result.successful for result in answer.results]

    def _call(self, client: Any, request: Any, seconds: float) -> str:
        """Return the message of an answer; empty if there was no answer."""
        answer = self._answer(client, request, seconds)
        return "" if answer is None else answer.message or "answered"

    def _answer(self, client: Any, request: Any, seconds: float) -> Any:
        """Return a service's answer; None if it does not come in time."""
        until = time.monotonic() + seconds
        while not client.service_is_ready():
            if time.monotonic() > until:
                return None
            time.sleep(0.05)
        answer = client.call_async(request)
        while not answer.done():
            if time.monotonic() > until:
                return None
            time.sleep(0.02)
        return answer.result()
