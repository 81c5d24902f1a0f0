"""The recorder node of a live site, which records every message as it arrives, for months.

Messages go into the files of a bag, split by size and by day (UTC), with their times of arrival,
and are on the disk after 10 s. The oldest files are removed when the bag reaches its limit. A full
disk stops the recording and raises an alarm; the node keeps running, and tries again every minute.
If the disk hangs, up to 32 MB of messages wait in memory until the disk responds; this, too, raises
an alarm. Of /alarms, only changes are recorded, and /diagnostics, of which they are made, is not.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.live_bag import LiveBag
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.ros.messages import decoder, qos_profile
from greenroof_ros.ros.parameters import declare
from greenroof_ros.site.site import Site

# A file of the bag is neither larger than this nor than a tenth of the whole bag.
_FILE_BYTES, _MB = 100e6, 1e6
# How long the node waits for the disk at its end (s).
_WRITTEN_S = 4.0
# How many messages on a topic can wait while the node or the machine is busy.
_DEPTH = 1000
# Where a message on /alarms begins after its time stamp (bytes).
_CONTENT = 12


def parameters(site: Site | None = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    return [
        Parameter("directory", "bag", meaning="directory of the bag, which may exist"),
        Parameter(
            "total_limit", 10_000.0, "MB", 0.2, 1e9, "size beyond which the bag's oldest files are "
                "removed",
        ),
    ]


class LiveRecorderNode(LiveNode):
    """Node that records the topics of a live graph under their full names.

    The disk thread writes the bag. The node's own thread receives messages and reports its state,
    and never waits for a disk.
    """

    def __init__(self) -> None:
        """Declare the parameters, read the existing bag and open the topics."""
        super().__init__("recorder", "recorder")
        values = declare(self, parameters())
        total = values["total_limit"] * _MB
        topics = {
            self.resolve_topic_name(topic.graph_name): topic for topic in self.interface.values()
            if topic.name != "/diagnostics"
        }
        self._bag = LiveBag(
            Path(values["directory"]).resolve(),
            [replace(topic, name=name) for name, topic in topics.items()],
            file_bytes=int(min(_FILE_BYTES, total / 10)),
            total_bytes=int(total),
        )
        self._alarms = b""  # the last content of /alarms
        for name, topic in topics.items():
            # No past messages; and a lease would restart a timer in this reader at every message.
            qos = replace(topic.qos, durability="volatile", depth=_DEPTH, lease_s=math.inf)
            queue = partial(self._queue, name, topic.name == "/alarms", decoder(topic.type))
            self.open_subscription(topic, queue, qos_profile(qos))

    def _queue(
        self, name: str, are_alarms: bool, decode: Callable[[bytes], Any], message: bytes
    ) -> None:
        """Queue a message for writing, with its time of arrival; a malformed one is refused."""
        decode(message)
        if are_alarms:
            before, self._alarms = self._alarms, message[_CONTENT:]
            if self._alarms == before and not self._bag.problem:  # it may have been lost
                return
        write = partial(self._bag.write, name, time.time_ns(), message, time.monotonic())
        DISK.do(write, len(message))

    def on_timer(self, now: float) -> None:
        """Flush the bag if a flush is due, and report the state of the recording."""
        DISK.do(self._flush_if_due)
        directory = self._bag.directory
        why = f"{directory}: the disk does not respond" if DISK.late else self._bag.problem
        diagnosis = Diagnosis.if_any("not_recorded", why)
        self.reports.diagnose("recording", diagnosis, f"recording to {directory}")

    def _flush_if_due(self) -> None:
        self._bag.flush_if_due(time.monotonic())

    def progress(self) -> dict[str, Any]:
        """Return the bag's path."""
        return {"bag": str(self._bag.directory)}

    def on_stop(self) -> None:
        """Close the bag; if the disk hangs, leave the bag as if the node had been killed."""
        is_closed = DISK.do(self._bag.close) and DISK.wait(_WRITTEN_S)
        if not is_closed or self._bag.problem:
            why = self._bag.problem or "the disk does not respond"
            self.get_logger().error(f"{self._bag.directory} was not closed: {why}")


main = live_command(LiveRecorderNode, __doc__)


if __name__ == "__main__":
    main()
