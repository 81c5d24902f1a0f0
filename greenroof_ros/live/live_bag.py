"""The bag of a live site, which is split into files, bounded, and survives a full disk."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.interface.topics import Topic
from greenroof_ros.results.bag_write import METADATA, BagWriter, find_files, write_metadata

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
