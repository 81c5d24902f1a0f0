"""The recorder node of a simulation: every message of every tick into a bag, once."""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import recorded_topics
from greenroof_ros.controllers.registry import DEFAULT, find_controller
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.link import CLOCK, LISTEN_S, LinkedNode
from greenroof_ros.graph.node_help import NodeParser, node_help
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import NodeParameter, declare
from greenroof_ros.graph.serialization import decode_clock, encoder
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.continued_bag import continue_bag

PARAMETERS = (
    NodeParameter("directory", "bag", "the bag; must not exist"),
    NodeParameter(
        "go_on", False, "the bag may exist: another recorder of this run was killed; the run goes "
        "on in another file of it",
    ),
    NodeParameter(
        "controller", DEFAULT, "the active controller: a name, or package.module:Class"
    ),
    NodeParameter("peer_limit", 5.0, "longest wait for the last messages (s)", 0.1, 1e6),
)


class RecorderNode(LinkedNode):
    """Writes ticks whole, in the order of the interface, stamped with their simulated time.

    The k-th message of a topic belongs to tick k. The bag has the names on the wire, with the
    namespace in which the graph runs.
    """

    def __init__(self) -> None:
        """Declare the parameters, make the bag and open the topics."""
        super().__init__("recorder", "recorder", may_be_live=False)
        values = declare(self, PARAMETERS)
        directory = values["directory"]
        self._limit = values["peer_limit"]
        try:
            controller = find_controller(values["controller"])
            self._topics = recorded_topics(controller.outputs)
        except ConfigurationError as error:
            raise ConfigurationError(f"parameter controller of recorder: {error}") from error
        self._in_bag = [
            replace(topic, name=self.resolve_topic_name(topic.graph_name))
            for topic in self._topics
        ]
        self._reporting = ("plant", "weather", controller.name)
        self.peers.names["controller"] = controller.name
        try:
            open_bag = continue_bag if values["go_on"] else BagWriter
            self._bag = open_bag(Path(directory), self._in_bag)
        except FileExistsError:
            raise ConfigurationError(
                "exists; the recorder never writes over a bag", key="directory", value=directory
            ) from None
        self._closed = False
        self._lost: list[tuple[str, int]] = []
        self._flush_at = 0  # ticks
        self._finished_at: float | None = None
        self._publish_written = self.publish_topic("/recorder/written")
        self._queues: list[deque[bytes]] = [deque() for _ in self._topics]
        self._queue_of = {
            topic.name: queue for topic, queue in zip(self._topics, self._queues, strict=True)
        }
        self._waiting = len(self._topics)  # how many topics have not yet sent the next tick
        for topic, queue in zip(self._topics, self._queues, strict=True):
            self.subscribe(topic.name, self._collect(queue), raw=True)
        self._clock_index = [topic.name for topic in self._topics].index(CLOCK)
        if self._bag.ticks:
            self._report_written()

    def _collect(self, queue: deque[bytes]) -> Callable[[bytes], None]:
        def callback(message: bytes) -> None:
            queue.append(message)
            if len(queue) == 1:
                self._waiting -= 1
                if not self._waiting:
                    self._write_ticks()

        return callback

    def on_answered_again(self, name: str) -> None:
        """Let go of a message of the present tick, of which /clock is the newest that came."""
        queue = self._queue_of[name]
        if name != CLOCK and len(queue) == len(self._queue_of[CLOCK]) > 0:
            queue.pop()
            self._waiting += not queue

    def begins_at(self) -> int:
        """Return how many ticks are in the bag; of those that come it is the first."""
        return self._bag.ticks

    def taken(self, name: str) -> int:
        """Return how many messages of a topic came, those in the bag included."""
        return self._bag.ticks + len(self._queue_of[name])

    def take_again(self, name: str, first: int) -> None:
        """Expect a topic from a tick on; what came of that tick is said again.

        What a node that was killed said last may have come to the plant and not here. The plant
        knows the commands, and a driver's flows; the rest is lost, and stands in the bag as what
        was not decided.

        Raises:
            LockstepError: more is lost than the plant knows.
        """
        queue = self._queue_of[name]
        taken = self.taken(name)
        # Nobody can say again what is of the ticks before, should this node be killed, too.
        self._flush_at = max(first, self._bag.ticks)
        for _ in range(taken - first):
            queue.pop()
        encode = encoder(self.interface[name].type)
        for tick in range(taken, first):
            queue.append(encode(self._lost_value(name, tick)))
        self._waiting = sum(not one for one in self._queues)
        if not self._waiting:
            self._write_ticks()

    def _lost_value(self, name: str, tick: int) -> float | array[float]:
        """Return what stands in the bag for a message that a killed node gave the plant alone."""
        entry = self.inputs.entries[name]
        received: dict[str, tuple[int, list[float]]] = self.peers.said_by("plant")["received"]
        if name in received:
            count, values = received[name]
            if tick >= count - len(values):
                return values[tick - count]
        if not entry.topic.optional:
            raise LockstepError(
                f"{entry.name} of tick {tick} was lost with the node that published it; end all "
                "nodes and start the run again"
            )
        self.get_logger().warning(
            f"{entry.name} of tick {tick} was lost with the node that published it; in the bag it "
            "is as if the controller had not decided"
        )
        self._lost.append((name, tick))
        return entry.topic.undecided

    def progress(self) -> dict[str, Any]:
        """Return where the bag is, an absolute path, and what was lost with killed nodes."""
        return {"bag": str(self._bag.directory.resolve()), "lost": self._lost}

    def _write_ticks(self) -> None:
        """Write every tick that is whole."""
        self.acted = True
        queues = self._queues
        while all(queues):
            messages = [queue.popleft() for queue in queues]
            now = decode_clock(messages[self._clock_index])
            try:
                self._bag.write_tick(now, messages)
                if self._flush_at and self._bag.ticks >= self._flush_at:
                    self._bag.flush()
                    self._flush_at = 0
            except OSError as error:
                self._closed = True  # closing would only fail again
                raise self._damaged(error) from error
            if self._bag.safe == self._bag.ticks:
                self._report_written()
        self._waiting = sum(not queue for queue in queues)
        self.set_time(now)

    def _report_written(self) -> None:
        self._publish_written(float(self._bag.safe))

    def on_plant_finished(self) -> None:
        """Wait for the last messages of the others, too; see :meth:`on_idle`."""

    def on_idle(self) -> float:
        """End the bag when all that was sent is in it."""
        if not self._closed and "plant" in self.final_reports:
            self._end()
        return LISTEN_S

    def _end(self) -> None:
        """Hold the counts against what the publishers say they sent, and close the bag."""
        reports = self.final_reports
        if self._finished_at is None:
            self._finished_at = time.monotonic()
        late = time.monotonic() - self._finished_at > self._limit
        ticks = reports["plant"]["sent"]["/clock"]
        missing = [name for name in self._reporting if name not in reports]
        complete = self._bag.ticks == ticks and not missing
        if not complete and not late:
            return
        self._close()
        self._report_written()
        if missing:
            raise LockstepError(f"{', '.join(missing)} did not report the messages sent")
        sent: dict[str, int] = {}
        for name in self._reporting:
            # A node that was started again did not send the ticks before the one that it began at.
            began = reports[name]["answers_from"] or 0
            sent.update({topic: began + count for topic, count in reports[name]["sent"].items()})
        wrong = [
            f"{topic.name}: {self._bag.ticks + len(queue)} came, "
            f"{sent.get(topic.name, ticks)} sent, {ticks} expected"
            for topic, queue in zip(self._topics, self._queues, strict=True)
            if not self._bag.ticks == sent.get(topic.name, ticks) == ticks or queue
        ]
        if wrong:
            raise LockstepError("messages were lost or came twice; " + "; ".join(wrong))
        self.finish()

    def summary(self) -> dict[str, Any]:
        """Return how many messages of each topic are in the bag."""
        return {"messages": {topic.name: self._bag.ticks for topic in self._in_bag}}

    def _close(self) -> None:
        self._closed = True
        try:
            self._bag.close()
        except OSError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: OSError) -> OSError:
        bag = self._bag.directory
        return OSError(
            f"{bag}: {error.strerror}; 'greenroof recover {bag}' restores its first "
            f"{self._bag.safe} ticks"
        )

    def on_stop(self) -> None:
        """Close the bag with the ticks that are whole."""
        if not self._closed:
            self._close()


def _help() -> str:
    return node_help(
        "recorder", "recorder", __doc__, PARAMETERS,
        "--ros-args -p directory:=my_bag -p controller:=mpc",
    )


@command
def main() -> int:
    """Run the node."""
    if NodeParser().own_arguments().help:
        print(_help())
        return EXIT_DONE
    return run_node(RecorderNode)


if __name__ == "__main__":
    main()
