"""Base class of the nodes of a simulated graph.

A node acts only when all its inputs have received their messages of the tick
(:mod:`greenroof_ros.ros.lockstep`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from rclpy.clock import Clock, ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.time import Time

from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.interface.states import FINISHED, PLANT, READY
from greenroof_ros.interface.topics import Qos, Topic, read_topics
from greenroof_ros.ros.diagnostics import NodeDiagnostics
from greenroof_ros.ros.errors import LockstepError
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.inputs import Input
from greenroof_ros.ros.lockstep import CLOCK, RUN, Lockstep
from greenroof_ros.ros.messages import decoder, pass_whole, qos_profile
from greenroof_ros.ros.parameters import USE_SIM_TIME, fix
from greenroof_ros.ros.publishers import Publishers
from greenroof_ros.ros.rclpy_internals import NoClockSubscription

# How often publishers are counted and the node's state is reported (s of wall time): counting takes
# at least a tenth of a millisecond.
_CHECK_S = 0.25


class SimulationNode(NoClockSubscription, GraphNode):
    """A node of a simulated graph.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, using their names
    in the interface. A subclass overrides :meth:`on_inputs` and, if necessary, the other ``on_``
    methods, ``progress`` and ``summary``.

    Attributes:
        lockstep: object that makes the node act.
        result: values that the node adds to the summary of the run; empty until the run is over.
    """

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: the node's name.
            role: the node's role in the interface: its name, or ``controller``.

        Raises:
            ConfigurationError: if the ROS arguments or a parameter file is invalid.
        """
        self._now_ns = 0  # 0: not set yet
        super().__init__(name, role, read_topics(), NodeDiagnostics)
        self.inputs: dict[str, Input] = {}
        fix(self, USE_SIM_TIME, True, "must be true: this node is part of a simulated graph")
        self.lockstep = Lockstep(self._act, self.finish, self.peers.publishers_of)
        self._clock_input: Input | None = None
        self.result: dict[str, Any] = {}
        self._checked = -math.inf
        if role != PLANT:
            decode = decoder(self.interface[RUN].type)
            self._open(RUN, lambda message: self.lockstep.join(decode(message)))

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act on the inputs, all of which have received their messages of the tick."""

    def summary(self) -> dict[str, Any]:
        """Return the values that the node adds to its report at the end of the run."""
        return {}

    # --- setting up -------------------------------------------------------------------------

    def set_time(self, time_ns: int) -> None:
        """Set the node's clock to a simulated time (ns since 1970)."""
        self._now_ns = time_ns

    def follow_clock(self) -> None:
        """Wait in every tick for its time, which then is the node's time."""
        self._clock_input = self.subscribe(CLOCK)

    def _act(self) -> None:
        if self._clock_input is not None:
            self._now_ns = self._clock_input.value
        self.on_inputs()

    @property
    def time_ns(self) -> int:
        """The simulated time (ns since 1970)."""
        return self._now_ns

    def get_clock(self) -> Clock:
        """Return the node's clock; only this method updates the clock, since few ticks use it."""
        clock = super().get_clock()
        if self._now_ns:
            now = Time(nanoseconds=self._now_ns, clock_type=ClockType.ROS_TIME)
            cast(ROSClock, clock).set_ros_time_override(now)
        return clock

    def subscribe(self, name: str) -> Input:
        """Open an input that the node waits for in every tick, and return it.

        Args:
            name: name of the topic in the interface.
        """
        entry = self._input(name)
        self._open(name, self.lockstep.receiver(entry))
        return entry

    def listen(self, name: str, callback: Callable[[Any], None]) -> None:
        """Open an input that the node does not wait for; every value is passed to a callback."""
        entry = self._input(name)

        def receive(message: bytes) -> None:
            entry.receive(message)
            callback(entry.value)

        self._open(name, receive)

    def record(self, name: str, callback: Callable[[bytes], None]) -> None:
        """Pass every serialised message of a topic of any type to a callback."""
        self._open(name, pass_whole(self._input(name).topic.type, callback))

    def _input(self, name: str) -> Input:
        topic = self.interface[name]
        publishers = Publishers(self, topic, _required(topic))
        self.peers.publishers[name] = publishers
        self.inputs[name] = Input(topic, publishers.full_name)
        return self.inputs[name]

    def _open(self, name: str, callback: Callable[[bytes], None]) -> None:
        topic = self.interface[name]
        self.open_subscription(topic, callback, qos_profile(_required(topic)))

    # --- running ----------------------------------------------------------------------------

    @property
    def tick(self) -> int:
        """The number of the node's next tick."""
        return self.lockstep.tick

    @property
    def finished(self) -> bool:
        """Whether the run is over for this node."""
        return self.reports.state == FINISHED

    def finish(self) -> None:
        """Set the state to finished, and report the state and the node's summary."""
        self._update_warnings(time.monotonic())
        self.result = self._final = self.summary()
        self.reports.state = FINISHED
        self.report_state()

    def check(self, now: float) -> None:
        """Check the conditions that depend on the steady clock, and report the node's state.

        Args:
            now: time on the steady clock (s).

        Raises:
            LockstepError: if the graph cannot continue.
            OccupiedError: if an input has a second publisher before the run.
            OSError: if the node cannot continue, for instance because the disk is full.
        """
        self.on_timer(now)
        if now - self._checked < _CHECK_S:
            return
        self._checked = now
        if not self.finished:
            if second := self.peers.describe_second():
                # Before the run this is a wrong set-up, later a failure.
                raise (LockstepError if self.acted else OccupiedError)(second)
            self._update_warnings(now)
            if not self.ready and not self.peers.absent():
                self.reports.state = READY
        self.report_state()

    def _update_warnings(self, now: float) -> None:
        """Warn about rejected values and, before the run, about incompatible publishers."""
        found = [] if self.acted else self.peers.warnings()
        for entry in self.inputs.values():
            if entry.refused:
                found.append(
                    f"rejected a value on {entry.name}: it {entry.topic.range.expected()}; the "
                    "node used 0 instead, and later rejections are counted but not logged"
                )
        self.warn([*self.warnings, *found])

    # --- ending -----------------------------------------------------------------------------

    @property
    def may_end(self) -> bool:
        """Whether the node may stop: its run is over, and its readers have all its messages.

        The plant stops first; until then, other nodes may still need the messages of this node.

        Raises:
            LockstepError: if the plant stopped before the run was over.
        """
        if not self.finished:
            if self.lockstep.run is not None and self._plant_ended():
                raise LockstepError("the plant has stopped, which ends the run")
            return False
        return self.all_arrived() and (self.role == PLANT or self._plant_ended())

    def _plant_ended(self) -> bool:
        clock = self.peers.publishers.get(CLOCK)
        return clock is not None and clock.count == 0

    def all_arrived(self) -> bool:
        """Return True if all subscribers have received all messages of the node."""
        now = Duration()
        return all(publisher.wait_for_all_acked(now) for publisher in self._outputs.values())

    def report_state(self, **values: Any) -> None:
        """Report the node's state together with the number N of the last tick."""
        run = self.lockstep.run
        super().report_state(run_length=None if run is None else round(run.last_tick), **values)


def _required(topic: Topic) -> Qos:
    """Return the required quality of service, without the liveliness lease in a simulation."""
    return replace(topic.qos, lease_s=math.inf)
