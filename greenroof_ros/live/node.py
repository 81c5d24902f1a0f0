"""Nodes of a live site, which act at ticks of the steady clock on the latest value of each input.

The module also contains the entry point of live nodes, and their help.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn

from rclpy.executors import SingleThreadedExecutor

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.interface.states import READY
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.engine import LIMITS, RECOVERY, SampleAndHold
from greenroof_ros.live.live_diagnostics import LiveDiagnostics
from greenroof_ros.live.live_input import LiveInput, LivePublishers
from greenroof_ros.live.live_topics import read_live_topics
from greenroof_ros.live.pumping.input_rules import InputRules, LevelRule
from greenroof_ros.live.valve import refuse_valve
from greenroof_ros.ros.executable import node_command
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.messages import pass_whole
from greenroof_ros.ros.parameters import USE_SIM_TIME, fix
from greenroof_ros.ros.peers import group_by_role
from greenroof_ros.ros.publishers import DISCOVERY_S
from greenroof_ros.ros.spin import start_receiving
from greenroof_ros.site.site import Site

# Longest time for which a node waits for messages before it checks clocks and signals again (s).
_CHECK_S = 0.05
# Interval at which a node reports its state to the supervisor (s), which kills a silent pump node
# after 2 s; on /diagnostics it reports once a second.
_REPORT_S = 0.25


class LiveNode(GraphNode):
    """A node of a live site.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, using their names
    in the interface. The subclass overrides :meth:`on_inputs` and, as needed, the other ``on_``
    methods and ``progress``.
    """

    reports: LiveDiagnostics

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: name of the node.
            role: role of the node in the interface: its name, or ``controller``.

        Raises:
            ConfigurationError: if the ROS arguments or a parameter file are invalid.
        """
        super().__init__(name, role, read_live_topics(), LiveDiagnostics)
        if self.get_parameter(USE_SIM_TIME).value:
            raise ConfigurationError(
                "must be false: a live site runs on the steady clock",
                key=f"parameter {USE_SIM_TIME} of {name}", value="true",
            )
        fix(self, USE_SIM_TIME, False, "must be false: this node is in a live graph")
        self._engine = SampleAndHold(self.on_inputs, self.reports)
        self._subscribed: list[LivePublishers] = []
        self._checked = self._reported = self._warned = -math.inf

    # --- to override ------------------------------------------------------------------------

    def on_start(self) -> None:
        """Start what the node needs; called once, when all nodes of the process have been made.

        Raises:
            ConfigurationError: if a library is missing.
        """

    def on_inputs(self) -> None:
        """Act at the end of a period; see :attr:`good`."""

    # --- setting up -------------------------------------------------------------------------

    def declare_site(self) -> Site:
        """Declare the parameter ``site_file``, and read the site; its tau is the node's period.

        Raises:
            ConfigurationError: if the file or a value in it is invalid, or the site's outlet has a
                valve.
        """
        site = super().declare_site()
        refuse_valve(site, Path(self.get_parameter("site_file").value))
        self._engine.set_period(site.tau)
        return site

    def subscribe(
        self, name: str, *, optional: bool = False, level: LevelRule | None = None
    ) -> LiveInput:
        """Open an input, and return it.

        Args:
            name: name of the topic in the interface.
            optional: whether the node acts without the input.
            level: additional rule for a level; None for any other input.
        """
        limit = LIMITS[name].name
        publishers = LivePublishers(self, self.interface[name])
        rules = InputRules(
            boot_time(), self.get_parameter(limit).value, self.get_parameter(RECOVERY.name).value,
            topic=publishers.full_name, limit_name=limit, level=level,
        )
        self.inputs[name] = entry = LiveInput(publishers, rules, optional=optional)
        self._open(publishers, self._engine.receiver(entry))
        return entry

    def record(self, name: str, callback: Callable[[bytes], None]) -> None:
        """Pass every serialised message on a topic of any type to a callback."""
        topic = self.interface[name]
        publishers = LivePublishers(self, topic, recorded=True)
        self._open(publishers, pass_whole(topic.type, callback))

    def _open(self, publishers: LivePublishers, callback: Callable[[bytes], None]) -> None:
        self._subscribed.append(publishers)
        self.open_subscription(
            publishers.topic, callback, publishers.profile(), publishers.events()
        )

    # --- running ----------------------------------------------------------------------------

    @property
    def acted(self) -> bool:
        """Whether the node has acted."""
        return self._engine.has_acted

    @property
    def good(self) -> bool:
        """Whether all required inputs satisfy their rules."""
        self._engine.check_inputs()
        return all(entry.good for entry in self._engine.required)

    def absent(self) -> dict[str, list[str]]:
        """Return the required inputs without a compatible publisher, keyed by the missing role."""
        topics = {name: entry.topic for name, entry in self.inputs.items()}
        return group_by_role(self.role, topics, [
            entry.topic.name for entry in self._engine.required if not entry.publishers.compatible
        ])

    @property
    def wait_s(self) -> float:
        """Maximum time for which the node may wait for the next message (s)."""
        return min(_CHECK_S, self._engine.due_in)

    def check(self, now: float) -> None:
        """Act if it is time to do so, run the other checks that depend on the clock, and report.

        Args:
            now: time of the steady clock (s).

        Raises:
            LockstepError: if the node cannot continue.
            ConfigurationError: if the set-up is invalid.
            OSError: if the node cannot continue, for instance because of a full disk.
        """
        if self.failure is not None:
            raise self.failure
        self._engine.check()
        if now - self._checked < _CHECK_S:  # asking ROS takes milliseconds: not for every message
            return
        self._checked = now
        self.on_timer(now)
        if now - self._warned >= DISCOVERY_S:
            self._warned = now
            self._warn(now)
        begins = not self.ready and self.acted and not self.absent()
        if begins:
            self.reports.state = READY
        if begins or self.reports.urgent or now - self._reported > _REPORT_S:
            self._reported = now
            self.report_state()

    def _warn(self, now: float) -> None:
        """Warn once about each publisher that does not respond, until that publisher is gone."""
        before = self.warnings
        self.warnings = [
            sentence for publishers in self._subscribed if (sentence := publishers.warning(now))
        ]
        for sentence in self.warnings:
            if sentence not in before:
                self.get_logger().warning(sentence)


def spin(nodes: Sequence[LiveNode], check: Callable[[], None]) -> NoReturn:
    """Run the live nodes of this process until one fails or a check ends them.

    The function does not use rclpy's fast executor, which publisher events can lock up
    (rmw_fastrtps, pull request 890).

    Args:
        nodes: the nodes.
        check: function that is called at least 20 times a second and may raise an exception.
    """
    executor = SingleThreadedExecutor()
    for node in nodes:
        node.on_start()
        start_receiving(executor, node)
    while True:
        check()
        executor.spin_once(timeout_sec=min(node.wait_s for node in nodes))
        for node in nodes:
            node.check(time.monotonic())


live_command = partial(node_command, spin=spin)
