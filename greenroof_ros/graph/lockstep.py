"""Lockstep over topics: a node acts once every input has arrived since it last acted.

What each node takes and publishes comes from ``msg_defs/topics.yaml``. There are no timers and no
sleeps on the way of a tick; the only clocks here are wall clocks that end a run which hangs.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration, Infinite
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import Qos, Topic, read_topics
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.reports import FINISHED, READY, REPORT_PIPE, STARTING

# A node that joins takes the last of what its peers said before; first it lets them finish.
_SILENCE_S = 0.5
# The name of a node is known a moment after its publisher; how long to wait for it (s).
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMING_S = 0.5
# How long a node listens at most before it looks at its clocks and signals again (s).
LISTEN_S = 0.05
# How long a node that ends waits for its readers (s): one that was killed stays matched.
_FLUSH_S = 1.0
# How often a node says how it is (s of wall time).
_REPORT_S = 0.25

DIAGNOSTICS = "/diagnostics"


class LockstepError(Exception):
    """The graph cannot go on; the message names the topic and the node."""


def message_class(topic: Topic) -> Any:
    """Return the Python class of a topic's messages."""
    package, _, name = topic.type.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def qos_profile(qos: Qos) -> QoSProfile:
    """Return a profile of the contract as rclpy takes it."""
    profile = QoSProfile(
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
        liveliness=LivelinessPolicy.AUTOMATIC,
    )
    if math.isfinite(qos.lease_s):
        profile.liveliness_lease_duration = Duration(seconds=qos.lease_s)
    return profile


@dataclass
class Input:
    """One topic that a node takes."""

    topic: Topic
    bit: int
    value: Any = 0.0
    good: bool = True
    publishers: int = 0
    refused: int = 0


