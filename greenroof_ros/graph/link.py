"""A node's link to its graph: its topics, what it says of itself, and when it acts.

What each node publishes and subscribes to comes from ``msg_defs/topics.yaml``. When it acts is one
of two triggers: fresh inputs, in a simulation (:mod:`greenroof_ros.graph.lockstep`), or steady
time, on a live site (:mod:`greenroof_ros.graph.live`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

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
from greenroof_ros.graph.live import Live
from greenroof_ros.graph.lockstep import PLANT, RUN, Lockstep
from greenroof_ros.graph.messages import LockstepError, decoder, encoder, message_class, qos_profile
from greenroof_ros.graph.parameters import LIVE, declare, site_file
from greenroof_ros.graph.rclpy_internals import NoClockSubscription
from greenroof_ros.graph.reports import ERROR, OK, WARN, Reports
from greenroof_ros.graph.supervision import ENDED, FINISHED, READY, STARTING
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.pumping.input_rules import LevelRule

# How long a node listens at most before it looks at its clocks and signals again (s).
LISTEN_S = 0.05
# How long a node that ends waits for its readers (s): one that was killed stays matched.
_FLUSH_S = 1.0
# How often a node says how it is (s of wall time).
_REPORT_S = 0.25


class LinkedNode(NoClockSubscription, Node):
    """A node of a graph, simulated or live.

    It opens its topics by :meth:`open_outputs` and :meth:`subscribe`, by their names in the
    interface, and overrides :meth:`on_inputs`, and of the other ``on_`` methods, ``progress`` and
    ``summary`` those that it needs. Its parameter ``live`` says which graph it is; in a simulated
    one it lives in simulated time (``use_sim_time`` is true).

    Attributes:
        role: what the interface calls it: its name, or ``controller``.
        live: whether its graph is live.
        lockstep: what makes it act, in a simulation.
        error: why the node cannot go on.
        acted: whether the run has begun for the node.
        inputs: what it subscribes to.
        interface: every topic of the graph, by name.
        reports: what it says of itself.
    """

    def __init__(self, name: str, role: str, *, live: bool | None = None) -> None:
        """Join the graph.

        Args:
            name: of the node.
            role: what the interface calls it: its name, or ``controller``.
            live: whether its graph is live; None where its parameter ``live`` says that.

        Raises:
            ConfigurationError: ROS arguments or a parameter file are wrong.
        """
        try:
            super().__init__(
                name, parameter_overrides=[Parameter("use_sim_time", Parameter.Type.BOOL, False)]
            )
        except RuntimeError as error:  # of rcl
            raise ConfigurationError(" ".join(str(error).split())) from error
        self.role = role
        self.live: bool = declare(self, [LIVE])["live"] if live is None else live
        self.error: Exception | None = None
        self.acted = False
        self.interface = read_live_topics() if self.live else read_topics()
        self.inputs = Inputs(role)
        self._heard: list[Publishers] = []  # of all that it subscribes to
        self._warnings: list[str] = []
        # Of each topic its publisher, and what makes its messages.
        self._outputs: dict[str, tuple[Publisher, Callable[[Any], bytes]]] = {}
        self._reported = self._warned = self._looked = 0.0
        self._final_values: dict[str, Any] = {}
        self._site_file: dict[str, str] = {}
        self.lockstep = Lockstep(role, self.act, self.finish)
        self._live = Live(self, self.act, self.diagnose) if self.live else None
        self.set_parameters([Parameter("use_sim_time", Parameter.Type.BOOL, not self.live)])
        self._ros_clock = cast(ROSClock, self.get_clock())
        self.reports = Reports(self, role)
        if not self.live and role != PLANT:
            run = Publishers(self, self.interface[RUN], live=False)
            decode = decoder(run.topic.type)
            self._open(run, lambda message: self.lockstep.hear_run(decode(message)))

    def act(self) -> None:
        """Act: it is time to."""
        self.acted = True
        self.on_inputs()

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act: every input is fresh, or, live, it is time; see :attr:`good`."""

    def on_idle(self) -> None:
        """Look at what is due between messages; called every 50 ms at least."""

    def on_stop(self) -> None:
        """Put away what is open; called once at the end, whatever the reason."""

    def progress(self) -> dict[str, Any]:
        """Return what the node adds to each of its reports."""
        return {}

    def summary(self) -> dict[str, Any]:
        """Return what the node adds to its report at the end of the run."""
        return {}

    # --- setting up -------------------------------------------------------------------------

    def declare_site(self) -> Site:
        """Declare the parameter ``site_file``, and read the site.

        Its tau is the period of a node in a live graph. Each report says from then on which file it
        was, as ``site``, an absolute path: who looks on judges by the same site.

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
        """Set the node's clock, which ``get_clock()`` returns, to a simulated time (ns)."""
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
        """Publish a value on a topic of the interface that is open."""
        publisher, encode = self._outputs[name]
        publisher.publish(encode(value))

    def subscribe(
        self, name: str, callback: Callable[[Any], None] | None = None, *,
        optional: bool = False, level: LevelRule | None = None, tolerates_second: bool = False,
    ) -> Input:
        """Open an input and return it; in lockstep it is awaited, unless a callback has its values.

        Args:
            name: of the topic in the interface.
            callback: called with each value as it comes; the node does not wait for it to act.
            optional: the node acts without it, too; only in a live graph.
            level: what else holds for a level in a live graph.
            tolerates_second: a second publisher ends nothing in lockstep, either; the node looks
                itself whether there is one, at the ``publishers`` of what is returned.
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
        """Keep what comes on a topic, whatever its type; only its publisher is waited for, once.

        In a live graph nothing is.

        Args:
            name: of the topic in the interface.
            callback: called with each message, serialised.
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
        """N of the run that the node takes part in; None before the plant has said it."""
        run = self.lockstep.run
        return None if run is None else round(run.last_tick)

    def _guarded(self, callback: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Keep an error for the node's loop: the executor would print it, and more, by itself."""

        def guarded(message: bytes) -> None:
            try:
                callback(message)
            except (LockstepError, ConfigurationError, OSError) as error:
                self.error = self.error or error

        return guarded

    # --- running ----------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether every input had its publisher once; live, and it acted, if it acts by itself."""
        return self.reports.state != STARTING

    @property
    def good(self) -> bool:
        """Whether no input's present value was refused, or, live, breaks another rule."""
        if self._live:
            self._live.judge()
        return all(entry.good for entry in self.inputs.by_name.values() if not entry.optional)

    def diagnose(
        self, part: str, level: bytes, message: str, code: str = "", cause: str = ""
    ) -> None:
        """Say how a part of the node is; a change is logged.

        Args:
            part: its name.
            level: of :mod:`greenroof_ros.graph.reports`: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
            message: a sentence.
            code: of :mod:`greenroof_ros.common.interface`; empty where all is well.
            cause: the code that it follows from, if that is known.
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
        """Say of a part of the node that it has a problem, or where that is empty that it is well.

        Args:
            part: its name.
            problem: a sentence; empty where there is none.
            well: a sentence for when there is none.
            code: of the problem; see :meth:`diagnose`.
            level: likewise.
            cause: likewise.
        """
        if problem:
            self.diagnose(part, level, problem, code, cause)
        else:
            self.diagnose(part, OK, well)

    def listen_s(self) -> float:
        """Look at what is due; return how long the node may wait for the next message (s)."""
        self.on_idle()
        return min(LISTEN_S, (self._live or self.lockstep).due_in)

    def check(self) -> None:
        """Look at the wall clock: say how the node is, and act where it is time to.

        Raises:
            LockstepError: the graph cannot go on.
            ConfigurationError: nor can it as it was set up.
            OSError: nor can the node, for instance on a full disk.
        """
        if self.error is not None:
            raise self.error
        now = time.monotonic()
        if self._live:
            self._live.look()
        if now - self._looked < LISTEN_S:  # a message costs little; asking ROS, milliseconds
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
            # Again and again, for a reader that joins late may miss what was said once.
            self._report(now)

    def _warn(self, now: float) -> None:
        """Warn of each publisher that is not heard, once; live, for as long as it is there."""
        before = self._warnings
        warnings = [sentence for publishers in self._heard if (sentence := publishers.warning(now))]
        new = [sentence for sentence in warnings if sentence not in before]
        self._warnings = warnings if self.live else [*before, *new]
        for sentence in new:
            self.get_logger().warning(sentence)

    def finish(self) -> None:
        """Say from now on that the run is over for this node, with what its summary needs."""
        self._final_values = self.summary()
        self.reports.state = FINISHED
        self._report(time.monotonic())

    def all_arrived(self) -> bool:
        """Whether all that the node said has come to who hears it."""
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
        """Say that the node ends, and wait a second at most until its readers have all it said.

        Args:
            failure: what ended it; None where it was asked to end.
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
