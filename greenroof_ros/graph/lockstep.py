"""Lockstep over topics: a node acts once every input has arrived since it last acted.

What each node publishes and subscribes to comes from ``msg_defs/topics.yaml``. There are no timers
and no sleeps on the way of a tick; the only wall clocks here end a run which hangs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any, cast

from rclpy.clock import ROSClock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.time import Time

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.peers import Peers, by_publisher, root_causes
from greenroof_ros.graph.publishers import PublisherWatch
from greenroof_ros.graph.qos import message_class, qos_profile
from greenroof_ros.graph.reports import Report, Reports
from greenroof_ros.graph.serialization import encoder
from greenroof_ros.graph.states import ENDED, FINISHED, READY, STARTING
from greenroof_ros.graph.unfit_publishers import UnfitPublishers
from greenroof_ros.graph.validation import Input

CLOCK = "/clock"
# How long a node listens at most before it looks at its clocks and signals again (s).
LISTEN_S = 0.05
# A node that joins receives the last of what its peers said before; first it lets them finish.
_SILENCE_S = 0.5
# How long a node that ends waits for its readers (s): one that was killed stays matched.
_FLUSH_S = 1.0
# How often a node says how it is (s of wall time).
_REPORT_S = 0.25
# How long a node that nobody supervises still says at least that it has finished (s).
_LAST_WORD_S = 1.0
# For how long after that a node that has not joined may still be one of this run (s).
_JOINING_S = 5.0
# Among the inputs that must be fresh: that none of them has two publishers, of which one may live.
_NO_DOUBT = 1 << 32


class LockstepNode(Node):
    """A node of a simulated graph.

    It opens its topics by :meth:`publish_topic` and :meth:`subscribe`, by their names in the
    interface, and overrides :meth:`on_inputs`, and of the other ``on_`` methods, ``progress`` and
    ``summary`` those that it needs. It lives in simulated time (``use_sim_time`` is true).

    Attributes:
        sent: how many messages went out, by topic.
        error: why the node cannot go on.
        acted: whether the run has begun for the node.
        over: whether the node may end by itself: nobody supervises it, the run is over, and all
            who were in it have its last word.
        final_reports: the values of the reports of nodes that have finished, by node.
    """

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: of the node.
            role: what the interface calls it: its name, or ``controller``.

        Raises:
            ConfigurationError: ROS arguments or a parameter file are wrong.
        """
        try:
            super().__init__(
                name, parameter_overrides=[Parameter("use_sim_time", Parameter.Type.BOOL, True)]
            )
        except RuntimeError as error:  # of rcl
            raise ConfigurationError(" ".join(str(error).split())) from error
        self.sent: dict[str, int] = {}
        self.error: Exception | None = None
        self._role = role
        self._ros_clock = cast(ROSClock, self.get_clock())
        self._interface = read_topics()
        self._inputs: dict[str, Input] = {}
        self._watches: dict[str, PublisherWatch] = {}
        self._unfit = UnfitPublishers(self)
        self._bits: dict[str, int] = {}  # of the inputs that must be fresh
        self._fresh = 0
        self._all = 0
        self._joining = True
        self.acted = False
        self.over = False
        self.final_reports: dict[str, dict[str, Any]] = {}
        self._last_arrival = time.monotonic()
        self._outputs: list[Publisher] = []
        self._reports = Reports(self, role, self._on_report)
        self.peers = Peers(self.get_logger())
        self._run_of: str | None = None  # the process of its plant
        self._doubts: set[PublisherWatch] = set()
        self._looked = self._reported = 0.0
        self._finished_since = 0.0
        self._final_values: dict[str, Any] = {}

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act: every input is fresh."""

    def on_idle(self) -> float:
        """Look at what is due between messages; called every 50 ms at least.

        Returns:
            How long the node may wait for the next message (s).
        """
        return LISTEN_S

    def on_plant_finished(self) -> None:
        """End the run for this node: the plant has."""
        self.finish()

    def on_answered_again(self, name: str) -> None:
        """Forget what came on a topic for the present tick: its publisher was started again.

        It answers that tick as a whole, of which the one that was killed may have answered a part.
        """

    def on_stop(self) -> None:
        """Put away what is open; called once at the end, whatever the reason."""

    def progress(self) -> dict[str, Any]:
        """Return what the node adds to each of its reports."""
        return {}

    def summary(self) -> dict[str, Any]:
        """Return what the node adds to its report at the end of the run."""
        return {}

    # --- setting up -------------------------------------------------------------------------

    def create_subscription(self, msg_type: Any, topic: str, *args: Any, **options: Any) -> Any:
        """Open a subscription, but not rclpy's own to the clock.

        That one is to ``/clock`` even in a namespace, and costs 35 us of processor time a tick in
        each node; :meth:`set_time` sets the node's clock from messages that it has already.
        """
        if topic == CLOCK:
            return None
        return super().create_subscription(msg_type, topic, *args, **options)

    def set_time(self, time_ns: int) -> None:
        """Set the node's clock, which ``get_clock()`` returns, to a simulated time (ns)."""
        now = Time(nanoseconds=time_ns, clock_type=ClockType.ROS_TIME)
        self._ros_clock.set_ros_time_override(now)

    def publish_topic(self, name: str) -> Callable[[Any], None]:
        """Open an output and return what publishes a value on it.

        Args:
            name: of the topic in the interface.
        """
        topic = self._interface[name]
        publisher = self.create_publisher(
            message_class(topic.type), topic.graph_name, qos_profile(topic.qos)
        )
        self._outputs.append(publisher)
        self.sent[name] = 0
        encode, send, sent = encoder(topic.type), publisher.publish, self.sent

        def publish(value: Any) -> None:
            sent[name] += 1
            send(encode(value))

        return publish

    def subscribe(
        self, name: str, callback: Callable[[Any], None] | None = None, *, raw: bool = False
    ) -> Input:
        """Open an input and return it.

        Args:
            name: of the topic in the interface.
            callback: called with each value; without it the input is one of those that must be
                fresh before the node acts.
            raw: the callback gets the serialised message, and the node does not watch whether the
                publisher lives: it only keeps what is published.
        """
        topic = self._interface[name]
        entry = Input(topic, self.resolve_topic_name(topic.graph_name), self.get_logger())
        self._inputs[name] = entry
        bit = 0
        if callback is None:
            self._bits[name] = bit = 1 << len(self._bits)
            self._all |= bit

        def on_second(*, answered: bool) -> None:
            if self.acted and bit and not self._awaits_publisher_of(name):
                self._refuse(
                    f"a second publisher of {entry.name} ({watch.said_names()}) came when the "
                    "first had answered the tick; which tick it answers cannot be told: end all "
                    "nodes and start the run again"
                )
            if not self._joining and not answered:
                self._fresh &= ~bit
            self.on_answered_again(name)

        self._watches[name] = watch = PublisherWatch(
            self, topic, self._refuse, self._on_doubt, on_second, recorded=raw
        )
        if callback is None:
            on_message = self._when_fresh(entry, bit, watch)
        elif raw:
            on_message = callback
        else:
            on_message = self._with_value(entry, callback)
        events = watch.events()
        events.incompatible_qos = self._unfit.on_event(topic)
        self.create_subscription(
            message_class(topic.type),
            topic.graph_name,
            self._guarded(on_message),
            watch.profile(),
            raw=True,
            event_callbacks=events,
        )
        return entry

    def _awaits_publisher_of(self, name: str) -> bool:
        """Whether a tick waits for the node that publishes a topic.

        One that is started again answers the newest tick that it sees. Only where that tick still
        waits for it does it answer once; otherwise the answer would count for the next tick.
        """
        bits = sum(
            bit for other, bit in self._bits.items()
            if self._publisher_of(other) == self._publisher_of(name)
        )
        return self.tick_is_open() and self._fresh & bits != bits

    def _publisher_of(self, name: str) -> str:
        return next(who for who in self._interface[name].publishers if who != self._role)

    def tick_is_open(self) -> bool:
        """Whether the plant has published a tick on which this node has not acted."""
        return all(
            self._fresh & bit
            for name, bit in self._bits.items() if self._publisher_of(name) == "plant"
        )

    def start_fresh(self) -> None:
        """Act on the first fresh inputs: for the plant, whom the others wait for."""
        self._joining = False

    def _when_fresh(
        self, entry: Input, bit: int, watch: PublisherWatch
    ) -> Callable[[bytes], None]:
        """Return what receives an input, and acts when it was the last one missing."""
        receive = entry.receive

        def on_message(message: bytes) -> None:
            receive(message)
            if self._joining:
                self._fresh |= bit
                self._last_arrival = time.monotonic()
                return
            if self._fresh & bit:
                watch.came_twice()
            self._fresh |= bit
            if self._fresh == self._all:
                self._act()

        return on_message

    def _with_value(
        self, entry: Input, callback: Callable[[Any], None]
    ) -> Callable[[bytes], None]:
        def on_message(message: bytes) -> None:
            entry.receive(message)
            callback(entry.value)

        return on_message

    def _guarded(self, callback: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Keep an error for the node's loop: the executor would print it, and more, by itself."""

        def guarded(message: bytes) -> None:
            try:
                callback(message)
            except (LockstepError, ConfigurationError, OSError) as error:
                self.error = self.error or error

        return guarded

    def _refuse(self, message: str) -> None:
        """Refuse a second publisher: a wrong set-up before the run, in it a failure of the run."""
        kind = LockstepError if self.acted else OccupiedError
        self.error = self.error or kind(message)

    def _on_doubt(self, watch: PublisherWatch) -> None:
        """Do not act as long as a publisher may be one too many.

        What came meanwhile on its topic counts once it is known to be of the only one that lives;
        of two that live both answer a tick, or stay, and either is refused.
        """
        (self._doubts.add if watch.doubtful else self._doubts.discard)(watch)
        if any(each.topic.name in self._bits for each in self._doubts):
            self._all |= _NO_DOUBT
        else:
            self._all &= ~_NO_DOUBT

    # --- running ----------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether every input has its publisher."""
        return not self._doubts and all(watch.count for watch in self._watches.values())

    @property
    def good(self) -> bool:
        """Whether no input's present value was refused."""
        return all(entry.good for entry in self._inputs.values())

    @property
    def doubtful(self) -> bool:
        """Whether a topic has two publishers, of which one may be dead: see its watch."""
        return bool(self._doubts)

    def absent(self) -> str:
        """Name the topics without a publisher, and who should publish them."""
        return self._name(self._without_publisher())

    def missing(self) -> str:
        """Name the topics that the node waits for, and who should publish them.

        Those of a node that waits itself for another one of them are left out.
        """
        silent = self._by_publisher([n for n, bit in self._bits.items() if not self._fresh & bit])
        causes = root_causes(silent, self._interface.values())
        return self._name({role: silent[role] for role in silent if role in causes})

    def _name(self, silent: dict[str, list[str]]) -> str:
        return "; ".join(
            f"{', '.join(self._inputs[name].name for name in names)} from "
            f"{self.peers.call(role, self._watches[names[0]].names())}"
            for role, names in silent.items()
        )

    def _without_publisher(self) -> dict[str, list[str]]:
        return self._by_publisher([n for n, watch in self._watches.items() if not watch.count])

    def _by_publisher(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return those of the node's topics, by the role of who should publish them."""
        topics = {name: self._interface[name] for name in self._watches}
        return by_publisher(names, topics, self._role)

    def _act(self) -> None:
        self._fresh = 0
        self.acted = True
        self.on_inputs()

    def check(self) -> None:
        """Look at the wall clock: say how the node is, and act first once a joining node may.

        Raises:
            LockstepError: the graph cannot go on.
            ConfigurationError: nor can it as it was set up.
            OSError: nor can the node, for instance on a full disk.
        """
        now = time.monotonic()
        if now - self._looked > LISTEN_S:
            self._looked = now
            for watch in list(self._doubts):
                watch.settle(now)
            self._look_at_peers(now)
        if self.error is not None:
            raise self.error
        self._unfit.look()
        if self._reports.state == STARTING and self.ready:
            self._reports.state = READY
            self._report(now)
        elif now - self._reported > _REPORT_S:
            # Again and again, for a reader that joins late may miss what was said once.
            self._report(now)
        if self._all and self._fresh == self._all:  # joining, or a doubt is over
            if not self._joining:
                self._act()
            elif now - self._last_arrival > _SILENCE_S:
                self._joining = False
                self._act()

    def _look_at_peers(self, now: float) -> None:
        """Say who is missing before the run, and who goes in it; end with the run.

        A node that somebody supervises ends when it is asked to: the supervisor needs the last word
        of each, and names the node that failed first.

        Raises:
            LockstepError: the plant went in the run.
        """
        self.peers.look(now)
        if self._reports.state == FINISHED:
            passed = now - self._finished_since
            self.over = (
                not self._reports.supervised
                and passed > _LAST_WORD_S
                and not self.peers.running(now, just_finished=passed < _JOINING_S)
            )
        elif not self.acted:
            missing = {*self._without_publisher(), *self.peers.waited_for(self._role)}
            self.peers.say_missing(missing, now)
        elif not self._reports.supervised and "plant" not in self.final_reports:
            end = self.peers.end_of("plant", now)
            if end is not None:
                raise LockstepError(f"{end}, and the run with it")

    def finish(self) -> None:
        """Say from now on that the run is over for this node, with what its summary needs."""
        self._final_values = {"sent": dict(self.sent), **self.summary()}
        self._reports.state = FINISHED
        self._finished_since = time.monotonic()
        self._report(self._finished_since)

    def _report(self, now: float) -> None:
        self._reported = now
        starting = self._reports.state == STARTING
        waiting = {"waiting": list(self._without_publisher())} if starting else {}
        refused = {name: entry.refused for name, entry in self._inputs.items() if entry.refused}
        self._reports.say({
            **self.progress(), **waiting, "refused": refused, "warnings": self._unfit.warnings,
            **self._final_values,
        })

    def _on_report(self, report: Report) -> None:
        """Take a peer's report; one of an earlier run is none of this node's."""
        self.peers.hear(report)
        is_plant = report.role == "plant"
        if report.state == ENDED and "failure" in report.values:
            self._end_with(report)
        if not self.acted:
            if self._joining and (report.state == FINISHED or (is_plant and report.state == ENDED)):
                self._fresh = 0
            return
        if is_plant and report.state in (STARTING, READY):
            self._run_of = self._run_of or report.process
            if report.process != self._run_of and self._reports.state != FINISHED:
                self.error = self.error or LockstepError(
                    f"{report.name} was started again, or there are two; a run ends with its plant"
                )
        if report.state == FINISHED:
            self.final_reports[report.name] = report.values
            if is_plant and self._reports.state != FINISHED:
                self.on_plant_finished()

    def _end_with(self, report: Report) -> None:
        """End with a node that failed and on which this one depends, and say why it did."""
        needed = {self._publisher_of(name) for name in self._watches}
        alone = not self._reports.supervised
        if alone and report.role in needed and self._reports.state != FINISHED:
            self.error = self.error or LockstepError(
                f"{report.name} has ended: {report.values['failure']}"
            )

    def flush(self, failure: str | None) -> None:
        """Say that the node ends, and wait a second at most until its readers have all it said.

        Args:
            failure: what ended it; None where it was asked to end.
        """
        self._reports.state = ENDED
        if failure is not None:
            self._final_values["failure"] = failure
        self._report(time.monotonic())
        until = time.monotonic() + _FLUSH_S
        for publisher in [*self._outputs, self._reports.publisher]:
            left = max(0.0, until - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))
