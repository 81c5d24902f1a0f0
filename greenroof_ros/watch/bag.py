"""Follows a bag: reads what it holds now, and then what is added to it, in batches.

The files of this package's recorders grow by whole chunks. The end of the last whole record is
remembered, so each byte is read once. A file may be truncated, damaged, removed as the oldest of
its bag, or replaced by another one of the same name: nothing is raised; the batch states this.

A process of its own reads, with the lowest priority on the machine. A thread could not: a thread
that waits for the processor while it holds Python's lock also stops the page, on a busy machine for
tens of seconds.
"""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.processes import child_environment, end_with_parent
from greenroof_ros.recording.bag_writer import DAMAGED, bag_files
from greenroof_ros.watch.history import Stamps, Values

# How far back a bag of many files is read, from its newest file (s).
_PAST_S = 7 * 86_400
# How much of a file is read for one batch (bytes); unpacked, that is ten times as much.
_BATCH = 1 << 20
# A record or a chunk's content that claims to be longer (bytes) is damaged.
_LONGEST = 1 << 28
# Progress is reported if this much or more is left to read (bytes).
_MUCH = 1 << 23
# How often a bag that was read to its end is checked again (s).
_POLL_S = 0.5

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
# A record with a number: the head of the record, the CDR header, and the value.
_NUMBER = np.dtype([
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8"),
    ("published", "<u8"), ("header", "u1", 4), ("value", "<f8"),
])
_NUMBER_LENGTH = _NUMBER.itemsize - _HEAD.size

_FLOAT = "std_msgs/msg/Float64"
_TYPES = (_FLOAT, "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String")


@dataclass
class Batch:
    """The content read in one go, and how far the bag was read; names are as in the interface.

    Attributes:
        numbers: topics of numbers, with times (ns since 1970) and values, in the order of the bag.
        messages: messages of other topics, as recorded, by topic and time (ns since 1970). Only the
            newest forecast is kept, under its topic and 0.
        newest_ns: the newest time of any number so far (ns since 1970); 0 before the first.
        problem: why part of the bag cannot be read; empty if all of it can.
        progress: how far the bag was read, if that takes long; otherwise empty.
        more: whether there is more to read at once.
        replaced: whether another bag has replaced it; it must be read from the start.
    """

    numbers: list[tuple[str, Stamps, Values]] = field(default_factory=list)
    messages: dict[tuple[str, int], tuple[int, bytes]] = field(default_factory=dict)
    newest_ns: int = 0
    problem: str = ""
    progress: str = ""
    more: bool = False
    replaced: bool = False


@dataclass
class _File:
    """A file of the bag, and how far it was read."""

    path: Path
    inode: int
    size: int = 0
    offset: int = 0  # the end of its last whole record
    channels: dict[int, str] = field(default_factory=dict)  # topics on the wire
    finished: bool = False  # read to its end, or nothing more can be read
    problem: str = ""

    def report_damage(self, damage: Exception) -> None:
        """Report that a part of the file is damaged."""
        why = str(damage) or type(damage).__name__
        self.problem = f"Part of the recording {self.path} is damaged and left out ({why})."


