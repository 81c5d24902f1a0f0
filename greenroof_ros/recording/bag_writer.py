"""Writes bags as rosbag2 has them: numbered mcap files, and the ``metadata.yaml`` that names them.

rosbag2, rosbags, Foxglove and PlotJuggler open them. In the bag of a simulation nothing depends on
the wall clock or on where it lies: two equal runs give equal bytes.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import yaml
import zstandard
from mcap.exceptions import McapError
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Footer, Schema, Statistics
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import CompressionType, Writer

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.interface import Qos, Topic

METADATA = "metadata.yaml"

# What is raised in reading a file that was cut or damaged.
DAMAGED = (
    McapError, EOFError, MemoryError, OverflowError, RuntimeError, ValueError, struct.error,
    zstandard.ZstdError,
)

# How many ticks go to the operating system together. What a kill -9 can cost is what the plant is
# ahead of them, at most 32 ticks.
_TICKS_PER_CHUNK = 16

# How often a live bag goes to the disk: what a kill -9, or a power failure, can cost (s).
FLUSH_S = 10.0
# How long a live recording that failed, as on a full disk, waits before it tries again (s).
RETRY_S = 60.0
_DAY_NS = 86_400 * 10**9

# The names that an mcap channel has for a topic's profiles and type hash.
_PROFILES, _HASH = "offered_qos_profiles", "topic_type_hash"

# rosbag2's metadata version and RMW_DURATION_INFINITE, which stands for "no limit".
_METADATA_VERSION = 9
_INFINITE = {"sec": 9223372036, "nsec": 854775807}


class LiveBag:
    """Writes the bag of a live site: what comes, as it comes, in files by size and day, for months.

    The files are numbered from the first start on: a recorder that is started again in the same
    directory goes on with the next number. ``metadata.yaml`` names those that are closed and is
    rewritten, whole or not at all, with each of them; so rosbag2 and rosbags open the bag while it
    is being recorded, and after the recorder was killed. The file that was open then is not among
    them: ``greenroof recover`` restores it.

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
                a file's.
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


class BagFile:
    """An mcap file that is written; where no more of it can be, it ends with its last flush.

    Of what did not fit, a part would else be in the file; how much can be recovered would then be
    another number than what is known to be safe.

    Attributes:
        path: the file.
        written: how often something was written.
        safe: how much of that was flushed; a killed process keeps it.
    """

    def __init__(self, path: Path, topics: Sequence[Topic]) -> None:
        """Make the file and write its head.

        Args:
            path: must not exist.
            topics: those that it can have messages of.

        Raises:
            FileExistsError: the file exists.
            OSError: it cannot be written.
        """
        self.path = path
        self.written = self.safe = 0
        self._safe_bytes = 0
        self._stream: BinaryIO = path.open("xb")
        self._writer = start_writer(self._stream)
        self._add = self._writer.add_message
        types = read_yaml(shared_directory() / "msg_defs" / "types.yaml")
        schemas: dict[str, int] = {}
        self._channels = []
        for topic in topics:
            kind = topic.type
            if kind not in schemas:
                schemas[kind] = self._writer.register_schema(
                    kind, "ros2msg", _definition(types, kind).encode()
                )
            about = {_PROFILES: _yaml([_qos_profile(topic.qos)]), _HASH: types[kind]["hash"]}
            self._channels.append(
                self._writer.register_channel(topic.name, "cdr", schemas[kind], about)
            )
        self._counts = [0] * len(self._channels)

    @property
    def size(self) -> int:
        """How many bytes of it are written, without the present chunk."""
        return self._stream.tell()

    def write(self, time_ns: int, messages: Iterable[tuple[int, bytes]]) -> None:
        """Write messages of one time.

        Args:
            time_ns: nanoseconds since 1970.
            messages: of each the index of its topic, and the message, serialised (CDR).

        Raises:
            OSError: for instance on a full disk.
        """
        with self._cut_on_error():
            for index, message in messages:
                self._add(
                    self._channels[index], time_ns, message, time_ns, self._counts[index]
                )
                self._counts[index] += 1
        self.written += 1

    def flush(self, *, to_disk: bool = False) -> None:
        """Hand everything written so far to the operating system.

        Args:
            to_disk: have it brought to the disk: it is there after a power failure, too.

        Raises:
            OSError: for instance on a full disk.
        """
        with self._cut_on_error():
            self._writer.flush()
            if to_disk:
                os.fsync(self._stream.fileno())
        self.safe, self._safe_bytes = self.written, self._stream.tell()

    def close(self) -> None:
        """Write the index and the end of the file.

        Raises:
            OSError: for instance on a full disk.
        """
        with self._cut_on_error():
            self._writer.finish()
            self._stream.close()
        self.safe = self.written

    def cut(self) -> None:
        """Leave nothing behind the last flush, and no file without one; let it go."""
        with suppress(OSError):  # the disk itself may be gone
            self._stream.close()  # tries again to write the rest
        with suppress(OSError):
            os.truncate(self.path, self._safe_bytes)
            if not self._safe_bytes:
                self.path.unlink()

    @contextmanager
    def _cut_on_error(self) -> Iterator[None]:
        try:
            yield
        except OSError:
            self.cut()
            raise


