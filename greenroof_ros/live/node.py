"""A node's link to its graph: its topics, its reports, and when it acts.

``msg_defs/topics.yaml`` defines what each node publishes and subscribes to. A node acts on one of
two triggers: fresh inputs in a simulation (:mod:`greenroof_ros.graph.lockstep`), or the steady
clock on a live site (:mod:`greenroof_ros.live.engine`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.time import Time

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import read_live_topics, read_topics
from greenroof_ros.graph.inputs import DISCOVERY_S, Input, Inputs, Publishers
from greenroof_ros.live.engine import Live
from greenroof_ros.graph.lockstep import PLANT, RUN, Lockstep
from greenroof_ros.graph.messages import LockstepError, decoder, encoder, message_class, qos_profile
from greenroof_ros.graph.parameters import LIVE, declare, site_file
from greenroof_ros.graph.rclpy_internals import NoClockSubscription
from greenroof_ros.graph.reports import ERROR, OK, WARN, Reports
from greenroof_ros.graph.states import ENDED, FINISHED, READY, STARTING
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.pumping.input_rules import LevelRule

# How long a node listens at most before it checks its clocks and signals again (s).
LISTEN_S = 0.05
# How long an ending node waits for its readers at most (s): a killed reader stays matched.
_FLUSH_S = 1.0
# How often a node reports its state (s of wall time).
_REPORT_S = 0.25


class LiveNode(NoClockSubscription, Node):
    """A node of a graph, simulated or live.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, by their names in
    the interface. It overrides :meth:`on_inputs` and, as needed, the other ``on_`` methods,
    ``progress`` and ``summary``. The parameter ``live`` selects the kind of graph; in a simulated
    one the node uses simulated time (``use_sim_time`` is true).

    Attributes:
        role: its role in the interface: its name, or ``controller``.
        live: whether its graph is live.
        lockstep: makes the node act in a simulation.
        error: the error after which the node cannot go on; None if there is none.
        acted: whether the node has acted, so the run has begun for it.
        inputs: the topics that it subscribes to.
        interface: every topic of the graph, by name.
        reports: reports the node's state.
    """

    def __init__(self, name: str, role: str, *, live: bool | None = None) -> None:
        """Join the graph.

        Args:
            name: the node's name.
            role: its role in the interface: its name, or ``controller``.
            live: whether its graph is live; None to read the parameter ``live``.

        Raises:
            ConfigurationError: ROS arguments or a parameter file are wrong.
        """
        try:
            super().__init__(name)
        except RuntimeError as error:  # from rcl
            raise ConfigurationError(" ".join(str(error).split())) from error
        self.role = role
        self.live: bool = declare(self, [LIVE])["live"] if live is None else live
        self._fix_time_source()
        self.error: Exception | None = None
        self.acted = False
        self.interface = read_live_topics() if self.live else read_topics()
        self.inputs = Inputs(role)
        self._heard: list[Publishers] = []  # of all topics that it subscribes to
        self._warnings: list[str] = []
        # Each topic's publisher, and the encoder of its messages.
        self._outputs: dict[str, tuple[Publisher, Callable[[Any], bytes]]] = {}
        self._reported = self._warned = self._looked = 0.0
        self._final_values: dict[str, Any] = {}
        self._site_file: dict[str, str] = {}
        self.lockstep = Lockstep(role, self.act, self.finish)
        self._live = Live(self, self.act, self.diagnose) if self.live else None
        self._ros_clock = cast(ROSClock, self.get_clock())
        self.reports = Reports(self, role)
        if not self.live and role != PLANT:
            run = Publishers(self, self.interface[RUN], live=False)
            decode = decoder(run.topic.type)
            self._open(run, lambda message: self.lockstep.hear_run(decode(message)))

    def _fix_time_source(self) -> None:
        """Set ``use_sim_time`` as the kind of graph needs it, and refuse every later change.

        On simulated time a live node would wait for a clock that nobody publishes.

        Raises:
            ConfigurationError: a live node was started with ``use_sim_time`` true.
        """
        simulated = not self.live
        if self.live and self.get_parameter("use_sim_time").value:
            raise ConfigurationError(
                "must be false: a live site runs on the steady clock",
                key=f"parameter use_sim_time of {self.get_name()}", value="true",
            )
        self.set_parameters([Parameter("use_sim_time", Parameter.Type.BOOL, simulated)])

        def refuse_change(changes: list[Parameter]) -> SetParametersResult:
            changed = any(
                change.name == "use_sim_time" and change.value is not simulated
                for change in changes
            )
            kind = "simulated" if simulated else "live"
            value = str(simulated).lower()
            reason = f"use_sim_time must be {value}: this node is in a {kind} graph"
            return SetParametersResult(successful=not changed, reason=reason if changed else "")

        self.add_on_set_parameters_callback(refuse_change)

    def act(self) -> None:
        """Let the node act, and note that its run has begun."""
        self.acted = True
        self.on_inputs()

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act: every input is fresh or, live, the period has passed; see :attr:`good`."""

    def on_idle(self) -> None:
        """Do what is due between messages; called at least every 50 ms."""

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

        In a live graph the site's tau becomes the node's period. From then on each report has the
        absolute path of the file, as ``site``, so that observers can read the same site.

        Raises:
            ConfigurationError: the file, or a value in it, is wrong.
        """
        file = Path(declare(self, [site_file()])["site_file"])
        self._site_file = {"site": str(file.resolve())}
        site = read_site(file)
        if self._live:
            self._live.act_every(site.tau)
        return site

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

    def subscribe(
        self, name: str, callback: Callable[[Any], None] | None = None, *,
        optional: bool = False, level: LevelRule | None = None, tolerates_second: bool = False,
    ) -> Input:
        """Open an input and return it; in lockstep the node waits for it, unless it has a callback.

        Args:
            name: the topic's name in the interface.
            callback: called with each value as it comes; the node does not wait for it to act.
            optional: whether the node acts without it; only in a live graph.
            level: the additional rule for a level in a live graph.
            tolerates_second: whether a second publisher does not end the run in lockstep; the node
                must then look for one itself, in the returned input's ``publishers``.
        """
        publishers = Publishers(self, self.interface[name], live=self.live)
        entry = Input(
            publishers, self.get_logger(), optional=optional, tolerates_second=tolerates_second
        )
        self.inputs.by_name[name] = entry
        self._open(publishers, (
            self._live.receiver(entry, level, callback) if self._live
            else self.lockstep.receiver(entry, callback)
        ))
        return entry

    def record(self, name: str, callback: Callable[[bytes], None]) -> None:
        """Record a topic of any type.

        In lockstep the node is not ready before the topic has a publisher; live, it never waits.

        Args:
            name: the topic's name in the interface.
            callback: called with each serialised message.
        """
        publishers = Publishers(self, self.interface[name], live=self.live, recorded=True)
        if not self.live:
            self.inputs.by_name[name] = Input(publishers, self.get_logger())
        self._open(publishers, callback)

    def _open(self, publishers: Publishers, callback: Callable[[bytes], None]) -> None:
        topic = publishers.topic
        self._heard.append(publishers)
        self.create_subscription(
            message_class(topic.type), topic.graph_name, self._guarded(callback),
            publishers.profile(), raw=True, event_callbacks=publishers.events(),
        )

    @property
    def run_length(self) -> int | None:
        """N of the run that the node takes part in; None before the plant has published it."""
        run = self.lockstep.run
        return None if run is None else round(run.last_tick)

    def _guarded(self, callback: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Keep an error for :meth:`check`: the executor would print it with a traceback."""

        def guarded(message: bytes) -> None:
            try:
                callback(message)
            except (LockstepError, ConfigurationError, OSError) as error:
                self.error = self.error or error

        return guarded

    # --- running ----------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether every required input has had a publisher and, live, a periodic node has acted."""
        return self.reports.state != STARTING

    @property
    def good(self) -> bool:
        """Whether no required input's present value was refused or, live, breaks another rule."""
        if self._live:
            self._live.judge()
        return all(entry.good for entry in self.inputs.by_name.values() if not entry.optional)

    def diagnose(
        self, part: str, level: bytes, message: str, code: str = "", cause: str = ""
    ) -> None:
        """Report the state of a part of the node; a change is logged.

        Args:
            part: the part's name.
            level: ``OK``, ``WARN``, ``ERROR`` or ``STALE`` of :mod:`greenroof_ros.graph.reports`.
            message: a sentence.
            code: a code of :mod:`greenroof_ros.common.interface`; empty if the part is well.
            cause: the code of the cause; empty if unknown.
        """
        before = self.reports.diagnoses.get(part)
        if not self.reports.diagnose(part, level, message, code, cause):
            return
        self._reported = 0.0  # at once
        if level == OK:
            if before is not None:
                self.get_logger().info(message)
        elif level == WARN:
            self.get_logger().warning(message)
        else:
            self.get_logger().error(message)

    def say(
        self, part: str, problem: str, well: str, code: str, level: bytes = ERROR, cause: str = ""
    ) -> None:
        """Report a problem of a part of the node, or that the part is well if there is none.

        Args:
            part: the part's name.
            problem: a sentence; empty if there is no problem.
            well: the sentence to report if there is no problem.
            code: the problem's code; see :meth:`diagnose`.
            level: the problem's level; likewise.
            cause: the code of its cause; likewise.
        """
        if problem:
            self.diagnose(part, level, problem, code, cause)
        else:
            self.diagnose(part, OK, well)

    def listen_s(self) -> float:
        """Do what is due; return how long the node may wait for the next message (s)."""
        self.on_idle()
        return min(LISTEN_S, (self._live or self.lockstep).due_in)

    def check(self) -> None:
        """Check the wall clock: act if it is time to, and report the node's state.

        Raises:
            LockstepError: the graph cannot go on.
            ConfigurationError: the set-up is wrong.
            OSError: the node cannot go on, for instance on a full disk.
        """
        if self.error is not None:
            raise self.error
        now = time.monotonic()
        if self._live:
            self._live.look()
        if now - self._looked < LISTEN_S:  # asking ROS takes milliseconds: not for each message
            return
        self._looked = now
        if (self.live or not self.acted) and now - self._warned >= DISCOVERY_S:
            self._warned = now
            self._warn(now)
        begun = self._live is None or self._live.has_begun
        if not self.ready and begun and not self.inputs.absent():
            self.reports.state = READY
            self._report(now)
        if now - self._reported > _REPORT_S:
            # Repeated, since a reader that joins late may have missed it.
            self._report(now)

    def _warn(self, now: float) -> None:
        """Log each publisher that is not heard, once; drop the warning when it has gone."""
        before = self._warnings
        self._warnings = [
            sentence for publishers in self._heard if (sentence := publishers.warning(now))
        ]
        for sentence in self._warnings:
            if sentence not in before:
                self.get_logger().warning(sentence)

    def finish(self) -> None:
        """Report from now on that the run is over for this node, with the node's summary."""
        self._final_values = self.summary()
        self.reports.state = FINISHED
        self._report(time.monotonic())

    def all_arrived(self) -> bool:
        """Whether all subscribers have received everything that the node has published."""
        now = Duration()
        return all(publisher.wait_for_all_acked(now) for publisher, _ in self._outputs.values())

    def _report(self, now: float) -> None:
        self._reported = now
        waiting = {} if self.ready else {"waiting": list(self.inputs.absent())}
        refused = {
            name: entry.refused for name, entry in self.inputs.by_name.items() if entry.refused
        }
        run = {} if self.live else {"run_length": self.run_length}
        self.reports.say({
            **self._site_file, **run, **self.progress(), **waiting, "refused": refused,
            "warnings": self._warnings, **self._final_values,
        })

    def flush(self, failure: str | None) -> None:
        """Report that the node ends, and wait until its readers have everything, 1 s at most.

        Args:
            failure: the error that ended it; None if there was none.
        """
        self.reports.state = ENDED
        if failure is not None:
            self._final_values["failure"] = failure
        self._report(time.monotonic())
        until = time.monotonic() + _FLUSH_S
        for publisher in [
            *(output for output, _ in self._outputs.values()), self.reports.publisher
        ]:
            left = max(0.0, until - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))
        while not self.reports.supervisor.send() and time.monotonic() < until:
            time.sleep(LISTEN_S)
