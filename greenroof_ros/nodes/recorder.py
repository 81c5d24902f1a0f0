"""The recorder node of a simulation, which writes each message of every tick to a bag once."""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, LockstepError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.registry import DEFAULT, find_controller
from greenroof_ros.interface.states import RECORDER
from greenroof_ros.interface.topics import recorded_topics
from greenroof_ros.results.bag_write import BagWriter
from greenroof_ros.ros.lockstep import CLOCK, LockstepNode
from greenroof_ros.ros.messages import decode_clock, decoder
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.ros.spin import node_command


def parameters(site: object = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    return [
        site_file(),
        Parameter(
            "directory", "bag", meaning="directory in which the bag is created; it must not exist",
        ),
        Parameter(
            "controller", DEFAULT, meaning="name of the active controller, or package.module:Class",
        ),
    ]


class RecorderNode(LockstepNode):
    """Node that writes complete ticks with their simulated time, in the order of the interface.

    The k-th message of a topic belongs to tick k. The bag uses the full names of topics, including
    the namespace of the graph.
    """

    def __init__(self) -> None:
        """Declare the parameters, create the bag and open the topics."""
        super().__init__(RECORDER, RECORDER)
        site = self.declare_site()
        values = declare(self, parameters())
        directory = Path(values["directory"])
        controller = find_controller(values["controller"])
        topics = recorded_topics(controller.outputs, site)
        if directory.exists():
            raise ConfigurationError(
                "exists, but the recorder never overwrites a bag", key="directory", value=directory
            )
        self._full_names = [self.resolve_topic_name(topic.graph_name) for topic in topics]
        self._bag = BagWriter(directory, [
            replace(topic, name=name) for topic, name in zip(topics, self._full_names, strict=True)
        ])
        self._closed = False
        self.open_outputs("/recorder/written")
        self._queues: dict[str, deque[bytes]] = {topic.name: deque() for topic in topics}
        for topic in topics:
            self.open(topic.name, partial(self._receive, topic.name, decoder(topic.type)))

    def _receive(self, name: str, decode: Callable[[bytes], Any], message: bytes) -> None:
        """Queue a message of a topic, and write every tick that has become complete.

        Raises:
            LockstepError: if the bag is already closed.
        """
        decode(message)  # a malformed message is not recorded
        if self._closed:
            raise self._superfluous(name)
        self._queues[name].append(message)
        while all(queues := self._queues.values()):
            now = decode_clock(self._queues[CLOCK][0])
            self._save(self._bag.write_tick, now, [queue.popleft() for queue in queues])
            self.tick, self.time_ns = self._bag.written, now
            if self._bag.safe == self.tick:
                self._report_written()
            self._end_if_complete()

    def _end_if_complete(self) -> None:
        """Close the bag once the last tick is written.

        Raises:
            LockstepError: if a topic has more messages.
        """
        if self._closed or self.tick <= self.last_tick:
            return
        for name, queue in self._queues.items():
            if queue:
                raise self._superfluous(name)
        self.on_stop()
        self._report_written()
        self.finish()

    def _superfluous(self, name: str) -> LockstepError:
        return LockstepError(
            f"{name} has a second message in tick {self.tick} (after the last tick)"
        )

    def on_timer(self, now: float) -> None:
        """End if ``/run`` has arrived after the last tick; the plant finds what is missing."""
        self._end_if_complete()

    def progress(self) -> dict[str, Any]:
        """Return the bag's absolute path."""
        return {"bag": str(self._bag.directory.resolve())}

    def _report_written(self) -> None:
        self.publish("/recorder/written", float(self._bag.safe))

    def summary(self) -> dict[str, Any]:
        """Return the number of messages in the bag, by topic."""
        return {"messages": dict.fromkeys(self._full_names, self.tick)}

    def _save(self, act: Callable[..., None], *arguments: Any) -> None:
        """Write to the bag; an error of the disk closes it, and says how to restore it."""
        try:
            act(*arguments)
        except OSError as error:
            self._closed = True  # closing it would only fail again
            self._bag.cut()
            bag = self._bag.directory
            raise OSError(
                f"{bag}: {error.strerror}; 'greenroof recover {bag}' restores the first "
                f"{self._bag.safe} ticks of the bag"
            ) from error

    def on_stop(self) -> None:
        """Close the bag, which then contains all complete ticks."""
        if not self._closed:
            self._closed = True
            self._save(self._bag.close)


main = node_command(RecorderNode, __doc__)


if __name__ == "__main__":
    main()