class BagWriter(BagFile):
    """Writes the bag of a simulation, tick by tick, into one file; `written` counts ticks.

    Attributes:
        directory: the bag.
    """

    def __init__(self, directory: Path, topics: Sequence[Topic]) -> None:
        """Make the bag's directory and write the head of its file.

        Args:
            directory: must not exist.
            topics: of each tick, in the order in which they are written.

        Raises:
            FileExistsError: the directory exists.
            OSError: it cannot be written.
        """
        self.directory = directory
        directory.mkdir(parents=True)
        super().__init__(next_file([], directory), topics)

    def write_tick(self, time_ns: int, messages: Sequence[bytes]) -> None:
        """Write one tick.

        Args:
            time_ns: its simulated time, nanoseconds since 1970.
            messages: the serialised (CDR) message of each topic, in the order of the topics.

        Raises:
            OSError: for instance on a full disk; the file then ends with the safe ticks.
        """
        self.write(time_ns, enumerate(messages))
        if self.written % _TICKS_PER_CHUNK == 0:
            self.flush()

    def close(self) -> None:
        """Finish the file and write ``metadata.yaml``.

        Raises:
            OSError: for instance on a full disk; ``greenroof recover`` then restores
                the safe ticks.
        """
        super().close()
        write_metadata(self.directory, [read_index(self.path)])


def start_writer(stream: BinaryIO) -> Writer:
    """Return mcap's writer for a file of a bag, and write the file's head."""
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start(profile="ros2", library="greenroof_ros")
    return writer


def bag_files(bag: Path) -> list[Path]:
    """Return the files of a bag, the oldest first."""
    numbered = (path for path in bag.glob("*_*.mcap") if _number(path).isdecimal())
    return sorted(numbered, key=lambda path: int(_number(path)))


def next_file(files: Sequence[Path], bag: Path) -> Path:
    """Return what the file after these is called, the oldest first."""
    number = int(_number(files[-1])) + 1 if files else 0
    return bag / f"{bag.name}_{number}.mcap"


def recovered_bag(bag: Path) -> Path:
    """Return where the recovery of a damaged bag goes by default: beside it."""
    place = bag.resolve()
    return place.parent / f"{place.name}-recovered"


def _number(file: Path) -> str:
    return file.stem.rpartition("_")[2]


class FileIndex(NamedTuple):
    """What is in a file of a bag that was closed.

    Attributes:
        name: of the file.
        types: of messages, by the numbers of their schemas.
        channels: one of each topic.
        statistics: how many messages there are, and from when to when (ns since 1970).
    """

    name: str
    types: dict[int, str]
    channels: list[Channel]
    statistics: Statistics


