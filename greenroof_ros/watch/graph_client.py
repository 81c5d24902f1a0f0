"""A client of a graph, which receives selected topics and can hold the pump.

The client can also release the pump, clear some faults and, if the site allows it, request a dose.

The client must not delay any node. It therefore subscribes with best-effort reliability and
volatile durability, so no publisher stores or resends messages for the client, or waits for it. The
client uses only UDP, since a stopped process that uses shared memory can hold a lock that other
processes need. It polls instead of being woken by messages, and takes each message together with
the publisher's sequence number, which rclpy's fast executor does not provide.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Collection, Mapping
from itertools import islice
from typing import Any

from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.domain import SHUTDOWN_S, join
from greenroof_ros.ros.rclpy_internals import take_messages
from greenroof_ros.watch.words import list_names

# How many messages on a topic can wait for the next poll: 1 s at 60 times real time.
_DEPTH = 64
# For how long after joining a client still discovers nodes that were there before (s), and the
# interval at which it looks for an answer (s).
_DISCOVERY_S, _SPIN_S = 2.0, 0.02

DIAGNOSTICS, ALARMS = "/diagnostics", "/alarms"
# The service of the pump node for each action.
_SERVICES = {
    "stop": "hold", "release": "stop", "clear": "clear", "reset": "reset", "dose": "dose",
}


class PumpRequestError(Exception):
    """Error for a request that the pump node did not confirm; the message states the reason.

    Attributes:
        answered: whether the pump node replied at all.
    """

    def __init__(self, why: str, *, answered: bool = False) -> None:
        super().__init__(why)
        self.answered = answered


class GraphClient:
    """A client with two nodes in its own context: one to receive messages, one to make requests.

    One thread receives the messages. Any thread may make requests, but only one at a time.
    """

    def __init__(
        self, namespace: str, on_message: Callable[[str, bytes, int | None, int], None]
    ) -> None:
        """Join the graph's domain, and subscribe to /diagnostics and /alarms.

        Args:
            namespace: namespace of the graph, such as ``/site1``; empty for none.
            on_message: callback for each message. It receives the name of the topic in the
                interface, the serialized message, the number of the message (1 for the first of its
                publisher; None if the middleware does not number messages) and the time of arrival
                (ns of the system clock).

        Raises:
            ConfigurationError: if ROS 2 is not installed.
        """
        self._context = join()
        from rcl_interfaces.srv import SetParametersAtomically
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from std_srvs.srv import SetBool, Trigger

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
        self._types: dict[str, Any] = {
            "stop": SetBool, "clear": Trigger, "reset": Trigger, "hold": SetParametersAtomically,
            "dose": SetParametersAtomically,
        }
        self._namespace, self._joined_at = namespace, time.monotonic()
        self._clients: dict[tuple[str, str], Any] = {}  # by node and service
        self._on_message = on_message
        self._subscriptions: dict[str, Any] = {}
        self.subscribe(())

    def subscribe(self, topics: Collection[str]) -> None:
        """Subscribe to /diagnostics, /alarms and the given topics of the interface only."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        from greenroof_ros.ros.messages import message_class

        needed = {DIAGNOSTICS, ALARMS, *topics}
        for name in self._subscriptions.keys() - needed:
            self._node.destroy_subscription(self._subscriptions.pop(name))
        for name in needed - self._subscriptions.keys():
            topic = read_topics()[name]
            self._subscriptions[name] = self._node.create_subscription(
                message_class(topic.type), topic.graph_name, lambda message: None,
                QoSProfile(
                    depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT,
                    durability=DurabilityPolicy.VOLATILE,
                ),
                raw=True,
            )

    def receive(self) -> None:
        """Pass on the messages that have arrived, starting with the reports."""
        for name in sorted(self._subscriptions, key=lambda name: name != DIAGNOSTICS):
            subscription = self._subscriptions[name]
            for message, info in islice(take_messages(subscription), _DEPTH):
                number = info["publication_sequence_number"]
                self._on_message(name, message, number, info["received_timestamp"])

    def find_pumps(self) -> dict[str, int]:
        """Return the names of the nodes that offer a hold service, with how many have this name.

        The names do not depend on any reports. A client is opened for each service, so that it is
        ready for a later stop.
        """
        pattern = re.compile(re.escape(self._namespace) + "(/[^/]+)/hold")
        pumps = {
            self._namespace + offered[1]: count
            for service, types in self._caller.get_service_names_and_types()
            if "rcl_interfaces/srv/SetParametersAtomically" in types
            and (offered := pattern.fullmatch(service))
            and (count := self._caller.count_services(service))  # listed for this client alone: 0
        }
        for key in [key for key in self._clients if key[0] not in pumps]:
            self._caller.destroy_client(self._clients.pop(key))
        for name in pumps:
            self._open_client(name, "hold")
        return pumps

    def _open_client(self, name: str, service: str) -> Any:
        if (name, service) not in self._clients:
            self._clients[name, service] = self._caller.create_client(
                self._types[service], f"{name}/{service}"
            )
        return self._clients[name, service]

    def request(self, action: str, timeout_s: float, **parameters: float | str) -> str:
        """Make a request to the pump node, and return its answer.

        A stop is sent to every node that may control the pump. If more than one node may control
        the pump, no other request is sent to any of them. If two nodes have the same name, an
        answer from one node reveals nothing about the other, so the request is repeated once only
        one of the two nodes is left.

        Args:
            action: name of the action. ``stop`` holds the pump until someone releases it, or until
                a given time. ``release`` ends the hold, regardless of who requested it. ``clear``
                clears a latched fault that may be cleared remotely. ``reset`` clears any fault, and
                is meant for a person at the pump. ``dose`` delivers a volume.
            timeout_s: maximum time to wait for the answer (s).
            parameters: parameters of the action. A stop has an ``owner`` (the person or program
                that requests it), a ``reason`` (may be empty) and, if it ends at a given time, this
                time as ``until`` (s since 1970). A dose has a ``volume`` (m3) and ``asked_at``, the
                time at which the user requested the dose (s since 1970).

        Raises:
            PumpRequestError: if the pump node does not confirm the request.
        """
        service = _SERVICES[action]
        request = self._types[service].Request(**(
            {"data": False} if action == "release" else _make_parameters(parameters)
        ))
        until = time.monotonic() + timeout_s
        settled = min(until, self._joined_at + _DISCOVERY_S)
        sent: dict[str, Any] = {}
        twins, waiting = set[str](), True
        while waiting:
            pumps = self.find_pumps()
            before, twins = twins, {name for name, count in pumps.items() if count > 1}
            for name in before - twins:
                sent.pop(name, None)
            if sum(pumps.values()) > 1 and action != "stop":
                raise PumpRequestError(
                    "Nothing was done, because it is unclear which of these nodes controls the "
                    f"pump: {list_names(pumps)}. Shut down the nodes that should not be running."
                )
            for name in pumps.keys() - sent.keys():
                client = self._open_client(name, service)
                if client.service_is_ready():
                    sent[name] = client.call_async(request)
            self._executor.spin_once(timeout_sec=_SPIN_S)
            now = time.monotonic()
            answered = pumps.keys() <= sent.keys() and all(map(_is_done, sent.values()))
            waiting = now < until and (now < settled or bool(twins) or not sent or not answered)
        for name, future in sent.items():
            if not future.done() and name in pumps:
                self._clients[name, service].remove_pending_request(future)
        return _read_answers(service, timeout_s, {
            name: (sent.get(name), name in twins) for name in sorted(pumps)
        })

    def close(self) -> None:
        """Leave the domain."""
        before = signal.alarm(SHUTDOWN_S)
        self._executor.shutdown(timeout_sec=1)
        self._node.destroy_node()
        self._caller.destroy_node()
        self._context.try_shutdown()
        signal.alarm(before)


