"""The recorder node: every message of every tick into a bag, once."""

from __future__ import annotations

import struct
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rclpy.node import Node
from std_msgs.msg import Float64

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import recorded_topics
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import LISTEN_S, Link, LockstepError
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare
from greenroof_ros.recording.bag_writer import BagWriter


class RecorderNode:
    """Writes ticks whole, in the order of the contract, stamped with their simulated time.

    The k-th message of a topic belongs to tick k.
    """

    def __init__(self, node: Node) -> None:
        """Declare the parameters, make the bag and open the topics."""
        directory = declare(node, "directory", "bag", "the bag; must not exist")
        controller = declare(
            node, "controller", "mpc", "the active controller", among=tuple(CONTROLLERS)
        )
        self._limit = declare(
            node, "peer_limit", 5.0, "longest wait for the last messages (s)", low=0.1, high=1e6
        )
        self._topics = recorded_topics(["plant", "weather", controller])
        self._publishers = ["plant", "weather", controller]
        try:
            self._bag = BagWriter(Path(directory), self._topics)
        except FileExistsError:
            raise ConfigurationError(
                "exists; the recorder never writes over a bag", key="directory", value=directory
            ) from None
        self._closed = False
        self._finished_at: float | None = None
        self.link = link = Link(node, "recorder")
        link.turn = self._turn
        link.stop = self._stop
        self._publish_written = link.publish_topic("/recorder/written")
        self._written = Float64()
        self._queues: list[deque[bytes]] = [deque() for _ in self._topics]
        self._waiting = len(self._topics)  # how many topics have not yet sent the next tick
        for topic, queue in zip(self._topics, self._queues, strict=True):
            link.take_topic(topic.name, self._collect(queue), raw=True)
        self._clock = [topic.name for topic in self._topics].index("/clock")

    def _collect(self, queue: deque[bytes]) -> Callable[[bytes], None]:
        def callback(message: bytes) -> None:
            queue.append(message)
            if len(queue) == 1:
                self._waiting -= 1
                if not self._waiting:
                    self._write_ticks()

        return callback

    def _write_ticks(self) -> None:
        """Write every tick that is whole."""
        self.link.acted = True
        queues = self._queues
        while all(queues):
            messages = [queue.popleft() for queue in queues]
            # CDR: four bytes of header, then seconds and nanoseconds.
            seconds, nanoseconds = struct.unpack_from("<iI", messages[self._clock], 4)
            try:
                self._bag.write_tick(seconds * 1_000_000_000 + nanoseconds, messages)
            except OSError as error:
                self._closed = True  # closing would only fail again
                raise self._damaged(error) from error
            if self._bag.safe == self._bag.ticks:
                self._report_written()
        self._waiting = sum(not queue for queue in queues)

    def _report_written(self) -> None:
        self._written.data = float(self._bag.safe)
        self._publish_written(self._written)

    def _turn(self) -> float:
        if not self._closed and "plant" in self.link.final_reports:
            self._end()
        return LISTEN_S

    def _end(self) -> None:
        """Hold the counts against what the publishers say they sent, and close the bag."""
        reports = self.link.final_reports
        if self._finished_at is None:
            self._finished_at = time.monotonic()
        late = time.monotonic() - self._finished_at > self._limit
        ticks = reports["plant"]["sent"]["/clock"]
        missing = [name for name in self._publishers if name not in reports]
        complete = self._bag.ticks == ticks and not missing
        if not complete and not late:
            return
        self._close()
        self._report_written()
        if missing:
            raise LockstepError(f"no word from {', '.join(missing)} of what it sent")
        sent: dict[str, int] = {}
        for name in self._publishers:
            sent.update(reports[name]["sent"])
        wrong = [
            f"{topic.name}: {self._bag.ticks} recorded, {sent.get(topic.name, ticks)} sent, "
            f"{ticks} expected"
            for topic, queue in zip(self._topics, self._queues, strict=True)
            if not self._bag.ticks == sent.get(topic.name, ticks) == ticks or queue
        ]
        if wrong:
            raise LockstepError("messages were lost or doubled; " + "; ".join(wrong))
        self.link.finish(messages={topic.name: self._bag.ticks for topic in self._topics})

    def _close(self) -> None:
        self._closed = True
        try:
            self._bag.close()
        except OSError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: OSError) -> OSError:
        bag = self._bag.directory
        return OSError(
            f"{bag}: {error.strerror}; the run ends here, and 'python -m greenroof_ros.recover "
            f"{bag}' restores its first {self._bag.safe} ticks"
        )

    def _stop(self) -> None:
        """Close the bag with the ticks that are whole."""
        if not self._closed:
            self._close()


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("recorder", lambda node: RecorderNode(node).link, args))


if __name__ == "__main__":
    main()