class GrowingBag:
    """A bag that is being read."""

    def __init__(self, bag: Path, namespace: str | None = None) -> None:
        """Start before the first message.

        Args:
            bag: a directory with ``.mcap`` files, which need not exist yet.
            namespace: of its topics, such as ``/site1``; None: as of the first roof level.
        """
        self._bag = bag
        self._namespace = namespace
        self._types = {
            name: topic.type for name, topic in read_topics().items() if topic.type in _TYPES
        }
        self._files: dict[Path, _File] = {}
        self._started = self._replaced = False
        self._newest_ns = 0

    def read(self) -> Batch:
        """Read on, some megabytes at most."""
        batch = Batch()
        try:
            batch.problem = self._find_files()
            self._read_files(batch)
        except OSError as error:
            batch.problem = f"The recording {self._bag} cannot be read: {error.strerror or error}."
        damages = [file.problem for file in self._files.values() if file.problem]
        batch.problem = batch.problem or " ".join(damages[-1:])
        sizes = sum(file.size for file in self._files.values())
        read = sum(file.size if file.finished else file.offset for file in self._files.values())
        if batch.more and sizes - read >= _MUCH:
            batch.progress = f"The recording is being read: {100 * read // sizes} %."
        newest = (int(times.max()) for _, times, _ in batch.numbers)
        self._newest_ns = batch.newest_ns = max([self._newest_ns, *newest])
        batch.replaced = self._replaced
        return batch

    def _find_files(self) -> str:
        """Find the files and their present sizes; return what is wrong with the bag."""
        paths = bag_files(self._bag)
        if not paths:
            return f"There is no recording at {self._bag}."
        if not self._started:
            paths = _recent(paths)
            self._started = True
        for path in self._files.keys() - set(paths):
            del self._files[path]  # a full bag loses its oldest files
        first = next(iter(self._files), paths[0])
        for path in paths[paths.index(first) :]:
            try:
                status = path.stat()
            except FileNotFoundError:
                continue
            file = self._files.setdefault(path, _File(path, status.st_ino))
            self._replaced |= file.inode != status.st_ino or status.st_size < file.offset
            file.size = status.st_size
        return ""

    def _read_files(self, batch: Batch) -> None:
        """Read on in the first file that is not read to its end."""
        files = [file for file in self._files.values() if not file.finished]
        for file in files:
            try:
                batch.more = self._read_on(file, batch)
            except FileNotFoundError:
                file.finished = True
            except DAMAGED as error:
                file.finished = True
                file.report_damage(error)
            if batch.more:
                return
            if file is not files[-1]:
                file.finished = True  # its writer was killed: there is a later file

    def _read_on(self, file: _File, batch: Batch) -> bool:
        """Read the next whole records of a file; False if there is none."""
        start = len(_MAGIC) if file.offset == 0 else 0
        with file.path.open("rb") as stream:
            stream.seek(file.offset)
            data = stream.read(min(_BATCH, file.size - file.offset))
            if not data.startswith(_MAGIC[:min(start, len(data))]):
                raise ValueError("it is not an MCAP file")
            if len(data) < start + _HEAD.size:
                return False
            _, length = _HEAD.unpack_from(data, start)
            if length > _LONGEST:
                raise ValueError(f"a record claims to have {length} bytes")
            needed = start + _HEAD.size + int(length)
            if file.offset + needed > file.size:
                return False  # it is not fully written yet
            data += stream.read(max(0, needed - len(data)))
        numbers: list[NDArray[np.void]] = []
        try:
            end = self._read_records(file, data, start, batch, numbers)
        finally:
            if numbers:
                self._group(file, np.concatenate(numbers), batch)
        file.offset += end
        return True

    def _read_records(
        self, file: _File, data: bytes, at: int, batch: Batch, numbers: list[NDArray[np.void]]
    ) -> int:
        """Read the whole records in some bytes of a file; return where the last one ends."""
        small: list[int] = []
        head, size, last = _HEAD.unpack_from, _HEAD.size, len(data) - _HEAD.size
        try:
            while at <= last and not file.finished:
                opcode, length = head(data, at)
                begin, end = at + size, at + size + length
                if end > len(data):
                    break
                if opcode == Opcode.MESSAGE and length == _NUMBER_LENGTH:
                    small.append(at)
                elif opcode == Opcode.MESSAGE:
                    channel, _, time_ns, _ = _MESSAGE.unpack_from(data, begin)
                    message = data[begin + _MESSAGE.size : end]
                    self._add_message(file, channel, time_ns, message, batch)
                elif opcode == Opcode.CHUNK:
                    try:
                        self._read_chunk(file, data[begin:end], batch, numbers)
                    except DAMAGED as error:
                        file.report_damage(error)
                elif opcode == Opcode.CHANNEL:
                    named = Channel.read(ReadDataStream(BytesIO(data[begin:end])))
                    file.channels[named.id] = named.topic
                    if self._namespace is None and named.topic.endswith("/roof/level"):
                        self._namespace = named.topic.removesuffix("/roof/level")
                elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    file.finished = True
                elif not 0 < opcode < 0x80:
                    raise ValueError(f"there is no record type {opcode:#x}")
                at = end
        finally:
            if small:
                places = np.array(small)[:, None] + np.arange(_NUMBER.itemsize)
                numbers.append(np.frombuffer(data, np.uint8)[places].view(_NUMBER)[:, 0])
        return at

    def _read_chunk(
        self, file: _File, content: bytes, batch: Batch, numbers: list[NDArray[np.void]]
    ) -> None:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        if chunk.uncompressed_size > _LONGEST:
            raise ValueError(f"a chunk claims to have {chunk.uncompressed_size} bytes")
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        if self._read_records(file, stream.read(length), 0, batch, numbers) < length:
            raise ValueError("a chunk ends in the middle of a record")

    def _topic_of(self, file: _File, channel: int) -> str:
        """Return the interface's name of a channel's topic; empty for a topic of another graph."""
        name, namespace = file.channels.get(channel, ""), self._namespace or ""
        return name.removeprefix(namespace) if name.startswith(f"{namespace}/") else ""

    def _group(self, file: _File, records: NDArray[np.void], batch: Batch) -> None:
        """Sort records of numbers, or of other messages of the same length, by topic."""
        values = records["value"].copy()
        other = records["header"][:, 1] == 0  # from a machine with the other byte order
        values[other] = values[other].byteswap()
        times = records["time"].astype(np.int64)
        for channel in np.unique(records["channel"]).tolist():
            mine = records["channel"] == channel
            name = self._topic_of(file, channel)
            if self._types.get(name) == _FLOAT:
                batch.numbers.append((name, times[mine], values[mine]))
            else:  # a short text, such as "off"
                for record in records[mine]:
                    message = record["header"].tobytes() + record["value"].tobytes()
                    self._add_message(file, channel, int(record["time"]), message, batch)

    def _add_message(
        self, file: _File, channel: int, time_ns: int, message: bytes, batch: Batch
    ) -> None:
        """Add a message that is not a number, if its topic is shown at all."""
        name = self._topic_of(file, channel)
        if self._types.get(name, _FLOAT) != _FLOAT:
            newest_alone = name.startswith("/forecast/")
            batch.messages[name, 0 if newest_alone else time_ns] = time_ns, message


