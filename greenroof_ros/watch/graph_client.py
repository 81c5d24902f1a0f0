"""A client of a graph: receives the topics it is given, and can hold the pump.

It can also release the pump, clear some faults and, if the site allows it, request a dose.

It must not delay any node. So it subscribes best effort and volatile: no publisher stores, repeats
or waits for anything for it. It uses only UDP: with shared memory, a stopped process can hold a
lock that others need. Messages do not wake it: it polls, and takes each message with its
publisher's sequence number, which rclpy's fast executor does not provide.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Collection
from itertools import islice
from typing import Any

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.domain import SHUTDOWN_S, join
from greenroof_ros.graph.rclpy_internals import waiting_messages

# How many messages of a topic can wait for the next poll: 1 s at 60 times real time.
_DEPTH = 64

DIAGNOSTICS = "/diagnostics"


class PumpRequestError(Exception):
    """The pump node did not confirm a request; the message states why.

    Attributes:
        answered: whether it answered at all.
    """

    def __init__(self, why: str, *, answered: bool = False) -> None:
        super().__init__(why)
        self.answered = answered


class GraphClient:
    """A separate node with a separate context, to be used by one thread."""

    def __init__(
        self, namespace: str, on_message: Callable[[str, bytes, int | None, int], None]
    ) -> None:
        """Join the graph's domain, and subscribe to /diagnostics.

        Args:
            namespace: the graph's namespace, such as ``/site1``; empty for none.
            on_message: called with the topic's name in the interface, the serialised message, its
                number (1 for its publisher's first; None if the middleware does not number) and
                its time of arrival (ns of the system clock).

        Raises:
            ConfigurationError: ROS 2 is not installed.
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

        # A second node makes the calls: an executor takes the messages of the node that it spins.
        self._node, self._caller = node("watch"), node("watch_stop")
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._caller)
        self._types: dict[str, Any] = {
            "stop": SetBool, "clear": Trigger, "reset": Trigger, "hold": SetParametersAtomically,
            "dose": SetParametersAtomically,
        }
        self._pump: str | None = None
        self._services: dict[str, Any] = {}
        self._on_message = on_message
        self._interface = read_topics()
        self._subscriptions: dict[str, Any] = {}
        self._wake = threading.Event()
        self.subscribe(())

    def subscribe(self, topics: Collection[str]) -> None:
        """Subscribe to these topics of the interface and /diagnostics, and to no others."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        from greenroof_ros.graph.messages import message_class

        needed = {DIAGNOSTICS, *topics}
        for name in self._subscriptions.keys() - needed:
            self._node.destroy_subscription(self._subscriptions.pop(name))
        for name in needed - self._subscriptions.keys():
            topic = self._interface[name]
            self._subscriptions[name] = self._node.create_subscription(
                message_class(topic.type), topic.graph_name, lambda message: None,
                QoSProfile(
                    depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT,
                    durability=DurabilityPolicy.VOLATILE,
                ),
                raw=True,
            )

    def receive(self, wait_s: float) -> None:
        """Wait, unless woken, and pass on all messages that have arrived; /diagnostics first."""
        self._wake.wait(wait_s)
        self._wake.clear()
        for name in sorted(self._subscriptions, key=lambda name: name != DIAGNOSTICS):
            subscription = self._subscriptions[name]
            for message, info in islice(waiting_messages(subscription), _DEPTH):
                number = info["publication_sequence_number"]
                self._on_message(name, message, number, info["received_timestamp"])

    def wake(self) -> None:
        """End the present wait, from another thread."""
        self._wake.set()

    def connect_pump(self, pump_node: str | None) -> None:
        """Open clients for the services of a pump node, so that a call finds them at once.

        Args:
            pump_node: its fully qualified name; None if there is none.
        """
        if self._pump == pump_node:
            return
        for client in self._services.values():
            self._caller.destroy_client(client)
        self._pump = pump_node
        self._services = {} if pump_node is None else {
            name: self._caller.create_client(kind, f"{pump_node}/{name}")
            for name, kind in self._types.items()
        }

    def hold_pump(
        self, owner: str, reason: str = "", until: float | None = None, timeout_s: float = 3.0
    ) -> str:
        """Hold the pump until someone releases it, or until a time.

        Args:
            owner: who requests it.
            reason: why; may be empty.
            until: its end (s since 1970); None if it has none.
            timeout_s: longest wait for the answer (s).

        Returns:
            The pump node's answer.

        Raises:
            PumpRequestError: the pump node did not confirm it.
        """
        end = {} if until is None else {"until": until}
        return self._set_parameters("hold", timeout_s, owner=owner, reason=reason, **end)

    def release_pump(self, timeout_s: float = 3.0) -> str:
        """End the hold, whoever made it; returns and raises likewise."""
        return self._request("stop", timeout_s, data=False)

    def clear_fault(self, timeout_s: float = 3.0) -> str:
        """Clear the latched fault if that may be done from afar; returns and raises likewise."""
        return self._request("clear", timeout_s)

    def reset_fault(self, timeout_s: float = 3.0) -> str:
        """Clear any latched fault, for a person at the pump; returns and raises likewise."""
        return self._request("reset", timeout_s)

    def request_dose(self, volume: float, requested_at: float, timeout_s: float = 3.0) -> str:
        """Request a dose.

        Args:
            volume: the dose (m3).
            requested_at: when the user requested it, by the system clock (s since 1970).
            timeout_s: longest wait for the answer (s).

        Returns:
            The pump node's answer.

        Raises:
            PumpRequestError: it was refused, or there was no answer.
        """
        return self._set_parameters("dose", timeout_s, volume=volume, asked_at=requested_at)

    def _set_parameters(self, service: str, timeout_s: float, **values: float | str) -> str:
        from rclpy.parameter import Parameter

        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        return self._request(service, timeout_s, parameters=parameters)

    def _request(self, service: str, timeout_s: float, **request: Any) -> str:
        if self._pump is None:
            raise PumpRequestError("There is no pump node that could be stopped from here.")
        name, client = self._pump, self._services[service]
        until = time.monotonic() + timeout_s
        while not client.service_is_ready():
            if time.monotonic() > until:
                raise PumpRequestError(
                    f"{name} does not answer: nothing provides its service {service}. Start its "
                    "graph first, in the same ROS_DOMAIN_ID and with the same "
                    "ROS_AUTOMATIC_DISCOVERY_RANGE and --namespace."
                )
            time.sleep(0.02)
        answer = client.call_async(self._types[service].Request(**request))
        self._executor.spin_until_future_complete(answer, max(0.0, until - time.monotonic()))
        if not answer.done():
            client.remove_pending_request(answer)
            raise PumpRequestError(
                f"{name} did not answer within {timeout_s:g} s: it may or may not have done that."
            )
        result = answer.result()
        if isinstance(result, self._types["dose"].Response):
            ok, message = result.result.successful, result.result.reason
        else:
            ok, message = result.success, result.message
        if not ok:
            # A hold with this answer may be in force, but would not survive a restart.
            raise PumpRequestError(str(message), answered=True)
        return str(message)

    def close(self) -> None:
        """Leave the domain."""
        before = signal.alarm(SHUTDOWN_S)
        self._executor.shutdown(timeout_sec=1)
        self._node.destroy_node()
        self._caller.destroy_node()
        self._context.try_shutdown()
        signal.alarm(before)
