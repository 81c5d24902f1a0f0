"""The bag of a live site: what comes, as it comes, in files by size and day, for months.

The files of a bag are numbered from its first start on: a recorder that is started again in the
same directory goes on with the next number. ``metadata.yaml`` names those that are closed and is
rewritten, whole or not at all, with each of them; so rosbag2 and rosbags open the bag while it is
being recorded, and after the recorder was killed. The file that was open then is not among them:
``greenroof recover`` restores it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.common.interface import Topic
from greenroof_ros.recording.bag_writer import (
    BagFile,
    bag_files,
    next_file,
    read_index,
    write_metadata,
)

# How often what came goes to the disk: what a kill -9, or a power failure, can cost (s).
FLUSH_S = 10.0
# How long a recording that failed, as on a full disk, waits before it tries again (s).
RETRY_S = 60.0

_DAY_NS = 86_400 * 10**9


class LiveBag:
    """Records messages with the time at which they came.

    Nothing here raises an OSError: recording can fail, as on a full disk, and its user lives on.
    The file that was being written then ends with its last flush; a new one is begun when trying
    again succeeds.

    Attributes:
        directory: the bag.
        problem: why recording failed; empty again when something of later is safe.
        recorded: how many messages are in the bag since this start.
        lost: how many are not, because recording failed.
    """

    def __init__(
        self, directory: Path, topics: Sequence[Topic], *, file_bytes: int, total_bytes: int
    ) -> None:
        """Look at what is in the bag already; nothing is written before the first message.

        Args:
            directory: the bag, which may exist.
            topics: those that can be recorded.
            file_bytes: size at which a file is closed and the next one begun; each day, by UTC,
                begins one, too.
            total_bytes: size of the bag beyond which its oldest files are removed, at least twice
                that of a file.
        """
        self.directory = directory
        self.problem = ""
        self.recorded = 0
        self.lost = 0
        self._topics = list(topics)
        self._index = {topic.name: index for index, topic in enumerate(self._topics)}
        self._file_bytes = file_bytes
        self._total_bytes = total_bytes
        # All files, the oldest first, with the indices of those that were closed.
        self._files = {path: read_index(path) for path in bag_files(directory)}
        self._file: BagFile | None = None  # that is being written: the last of them
        self._day = 0  # in which it was begun, since 1970
        self._before = 0  # how many messages were recorded before it
        self._flushed = -math.inf
        self._again = -math.inf  # when to try again, of the steady clock

    def write(self, topic: str, time_ns: int, message: bytes, now: float) -> None:
        """Record a message.

        Args:
            topic: its name.
            time_ns: when it came, nanoseconds since 1970.
            message: serialised (CDR).
            now: of the steady clock (s).
        """
        if now < self._again:
            self.lost += 1
            return
        day = time_ns // _DAY_NS
        try:
            if self._file is not None and (
                self._file.size >= self._file_bytes or day != self._day
            ):
                self._close(self._file)
            if self._file is None:
                self._file = self._open()
                self._flushed, self._day = now, day
            self._file.write(time_ns, [(self._index[topic], message)])
        except OSError as error:
            self.lost += 1
            self._fail(error, now)

    def look(self, now: float) -> None:
        """Flush when it is time to; called all the time.

        Args:
            now: of the steady clock (s).
        """
        if self._file is None or now - self._flushed < FLUSH_S:
            return
        self._flushed = now
        try:
            self._file.flush(to_disk=True)
            self._keep_safe(self._file)
            self._remove_oldest()
        except OSError as error:
            self._fail(error, now)

    def close(self) -> None:
        """Close the file that is being written; what fails in it is in :attr:`problem`."""
        try:
            if self._file is not None:
                self._close(self._file)
        except OSError as error:
            self._fail(error, -math.inf)

    def _open(self) -> BagFile:
        self.directory.mkdir(parents=True, exist_ok=True)
        path = next_file(list(self._files), self.directory)
        self._files[path] = None
        self._before = self.recorded
        return BagFile(path, self._topics)

    def _close(self, file: BagFile) -> None:
        file.close()
        self._file = None
        self._keep_safe(file)
        self._files[file.path] = read_index(file.path)
        self._remove_oldest()
        write_metadata(self.directory, self._files.values())

    def _keep_safe(self, file: BagFile) -> None:
        """Count what was flushed: recording works."""
        self.recorded = self._before + file.safe
        self.problem = ""

    def _fail(self, error: OSError, now: float) -> None:
        """Give up for a while: leave what is safe, and count the rest as lost."""
        self.problem = f"{self.directory}: {error.strerror or error}"
        self._again = now + RETRY_S
        file, self._file = self._file, None
        if file is not None:
            self.lost += file.written - file.safe
            file.cut()

    def _remove_oldest(self) -> None:
        """Keep the bag within its limit; the newest file stays in any case."""
        sizes = {path: path.stat().st_size for path in self._files if path.exists()}
        self._files = {path: self._files[path] for path in sizes}
        while len(sizes) > 1 and sum(sizes.values()) > self._total_bytes:
            oldest = next(iter(sizes))
            del sizes[oldest], self._files[oldest]
            try:
                # First: it never names a file that is gone.
                write_metadata(self.directory, self._files.values())
            finally:
                oldest.unlink()
