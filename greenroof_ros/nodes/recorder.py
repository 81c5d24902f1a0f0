"""The recorder node of a simulation, which writes each message of every tick to a bag once."""

from __future__ import annotations

from greenroof_ros.ros import begin_node

begin_node(__name__)

from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.registry import DEFAULT, find_controller
from greenroof_ros.interface.states import RECORDER
from greenroof_ros.interface.topics import recorded_topics
from greenroof_ros.results.bag_write import BagWriter
from greenroof_ros.ros.errors import LockstepError
from greenroof_ros.ros.executable import node_command
from greenroof_ros.ros.lockstep import CLOCK
from greenroof_ros.ros.messages import decode_clock
from greenroof_ros.ros.node import SimulationNode
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.site.site import Site


def parameters(site: Site | None = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    return [
        site_file(),
        Parameter(
            "directory", "bag", meaning="directory in which the bag is created; it must not exist",
        ),
        Parameter(
            "controller", DEFAULT, meaning="name of the active controller, or package.module:Class",
        ),
        Parameter(
            "peer_limit", 5.0, "s", 0.1, 1e6, "longest time to wait for the messages of the last "
            "tick",
        ),
    ]


# How many messages a topic may be ahead of the slowest: the plant is no more than 32 ticks ahead of
# the bag, and a publisher of another package may send its first messages early.
_MAX_AHEAD = 1000


class RecorderNode(SimulationNode):
    """Node that writes complete ticks with their simulated time, in the order of the interface.

    The k-th message of a topic belongs to tick k. The bag uses the full names of topics, including
    the namespace of the graph.
    """

    def __init__(self) -> None:
        """Declare the parameters, create the bag and open the topics."""
        super().__init__(RECORDER, RECORDER)
        site = self.declare_site()
        values = declare(self, parameters())
        directory = values["directory"]
        self._limit = values["peer_limit"]
        try:
            controller = find_controller(values["controller"])
            topics = recorded_topics(controller.outputs, site.low_outlet_valve)
        except ConfigurationError as error:
            raise ConfigurationError(f"parameter controller of recorder: {error}") from error
        self._in_bag = [
            replace(topic, name=self.resolve_topic_name(topic.graph_name))
            for topic in topics
        ]
        if Path(directory).exists():
            raise ConfigurationError(
                "exists, but the recorder never overwrites a bag", key="directory", value=directory
            )
        self._bag = BagWriter(Path(directory), self._in_bag)
        self._closed = False
        self._ending_since: float | None = None
        self.open_outputs("/recorder/written")
        self._queues: dict[str, deque[bytes]] = {topic.name: deque() for topic in topics}
        self._every_queue = self._queues.values()
        for name in self._queues:
            self.record(name, partial(self._receive, name))

    def _receive(self, name: str, message: bytes) -> None:
        """Queue a message of a topic, and write every tick that has become complete.

        Raises:
            LockstepError: if the topic is further ahead of the other topics than lockstep allows,
                or the bag is already closed.
        """
        if self._closed:
            raise LockstepError(
                f"{name} has a second message in tick {self._bag.written} (after the last tick)"
            )
        queue = self._queues[name]
        queue.append(message)
        if len(queue) > _MAX_AHEAD:
            late = min(self._queues, key=lambda other: len(self._queues[other]))
            raise LockstepError(
                f"{name} is {len(queue)} messages ahead of {late}, but every topic must have "
                "exactly one message per tick"
            )
        while all(self._every_queue):
            now = decode_clock(self._queues[CLOCK][0])
            try:
                self._bag.write_tick(now, [queue.popleft() for queue in self._every_queue])
            except OSError as error:
                self._closed = True  # closing it would only fail again
                raise self._damaged(error) from error
            if self._bag.safe == self._bag.written:
                self._report_written()
            self.set_time(now)
            self._end_if_complete()

    def progress(self) -> dict[str, Any]:
        """Return the bag's absolute path."""
        return {"bag": str(self._bag.directory.resolve())}

    def _report_written(self) -> None:
        self.publish("/recorder/written", float(self._bag.safe))

    @property
    def acted(self) -> bool:
        """Whether the recorder has written at least one tick."""
        return self._bag.written > 0

    def _end_if_complete(self) -> None:
        """Close the bag once the last tick is written, unless there are superfluous messages."""
        run = self.lockstep.run
        if self.finished or run is None or self._bag.written <= run.last_tick:
            return
        if not any(self._every_queue):
            self._close()
            self._report_written()
            self.finish()

    def on_timer(self, now: float) -> None:
        """Raise an error if the last tick is still incomplete after the time limit.

        Raises:
            LockstepError: if a topic has too few or too many messages.
        """
        run = self.lockstep.run
        if self.finished or run is None:
            return
        self._end_if_complete()  # /run may have arrived after the last tick
        ticks = round(run.last_tick) + 1
        counts = {name: self._bag.written + len(queue) for name, queue in self._queues.items()}
        if self.finished or max(counts.values()) < ticks:
            return
        if self._ending_since is None:
            self._ending_since = now
        elif now - self._ending_since > self._limit:
            wrong = ", ".join(
                f"{name}: {count}" for name, count in counts.items() if count != ticks
            )
            raise LockstepError(
                f"expected {ticks} messages of each topic; some were lost or arrived twice: {wrong}"
            )

    def summary(self) -> dict[str, Any]:
        """Return the number of messages in the bag, by topic."""
        return {"messages": {topic.name: self._bag.written for topic in self._in_bag}}

    def _close(self) -> None:
        self._closed = True
        try:
            self._bag.close()
        except OSError as error:
            raise self._damaged(error) from error

    def _damaged(self, error: OSError) -> OSError:
        self._bag.cut()
        bag = self._bag.directory
        return OSError(
            f"{bag}: {error.strerror}; 'greenroof recover {bag}' restores the first "
            f"{self._bag.safe} ticks of the bag"
        )

    def on_stop(self) -> None:
        """Close the bag, which then contains all complete ticks."""
        if not self._closed:
            self._close()


main = node_command(RecorderNode, __doc__)


if __name__ == "__main__":
    main()