class Link:
    """A node's place in the graph: its inputs, its outputs, and when it acts.

    Attributes:
        inputs: by topic name.
        sent: how many messages went out, by topic name.
        turn: called between messages, at least every 50 ms; returns how long the node may wait
            for the next message (s).
        stop: called once at the end, whatever the reason.
        progress: what the node adds to each of its reports.
        summary: what the node adds to its report at the end of the run.
        final_reports: the values of the reports of nodes that have finished, by node.
        error: why the node cannot go on.
        acted: whether the run has begun for the node; a second publisher is a wrong set-up before,
            and a failure of the run after.
    """

    def __init__(self, node: Node, role: str, act: Callable[[], None] = lambda: None) -> None:
        """Join the graph.

        Args:
            node: the rclpy node.
            role: its name in the contract.
            act: called when every input is fresh.
        """
        self.inputs: dict[str, Input] = {}
        self.sent: dict[str, int] = {}
        self.error: Exception | None = None
        self.acted = False
        self.turn: Callable[[], float] = lambda: LISTEN_S
        self.stop: Callable[[], None] = lambda: None
        self.progress: Callable[[], dict[str, Any]] = dict
        self.summary: Callable[[], dict[str, Any]] = dict
        self.final_reports: dict[str, dict[str, Any]] = {}
        self._node = node
        self._role = role
        self._act = act
        self._contract = read_topics()
        self._fresh = 0
        self._all = 0
        self._joining = True
        self._last_arrival = time.monotonic()
        self._publishers: dict[str, Any] = {}
        self._state = STARTING
        self._final_values: dict[str, Any] = {}
        self._reported = 0.0
        self._pipe: int | None = None
        if REPORT_PIPE in os.environ:
            self._pipe = int(os.environ[REPORT_PIPE])
            os.set_blocking(self._pipe, False)
        diagnostics = self._contract[DIAGNOSTICS]
        profile = qos_profile(diagnostics.qos)
        self._reporter = node.create_publisher(
            DiagnosticArray, diagnostics.relative_name, profile
        )
        node.create_subscription(
            DiagnosticArray, diagnostics.relative_name, self._on_report, profile
        )

    # --- setting up -------------------------------------------------------------------------

    def publish_topic(self, name: str) -> Callable[[Any], None]:
        """Open an output and return what publishes a message on it."""
        topic = self._contract[name]
        publisher = self._node.create_publisher(
            message_class(topic), topic.relative_name, qos_profile(topic.qos)
        )
        self._publishers[name] = publisher
        self.sent[name] = 0
        send = publisher.publish
        sent = self.sent

        def publish(message: Any) -> None:
            sent[name] += 1
            send(message)

        return publish

    def take_topic(
        self, name: str, callback: Callable[[Any], None] | None = None, *, raw: bool = False
    ) -> Input:
        """Open an input.

        Args:
            name: of the topic.
            callback: takes each message; without it the input is one of those that must be fresh
                before the node acts, and its value is checked against the contract's range.
            raw: whether the callback takes the serialised message.
        """
        topic = self._contract[name]
        entry = Input(topic, bit=0 if callback else 1 << len(self.inputs))
        self.inputs[name] = entry
        self._all |= entry.bit
        profile = qos_profile(topic.qos)
        watched = math.isfinite(topic.qos.lease_s) and not raw
        if watched:
            events = SubscriptionEventCallbacks(
                liveliness=self._guard(
                    lambda event: self._on_publishers(entry, event.alive_count, watched=True)
                )
            )
        else:
            # Each message of a watched topic sets a timer anew in its reader: only where a node
            # acts on it is that worth its cost.
            profile.liveliness_lease_duration = Infinite
            events = SubscriptionEventCallbacks(
                matched=self._guard(
                    lambda event: self._on_publishers(entry, event.current_count, watched=False)
                )
            )
        self._node.create_subscription(
            message_class(topic),
            topic.relative_name,
            self._guard(callback or self._fresh_input(entry)),
            profile,
            raw=raw,
            event_callbacks=events,
        )
        return entry

    def _fresh_input(self, entry: Input) -> Callable[[Any], None]:
        """Return what takes a message of an input, and acts when it was the last one missing."""
        read = self._reader(entry)

        def callback(message: Any) -> None:
            entry.value = read(message)
            if self._joining:
                self._fresh |= entry.bit
                self._last_arrival = time.monotonic()
                return
            if self._fresh & entry.bit:
                raise LockstepError(
                    f"{entry.topic.name} came twice in one tick; another publisher, or nodes of "
                    "an earlier run, are in this graph"
                )
            self._fresh |= entry.bit
            if self._fresh == self._all:
                self._fresh = 0
                self.acted = True
                self._act()

        return callback

    def _reader(self, entry: Input) -> Callable[[Any], Any]:
        """Return what takes the value out of a message, and refuses it if it is out of range."""
        low, high = entry.topic.low, entry.topic.high

        def clock(message: Any) -> int:
            stamp = message.clock
            return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)

        def many(message: Any) -> Any:
            values = message.data
            for value in values:
                if not low <= value <= high:  # neither is a NaN
                    return self._refuse(entry, value, [0.0] * len(values))
            entry.good = True
            return values

        def one(message: Any) -> float:
            value: float = message.data
            if not low <= value <= high:
                return float(self._refuse(entry, value, 0.0))
            entry.good = True
            return value

        if entry.topic.type.endswith("Clock"):
            return clock
        return many if entry.topic.type.endswith("MultiArray") else one

    def _refuse(self, entry: Input, value: float, instead: Any) -> Any:
        topic = entry.topic
        if not entry.refused:
            self._node.get_logger().error(
                f"refused {value!r} on {topic.name}: it must be from {topic.low:g} to "
                f"{topic.high:g} {topic.unit}; it acts as 0, and further ones are only counted"
            )
        entry.refused += 1
        entry.good = False
        return instead

    def _guard(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Keep an error for the node's loop: the executor would print it, and more, by itself."""

        def guarded(argument: Any) -> None:
            try:
                callback(argument)
            except (LockstepError, ConfigurationError, OSError) as error:
                self.error = self.error or error

        return guarded

    def _on_publishers(self, entry: Input, count: int, *, watched: bool) -> None:
        """Note how many publishers an input has, and refuse a second one.

        A killed process stays matched for 20 s; only on a watched topic is its death seen within
        2 s. So on the others two publishers of one name, a node and what it was before its
        restart, are let pass. (A third party under that name is met by its first message.)
        """
        entry.publishers = count
        if count <= 1:
            return
        topic = entry.topic
        until = time.monotonic() + _NAMING_S
        while True:
            found = self._node.get_publishers_info_by_topic(topic.relative_name)
            names = sorted({info.node_name for info in found})
            if _UNKNOWN not in names or time.monotonic() > until:
                break
            time.sleep(0.02)
        if watched or len(names) > 1:
            message = (
                f"{topic.name} has {count} publishers ({', '.join(names)}); a graph must have "
                "exactly one: end the other, or take another ROS_DOMAIN_ID"
            )
            raise LockstepError(message) if self.acted else ConfigurationError(message)

    # --- running ----------------------------------------------------------------------------

    def start_fresh(self) -> None:
        """Act on the first fresh inputs: for the plant, whom the others wait for."""
        self._joining = False

    @property
    def ready(self) -> bool:
        """Whether every input has its publisher."""
        return all(entry.publishers >= 1 for entry in self.inputs.values())

    @property
    def good(self) -> bool:
        """Whether no input's present value was refused."""
        return all(entry.good for entry in self.inputs.values())

    def absent(self) -> str:
        """Name the topics that nobody publishes, and who should."""
        return self._names(entry for entry in self.inputs.values() if entry.publishers == 0)

    def missing(self) -> str:
        """Name the topics that the node waits for, and who should publish them."""
        return self._names(
            entry
            for entry in self.inputs.values()
            if entry.bit and not self._fresh & entry.bit
        )

    def _names(self, entries: Iterable[Input]) -> str:
        return "; ".join(
            "{} from {}".format(
                entry.topic.name,
                " or ".join(name for name in entry.topic.publishers if name != self._role),
            )
            for entry in entries
        )

    def check(self) -> None:
        """Look at the wall clock: say how the node is, and act first once a joining node may."""
        now = time.monotonic()
        if self._state == STARTING and self.ready:
            self._state = READY
            self._report(now)
        elif now - self._reported > _REPORT_S:
            # Again and again, for a reader that joins late may miss what was said once.
            self._report(now)
        if (
            self._joining
            and self._all
            and self._fresh == self._all
            and now - self._last_arrival > _SILENCE_S
        ):
            self._joining = False
            self._fresh = 0
            self.acted = True
            self._act()

    def finish(self, **values: Any) -> None:
        """Say from now on that the run is over for this node, with what its summary needs."""
        self._state = FINISHED
        self._final_values = {"sent": dict(self.sent), "refused": self.refusals(), **values}
        self._report(time.monotonic())

    def refusals(self) -> dict[str, int]:
        """Return how many values were refused, by topic, where any was."""
        return {name: entry.refused for name, entry in self.inputs.items() if entry.refused}

    def _report(self, now: float) -> None:
        """Publish the node's state on /diagnostics; values are written as JSON."""
        self._reported = now
        values = {**self.progress(), **self._final_values}
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=self._role,
            message=self._state,
            values=[KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._reporter.publish(array)
        if self._pipe is not None:
            # A reader that is stopped must not stop the node: what does not fit is dropped, and
            # said again a moment later.
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                line = json.dumps({"state": self._state, **values})
                os.write(self._pipe, f"{line}\n".encode())

    def _on_report(self, array: DiagnosticArray) -> None:
        for node, state, values in read_reports(array):
            if state != FINISHED:
                continue
            self.final_reports[node] = values
            ended = node == "plant" and self._state != FINISHED
            if ended and self._role in ("weather", *CONTROLLERS):
                self.finish(**self.summary())

    def flush(self) -> None:
        """Wait until the readers have what was published, for at most a second."""
        until = time.monotonic() + _FLUSH_S
        for publisher in [*self._publishers.values(), self._reporter]:
            left = max(0.0, until - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))


def read_reports(array: DiagnosticArray) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield node, state and values of each of this package's states in a message."""
    for status in array.status:
        if status.message in (STARTING, READY, FINISHED):
            with contextlib.suppress(json.JSONDecodeError):
                values = {entry.key: json.loads(entry.value) for entry in status.values}
                yield status.name, status.message, values
