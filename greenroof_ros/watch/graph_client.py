"""A client of a graph, which receives selected topics and can hold the pump or the outlet valve.

The client can also release both, clear some faults, open the valve and, if the site allows it,
request a dose.

The client must not delay any node. It therefore subscribes with best-effort reliability and
volatile durability, so no publisher stores or resends messages for the client, or waits for it. The
client uses only UDP, since a stopped process that uses shared memory can hold a lock that other
processes need. It polls instead of being woken by messages.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

from greenroof_ros.base.errors import FailedError
from greenroof_ros.interface.states import PUMP, VALVE
from greenroof_ros.interface.topics import Qos, read_topics
from greenroof_ros.ros.domain import SHUTDOWN_S, join
from greenroof_ros.ros.reports import read_statuses

# How many messages on a topic can wait for the next poll: 1 s at 60 times real time.
_DEPTH = 64
# For how long after joining a client still discovers nodes that were there before (s), and the
# interval at which it looks for an answer (s).
_DISCOVERY_S, _SPIN_S = 2.0, 0.02

# Without /clock for this time (s), a graph is not simulated.
_NO_CLOCK_S = 10.0

DIAGNOSTICS, ALARMS, CLOCK = "/diagnostics", "/alarms", "/clock"
HOLDS = "stop", "close"
"""Actions that hold the pump off or the valve closed."""


def read_message(name: str, message: bytes) -> Any:
    """Return what a message of a topic contains; None if it is incomplete.

    Of /diagnostics and /alarms, this is the time (ns) and the statuses; of another topic, the
    value, and of rows of numbers also the numbers before the offset, as in
    :func:`greenroof_ros.ros.messages.decode_numbers`.
    """
    from greenroof_ros.ros.messages import decode_numbers, decoder  # only a graph needs ROS

    with suppress(Exception):  # from the middleware, or because a text is not UTF-8
        if name in (DIAGNOSTICS, ALARMS):
            return read_statuses(message)
        kind = read_topics()[name].type
        is_array = kind == "std_msgs/msg/Float64MultiArray"
        return decode_numbers(message) if is_array else decoder(kind)(message)
    return None


class RequestError(FailedError):
    """Error for a request that a node did not confirm; the message states the reason.

    Attributes:
        answered: whether every node that the request is for has answered, if only by a refusal.
    """

    def __init__(self, reason: str, *, answered: bool = False) -> None:
        super().__init__(reason)
        self.answered = answered


class GraphClient:
    """A client with two nodes in its own context: one to receive messages, one to make requests.

    One thread receives the messages. Any thread may make requests, but only one at a time.
    """

    def __init__(self, namespace: str, on_message: Callable[[str, bytes, int], None]) -> None:
        """Join the graph's domain, and subscribe to /diagnostics and /alarms.

        Args:
            namespace: namespace of the graph, such as ``/site1``; empty for none.
            on_message: callback for each message. It receives the name of the topic in the
                interface, the serialized message, and its time (ns since 1970): the simulated time
                if ``/clock`` is subscribed to and published, otherwise the time of arrival.

        Raises:
            ConfigurationError: if ROS 2 is not installed.
        """
        self._context = join()
        from rcl_interfaces.srv import SetParametersAtomically
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import Trigger

        def node(name: str) -> Node:
            return Node(
                f"{name}_{os.getpid()}", namespace=namespace or None, context=self._context,
                start_parameter_services=False, enable_rosout=False, use_global_arguments=False,
            )

        # A second node makes the calls, since an executor takes the messages of the node that it
        # spins.
        self._node, self._caller = node("watch"), node("watch_stop")
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._caller)
        self._types: dict[str, Any] = dict.fromkeys(("release", "clear", "reset"), Trigger)
        self._types |= dict.fromkeys(("hold", "dose", "open"), SetParametersAtomically)
        self._offers_hold = re.compile(re.escape(namespace) + "/[^/]+(?=/hold$)")
        self._joined_at = time.monotonic()
        self._clients: dict[tuple[str, str], Any] = {}  # by node and service
        self._on_message = on_message
        self._clock_ns, self._clock_at = 0, 0.0  # the simulated time, and when it came (s)
        self._subscriptions: dict[str, Any] = {}
        self.subscribe(())

    def subscribe(self, topics: Collection[str]) -> None:
        """Subscribe to /diagnostics, /alarms and the given topics of the interface only."""
        from greenroof_ros.ros.messages import message_class, qos_profile

        needed = {DIAGNOSTICS, ALARMS, *topics}
        for name in self._subscriptions.keys() - needed:
            self._node.destroy_subscription(self._subscriptions.pop(name))
        for name in needed - self._subscriptions.keys():
            topic = read_topics()[name]
            self._subscriptions[name] = self._node.create_subscription(
                message_class(topic.type), topic.graph_name, lambda message: None,
                qos_profile(Qos("best_effort", "volatile", _DEPTH)), raw=True,
            )

    def receive(self) -> None:
        """Pass on the messages that have arrived, in the order of their arrival."""
        from greenroof_ros.ros.messages import take_messages

        now = time.monotonic()
        self._clock_ns = self._clock_ns if now - self._clock_at < _NO_CLOCK_S else 0
        is_clocked = self._clock_ns or self._node.count_publishers(CLOCK[1:])
        simulated = CLOCK in self._subscriptions and is_clocked
        for arrived_ns, name, message in sorted(
            (info["received_timestamp"], name, message)
            for name, subscription in self._subscriptions.items()
            for message, info in islice(take_messages(subscription), _DEPTH)
        ):
            if name == CLOCK:
                time_ns = read_message(CLOCK, message)
                self._clock_ns, self._clock_at = time_ns or self._clock_ns, now
            if time_ns := self._clock_ns if simulated else arrived_ns:
                self._on_message(name, message, time_ns)

    def find_nodes(self, role: str = PUMP) -> dict[str, int]:
        """Return the names of the nodes that offer a hold service, with how many have this name.

        The names do not depend on any reports. A client is opened for each service, so that it is
        ready for a later stop.

        Args:
            role: ``pump``, or ``valve`` for the nodes that also offer to open.
        """
        services = dict(self._caller.get_service_names_and_types())
        nodes = {
            offered[0]: count
            for service, types in services.items()
            if "rcl_interfaces/srv/SetParametersAtomically" in types
            and (offered := self._offers_hold.match(service))
            and (f"{offered[0]}/open" in services) == (role == VALVE)
            and (count := self._caller.count_services(service))  # listed for this client alone: 0
        }
        for key in [key for key in self._clients if key[0] not in nodes]:
            self._caller.destroy_client(self._clients.pop(key))
        for name in nodes:
            self._open_client(name, "hold")
        return nodes

    def _open_client(self, name: str, service: str) -> Any:
        if (name, service) not in self._clients:
            self._clients[name, service] = self._caller.create_client(
                self._types[service], f"{name}/{service}"
            )
        return self._clients[name, service]

    def request(
        self, action: str, timeout_s: float, role: str = PUMP, **parameters: float | str
    ) -> str:
        """Make a request to the node of the pump or the valve, and return its answer.

        A stop is sent to every node that may control the pump. If more than one node may control
        the pump, no other request is sent to any of them. The same applies to the valve.

        Args:
            action: name of the action. ``stop`` holds the pump until someone releases it, or until
                a given time; so does ``close`` with the valve. ``release`` ends the hold,
                regardless of who requested it. ``clear`` clears a latched fault that may be cleared
                remotely. ``reset`` clears any fault, and is meant for a person at the device.
                ``dose`` delivers a volume. ``open`` opens the valve until a given time.
            timeout_s: maximum time to wait for the answer (s).
            role: role of the node: ``pump`` or ``valve``.
            parameters: parameters of the action. A stop has an ``owner`` (the person or program
                that requests it), a ``reason`` (may be empty) and, if it ends at a given time, this
                time as ``until`` (s since 1970). A dose has a ``volume`` (m3) and ``asked_at``, the
                time at which the user requested the dose (s since 1970). An opening has an
                ``owner`` and ``until``.

        Raises:
            RequestError: if the node does not confirm the request.
        """
        from rclpy.parameter import Parameter

        service = "hold" if action in HOLDS else action
        request = self._types[service].Request()
        if parameters:
            request.parameters = [
                Parameter(name, value=value).to_parameter_msg()
                for name, value in parameters.items()
            ]
        now = time.monotonic()
        until = now + timeout_s
        settled = min(until, self._joined_at + _DISCOVERY_S)
        sent: dict[str, Any] = {}
        nodes: dict[str, int] = {}

        def are_answered() -> bool:
            return bool(nodes) and all(name in sent and sent[name].done() for name in nodes)

        while now < until and (now < settled or not are_answered()):
            nodes = self.find_nodes(role)
            if service != "hold" and sum(nodes.values()) > 1:
                raise RequestError(
                    "Nothing was done, because it is unclear which of these nodes controls the "
                    f"{role}: {', '.join(sorted(nodes))}. Shut down the nodes that should not be "
                    "running."
                )
            for name in nodes.keys() - sent.keys():
                client = self._open_client(name, service)
                if client.service_is_ready() and (service == "hold" or now >= settled):
                    sent[name] = client.call_async(request)
            self._executor.spin_once(timeout_sec=_SPIN_S)
            now = time.monotonic()
        return _read_answers(role, service, timeout_s, nodes, sent)

    def close(self) -> None:
        """Leave the domain."""
        before = signal.alarm(SHUTDOWN_S)
        self._executor.shutdown(timeout_sec=1)
        self._node.destroy_node()
        self._caller.destroy_node()
        self._context.try_shutdown()
        signal.alarm(before)


def _read_answers(
    role: str, service: str, timeout_s: float, nodes: Mapping[str, int], sent: Mapping[str, Any]
) -> str:
    """Return the answers of all nodes as a sentence.

    Args:
        role: role of the nodes.
        service: name of the service.
        timeout_s: time spent waiting for the answers (s).
        nodes: names of the nodes, each with the number of nodes that have this name.
        sent: future of each request that was sent, by the name of the node.

    Raises:
        RequestError: if a node does not confirm the request.
    """
    if not nodes:
        raise RequestError(
            f"There is no {role} node to send the request to: no node provides the service "
            f"{service}. Start the {role} node's graph first, with the same ROS_DOMAIN_ID, "
            "ROS_AUTOMATIC_DISCOVERY_RANGE and --namespace."
        )
    sentences, confirmed, answered = [], True, True
    for name, count in sorted(nodes.items()):
        ok, text = False, (
            f"{name} did not answer within {timeout_s:g} s: it may or may not have carried out the "
            "request."
        )
        if has_answered := name in sent and sent[name].done():
            answer = sent[name].result()
            if hasattr(answer, "result"):  # of a request that sets parameters
                ok, text = answer.result.successful, answer.result.reason
            else:
                ok, text = answer.success, answer.message
        if count > 1:
            ok = has_answered = False
            text += "; two nodes have this name: shut down one, and try again"
        confirmed, answered = confirmed and ok, answered and has_answered
        sentences.append(f"{name}: {text}" if len(nodes) > 1 or count > 1 else text)
    if not confirmed:
        # A hold with this answer may be in force, but it would not survive a restart.
        raise RequestError("; ".join(sentences), answered=answered)
    return "; ".join(sentences)
