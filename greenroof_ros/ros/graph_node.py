"""Base class of the nodes, which use the topics of the interface and report their state.

``msg_defs/topics.yaml`` defines the topics that every node publishes and subscribes to.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from greenroof_ros.base.errors import ConfigurationError, MalformedMessageError
from greenroof_ros.base.files import as_started
from greenroof_ros.interface.states import ENDED, FINISHED, READY, STARTING
from greenroof_ros.interface.topics import Qos, Topic
from greenroof_ros.ros.diagnostics import NodeDiagnostics
from greenroof_ros.ros.messages import (
    Input,
    encoder,
    find_lacking,
    message_class,
    qos_profile,
    raw_publish,
)
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

# The longest time for which an ending node waits for its readers (s): a killed reader stays
# matched.
_FLUSH_S = 1.0
# How often a node looks for its peers and reports its state (s): counting publishers takes at least
# a tenth of a millisecond, and bringup kills a silent pump node after 2 s.
_REPORT_S = 0.25


class Publishers:
    """The publishers of a topic, including superfluous and incompatible ones.

    All publishers that ROS knows of are counted. ROS is polled for the publishers, because a
    middleware event can lock up rclpy's fast executor when the liveliness of a peer changes
    (rmw_fastrtps, pull request 890). ROS knows about a publisher before its first message arrives.

    Attributes:
        topic: the topic in the interface.
        full_name: the topic's full name in ROS, with its namespace.
        required: the quality of service that a publisher must offer to be compatible.
        optional: whether the subscribing node acts without the topic.
    """

    optional = False

    def __init__(self, node: Node, topic: Topic, required: Qos) -> None:
        """Create an object for the publishers that a subscription receives messages from.

        Args:
            node: the subscribing node.
            topic: the topic in the interface.
            required: the quality of service of the subscription.
        """
        self.topic = topic
        self.full_name: str = node.resolve_topic_name(topic.graph_name)
        self.required = required
        self._node = node

    @property
    def count(self) -> int:
        """The number of publishers."""
        return self._node.count_publishers(self.full_name)

    @property
    def compatible(self) -> int:
        """The number of publishers that have a compatible quality of service."""
        return len(self._endpoints()) - len(self._incompatible())

    def names(self) -> list[str]:
        """Return the names of the publishers' nodes."""
        return sorted({name_owner(info) for info in self._endpoints()})

    def describe_conflict(self) -> str:
        """Return a predicate that reports an incompatible or a second publisher, or ""."""
        if incompatible := self._incompatible():
            info, lacking = incompatible[0]
            return (
                f"has a publisher with an incompatible QoS ({name_owner(info)}): it must have "
                f"{lacking}; change its QoS, or stop it"
            )
        count = self.count
        if count < 2 or len(self._endpoints()) < 2:
            return ""
        return (
            f"has {count} publishers ({', '.join(self.names())}), but must have only one: stop the "
            "other publisher, or use another ROS_DOMAIN_ID or --namespace"
        )

    def _endpoints(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _incompatible(self) -> list[tuple[Any, str]]:
        """Return the publishers that ROS does not connect to the subscription, and why."""
        return [
            (info, lacking) for info in self._endpoints()
            if (lacking := find_lacking(info.qos_profile, self.required))
        ]


def name_owner(info: Any) -> str:
    """Return the name of an endpoint's node.

    A node that joins the graph just before another node is killed may discover the topics of the
    killed node, but never its name.
    """
    return str(info.node_name).replace("_NODE_NAME_UNKNOWN_", "a node whose name is unknown")


class GraphNode(Node):
    """A node that uses topics of the interface and reports its state; subclasses add the actions.

    Attributes:
        role: the node's role in the interface: its name, or ``controller``.
        failure: the error that prevents the node from continuing; None if there is none.
        inputs: the topics that the node acts on, keyed by their names in the interface.
        interface: all topics of the graph, by name.
        peers: the publishers of every topic that the node receives, by its name in the interface.
        reports: object that reports the node's state.
        tick: number of the node's next tick.
    """

    def __init__(self, name: str, role: str, interface: Mapping[str, Topic]) -> None:
        """Join the graph.

        Args:
            name: the node's name.
            role: the node's role in the interface: its name, or ``controller``.
            interface: all topics of the graph, by name.

        Raises:
            ConfigurationError: if the ROS arguments or a parameter file is invalid.
        """
        try:
            super().__init__(name)
        except RuntimeError as error:  # from rcl
            raise ConfigurationError(" ".join(str(error).split())) from error
        self.role = role
        self.failure: Exception | None = None
        self.interface = interface
        self.inputs: Mapping[str, Input] = {}
        self.peers: dict[str, Publishers] = {}
        self.tick = 0
        self.reports = NodeDiagnostics(self, role)
        self._reported = 0.0
        # Every topic's publisher, its method to publish, and the encoder of its messages.
        self._outputs: dict[str, tuple[Publisher, Any, Any]] = {}
        # What every report contains, and what is added at the end.
        self._always: dict[str, Any] = {}

    # --- to override ------------------------------------------------------------------------

    def on_start(self) -> None:
        """Start what the node needs; called once at a live site, when its process has all nodes.

        Raises:
            ConfigurationError: if a library is missing.
        """

    def on_timer(self, now: float) -> None:
        """Perform the actions that depend on the steady clock; called 20 times a second."""

    def on_stop(self) -> None:
        """Close open files and connections; called once when the node stops for any reason."""

    def progress(self) -> dict[str, Any]:
        """Return the values that the node adds to each of its reports."""
        return {}

    # --- topics -----------------------------------------------------------------------------

    def declare_site(self) -> Site:
        """Declare the parameter ``site_file``, and read the site.

        From then on, every report includes the absolute path of the file as ``site``, so that
        observers can read the same site file.

        Raises:
            ConfigurationError: if the file cannot be read, or if a value in it is invalid.
        """
        file = Path(declare(self, [site_file()])["site_file"])
        self._always["site"] = str(as_started(file).resolve())
        return read_site(file)

    def open_outputs(self, *names: str) -> None:
        """Create publishers for topics of the interface, to be used by :meth:`publish`."""
        for name in names:
            topic = self.interface[name]
            publisher = self.create_publisher(
                message_class(topic.type), topic.graph_name, qos_profile(topic.qos),
                event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            )
            encode = encoder(topic.type, topic.dimensions)
            self._outputs[name] = publisher, raw_publish(publisher), encode

    def publish(self, name: str, value: Any) -> None:
        """Publish a value on a topic whose publisher :meth:`open_outputs` has created."""
        _, publish, encode = self._outputs[name]
        publish(encode(value))

    def open_subscription(
        self, topic: Topic, callback: Callable[[bytes], None], profile: QoSProfile,
        events: SubscriptionEventCallbacks | None = None,
    ) -> None:
        """Pass every serialised message of a topic to a callback, and store an error raised by it.

        A malformed message is dropped, since any program may publish on the topic, and so are all
        messages after an error: if each of them failed again, the executor might never return.
        """

        def guarded(message: bytes) -> None:
            """Store an error until the run ends; the executor would print it with a traceback."""
            if self.failure is not None:
                return
            try:
                with suppress(MalformedMessageError):
                    callback(message)
            except Exception as error:
                self.fail(error)

        self.create_subscription(
            message_class(topic.type), topic.graph_name, guarded, profile, raw=True,
            event_callbacks=events or SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], **options: Any
    ) -> Any:
        """Create a service that survives every request, as those of rclpy for parameters do not.

        A request that fails gets the response that was prepared for it.
        """

        def guarded(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self.get_logger().error(f"{srv_name}: a request failed: {error}")
                return response

        return super().create_service(srv_type, srv_name, guarded, **options)

    # --- running ----------------------------------------------------------------------------

    def fail(self, error: Exception) -> None:
        """Store the error that ends the run, unless an earlier error is stored."""
        self.failure = self.failure or error

    @property
    def acted(self) -> bool:
        """Whether the node has acted, or is acting for the first time."""
        return self.tick > 0

    @property
    def time_ns(self) -> int:
        """The time (ns since 1970): in a live graph the system's, whatever ``use_sim_time`` is."""
        return time.time_ns()

    @property
    def good(self) -> bool:
        """Whether the node may act on all inputs that it requires."""
        return all(entry.good for entry in self.inputs.values())

    @property
    def refused(self) -> dict[str, int]:
        """The number of refused values by topic, without topics that have none."""
        return {name: entry.refused for name, entry in self.inputs.items() if entry.refused}

    @property
    def ready(self) -> bool:
        """Whether every input has had a publisher."""
        return self.reports.state != STARTING

    @property
    def finished(self) -> bool:
        """Whether the run is over for this node; never so in a live graph."""
        return self.reports.state == FINISHED

    def check(self, now: float) -> None:
        """Check the conditions that depend on the steady clock, and report the node's state.

        Args:
            now: time on the steady clock (s).
        """
        self.on_timer(now)
        if now - self._reported < _REPORT_S and not self.reports.urgent:
            return
        self._reported = now
        self.check_peers()
        if not self.ready and self.acted and not self.absent():
            self.reports.state = READY
        self.report_state()

    def check_peers(self) -> None:
        """Check the publishers of the inputs; called four times a second."""

    def absent(self) -> dict[str, list[str]]:
        """Return the required inputs without a compatible publisher; see :meth:`by_role`."""
        return self.by_role(
            name for name, peer in self.peers.items() if not (peer.optional or peer.compatible)
        )

    def by_role(self, names: Iterable[str]) -> dict[str, list[str]]:
        """Return the full names of inputs, by the role that should publish them.

        If the interface names two roles for an input, the last one is meant: the flow of a pump
        that the plant does not simulate is missing from the pump driver.
        """
        roles: dict[str, list[str]] = {}
        for peer in map(self.peers.__getitem__, names):
            roles.setdefault(peer.topic.publishers[-1], []).append(peer.full_name)
        return roles

    # --- ending -----------------------------------------------------------------------------

    def note_failure(self, failure: str | None) -> None:
        """Add the error that stops the node, if there is one, to all later reports."""
        if failure is not None:
            self._always["failure"] = failure

    def end(self, failure: str | None) -> None:
        """Report that the node is stopping, and wait up to 1 s for readers to receive all messages.

        Args:
            failure: the error that stopped the node; None if there was none.
        """
        self.reports.state = ENDED
        self.note_failure(failure)
        self.report_state()
        until = time.monotonic() + _FLUSH_S
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))

    def report_state(self, **values: Any) -> None:
        """Report the node's state together with the given values."""
        self.reports.publish({
            **values, **self.progress(),
            **({} if self.ready else {"waiting": list(self.absent())}),
            "refused": self.refused, **self._always,
        })
