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
from contextlib import suppress
from pathlib import Path

from greenroof_ros.common.interface import Topic
from greenroof_ros.recording.bag_files import content_of, numbered_files
from greenroof_ros.recording.bag_metadata import METADATA, write_metadata
from greenroof_ros.recording.mcap_file import McapFile

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
        self._file: McapFile | None = None
        self._unsafe = 0  # how many messages were not yet flushed
        self._flushed = -math.inf
        self._again = -math.inf  # when to try again, of the steady clock
        numbered = numbered_files(directory)
        self._next = numbered[-1][0] + 1 if numbered else 0
        # All files, the oldest first, and what is in those of them that were closed.
        self._paths = [path for _, path in numbered]
        self._closed = {
            path: content for path in self._paths if (content := content_of(path)) is not None
        }

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
        added = False
        try:
            if self._file is not None and (
                self._file.size >= self._file_bytes
                or time_ns // _DAY_NS != self._file.first_ns // _DAY_NS
            ):
                self._close()
            file = self._file or self._open(now)
            self._unsafe += 1
            added = True
            file.write(time_ns, [(self._index[topic], message)])
        except OSError as error:
            self.lost += not added  # else it is among those that were not flushed
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
            self._file.flush()
            self._file.sync()
            self._keep_safe()
            self._remove_oldest()
        except OSError as error:
            self._fail(error, now)

    def close(self) -> None:
        """Close the file that is being written; what fails in it is in :attr:`problem`."""
        try:
            self._close()
        except OSError as error:
            self._fail(error, -math.inf)

    def _open(self, now: float) -> McapFile:
        self.directory.mkdir(parents=True, exist_ok=True)
        path = self.directory / f"{self.directory.name}_{self._next}.mcap"
        self._next += 1
        self._paths.append(path)
        self._flushed = now
        self._file = McapFile(path, self._topics)
        return self._file

    def _close(self) -> None:
        if self._file is None:
            return
        self._file.close()
        self._keep_safe()
        self._closed[self._file.path] = self._file.content
        self._file = None
        self._remove_oldest()
        self._write_metadata()

    def _keep_safe(self) -> None:
        """Count what was flushed: recording works."""
        self.recorded += self._unsafe
        self._unsafe = 0
        self.problem = ""

    def _fail(self, error: OSError, now: float) -> None:
        """Give up for a while: leave what is safe, and count the rest as lost."""
        self.problem = f"{self.directory}: {error.strerror or error}"
        self._again = now + RETRY_S
        lost, self._unsafe = self._unsafe, 0
        self.lost += lost
        file, self._file = self._file, None
        if file is None:
            return
        with suppress(OSError):  # the disk itself may be gone
            file.cut()
            if lost == file.content.count:  # nothing of it is safe
                file.path.unlink()

    def _remove_oldest(self) -> None:
        """Keep the bag within its limit; the file that is being written is not removed."""
        present = self._file.path if self._file is not None else None
        sizes = {path: path.stat().st_size for path in self._paths if path.exists()}
        self._paths = list(sizes)
        too_much = sum(sizes.values()) - self._total_bytes
        removed = []
        for path, size in sizes.items():
            if too_much <= 0 or path == present:
                break
            removed.append(path)
            too_much -= size
        if removed:
            self._paths = self._paths[len(removed):]
            try:
                self._write_metadata()  # first: it never names a file that is gone
            finally:
                for path in removed:
                    self._closed.pop(path, None)
                    path.unlink()

    def _write_metadata(self) -> None:
        """Name the closed files."""
        files = [self._closed[path] for path in self._paths if path in self._closed]
        if files:
            write_metadata(self.directory, self._topics, files)
        else:
            (self.directory / METADATA).unlink(missing_ok=True)
