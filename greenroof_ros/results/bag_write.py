"""Writing bags in rosbag2's format, as numbered mcap files that ``metadata.yaml`` lists.

rosbag2, rosbags, Foxglove and PlotJuggler can open these bags. The bag of a simulation does not
depend on the wall clock or on the bag's location: two identical runs produce identical bytes.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from mcap.records import Channel, Schema, Statistics

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_yaml, replace_text, shared_directory
from greenroof_ros.interface.topics import Qos, Topic
from greenroof_ros.results.mcap import McapWriter, read_summary

METADATA = "metadata.yaml"

# Ticks passed to the operating system together. A kill -9 loses no more than the ticks by which the
# plant is ahead of them: 32.
_TICKS_PER_CHUNK = 16

# The mcap channel metadata keys of a topic's QoS profiles and type hash.
_PROFILES, _HASH = "offered_qos_profiles", "topic_type_hash"

_METADATA_VERSION = 9  # of rosbag2


class BagWriter:
    """Writer of the next file of a bag, which must be cut after a write error.

    Otherwise the file would contain a part of the failed write, and the number of recoverable
    writes would differ from ``safe``.

    Attributes:
        directory: directory of the bag.
        path: path of the file.
        written: number of writes, such as ticks.
        safe: number of writes that were flushed, and are therefore safe if the process is killed.
    """

    def __init__(self, directory: Path, topics: Sequence[Topic]) -> None:
        """Create the file, and its directory if necessary, and write its header with the topics.

        Args:
            directory: directory of the bag.
            topics: topics whose messages the file can contain; of a tick, in the order of writing.

        Raises:
            OSError: if the directory or the file cannot be written.
        """
        directory.mkdir(parents=True, exist_ok=True)
        self.directory, self.path = directory, name_next_file(directory)
        self.written = self.safe = 0
        self._safe_bytes = 0
        self._stream = self.path.open("xb")
        self._mcap = McapWriter(self._stream)
        types = _read_constants()["types"]
        kinds: list[str] = []
        for number, topic in enumerate(topics, start=1):
            kind = topic.type
            if kind not in kinds:
                kinds.append(kind)
                definition = types[kind]["definition"].encode()
                self._mcap.add(Schema(len(kinds), definition, "ros2msg", kind))
            about = {_PROFILES: _describe_qos(topic.qos), _HASH: types[kind]["hash"]}
            self._mcap.add(Channel(number, topic.name, "cdr", about, kinds.index(kind) + 1))
        self._sequences = [0] * len(topics)

    @property
    def size(self) -> int:
        """Number of bytes written so far, excluding the current chunk."""
        return self._stream.tell()

    def write(self, time_ns: int, messages: Iterable[tuple[int, bytes]]) -> None:
        """Write messages that share one time stamp.

        Args:
            time_ns: time of the messages (ns since 1970).
            messages: pairs of a topic's index and a message, serialised as CDR.

        Raises:
            OSError: if writing fails, for instance because the disk is full.
        """
        for index, message in messages:
            self._mcap.add_message(index + 1, time_ns, message, time_ns, self._sequences[index])
            self._sequences[index] += 1
        self.written += 1

    def write_tick(self, time_ns: int, messages: Sequence[bytes]) -> None:
        """Write the messages of a simulation's tick, and flush after every sixteenth tick.

        Args:
            time_ns: simulated time of the tick (ns since 1970).
            messages: the message of every topic, serialised as CDR, in the order of the topics.

        Raises:
            OSError: if writing fails, for instance because the disk is full.
        """
        self.write(time_ns, enumerate(messages))
        if self.written % _TICKS_PER_CHUNK == 0:
            self.flush()

    def flush(self, *, to_disk: bool = False) -> None:
        """Pass all messages written so far to the operating system.

        Args:
            to_disk: True to sync the file to the disk as well, so that it survives a power failure.

        Raises:
            OSError: if writing fails, for instance because the disk is full.
        """
        self._mcap.flush()
        if to_disk:
            os.fsync(self._stream.fileno())
        self.safe, self._safe_bytes = self.written, self._stream.tell()

    def close(self) -> None:
        """Write the index and the end of the file, and list the file in ``metadata.yaml``.

        Raises:
            OSError: if writing fails, for instance because the disk is full; ``greenroof recover``
                then restores what is safe.
        """
        self._mcap.finish()
        self.flush()
        self._stream.close()
        write_metadata(self.directory, find_files(self.directory))

    def cut(self) -> None:
        """Close the file and truncate it to its last flush; remove it if it was never flushed."""
        with suppress(OSError):  # the disk itself may be gone
            self._stream.close()  # tries to write the rest again
        with suppress(OSError):
            os.truncate(self.path, self._safe_bytes)
            if not self._safe_bytes:
                self.path.unlink()


def find_files(bag: Path) -> list[Path]:
    """Return the files of a bag, oldest first."""
    numbered = (path for path in bag.glob("*_*.mcap") if _read_number(path).isdecimal())
    return sorted(numbered, key=lambda path: int(_read_number(path)))


def name_next_file(bag: Path) -> Path:
    """Return the path of the file that follows the files of a bag."""
    files = find_files(bag)
    number = int(_read_number(files[-1])) + 1 if files else 0
    return bag / f"{bag.name}_{number}.mcap"


def name_recovered_bag(bag: Path) -> Path:
    """Return the default path of the recovered copy of a damaged bag, next to the bag."""
    return bag.resolve().with_name(f"{bag.resolve().name}-recovered")


def _read_number(file: Path) -> str:
    return file.stem.rpartition("_")[2]


def _read_index(path: Path) -> tuple[dict[int, str], list[Channel], Statistics] | None:
    """Return the index of a file; None if the file was not closed or cannot be read.

    Returns:
        Message types by the numbers of their schemas, the channels of all topics, and the number
        of messages with the times of the first and the last message (ns since 1970).
    """
    types: dict[int, str] = {}
    channels: list[Channel] = []
    with suppress(Exception), path.open("rb") as stream:
        # Do not read to the end: a day has thousands of chunks, each with an index.
        for record in read_summary(stream):
            if isinstance(record, Schema):
                types[record.id] = record.name
            elif isinstance(record, Channel):
                channels.append(record)
            elif isinstance(record, Statistics):
                return types, channels, record
    return None


def write_metadata(bag: Path, files: Sequence[Path]) -> None:
    """Replace ``metadata.yaml`` atomically, so that readers find either the old or the new text.

    Args:
        bag: directory of the bag.
        files: the bag's files, oldest first. A file that was not closed is not listed; if no file
            was closed, ``metadata.yaml`` is removed.

    Raises:
        OSError: if ``metadata.yaml`` cannot be written; the old file is then unchanged.
    """
    indices = {file: index for file in files if (index := _read_index(file)) is not None}
    if not indices:
        (bag / METADATA).unlink(missing_ok=True)
        return
    topics: dict[str, dict[str, Any]] = {}
    for types, channels, statistics in indices.values():
        for channel in channels:
            topic = topics.setdefault(channel.topic, {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": types.get(channel.schema_id, ""),
                    "serialization_format": channel.message_encoding,
                    "offered_qos_profiles": _read_profiles(channel.metadata.get(_PROFILES, "")),
                    "type_description_hash": channel.metadata.get(_HASH, ""),
                },
                "message_count": 0,
            })
            topic["message_count"] += statistics.channel_message_counts.get(channel.id, 0)
    messages = {file: statistics for file, (*_, statistics) in indices.items()}
    about = {
        "version": _METADATA_VERSION,
        "storage_identifier": "mcap",
        **_describe_messages(messages.values()),
        "topics_with_message_count": list(topics.values()),
        # Refers to whole files; the chunks are compressed, as the mcap files themselves state.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in indices],
        "files": [
            {"path": file.name, **_describe_messages([of_file])}
            for file, of_file in messages.items()
        ],
        "custom_data": {},
        "ros_distro": "jazzy",
    }
    replace_text(bag / METADATA, yaml.safe_dump(
        {"rosbag2_bagfile_information": about}, sort_keys=False, default_flow_style=False,
        width=10_000,
    ))


def _describe_messages(statistics: Collection[Statistics]) -> dict[str, Any]:
    """Return the period and the number of the messages in files, as in ``metadata.yaml``."""
    start = min(of_file.message_start_time for of_file in statistics)
    end = max(of_file.message_end_time for of_file in statistics)
    return {
        "starting_time": {"nanoseconds_since_epoch": start},
        "duration": {"nanoseconds": end - start},
        "message_count": sum(of_file.message_count for of_file in statistics),
    }


def read_recorded(bag: Path) -> dict[str, int]:
    """Return each closed file's number of messages.

    The result is empty if the bag's metadata is damaged.
    """
    with suppress(ConfigurationError, AttributeError, KeyError, TypeError, ValueError):
        about = read_yaml(bag / METADATA)["rosbag2_bagfile_information"]
        return {str(file["path"]): int(file["message_count"]) for file in about["files"]}
    return {}


@functools.cache
def _read_constants() -> dict[str, Any]:
    return read_yaml(shared_directory() / "msg_defs" / "bag.yaml")


def _describe_qos(qos: Qos) -> str:
    lease = {"sec": 9223372036, "nsec": 854775807}  # RMW_DURATION_INFINITE
    if math.isfinite(qos.lease_s):
        lease = {"sec": int(qos.lease_s), "nsec": round(qos.lease_s % 1 * 1e9)}
    profile: str = _read_constants()["qos_profile"]
    return profile.format(qos=qos, **lease)


def read_definition(name: str) -> str:
    """Return the definition of a message type and its nested types, in the format of bags."""
    return str(_read_constants()["types"][name]["definition"])


def _read_profiles(profiles: str) -> list[Any]:
    """Return the QoS profiles in a channel's metadata; an empty list if the YAML is invalid."""
    with suppress(yaml.YAMLError, RecursionError, ValueError):
        return yaml.safe_load(profiles) or []
    return []