def _recent(paths: list[Path]) -> list[Path]:
    """Return the files of a bag that were written in its last week, the oldest first."""
    written = [path.stat().st_mtime for path in paths]
    return [path for path, at in zip(paths, written, strict=True) if at > max(written) - _PAST_S]


# --- a process that reads -------------------------------------------------------------------------


class BagProcess:
    """A bag that is read by a process of its own.

    Attributes:
        bag: its directory.
        read: the last batch, without its numbers and messages.
        grew_at: when a batch last had a newer time (steady clock, s).
    """

    def __init__(
        self, bag: Path, namespace: str | None, on_batch: Callable[[BagProcess, Batch], None]
    ) -> None:
        """Start to read.

        Args:
            bag: its directory.
            namespace: of its topics; None: as of the first roof level.
            on_batch: called in a thread of its own with each batch.
        """
        self.bag = bag
        self.read, self.grew_at = Batch(more=True), time.monotonic()
        self._on_batch = on_batch
        self._closed = False
        arguments = [str(bag)] if namespace is None else [str(bag), namespace]
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import main; main()", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=child_environment(),
        )
        threading.Thread(target=self._receive, name="bag", daemon=True).start()

    def close(self) -> None:
        """End the process; a batch already received may still be passed on."""
        self._closed = True
        self._process.kill()

    def _receive(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            while not self._closed:
                try:
                    batch = pickle.load(stream)  # noqa: S301 - from main below alone
                    self._on_batch(self, batch)
                except Exception as error:  # for any error, it is shown
                    self.read = replace(self.read, more=False, problem=(
                        "The recording is no longer read; later values are missing "
                        f"({type(error).__name__}{f': {error}' if str(error) else ''})."
                    ))
                    break
                if batch.newest_ns > self.read.newest_ns:
                    self.grew_at = time.monotonic()
                self.read = replace(batch, numbers=[], messages={})
        self._process.kill()
        self._process.wait()


def main() -> None:
    """Read a bag, and write its batches to standard output."""
    end_with_parent()
    with suppress(AttributeError, OSError):  # not Linux, or a container that forbids it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    bag, *namespace = sys.argv[1:]
    recorded = GrowingBag(Path(bag), *namespace)
    with suppress(BrokenPipeError, KeyboardInterrupt):
        while True:
            batch = recorded.read()
            pickle.dump(batch, sys.stdout.buffer)
            sys.stdout.buffer.flush()
            if not batch.more:
                time.sleep(_POLL_S)
