"""Lockstep over topics: a node acts once every input has arrived since it last acted.

Before a node acts first it has to know of which tick what comes is: see
:mod:`greenroof_ros.graph.handshake`. There are no timers and no sleeps on the way of a tick; the
only wall clocks here end a run which hangs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from typing import Any, Protocol, cast

from rclpy.node import Node

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.arrivals import Arrivals
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.handshake import PLANT, Handshake
from greenroof_ros.graph.inputs import Inputs
from greenroof_ros.graph.live import LivePublishers
from greenroof_ros.graph.peers import Peers, root_causes
from greenroof_ros.graph.publishers import UNKNOWN_NAME, PublisherWatch, names_of_publishers
from greenroof_ros.graph.reports import Report, Reports
from greenroof_ros.graph.states import ENDED, FINISHED, READY, STARTING
from greenroof_ros.graph.validation import Input

# Among nodes that say nothing of their ticks the newest message is the present tick's, once no
# other came for so long (s).
_SILENCE_S = 0.5
# How long a node that nobody supervises still says at least that it has finished (s).
_LAST_WORD_S = 1.0
# For how long after that a node that has not joined may still be one of this run (s).
_JOINING_S = 5.0
# Among the inputs that must be fresh: that none of them has two publishers, of which one may live.
_NO_DOUBT = 1 << 32


class LockstepNode(Protocol):
    """What lockstep needs of its node; see :class:`greenroof_ros.graph.link.LinkedNode`."""

    role: str
    acted: bool
    over: bool
    error: Exception | None
    final_reports: dict[str, dict[str, Any]]
    inputs: Inputs
    interface: dict[str, Topic]
    peers: Peers
    reports: Reports
    repeats: bool

    def on_inputs(self) -> None:
        """Act."""

    def on_begin(self, tick: int) -> None:
        """Take the tick from which the node answers."""

    def on_restart(self, name: str) -> None:
        """Wait anew for a node that was started again."""

    def on_answered_again(self, name: str) -> None:
        """Forget what came on a topic for the present tick."""

    def on_plant_finished(self) -> None:
        """End the run for this node."""

    def begins_at(self) -> int | None:
        """Return the tick from which the node answers, if it knows it by itself."""

    def taken(self, name: str) -> int:
        """Return how many messages of a topic the node has had."""

    def take_again(self, name: str, first: int) -> None:
        """Expect a topic from a tick on."""

    def take_all(self, names: Collection[str]) -> None:
        """Take all messages of some inputs that are here and were not yet taken."""

    def report_soon(self) -> None:
        """Say at once how the node is."""

    def tick_is_open(self) -> bool:
        """Whether the plant has published a tick on which this node has not acted."""


class Lockstep:
    """Makes a node act when every input is fresh, and end with its run.

    Attributes:
        simulated_time: whether the node's clock is that of the run.
        joining: whether the node does not yet take part, and messages have to come with their
            numbers, which only rclpy's slower executor hands on.
    """

    simulated_time = True

    def __init__(self, node: LockstepNode) -> None:
        """Begin to join.

        Args:
            node: that is to act.
        """
        self._node = node
        self._act_on_inputs = node.on_inputs
        self._watches: dict[str, PublisherWatch] = {}
        self._entries: list[Input] = []
        self._bits: dict[str, int] = {}  # of the inputs that must be fresh
        self._fresh = 0
        self._all = 0
        self._tick = 0  # on which it acts next
        self._again: dict[str, int] = {}  # how many messages that it has had come again
        self._without_report: set[str] = set()  # inputs that came from who had said nothing yet
        self.joining = node.role != PLANT  # the others wait for the plant
        self._arrivals: dict[str, Arrivals] = {}
        self._receivers: dict[str, Callable[[bytes], None]] = {}
        self._last_arrival = time.monotonic()
        self._doubts: set[PublisherWatch] = set()
        self._run_of: str | None = None  # the process of its plant
        self._finished_since = 0.0

    def start(self, ros_node: Node) -> None:
        """Be ready to hear other nodes; the node can say by now how it is.

        Args:
            ros_node: the node as rclpy has it.
        """
        node = self._node
        self._ros_node = ros_node
        self._handshake = Handshake(
            node.role, node.reports.process, node.interface, repeats=node.repeats
        )

    def open(
        self, node: Node, entry: Input, callback: Callable[[Any], None] | None, *, raw: bool,
        heals: bool, **rules_of_live_graphs: object,
    ) -> tuple[PublisherWatch | LivePublishers, Callable[[bytes], None]]:
        """Prepare an input; see :meth:`greenroof_ros.graph.link.LinkedNode.subscribe`.

        Args:
            node: subscribes to it.
            entry: the input.
            callback: called with each value; without it the input must be fresh.
            raw: the callback gets the message.
            heals: a second publisher ends nothing; the node looks itself whether there is one.
            rules_of_live_graphs: none of these counts here.

        Returns:
            What counts its publishers, and what receives its messages once the node takes part.
        """
        name = entry.topic.name
        self._entries.append(entry)
        bit = 0
        if callback is None:
            self._bits[name] = bit = 1 << len(self._bits)
            self._all |= bit
        receive: Callable[[bytes], None] = entry.receive
        if callback is not None:
            receive = callback if raw else _with_value(entry, callback)
        self._receivers[name] = receive
        self._arrivals[name] = Arrivals(entry.name)
        if heals:
            return (
                LivePublishers(node, entry.topic, self._node.peers, recorded=False, past=True),
                self._when_fresh(entry, bit, lambda: None),
            )

        def on_second(*, answered: bool) -> None:
            if self._publisher_of(name) in self._handshake.nodes:
                return  # it says which tick it answers
            if self._node.acted and bit and not self._awaits_publisher_of(name):
                self._refuse(
                    f"a second publisher of {entry.name} ({watch.said_names()}) came when the "
                    "first had answered the tick; which tick it answers cannot be told: end all "
                    "nodes and start the run again"
                )
            if not self.joining and not answered:
                self._fresh &= ~bit
            self._node.on_answered_again(name)

        self._watches[name] = watch = PublisherWatch(
            node, entry.topic, self._refuse, self._on_doubt, on_second, recorded=raw
        )
        return watch, self._when_fresh(entry, bit, watch.came_twice) if bit else receive

    def while_joining(self, name: str) -> Callable[[bytes, Any], None]:
        """Return what receives the messages of an input, and what rclpy says of each, till then."""
        arrivals = self._arrivals[name]
        if not self._node.interface[name].per_tick:
            return lambda message, information: self._receivers[name](message)

        def on_message(message: bytes, information: Any) -> None:
            arrivals.take(message, information)
            self._last_arrival = time.monotonic()

        return on_message

    def said(self) -> dict[str, Any]:
        """Return what the node says of its ticks."""
        return self._handshake.said()

    def _publisher_of(self, name: str) -> str:
        """Return the role of who publishes a topic: of two that may, the one that is here."""
        roles = [role for role in self._node.interface[name].publishers if role != self._node.role]
        here = [role for role in roles if self._handshake.is_here(role)]
        return [*roles[:1], *here][-1]

    def _names_of(self, role: str) -> list[str]:
        """Return the inputs of each tick that a role publishes."""
        return [
            name for name in self._arrivals
            if self._node.interface[name].per_tick and self._publisher_of(name) == role
        ]

    # --- which tick -------------------------------------------------------------------------

    def taken(self, name: str) -> int:
        """Return how many messages of a topic, one a tick, the node has had."""
        if self.joining:
            return self._arrivals[name].next or 0
        return self._tick + bool(self._fresh & self._bits.get(name, 0))

    def take_again(self, name: str, first: int) -> None:
        """Expect a topic from a tick on; what the node has had of it counts once.

        Raises:
            LockstepError: a message was lost.
        """
        taken = self.taken(name)
        if first > taken:
            raise LockstepError(
                f"{self._node.inputs.entries[name].name} of tick {taken} was lost with the node "
                "that published it; end all nodes and start the run again"
            )
        if first < taken:
            self._again[name] = taken - first

    def _settle(self) -> None:
        """Tell the others what they must know, and take what they told."""
        node, handshake = self._node, self._handshake
        changed = False
        if handshake.answers_from is None:
            begins_at = node.begins_at()
            if begins_at is not None:
                handshake.answers_from, handshake.agreed = begins_at, True
                self._begin(begins_at)
                changed = True
            elif handshake.decide(supervised=node.reports.supervised):
                self._begin(cast(int, handshake.answers_from))
                changed = True
        elif handshake.decide(supervised=node.reports.supervised):
            changed = True
        if handshake.answers_from is not None:
            for role in handshake.nodes:
                if handshake.must_be_told(role):
                    handshake.tell(role, {n: node.taken(n) for n in self._names_of(role)})
                    changed = True
                if handshake.may_agree(role):
                    self._agree(role)
                    changed = True
        if changed:
            node.report_soon()

    def _begin(self, tick: int) -> None:
        self._tick = tick
        for arrivals in self._arrivals.values():
            arrivals.next = tick
        self._node.on_begin(tick)

    def _agree(self, role: str) -> None:
        """Take a role's present process for who publishes its topics."""
        handshake = self._handshake
        first = cast(int, handshake.first_of(role))
        handshake.agree(role)
        told = handshake.taken[handshake.nodes[role]]
        # What is said again first: the recorder writes a tick as soon as it is whole.
        for name in sorted(told, key=self._node.taken, reverse=True):
            # Of a first process all is its own, though its report came later than its messages.
            own = first == 0 and name in self._without_report
            self._without_report.discard(name)
            if not own and (not self.joining or first > told[name]):
                self._node.take_again(name, first)
                self._arrivals[name].next = max(first, self._arrivals[name].next or 0)
            self._arrivals[name].first = first
            if role == PLANT and len(self._node.interface[name].publishers) > 1:
                # It may be that of a pump node whose report is yet to come.
                self._without_report.add(name)

    def _join(self) -> None:
        """Act on what came while the node was joining, and take part from then on."""
        node, handshake = self._node, self._handshake
        if not handshake.agreed:
            if handshake.answers_from is None and self._nobody_says_ticks():
                handshake.answers_from, handshake.agreed = 0, True
                self._begin(0)
                for arrivals in self._arrivals.values():
                    arrivals.begin_with_newest()
            return
        self._act_on_arrivals()
        if node.acted and all(arrivals.first is not None for arrivals in self._arrivals.values()):
            # The fast executor keeps the order in which messages come, but does not know that of
            # those which are here already.
            node.take_all(self._arrivals)
            self._act_on_arrivals()
            dues = {name: self._arrivals[name].due for name in self._bits}
            if any(len(due) > 1 for due in dues.values()):
                return
            self.joining = False
            for name, due in dues.items():
                if due:
                    self._receivers[name](due.popleft())
                    self._fresh |= self._bits[name]

    def _act_on_arrivals(self) -> None:
        """Hand on what came of the ticks that are wanted, and act on each tick that is whole."""
        for name, arrivals in self._arrivals.items():
            if arrivals.first is None and self._handshake.is_foreign(self._publisher_of(name)):
                arrivals.first = 0
                self._without_report.add(name)
            arrivals.sort()
            if name not in self._bits:
                while arrivals.due:
                    self._receivers[name](arrivals.due.popleft())
        if self._bits and not self._all & _NO_DOUBT:
            dues = {name: self._arrivals[name].due for name in self._bits}
            while all(dues.values()):
                for name, due in dues.items():
                    self._receivers[name](due.popleft())
                self._act()

    def _nobody_says_ticks(self) -> bool:
        """Whether all inputs are here, and the plant is none that says of which tick they are."""
        arrivals = [self._arrivals[name] for name in self._bits]
        if (
            PLANT in self._handshake.nodes
            or not all(one.came for one in arrivals)
            or time.monotonic() - self._last_arrival < _SILENCE_S
        ):
            return False
        reporting = names_of_publishers(self._ros_node, "/diagnostics")
        publishing = {
            node for name in self._bits if self._publisher_of(name) == PLANT
            for node in names_of_publishers(self._ros_node, name.removeprefix("/"))
        }
        return UNKNOWN_NAME not in publishing and not publishing & reporting

    def _awaits_publisher_of(self, name: str) -> bool:
        """Whether a tick waits for the node that publishes a topic.

        One that is started again answers the newest tick that it sees. Only where that tick still
        waits for it does it answer once; otherwise the answer would count for the next tick.
        """
        publisher_of = self._node.inputs.publisher_of
        bits = sum(
            bit for other, bit in self._bits.items() if publisher_of(other) == publisher_of(name)
        )
        return self._node.tick_is_open() and self._fresh & bits != bits

    def tick_is_open(self) -> bool:
        """Whether the plant has published a tick on which the node has not acted."""
        return all(
            self._fresh & bit
            for name, bit in self._bits.items()
            if self._node.inputs.publisher_of(name) == "plant"
        )

    def _when_fresh(
        self, entry: Input, bit: int, came_twice: Callable[[], None]
    ) -> Callable[[bytes], None]:
        """Return what receives an input, and acts when it was the last one missing."""
        receive = entry.receive
        name, again = entry.topic.name, self._again

        def on_message(message: bytes) -> None:
            if again and name in again:
                again[name] -= 1
                if not again[name]:
                    del again[name]
                return
            receive(message)
            if self._fresh & bit:
                came_twice()
            self._fresh |= bit
            if self._fresh == self._all:
                self._act()

        return on_message

    def _refuse(self, message: str) -> None:
        """Refuse a second publisher: a wrong set-up before the run, in it a failure of the run."""
        kind = LockstepError if self._node.acted else OccupiedError
        self._node.error = self._node.error or kind(message)

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

    def good(self) -> bool:
        """Whether no input's present value was refused."""
        return all(entry.good for entry in self._entries)

    @property
    def doubtful(self) -> bool:
        """Whether a topic has two publishers, of which one may be dead: see its watch."""
        return bool(self._doubts)

    def missing(self) -> str:
        """Name the topics that the node waits for, and who should publish them.

        Those of a node that waits itself for another one of them are left out.
        """
        inputs = self._node.inputs
        silent = inputs.by_role([n for n, bit in self._bits.items() if not self._fresh & bit])
        causes = root_causes(silent, self._node.interface.values())
        return inputs.say({role: silent[role] for role in silent if role in causes})

    def _act(self) -> None:
        self._fresh = 0
        self._tick += 1
        self._node.acted = True
        self._act_on_inputs()

    def due_in(self) -> float:
        """How long until the node must act whatever comes (s): it need not."""
        return math.inf

    def act_if_due(self) -> None:
        """Act where nothing more has to come: first, or when a doubt is over."""
        if self.joining:
            self._join()
        elif self._all and self._fresh == self._all:
            self._act()

    def look(self, now: float) -> None:
        """Look whether doubts are over, say who is missing or goes, and end with the run.

        A node that somebody supervises ends when it is asked to: the supervisor needs the last word
        of each, and names the node that failed first.

        Args:
            now: of the steady clock (s).

        Raises:
            LockstepError: the plant went in the run.
        """
        for watch in list(self._doubts):
            watch.settle(now)
        node, peers, reports = self._node, self._node.peers, self._node.reports
        peers.look(now)
        self._settle()
        if (
            self.joining and "plant" in node.final_reports and self._handshake.agreed
            and reports.state != FINISHED
        ):
            node.on_plant_finished()  # nothing is left to answer
        if reports.state == FINISHED:
            passed = now - self._finished_since
            node.over = (
                not reports.supervised
                and passed > _LAST_WORD_S
                and not peers.running(now, just_finished=passed < _JOINING_S)
            )
        elif not node.acted:
            missing = {*node.inputs.absent(), *peers.waited_for(node.role)}
            peers.say_missing(missing, now)
        elif not reports.supervised and "plant" not in node.final_reports:
            end = peers.end_of("plant", now)
            if end is not None:
                raise LockstepError(f"{end}, and the run with it")

    def finish(self, now: float) -> None:
        """Note when the run was over for the node (s of the steady clock)."""
        self._finished_since = now

    def hear(self, report: Report) -> None:
        """Take a peer's report; one of an earlier run is none of this node's."""
        node = self._node
        is_plant = report.role == "plant"
        if report.state == ENDED and "failure" in report.values:
            self._end_with(report)
        known = self._handshake.nodes.get(report.role) == report.process
        again = self._handshake.hear(report)
        if not known and self._handshake.nodes.get(report.role) == report.process:
            self._on_process(report, again=again)
        self._settle()
        if not node.acted and not (self.joining and node.reports.supervised):
            if self.joining and (report.state == FINISHED or (is_plant and report.state == ENDED)):
                for arrivals in self._arrivals.values():
                    arrivals.forget()
                self._handshake.begin()
            return
        if is_plant and report.state in (STARTING, READY):
            self._run_of = self._run_of or report.process
            if (
                report.process != self._run_of and node.acted
                and node.reports.state != FINISHED
            ):
                node.error = node.error or LockstepError(
                    f"{report.name} was started again, or there are two; a run ends with its plant"
                )
        if report.state == FINISHED:
            node.final_reports[report.name] = report.values
            if is_plant and node.reports.state != FINISHED and not self.joining:
                node.on_plant_finished()

    def _on_process(self, report: Report, *, again: bool) -> None:
        """Go on with a node that has come, or begin anew with another plant.

        Args:
            report: its first.
            again: whether it is in the place of another.
        """
        if report.role == PLANT:
            if again and not self._node.acted:
                self._handshake.begin()
                for arrivals in self._arrivals.values():
                    arrivals.next = None
            return
        if self.joining and "silent_at" in report.values:
            # It had not published yet: what was published before that is of the one before it.
            names = self._names_of(report.role)
            self._node.take_all(names)
            for name in names:
                self._arrivals[name].of_another(report.values["silent_at"])
        if again:
            self._node.on_restart(report.name)

    def _end_with(self, report: Report) -> None:
        """End with a node that failed and on which this one depends, and say why it did."""
        node = self._node
        needed = {node.inputs.publisher_of(name) for name in self._watches}
        alone = not node.reports.supervised
        if alone and report.role in needed and node.reports.state != FINISHED:
            node.error = node.error or LockstepError(
                f"{report.name} has ended: {report.values['failure']}"
            )


def _with_value(entry: Input, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
    """Return what receives an input and hands its value on."""

    def on_message(message: bytes) -> None:
        entry.receive(message)
        callback(entry.value)

    return on_message