def _is_done(future: Any) -> bool:
    return bool(future.done())


def _make_parameters(values: Mapping[str, float | str]) -> dict[str, Any]:
    """Return the fields of a request with the given parameters; empty if there are none."""
    from rclpy.parameter import Parameter

    return {"parameters": [
        Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
    ]} if values else {}


def _read_answers(
    service: str, timeout_s: float, asked: Mapping[str, tuple[Any, bool]]
) -> str:
    """Return the answers of all nodes as a sentence.

    Args:
        service: name of the service.
        timeout_s: time spent waiting for the answers (s).
        asked: by the name of each node, the future for its answer (None if it could not be
            reached), and whether another node has the same name.

    Raises:
        PumpRequestError: if a node does not confirm the request.
    """
    if not asked:
        raise PumpRequestError(
            "There is no pump node to send the request to: no node provides the service "
            f"{service}. Start the pump node's graph first, with the same ROS_DOMAIN_ID, "
            "ROS_AUTOMATIC_DISCOVERY_RANGE and --namespace."
        )
    sentences, confirmed = [], True
    for name, (future, has_twin) in asked.items():
        ok, text = _read_answer(name, future, timeout_s)
        if has_twin:
            ok, text = False, (
                f"two nodes are named {name}, and one of them may not have carried out the request "
                f"({text}): shut down the node that should not be running, and try again"
            )
        confirmed = confirmed and ok
        sentences.append(f"{name}: {text}" if len(asked) > 1 else text)
    if not confirmed:
        # A hold with this answer may be in force, but it would not survive a restart.
        answered = any(future is not None and future.done() for future, _ in asked.values())
        raise PumpRequestError("; ".join(sentences), answered=answered)
    return "; ".join(sentences)


def _read_answer(name: str, future: Any, timeout_s: float) -> tuple[bool, str]:
    """Return whether a node carried out the request, and its answer; see :func:`_read_answers`."""
    if future is None:
        return False, f"{name} could not be reached within {timeout_s:g} s."
    if not future.done():
        return False, (
            f"{name} did not answer within {timeout_s:g} s: it may or may not have carried out "
            "the request."
        )
    result = future.result()
    if hasattr(result, "result"):  # of a request that sets parameters
        return bool(result.result.successful), str(result.result.reason)
    return bool(result.success), str(result.message)
