"""Server of a running graph for Foxglove and Lichtblick over the Foxglove WebSocket protocol.

The server subscribes to a topic only while a viewer shows the topic, using the same kind of
subscription as the page. Even a slow viewer therefore does not delay any node (see
:mod:`greenroof_ros.watch.graph_client`). In a simulation, the time of a message is the latest
simulated time; otherwise, it is its time of arrival.
"""

from __future__ import annotations

import time

from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.processes import Signals
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.results.bag_write import read_definition
from greenroof_ros.watch.graph_client import CLOCK, GraphClient
from greenroof_ros.watch.listening import LOOPBACK, listen

# Interval at which new messages are passed on (s).
_POLL_S = 0.05


class FoxgloveServer:
    """A server of all topics of the interface on the loopback address.

    Attributes:
        url: address for a viewer.
    """

    def __init__(self, namespace: str, port: int) -> None:
        """Join the graph, and listen on the port.

        Args:
            namespace: namespace of the graph, such as ``/site1``; empty for none.
            port: TCP port; 0 for any free port.

        Raises:
            ConfigurationError: if the port cannot be used, or foxglove-sdk or ROS 2 is missing.
        """
        with require_extra("foxglove"):
            import foxglove
            from foxglove.websocket import Capability
        listen(LOOPBACK, port, key="--foxglove").socket.close()  # is it in use?

        self._client = GraphClient(namespace, self._on_message)
        self._channels = {
            name: foxglove.Channel(
                name if topic.absolute else namespace + name, message_encoding="cdr",
                schema=foxglove.Schema(
                    name=topic.type, encoding="ros2msg",
                    data=read_definition(topic.type).encode(),
                ),
            )
            for name, topic in read_topics().items()
        }
        self._server = foxglove.start_server(
            name=f"greenroof {namespace}".rstrip(), host=LOOPBACK, port=port,
            capabilities=[Capability.Time],
        )
        self.url = f"ws://{LOOPBACK}:{self._server.port}"

    def run(self, signals: Signals) -> None:
        """Pass messages on until a signal arrives.

        Raises:
            InterruptedRun: if a signal arrives.
        """
        try:
            while True:
                signals.check()
                shown = [name for name, channel in self._channels.items() if channel.has_sinks()]
                self._client.subscribe([CLOCK, *shown] if shown else ())
                time.sleep(_POLL_S)
                self._client.receive()
        finally:
            self._client.close()
            self._server.stop()

    def _on_message(self, name: str, message: bytes, time_ns: int) -> None:
        """Pass a message on, after its time, by which Lichtblick sorts the message."""
        self._server.broadcast_time(time_ns)
        self._channels[name].log(message, log_time=time_ns)
