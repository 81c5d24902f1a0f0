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
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.topics import Topic
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.results.bag_write import METADATA, BagWriter, find_files, write_metadata
from greenroof_ros.ros.messages import decoder, qos_profile
from greenroof_ros.ros.parameters import declare
from greenroof_ros.site.site import Site

# How often the bag is flushed to disk (s): the most that a kill -9 or a power failure can lose.
FLUSH_S = 10.0
# Share of the space on its disk, including the bag's own at the start, that the bag may use.
_SHARE = 0.9
# Wait until a recording that failed, as on a full disk, is tried again (s).
RETRY_S = 60.0
_DAY_NS = 86_400 * 10**9


class LiveBag:
    """Writer of a live site's bag for months of recording, split into files by size and day.

    A recorder that is restarted in the same directory continues with the next file number.
    ``metadata.yaml`` lists the closed files. The metadata is replaced atomically whenever a file is
    closed, so rosbag2 and rosbags can open the bag during recording and after the recorder was
    killed. The file that was open when the recorder was killed is not listed; ``greenroof recover``
    restores it.

    No method raises an OSError: if recording fails, for instance because the disk is full, the node
    continues. The current file then ends at its last flush, and a new file begins when a retry
    succeeds.

    Attributes:
        directory: directory of the bag.
        problem: reason why recording failed; empty if it has not failed, or once later messages are
            flushed.
    """

    def __init__(
        self, directory: Path, topics: Sequence[Topic], *, file_bytes: int, total_bytes: int
    ) -> None:
        """Set the bag, and write nothing before the first message.

        Args:
            directory: directory of the bag, which may exist.
            topics: topics whose messages can be recorded.
            file_bytes: size at which a file is closed and the next file begins (bytes); a new file
                also begins every day (UTC).
            total_bytes: size of the bag above which its oldest files are removed (bytes), or nine
                tenths of the disk space for it at the start, if that is less.
        """
        self.directory = directory
        self.problem = ""
        self._topics = list(topics)
        self._index = {topic.name: index for index, topic in enumerate(self._topics)}
        self._file_bytes = file_bytes
        self._total_bytes = total_bytes
        self._fits = 0  # how large the bag may be on its disk (bytes); 0 until it is known
        self._file: BagWriter | None = None  # the file being written
        self._day = 0  # day on which it was begun (days since 1970)
        # Times of the last flush and of the next try (steady clock, s).
        self._flushed = self._again = -math.inf

    def write(self, topic: str, time_ns: int, message: bytes, now: float) -> None:
        """Record a message.

        Args:
            topic: topic of the message.
            time_ns: time of arrival (ns since 1970).
            message: the message, serialised as CDR.
            now: current time on the steady clock (s).
        """
        if now < self._again:
            return
        day = time_ns // _DAY_NS
        try:
            if self._file is None or self._file.size >= self._file_bytes or day != self._day:
                self._close()
                self._file = BagWriter(self.directory, self._topics)
                self._flushed, self._day = now, day
            self._file.write(time_ns, [(self._index[topic], message)])
        except OSError as error:
            self._fail(error, now)

    def flush_if_due(self, now: float) -> None:
        """Flush the bag if a flush is due; call this method often.

        Args:
            now: current time on the steady clock (s).
        """
        if self._file is None or now - self._flushed < FLUSH_S:
            return
        self._flushed = now
        try:
            self._file.flush(to_disk=True)
            self.problem = ""
            self._remove_oldest()
        except OSError as error:
            self._fail(error, now)

    def close(self) -> None:
        """Close the current file; if closing fails, :attr:`problem` contains the reason."""
        try:
            self._close()
        except OSError as error:
            self._fail(error, -math.inf)

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file, self.problem = None, ""
            self._remove_oldest()

    def _fail(self, error: OSError, now: float) -> None:
        """Stop recording until the next retry; the messages not yet flushed are lost."""
        self.problem = f"{self.directory}: {error.strerror or error}"
        self._again = now + RETRY_S
        if self._file is not None:
            self._file.cut()
            self._file = None

    def _remove_oldest(self) -> None:
        """Remove the oldest files while the bag exceeds its limit, but never the newest file."""
        files = find_files(self.directory)
        size = sum(file.stat().st_size for file in files)
        if not self._fits:  # it is asked here, since a disk may hang
            self._fits = int(_SHARE * (shutil.disk_usage(self.directory).free + size))
        while len(files) > 1 and size > min(self._total_bytes, self._fits):
            oldest = files.pop(0)
            size -= oldest.stat().st_size
            # In this order, metadata never lists a missing file, and a full disk has room for them.
            (self.directory / METADATA).unlink(missing_ok=True)
            oldest.unlink()
            write_metadata(self.directory, files)


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
