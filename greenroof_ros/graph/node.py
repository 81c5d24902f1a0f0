"""A node of a simulated graph: its topics, its reports, and when it acts.

``msg_defs/topics.yaml`` defines what each node publishes and subscribes to. A node acts when every
input is fresh (:mod:`greenroof_ros.graph.lockstep`), and on no other event.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.time import Time

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.interface import Qos, Topic, read_topics
from greenroof_ros.graph.inputs import Input, accepted
from greenroof_ros.graph.lockstep import CLOCK, RUN, Lockstep
from greenroof_ros.graph.messages import LockstepError, decoder, encoder, message_class, qos_profile
from greenroof_ros.graph.parameters import declare, site_file
from greenroof_ros.graph.publishers import DISCOVERY_S, Publishers
from greenroof_ros.graph.rclpy_internals import NoClockSubscription
from greenroof_ros.graph.reports import Reports
from greenroof_ros.graph.states import ENDED, FINISHED, PLANT, READY, ROLES, STARTING
from greenroof_ros.model.site import Site, read_site

# How often publishers are counted and the node's state is reported (s of wall time): counting takes
# at least a tenth of a millisecond.
_CHECK_S = 0.25
# How long an ending node waits for its readers at most (s): a killed reader stays matched.
_FLUSH_S = 1.0


class SimulationNode(NoClockSubscription, Node):
    """A node of a simulated graph.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, by their names in
    the interface. It overrides :meth:`on_inputs` and, as needed, the other ``on_`` methods,
    ``progress`` and ``summary``.

    Attributes:
        role: its role in the interface: its name, or ``controller``.
        lockstep: makes the node act.
        failure: the error after which the node cannot go on; None if there is none.
        on_failure: called when there is such an error.
        inputs: the topics that it subscribes to, by name in the interface.
        interface: every topic of the graph, by name.
        reports: reports the node's state.
        warnings: what is wrong with its inputs, in sentences: publishers that cannot be heard, and
            the first refused value of each topic.
    """

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: the node's name.
            role: its role in the interface: its name, or ``controller``.

        Raises:
            ConfigurationError: ROS arguments or a parameter file are wrong.
        """
        try:
            super().__init__(name)
        except RuntimeError as error:  # from rcl
            raise ConfigurationError(" ".join(str(error).split())) from error
        self.role = role
        self._use_simulated_time()
        self.failure: Exception | None = None
        self.on_failure: Callable[[], None] = lambda: None
        self.interface = read_topics()
        self.inputs: dict[str, Input] = {}
        self.warnings: list[str] = []
        self.lockstep = Lockstep(self.on_inputs, self.finish)
        self.reports = Reports(self, role)
        self._waits_for: list[Publishers] = []
        self._tolerated: set[str] = set()  # topics whose second publisher the node handles
        self._unheard_since: dict[str, float] = {}
        # Each topic's publisher, and the encoder of its messages.
        self._outputs: dict[str, tuple[Publisher, Callable[[Any], bytes]]] = {}
        self._checked = -math.inf
        self._final: dict[str, Any] = {}
        self._site_file: dict[str, str] = {}
        self._ros_clock = cast(ROSClock, self.get_clock())
        if role != PLANT:
            decode = decoder(self.interface[RUN].type)
            self._open(self.interface[RUN], lambda message: self.lockstep.join(decode(message)))

    def _use_simulated_time(self) -> None:
        """Set ``use_sim_time``, and refuse every later change."""
        self.set_parameters([Parameter("use_sim_time", Parameter.Type.BOOL, True)])

        def refuse_change(changes: list[Parameter]) -> SetParametersResult:
            changed = any(
                change.name == "use_sim_time" and change.value is not True for change in changes
            )
            reason = "use_sim_time must be true: this node is in a simulated graph"
            return SetParametersResult(successful=not changed, reason=reason if changed else "")

        self.add_on_set_parameters_callback(refuse_change)

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act: every input is fresh."""

    def on_timer(self, now: float) -> None:
        """Do what is due by the wall clock; called 20 times a second."""

    def on_stop(self) -> None:
        """Close what is open; called once at the end, whatever the reason."""

    def progress(self) -> dict[str, Any]:
        """Return the node's additions to each of its reports."""
        return {}

    def summary(self) -> dict[str, Any]:
        """Return the node's additions to its report at the end of the run."""
        return {}

    # --- setting up -------------------------------------------------------------------------

    def declare_site(self) -> Site:
        """Declare the parameter ``site_file``, and read the site.

        From then on each report has the absolute path of the file, as ``site``, so that observers
        can read the same site.

        Raises:
            ConfigurationError: the file, or a value in it, is wrong.
        """
        file = Path(declare(self, [site_file()])["site_file"])
        self._site_file = {"site": str(file.resolve())}
        return read_site(file)

    def set_time(self, time_ns: int) -> None:
        """Set the node's clock (``get_clock()``) to a simulated time (ns since 1970)."""
        now = Time(nanoseconds=time_ns, clock_type=ClockType.ROS_TIME)
        self._ros_clock.set_ros_time_override(now)

    def open_outputs(self, *names: str) -> None:
        """Open topics of the interface for :meth:`publish`."""
        for name in names:
            topic = self.interface[name]
            publisher = self.create_publisher(
                message_class(topic.type), topic.graph_name, qos_profile(topic.qos),
                event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            )
            self._outputs[name] = publisher, encoder(topic.type, topic.dimensions)

    def publish(self, name: str, value: Any) -> None:
        """Publish a value on a topic that :meth:`open_outputs` has opened."""
        publisher, encode = self._outputs[name]
        publisher.publish(encode(value))

    def subscribe(self, name: str, *, tolerates_second: bool = False) -> Input:
        """Open an input that the node waits for in each tick, and return it.

        Args:
            name: the topic's name in the interface.
            tolerates_second: whether a second publisher does not end the run; the node must then
                look for one itself, in the returned input's ``publishers``.
        """
        entry = self._input(name)
        if tolerates_second:
            self._tolerated.add(name)
        receive = self.lockstep.receiver(entry, tolerates_second=tolerates_second)
        self._open(entry.topic, receive, entry.publishers)
        return entry

    def listen(self, name: str, callback: Callable[[Any], None]) -> Input:
        """Open an input that the node does not wait for: each value is passed to a callback."""
        entry = self._input(name)

        def receive(message: bytes) -> None:
            entry.receive(message)
            callback(entry.value)

        self._open(entry.topic, receive, entry.publishers)
        return entry

    def record(self, name: str, callback: Callable[[bytes], None]) -> None:
        """Pass each serialised message of a topic of any type to a callback."""
        entry = self._input(name)
        self._open(entry.topic, callback, entry.publishers)

    def _input(self, name: str) -> Input:
        topic = self.interface[name]
        self.inputs[name] = Input(Publishers(self, topic, _required(topic)))
        return self.inputs[name]

    def _open(
        self, topic: Topic, callback: Callable[[bytes], None], publishers: Publishers | None = None,
    ) -> None:
        if publishers is not None:
            self._waits_for.append(publishers)

        def guarded(message: bytes) -> None:
            """Keep an error for the run: the executor would print it with a traceback."""
            try:
                callback(message)
            except Exception as error:
                self.fail(error)

        self.create_subscription(
            message_class(topic.type), topic.graph_name, guarded, qos_profile(_required(topic)),
            raw=True, event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )

    # --- running ----------------------------------------------------------------------------

    def fail(self, error: Exception) -> None:
        """Note the error that ends the run; only the first counts."""
        if self.failure is not None:
            return
        if not isinstance(error, (LockstepError, ConfigurationError, OSError)):
            place = traceback.extract_tb(error.__traceback__)[-1]
            error = LockstepError(
                f"{self.get_name()}: {type(error).__name__}: {error} ({place.filename}, line "
                f"{place.lineno})"
            )
        self.failure = error
        self.on_failure()

    @property
    def acted(self) -> bool:
        """Whether the node has acted, so the run has begun for it."""
        return self.lockstep.tick > 0

    @property
    def ready(self) -> bool:
        """Whether every input has had a publisher."""
        return self.reports.state != STARTING

    @property
    def finished(self) -> bool:
        """Whether the run is over for this node."""
        return self.reports.state == FINISHED

    @property
    def good(self) -> bool:
        """Whether no input's present value was refused."""
        return all(entry.good for entry in self.inputs.values())

    def finish(self) -> None:
        """Report from now on that the run is over for this node, with the node's summary."""
        self._note_warnings(time.monotonic())
        self._final = self.summary()
        self.reports.state = FINISHED
        self._report()

    def check(self, now: float) -> None:
        """Check what depends on the wall clock, and report the node's state.

        Args:
            now: steady clock (s).

        Raises:
            LockstepError: the graph cannot go on.
            OccupiedError: a topic had a second publisher before the run.
            OSError: the node cannot go on, for instance on a full disk.
        """
        self.on_timer(now)
        if now - self._checked < _CHECK_S:
            return
        self._checked = now
        if not self.finished:
            self._refuse_second()
            self._note_warnings(now)
            if not self.ready and not self.absent():
                self.reports.state = READY
        self._report()

    def _refuse_second(self) -> None:
        for name, entry in self.inputs.items():
            publishers = entry.publishers
            if name not in self._tolerated and publishers.count > 1 and publishers.heard > 1:
                # Before the run it is a wrong set-up, later a failure.
                kind = LockstepError if self.acted else OccupiedError
                raise kind(f"{entry.name} {publishers.second()}")

    def _note_warnings(self, now: float) -> None:
        """Note publishers that have not been heard for the discovery time, and refused values."""
        for publishers in self._waits_for:
            problem = "" if self.acted else publishers.unheard()
            name = publishers.full_name
            since = self._unheard_since.setdefault(name, now) if problem else math.inf
            if not problem:
                self._unheard_since.pop(name, None)
            elif now - since >= DISCOVERY_S:
                self._warn(f"{name} {problem}")
        for entry in self.inputs.values():
            if entry.refused:
                self._warn(
                    f"refused a value on {entry.name}: it {accepted(entry.topic)}; it acts as 0, "
                    "and further ones are only counted"
                )

    def _warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            self.get_logger().warning(sentence)

    def absent(self) -> dict[str, list[str]]:
        """Return the inputs without a publisher that can be heard, by missing role."""
        return self.by_role(
            [name for name, entry in self.inputs.items() if not entry.publishers.heard]
        )

    def by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return some of the inputs, by the role that should publish them.

        If the interface names two roles (plant or pump driver), it is the first that publishes none
        of this node's other inputs, or else the last.
        """
        present = {self.role} | {
            entry.topic.publishers[0] for name, entry in self.inputs.items() if name not in names
        }
        roles: dict[str, list[str]] = {}
        for name in names:
            candidates = self.inputs[name].topic.publishers
            role = next((role for role in candidates if role not in present), candidates[-1])
            roles.setdefault(role, []).append(name)
        return roles

    def describe(self, silent: dict[str, list[str]]) -> str:
        """Return a text that names topics, and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.inputs[name].name for name in names)} from {self.call(role)}"
            for role, names in silent.items()
        )

    def call(self, role: str) -> str:
        """Return how to name the node of a role: by its node name if it publishes an input here."""
        nodes = [
            node for entry in self.inputs.values() if role in entry.topic.publishers
            for node in entry.publishers.names()
        ]
        return nodes[0] if nodes else ROLES.get(role, role)

    # --- ending -----------------------------------------------------------------------------

    @property
    def over(self) -> bool:
        """Whether a node that runs alone may end: its run is over, and its messages have arrived.

        The plant leaves first: until then a node may still need this node's messages.

        Raises:
            LockstepError: the plant has ended before the run.
        """
        if not self.finished:
            if self.lockstep.run is not None and self._plant_has_gone():
                raise LockstepError("plant has ended, and the run with it")
            return False
        return self.all_arrived() and (self.role == PLANT or self._plant_has_gone())

    def _plant_has_gone(self) -> bool:
        clock = self.inputs.get(CLOCK)
        return clock is not None and clock.publishers.count == 0

    def all_arrived(self) -> bool:
        """Whether all subscribers have received everything that the node has published."""
        now = Duration()
        return all(publisher.wait_for_all_acked(now) for publisher, _ in self._outputs.values())

    def end(self, failure: str | None) -> None:
        """Report that the node ends, and wait until its readers have everything, 1 s at most.

        Args:
            failure: the error that ended it; None if there was none.
        """
        self.reports.state = ENDED
        if failure is not None:
            self._final["failure"] = failure
        self._report()
        until = time.monotonic() + _FLUSH_S
        outputs = [publisher for publisher, _ in self._outputs.values()]
        for publisher in (*outputs, self.reports.publisher):
            left = max(0.0, until - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    def _report(self) -> None:
        waiting = {} if self.ready else {"waiting": list(self.absent())}
        refused = {name: entry.refused for name, entry in self.inputs.items() if entry.refused}
        run = self.lockstep.run
        self.reports.publish({
            **self._site_file, "run_length": None if run is None else round(run.last_tick),
            **self.progress(), **waiting, "refused": refused, "warnings": self.warnings,
            **self._final,
        })


def _required(topic: Topic) -> Qos:
    """Return what a publisher must offer: in a simulation there is no liveliness lease."""
    return replace(topic.qos, lease_s=math.inf)