def read_index(path: Path) -> FileIndex | None:
    """Return what is in a file; None where it was not closed, or cannot be read."""
    types: dict[int, str] = {}
    channels: list[Channel] = []
    with suppress(OSError, *DAMAGED), path.open("rb") as stream:
        stream.seek(-(FOOTER_SIZE + MAGIC_SIZE), os.SEEK_END)
        footer = next(StreamReader(stream, skip_magic=True).records)
        if not isinstance(footer, Footer) or not footer.summary_start:
            return None
        stream.seek(footer.summary_start)
        # It is not read to its end: a day has thousands of chunks, and each its own index.
        for record in StreamReader(stream, skip_magic=True).records:
            if isinstance(record, Schema):
                types[record.id] = record.name
            elif isinstance(record, Channel):
                channels.append(record)
            elif isinstance(record, Statistics):
                return FileIndex(path.name, types, channels, record)
    return None


def write_metadata(bag: Path, indices: Iterable[FileIndex | None]) -> None:
    """Write ``metadata.yaml`` in one step: a reader finds the old text or the new one.

    Args:
        bag: its directory.
        indices: of its files, the oldest first; it names those that were closed. Where there is
            none, the bag has no ``metadata.yaml``.

    Raises:
        OSError: it cannot be written; the old one is as it was.
    """
    files = [index for index in indices if index is not None]
    if not files:
        (bag / METADATA).unlink(missing_ok=True)
        return
    part = bag / f".{METADATA}.part"
    try:
        part.write_text(_metadata(files), encoding="utf-8")
        part.replace(bag / METADATA)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _metadata(files: Sequence[FileIndex]) -> str:
    topics: dict[str, dict[str, Any]] = {}
    for file in files:
        for channel in file.channels:
            if channel.topic not in topics:
                topics[channel.topic] = {
                    "topic_metadata": {
                        "name": channel.topic,
                        "type": file.types.get(channel.schema_id, ""),
                        "serialization_format": channel.message_encoding,
                        "offered_qos_profiles": _parsed(channel.metadata.get(_PROFILES, "")),
                        "type_description_hash": channel.metadata.get(_HASH, ""),
                    },
                    "message_count": 0,
                }
            count = file.statistics.channel_message_counts.get(channel.id, 0)
            topics[channel.topic]["message_count"] += count
    statistics = [file.statistics for file in files]
    start = min(of_file.message_start_time for of_file in statistics)
    end = max(of_file.message_end_time for of_file in statistics)
    return _yaml({
        "rosbag2_bagfile_information": {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(of_file.message_count for of_file in statistics),
            "topics_with_message_count": list(topics.values()),
            # Of whole files; the chunks in them are compressed, which mcap says itself.
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in files],
            "files": [
                {
                    "path": file.name,
                    "starting_time": {"nanoseconds_since_epoch": of_file.message_start_time},
                    "duration": {
                        "nanoseconds": of_file.message_end_time - of_file.message_start_time
                    },
                    "message_count": of_file.message_count,
                }
                for file, of_file in zip(files, statistics, strict=True)
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
    })


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


def _definition(types: Mapping[str, Any], name: str) -> str:
    """Return a type's definition with those that it uses appended, as in bags."""
    parts = [types[name]["definition"]]
    for used in types[name].get("uses", ()):
        short = used.replace("/msg/", "/")
        parts.append(f"{'=' * 80}\nMSG: {short}\n{types[used]['definition']}")
    return "\n".join(parts) + "\n"


def _yaml(content: object) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=False, width=10_000)


def _parsed(profiles: str) -> list[Any]:
    """Return the profiles that a channel of anybody's file says it has."""
    with suppress(yaml.YAMLError):
        return yaml.safe_load(profiles) or []
    return []
