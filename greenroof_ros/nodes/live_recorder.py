"""The recorder node of a live site: every message that comes, as it comes, for months.

Into a bag's files by size and by day (UTC), with the time at which it came. The oldest files go
when the bag reaches its limit. What came is on the disk after 10 s. A full disk ends the recording
and is an alarm, and nothing else: the node lives on, and tries again every minute. So is a disk
that hangs: what comes waits in memory, up to 32 MB, and is written when the disk goes on.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.common.disk import DISK
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.parameters import declare
from greenroof_ros.model.site import Site
from greenroof_ros.recording.bag_writer import LiveBag

_MB = 1e6
# How often it is looked whether it is time to flush (s), and how long the end waits for the disk.
_LOOK_S, _WRITTEN_S = 1.0, 4.0


def parameters(site: Site | None = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    return [
        Parameter("directory", "bag", meaning="the bag; goes on with one that is there"),
        Parameter(
            "file_limit", 100.0, "MB", 0.1, 1e6, "size at which a file of the bag ends and the "
            "next begins",
        ),
        Parameter(
            "total_limit", 10_000.0, "MB", 0.2, 1e9, "size beyond which the bag's oldest files are "
            "removed, at least twice file_limit",
        ),
    ]


class LiveRecorderNode(LinkedNode):
    """Writes the topics of a live graph, and /diagnostics, under their names on the wire.

    The disk's thread writes; this node's own takes messages and reports, and waits for no disk.
    """

    def __init__(self) -> None:
        """Declare the parameters, look at the bag and open the topics."""
        super().__init__("recorder", "recorder", live=True)
        values = declare(self, parameters())
        file, total = values["file_limit"], values["total_limit"]
        if total < 2 * file:
            raise ConfigurationError(
                f"must be at least twice file_limit, {file:g} MB",
                key="parameter total_limit of recorder", value=total,
            )
        topics = {
            self.resolve_topic_name(topic.graph_name): topic for topic in self.interface.values()
        }
        self._bag = LiveBag(
            Path(values["directory"]).resolve(),
            [replace(topic, name=name) for name, topic in topics.items()],
            file_bytes=int(file * _MB),
            total_bytes=int(total * _MB),
        )
        self._unwritten = 0  # messages for which there was no room in memory
        self._looked_at = time.monotonic()
        for name, topic in topics.items():
            self.record(topic.name, partial(self._take, name))

    def _take(self, name: str, message: bytes) -> None:
        """Have a message written, with the time at which it came."""
        write = partial(self._bag.write, name, time.time_ns(), message, time.monotonic())
        if not DISK.do(write, len(message)):
            self._unwritten += 1

    def on_idle(self) -> None:
        """Flush when it is time to, and say how recording goes."""
        now = time.monotonic()
        if now - self._looked_at > _LOOK_S:
            self._looked_at = now
            DISK.do(partial(self._bag.look, now))
        problem = self._bag.problem
        if DISK.late:
            problem = f"{self._bag.directory}: the disk takes nothing; what comes waits in memory"
        self.say(
            "recording", problem and f"nothing is recorded: {problem}",
            f"recording to {self._bag.directory}", "not_recorded",
        )

    def progress(self) -> dict[str, Any]:
        """Return where the bag is, and how many messages came into it since this start, or not."""
        return {
            "bag": str(self._bag.directory), "recorded": self._bag.recorded,
            "lost": self._bag.lost + self._unwritten,
        }

    def on_stop(self) -> None:
        """Close the bag, unless the disk hangs: then it is as a kill leaves it."""
        problem = ""
        if not (DISK.do(self._bag.close) and DISK.wait(_WRITTEN_S)):
            problem = f"{self._bag.directory}: the disk takes nothing; the bag is not closed"
        if problem or self._bag.problem:
            self.get_logger().error(problem or self._bag.problem)


main = node_command(LiveRecorderNode, partial(
    node_help, "live_recorder", "recorder", __doc__, parameters,
    "--ros-args -p directory:=/var/lib/greenroof/bag -p total_limit:=2000.0", always_live=True,
))


if __name__ == "__main__":
    main()
