"""Bags: mcap files in rosbag2's layout, written tick by tick."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from mcap.writer import CompressionType, Writer

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.interface import Qos, Topic

# rosbag2's metadata version and RMW_DURATION_INFINITE, which stands for "no limit".
_METADATA_VERSION = 9

_INFINITE = {"sec": 9223372036, "nsec": 854775807}

_LIBRARY = "greenroof_ros"

# How many ticks go to the operating system together. What a kill -9 can cost is what the plant is
# ahead of them, at most 32 ticks.
_TICKS_PER_CHUNK = 16


def _qos_profile(qos: Qos) -> dict[str, Any]:
    """Return a profile as rosbag2 writes it down."""
    lease = dict(_INFINITE)
    if qos.lease_s != float("inf"):
        lease = {"sec": int(qos.lease_s), "nsec": round(qos.lease_s % 1 * 1e9)}
    return {
        "history": "keep_last",
        "depth": qos.depth,
        "reliability": qos.reliability,
        "durability": qos.durability,
        "deadline": dict(_INFINITE),
        "lifespan": dict(_INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": lease,
        "avoid_ros_namespace_conventions": False,
    }


def _yaml(content: object) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=False, width=10_000)


def _definition(types: dict[str, Any], name: str) -> str:
    """Return a type's definition with those that it uses appended, as bags hold it."""
    parts = [types[name]["definition"]]
    for used in types[name].get("uses", ()):
        short = used.replace("/msg/", "/")
        parts.append(f"{'=' * 80}\nMSG: {short}\n{types[used]['definition']}")
    return "\n".join(parts) + "\n"


class BagWriter:
    """Writes a bag that rosbag2, rosbags, Foxglove and PlotJuggler open.

    Two equal runs give equal bytes: nothing in the file depends on the wall clock or on where it
    lies.

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
        self.ticks = 0
        self.safe = 0
        self._topics = list(topics)
        self._first_ns: int | None = None
        self._last_ns = 0
        directory.mkdir(parents=True)
        self._path = directory / f"{directory.name}_0.mcap"
        self._stream: BinaryIO = self._path.open("xb")
        self._safe_bytes = 0
        self._writer = Writer(self._stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=_LIBRARY)
        self._types = read_yaml(shared_directory() / "msg_defs" / "types.yaml")
        schemas: dict[str, int] = {}
        self._channels = []
        for topic in self._topics:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, "ros2msg", _definition(self._types, topic.type).encode()
                )
            self._channels.append(
                self._writer.register_channel(
                    topic.name,
                    "cdr",
                    schemas[topic.type],
                    {
                        "offered_qos_profiles": _yaml([_qos_profile(topic.qos)]),
                        "topic_type_hash": self._types[topic.type]["hash"],
                    },
                )
            )

    def write_tick(self, time_ns: int, messages: Sequence[bytes]) -> None:
        """Write one tick.

        Args:
            time_ns: its simulated time, nanoseconds since 1970.
            messages: the serialised (CDR) message of each topic, in the order of the topics.

        Raises:
            OSError: for instance on a full disk; the file then ends with the safe ticks.
        """
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last_ns = time_ns
        add = self._writer.add_message
        try:
            for channel, message in zip(self._channels, messages, strict=True):
                add(channel, time_ns, message, time_ns, self.ticks)
        except OSError:
            self._cut()
            raise
        self.ticks += 1
        if self.ticks % _TICKS_PER_CHUNK == 0:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system; a killed process keeps it.

        Raises:
            OSError: for instance on a full disk; the file then ends with the safe ticks.
        """
        try:
            self._writer.flush()
        except OSError:
            self._cut()
            raise
        self.safe = self.ticks
        self._safe_bytes = self._stream.tell()

    def _cut(self) -> None:
        """Leave nothing behind the safe ticks where writing more of them failed.

        Of what did not fit, whole ticks may be in the file; how many can be recovered would then
        be another number than that of the safe ones.
        """
        with suppress(OSError):
            self._stream.close()  # tries again to write the rest
        os.truncate(self._path, self._safe_bytes)

    def close(self) -> None:
        """Finish the file and write ``metadata.yaml``.

        Raises:
            OSError: for instance on a full disk; ``python -m greenroof_ros.recover`` then restores
                the safe ticks.
        """
        try:
            self._writer.finish()
            self._stream.close()
        except OSError:
            self._cut()
            raise
        self.safe = self.ticks
        metadata = self.directory / "metadata.yaml"
        try:
            metadata.write_text(self._metadata(), encoding="utf-8")
        except OSError:
            metadata.unlink(missing_ok=True)  # it says that the bag was closed
            raise

    def _metadata(self) -> str:
        start = {"nanoseconds_since_epoch": self._first_ns or 0}
        duration = {"nanoseconds": self._last_ns - (self._first_ns or 0)}
        count = self.ticks * len(self._topics)
        return _yaml(
            {
                "rosbag2_bagfile_information": {
                    "version": _METADATA_VERSION,
                    "storage_identifier": "mcap",
                    "duration": duration,
                    "starting_time": start,
                    "message_count": count,
                    "topics_with_message_count": [
                        {
                            "topic_metadata": {
                                "name": topic.name,
                                "type": topic.type,
                                "serialization_format": "cdr",
                                "offered_qos_profiles": [_qos_profile(topic.qos)],
                                "type_description_hash": self._types[topic.type]["hash"],
                            },
                            "message_count": self.ticks,
                        }
                        for topic in self._topics
                    ],
                    # Of whole files; the chunks in the file are compressed, which mcap says itself.
                    "compression_format": "",
                    "compression_mode": "",
                    "relative_file_paths": [self._path.name],
                    "files": [
                        {
                            "path": self._path.name,
                            "starting_time": dict(start),
                            "duration": dict(duration),
                            "message_count": count,
                        }
                    ],
                    "custom_data": None,
                    "ros_distro": "jazzy",
                }
            }
        )
