"""Bags: mcap files in rosbag2's layout, written tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.common.interface import Topic
from greenroof_ros.recording.bag_metadata import write_metadata
from greenroof_ros.recording.mcap_file import McapFile

# How many ticks go to the operating system together. What a kill -9 can cost is what the plant is
# ahead of them, at most 32 ticks.
_TICKS_PER_CHUNK = 16


class BagWriter:
    """Writes a bag that rosbag2, rosbags, Foxglove and PlotJuggler open.

    Two equal runs give equal bytes.

    Attributes:
        directory: the bag, ``metadata.yaml`` and one ``.mcap`` file.
        ticks: how many ticks were written.
        safe: how many of them a killed process would leave behind.
    """

    def __init__(self, directory: Path, topics: Sequence[Topic]) -> None:
        """Make the bag's directory and write the head of its file.

        Args:
            directory: must not exist.
            topics: those of each tick, in the order in which they are written.

        Raises:
            FileExistsError: the directory exists.
            OSError: it cannot be written.
        """
        self.directory = directory
        self.ticks = self.safe = 0
        self._topics = list(topics)
        directory.mkdir(parents=True)
        self._file = McapFile(directory / f"{directory.name}_0.mcap", self._topics)

    def write_tick(self, time_ns: int, messages: Sequence[bytes]) -> None:
        """Write one tick.

        Args:
            time_ns: its simulated time, nanoseconds since 1970.
            messages: the serialised (CDR) message of each topic, in the order of the topics.

        Raises:
            OSError: for instance on a full disk; the file then ends with the safe ticks.
        """
        try:
            self._file.write(time_ns, enumerate(messages))
        except OSError:
            self._file.cut()
            raise
        self.ticks += 1
        if self.ticks % _TICKS_PER_CHUNK == 0:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system; a killed process keeps it.

        Raises:
            OSError: for instance on a full disk; the file then ends with the safe ticks.
        """
        self._file.flush()
        self.safe = self.ticks

    def close(self) -> None:
        """Finish the file and write ``metadata.yaml``.

        Raises:
            OSError: for instance on a full disk; ``greenroof recover`` then restores
                the safe ticks.
        """
        self._file.close()
        self.safe = self.ticks
        write_metadata(self.directory, self._topics, [self._file.content])
