"""One mcap file of a bag, as rosbag2 writes it: its head, its messages, its end."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.interface import Topic
from greenroof_ros.recording.bag_metadata import FileContent, offered_profiles

_LIBRARY = "greenroof_ros"


class McapFile:
    """An mcap file that is written; where no more of it can be, it ends with what is safe.

    Nothing in it depends on the wall clock or on where it lies.

    Attributes:
        path: the file.
        first_ns: time of its first message, nanoseconds since 1970; 0 before there is one.
    """

    def __init__(self, path: Path, topics: Sequence[Topic]) -> None:
        """Make the file and write its head.

        Args:
            path: must not exist.
            topics: those that it can hold.

        Raises:
            FileExistsError: the file exists.
            OSError: it cannot be written.
        """
        self.path = path
        self.first_ns = self._last_ns = 0
        self._topics = list(topics)
        self._counts = [0] * len(self._topics)
        self._safe_bytes = 0
        self._stream: BinaryIO = path.open("xb")
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=_LIBRARY)
        types = read_yaml(shared_directory() / "msg_defs" / "types.yaml")
        schemas: dict[str, int] = {}
        self._channels = []
        for topic in topics:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, "ros2msg", _definition(types, topic.type).encode()
                )
            self._channels.append(
                self._writer.register_channel(
                    topic.name,
                    "cdr",
                    schemas[topic.type],
                    {
                        "offered_qos_profiles": offered_profiles(topic),
                        "topic_type_hash": types[topic.type]["hash"],
                    },
                )
            )
        self._add = self._writer.add_message

    def write(self, time_ns: int, messages: Iterable[tuple[int, bytes]]) -> None:
        """Add messages.

        Args:
            time_ns: their time, nanoseconds since 1970.
            messages: of each the index of its topic, and the message, serialised (CDR).

        Raises:
            OSError: for instance on a full disk; it calls for :meth:`cut`.
        """
        self.first_ns = self.first_ns or time_ns
        self._last_ns = max(self._last_ns, time_ns)
        add, channels, counts = self._add, self._channels, self._counts
        for index, message in messages:
            add(channels[index], time_ns, message, time_ns, counts[index])
            counts[index] += 1

    @property
    def content(self) -> FileContent:
        """What was added."""
        names = [topic.name for topic in self._topics]
        counts = dict(zip(names, self._counts, strict=True))
        return FileContent(self.path.name, self.first_ns, self._last_ns, counts)

    @property
    def size(self) -> int:
        """How many bytes of it are written; those of the present chunk are not yet."""
        return self._stream.tell()

    def flush(self) -> None:
        """Hand everything added so far to the operating system; a killed process keeps it.

        Raises:
            OSError: for instance on a full disk; the file then ends with the last flush.
        """
        try:
            self._writer.flush()
        except OSError:
            self.cut()
            raise
        self._safe_bytes = self._stream.tell()

    def sync(self) -> None:
        """Have the operating system bring it to the disk: it is there after a power failure, too.

        Raises:
            OSError: the disk does not take it.
        """
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Write the index and the end of the file.

        Raises:
            OSError: for instance on a full disk; the file then ends with the last flush.
        """
        try:
            self._writer.finish()
            self._stream.close()
        except OSError:
            self.cut()
            raise

    def cut(self) -> None:
        """Leave nothing behind the last flush where writing more of it failed, and let it go.

        Of what did not fit, a part may be in the file; how much can be recovered would then be
        another number than that of what is known to be safe.
        """
        with suppress(OSError):
            self._stream.close()  # tries again to write the rest
        os.truncate(self.path, self._safe_bytes)


def _definition(types: dict[str, dict[str, str]], name: str) -> str:
    """Return a type's definition with those that it uses appended, as bags hold it."""
    parts = [types[name]["definition"]]
    for used in types[name].get("uses", ()):
        short = used.replace("/msg/", "/")
        parts.append(f"{'=' * 80}\nMSG: {short}\n{types[used]['definition']}")
    return "\n".join(parts) + "\n"
