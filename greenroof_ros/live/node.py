"""Nodes of a live site, which act at ticks of the steady clock on the latest value of each input.

A live graph has no plant and no clock topic. A node does not wait for an input that is missing,
late or invalid. The rules of :mod:`greenroof_ros.live.pumping.input_rules` determine which inputs
are invalid, and the node acts accordingly.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NoReturn

from rclpy.executors import SingleThreadedExecutor

from greenroof_ros.base.times import boot_time, suspended_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import DriveState
from greenroof_ros.interface.topics import read_live_topics
from greenroof_ros.live.live_input import LIMITS, RECOVERY, LiveInput, LivePublishers, bad_inputs
from greenroof_ros.live.pumping.input_rules import AWAITED, InputRules, LevelRule
from greenroof_ros.live.upkeep import send_beat
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.messages import qos_profile
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.ros.spin import node_command, start_receiving
from greenroof_ros.site.site import Site

# Longest time after its start at which a node first acts (s).
_FIRST_S = 1.0
# Longest time for which a node waits for messages before it checks clocks and signals again (s).
_CHECK_S = 0.05


class LiveNode(GraphNode):
    """A node of a live site, which acts once per tau of the site even without its peers.

    The steady clock (CLOCK_BOOTTIME) keeps running while the computer is suspended, so inputs
    received before a suspension are too old.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, using their names
    in the interface. The subclass overrides :meth:`on_inputs` and, as needed, the other ``on_``
    methods and ``progress``.
    """

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: name of the node.
            role: role of the node in the interface: its name, or ``controller``.

        Raises:
            ConfigurationError: if the ROS arguments or a parameter file are invalid.
        """
        super().__init__(name, role, read_live_topics())
        self.inputs: dict[str, LiveInput] = {}
        self._period = self._due = math.inf  # without a site, the node only reacts
        self._awake_at = self._ignoring_until = boot_time()
        self._checked = -math.inf

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act at the end of a period; see :attr:`good`."""

    # --- setting up -------------------------------------------------------------------------

    def declare_site(self) -> Site:
        """Declare the parameter ``site_file``, and read the site; its tau is the node's period.

        Raises:
            ConfigurationError: if the file or a value in it is invalid.
        """
        site = super().declare_site()
        self._period = site.tau
        self._due = boot_time() + min(site.tau, _FIRST_S)
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
        publishers = LivePublishers(self, self.interface[name], optional=optional)
        rules = InputRules(
            boot_time(), self.get_parameter(limit).value, self.get_parameter(RECOVERY.name).value,
            topic=publishers.full_name, limit_name=limit, level=level,
        )
        self.inputs[name] = entry = LiveInput(publishers, rules)

        def receive(message: bytes) -> None:
            now = boot_time()
            self._handle_pause(now)
            if now >= self._ignoring_until:
                entry.receive(message)

        self.peers[name] = publishers
        profile = qos_profile(publishers.required)  # it requests no past messages
        self.open_subscription(publishers.topic, receive, profile, publishers.events())
        return entry

    # --- running ----------------------------------------------------------------------------

    @property
    def acted(self) -> bool:
        """Whether the node has acted or is acting; always true without a period."""
        return self.tick > 0 or math.isinf(self._period)

    @property
    def good(self) -> bool:
        """Whether all required inputs satisfy their rules."""
        return self._find_bad_input() is None

    def _find_bad_input(self) -> Diagnosis | None:
        self.check_inputs()
        return bad_inputs(each for each in self.inputs.values() if not each.publishers.optional)

    def check_inputs(self) -> None:
        """Check all inputs at the current time; after a pause of this process, all are too old."""
        self._handle_pause(boot_time())
        for entry in self.inputs.values():
            entry.check()

    @property
    def wait_s(self) -> float:
        """Maximum time for which the node may wait for the next message (s)."""
        return min(_CHECK_S, max(0.0, self._due - boot_time()))

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
        self._act_if_due()
        if now - self._checked >= _CHECK_S:  # asking ROS takes milliseconds: not for every message
            self._checked = now
            super().check(now)

    def _act_if_due(self) -> None:
        """Act if the period has passed; periods that were missed during a pause are skipped."""
        now = boot_time()
        self._handle_pause(now)
        if now < self._due:
            return
        self._due += (math.floor((now - self._due) / self._period) + 1) * self._period
        bad = self._find_bad_input()
        level = WARN if bad is not None and bad.code in AWAITED else ERROR
        self.reports.diagnose("inputs", bad, "all inputs are valid", level)
        self.tick += 1
        with self.deciding():
            self.on_inputs()

    @contextmanager
    def deciding(self) -> Iterator[None]:
        """Let a block take long without a pause, which would make all inputs too old.

        A suspension of the machine during the block is a pause.
        """
        before = suspended_time()
        try:
            yield
        finally:
            self._awake_at = boot_time() - (suspended_time() - before)

    def _handle_pause(self, now: float) -> None:
        """Clear all inputs if this process was paused.

        Messages that arrive shortly after the pause are ignored, since they may have been waiting.
        """
        passed, self._awake_at = now - self._awake_at, now
        if passed > PAUSE_S:
            self._ignoring_until = now + PAUSE_S
            for entry in self.inputs.values():
                entry.refuse(Diagnosis.of("input_paused", time=passed))

    def report_state(self, **values: Any) -> None:
        """Report the node's state, and send a heartbeat, since bringup must notice a hang soon."""
        super().report_state(**values)
        drive_state = self.reports.values.get("drive_state")
        send_beat(drive_state not in (None, DriveState.CONNECTING.value))


def spin(
    nodes: Sequence[Any], check: Callable[[], None],
    fail: Callable[[Any, Exception], None] | None = None,
) -> NoReturn:
    """Run the live nodes of this process until one fails or a check ends them.

    The function does not use rclpy's fast executor, which publisher events can lock up
    (rmw_fastrtps, pull request 890).

    Args:
        nodes: the nodes, which may become other nodes in the meantime.
        check: function that is called at least 20 times a second and may raise an exception.
        fail: function that removes a node that has failed; None to raise the error.
    """
    executor = SingleThreadedExecutor()
    while True:
        check()
        for node in tuple(nodes):
            try:
                if node not in executor.get_nodes():
                    node.on_start()
                    start_receiving(executor, node)
                node.check(time.monotonic())
            except Exception as error:  # whatever it is, it must not end the other nodes
                if fail is None:
                    raise
                executor.remove_node(node)
                fail(node, error)
        executor.spin_once(timeout_sec=min([_CHECK_S, *(node.wait_s for node in nodes)]))


live_command = partial(node_command, spin=spin)
