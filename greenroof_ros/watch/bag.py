"""Follows a bag: what stands in it by now, and from then on what is added to it, in batches.

The files of this package's recorders grow by whole chunks. Where the last whole one ends is
remembered, so that each byte is read once. A file may be cut short, damaged, removed as the oldest
of its bag, or be another one under the same name: none of these raises anything here; it is in
the note.

A process of its own reads, which gives way to all others of the machine. A thread could not: one
that waits for the processor while it holds Python's lock stops the page as well, on a busy machine
for tens of seconds.
"""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk
from mcap.stream_reader import get_chunk_data_stream
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.processes import asked_to_end_with_this, end_with_parent
from greenroof_ros.experiment.incidents import INCIDENTS, PROCESS, Incident, read_incidents
from greenroof_ros.experiment.summary import SUMMARY
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.recording.bag_writer import DAMAGED, bag_files, read_index
from greenroof_ros.watch import wire
from greenroof_ros.watch.words import plain

# How far back the past of a bag in many files is read, from its newest message (ns).
_PAST_NS = 7 * 86_400 * 10**9
# How much of a file is read for one batch (bytes), of which there is ten times as much unpacked.
_BATCH = 1 << 20
# A record or a chunk's content that says it is longer is not believed (bytes).
_LONGEST = 1 << 28
# What is left to read beyond this is worth a note (bytes).
_MUCH = 1 << 23
# How often it is looked at a bag of which all was read (s).
_LOOK_S = 0.5
_MOST_TEXT = 500

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
# A number with the record around it, and the CDR header before it.
_NUMBER = np.dtype([
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<u8"),
    ("published", "<u8"), ("header", "u1", 4), ("value", "<f8"),
])
_NUMBER_LENGTH = _NUMBER.itemsize - _HEAD.size

_FLOAT, _ARRAY, _TEXT = (
    "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String",
)
_PLAN = "/controller/plan"

Times = NDArray[np.int64]
Values = NDArray[np.float64]

_NONE = np.empty(0, np.int64), np.empty(0)


@dataclass
class Batch:
    """What was read at a time; times are nanoseconds since 1970, names those of the interface.

    Attributes:
        numbers: times and values of each topic of numbers, in the order of the bag.
        forecasts: the time and message of each forecast, the newest alone.
        plans: the time and rows of each new plan.
        texts: the time and text of each topic of texts.
        newest_ns: the newest time of all of these.
    """

    numbers: dict[str, tuple[Times, Values]] = field(default_factory=dict)
    forecasts: dict[str, tuple[int, bytes]] = field(default_factory=dict)
    plans: list[tuple[int, Values]] = field(default_factory=list)
    texts: list[tuple[str, int, str]] = field(default_factory=list)
    newest_ns: int = 0


@dataclass
class _File:
    """A file of the bag, as far as it was read."""

    path: Path
    inode: int
    size: int = 0
    offset: int = 0  # behind its last whole record
    channels: dict[int, str] = field(default_factory=dict)  # topics on the wire
    names: dict[int, str] = field(default_factory=dict)  # what each is in the interface
    over: bool = False  # it has its end, or nothing more of it can be read
    problem: str = ""


class _DamagedError(Exception):
    """A file does not go on as an mcap file does."""


# What is raised for what is no record, or no content of one.
_DAMAGED = (_DamagedError, *DAMAGED)


class Recorded:
    """A bag that is being read.

    Attributes:
        bag: its directory.
        newest_ns: the newest time that was read (ns since 1970); 0 before any was.
        problem: why not all of it can be read; empty where it can.
        progress: how far it has been read, where that takes long; otherwise empty.
        more: whether there is more to be read at once.
        replaced: whether it is another bag than the one that was read; it has to be begun anew.
    """

    def __init__(self, bag: Path, namespace: str | None = None) -> None:
        """Begin before its first message.

        Args:
            bag: a directory with ``.mcap`` files, which need not exist yet.
            namespace: of its topics, such as ``/site1``; None for that of the first level.
        """
        self.bag = bag
        self.newest_ns = 0
        self.problem = self.progress = ""
        self.more = self.replaced = False
        self._namespace = namespace
        self._types = {
            name: topic.type for name, topic in read_topics().items()
            if topic.type in (_FLOAT, _ARRAY, _TEXT)
        }
        self._files: dict[Path, _File] = {}
        self._begun = False

    def read(self) -> Batch:
        """Read on for some megabytes at most; what there is to know then is in the attributes."""
        batch = Batch()
        self.more = False
        try:
            self.problem = self._look()
            self._read_files(batch)
        except OSError as error:
            self.problem = f"The recording {self.bag} cannot be read: {error.strerror or error}."
        damages = [file.problem for file in self._files.values() if file.problem]
        self.problem = self.problem or " ".join(damages[-1:])
        self.progress = self._progress()
        batch.newest_ns = max(
            [self.newest_ns, *(int(times.max()) for times, _ in batch.numbers.values())]
        )
        self.newest_ns = batch.newest_ns
        return batch

    def _look(self) -> str:
        """See which files there are, and how long each is by now; return what is wrong there."""
        paths = bag_files(self.bag)
        if not paths:
            return f"There is no recording at {self.bag}."
        if not self._begun:
            paths = _recent(paths)
            self._begun = True
        for path in self._files.keys() - set(paths):
            del self._files[path]  # the oldest go when a bag is full
        first = next(iter(self._files), paths[0])
        for path in paths[paths.index(first) :]:
            try:
                status = path.stat()
            except FileNotFoundError:
                continue
            file = self._files.setdefault(path, _File(path, status.st_ino))
            if file.inode != status.st_ino or status.st_size < file.offset:
                self.replaced = True
            file.size = status.st_size
        return ""

    def _read_files(self, batch: Batch) -> None:
        """Read on in the first file that was not read to its end."""
        files = [file for file in self._files.values() if not file.over]
        for file in files:
            try:
                self.more = self._read_on(file, batch)
            except FileNotFoundError:
                file.over = True
            except _DAMAGED as error:
                file.over = True
                file.problem = _say_damage(file.path, error)
            if self.more:
                return
            if file is not files[-1]:
                file.over = True  # its writer was killed: another file was begun behind it

    def _read_on(self, file: _File, batch: Batch) -> bool:
        """Read the next whole records of a file; False where there is none."""
        if file.size <= file.offset:
            return False
        with file.path.open("rb") as stream:
            stream.seek(file.offset)
            data = stream.read(min(_BATCH, file.size - file.offset))
            start = 0
            if file.offset == 0:
                if len(data) < len(_MAGIC):
                    return False
                if not data.startswith(_MAGIC):
                    raise _DamagedError("it is no mcap file")
                start = len(_MAGIC)
            needed = _needed(data, start)
            if needed > len(data):
                if file.offset + needed > file.size:
                    return False  # its writer is not that far
                data += stream.read(needed - len(data))
        pieces: list[NDArray[np.void]] = []
        try:
            end = self._take(file, data, start, batch, pieces)
        finally:
            self._group(file, pieces, batch)
        file.offset += end
        return end > start

    def _take(
        self, file: _File, data: bytes, at: int, batch: Batch, pieces: list[NDArray[np.void]]
    ) -> int:
        """Take the whole records of some bytes of a file, and return where the last one ends."""
        small: list[int] = []
        head, size, last = _HEAD.unpack_from, _HEAD.size, len(data) - _HEAD.size
        try:
            while at <= last and not file.over:
                opcode, length = head(data, at)
                end = at + size + length
                if end > len(data):
                    break
                if opcode == Opcode.MESSAGE:
                    if length == _NUMBER_LENGTH:
                        small.append(at)
                    elif self._name(file, data[at + size] | data[at + size + 1] << 8):
                        self._take_message(file, data[at + size : end], batch)
                elif opcode == Opcode.CHUNK:
                    try:
                        self._take_chunk(file, data[at + size : end], batch, pieces)
                    except _DAMAGED as error:
                        file.problem = _say_damage(file.path, error)
                elif opcode == Opcode.CHANNEL:
                    self._take_channel(file, data[at + size : end])
                elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    file.over = True
                elif not 0 < opcode < 0x80:
                    raise _DamagedError(f"there is no record {opcode:#x}")
                at = end
        finally:
            if small:
                whole = np.frombuffer(data, np.uint8)
                places = np.array(small)[:, None] + np.arange(_NUMBER.itemsize)
                pieces.append(whole[places].view(_NUMBER)[:, 0])
        return at

    def _take_chunk(
        self, file: _File, content: bytes, batch: Batch, pieces: list[NDArray[np.void]]
    ) -> None:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        if chunk.uncompressed_size > _LONGEST:
            raise _DamagedError(f"a chunk says that it has {chunk.uncompressed_size} bytes")
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(length)
        if self._take(file, data, 0, batch, pieces) < len(data):
            raise _DamagedError("a chunk ends in a record")

    def _take_channel(self, file: _File, content: bytes) -> None:
        channel = Channel.read(ReadDataStream(BytesIO(content)))
        if self._namespace is None and channel.topic.endswith("/roof/level"):
            self._namespace = channel.topic.removesuffix("/roof/level")
        if file.channels.get(channel.id) != channel.topic:
            file.channels[channel.id] = channel.topic
            file.names.clear()

    def _name(self, file: _File, channel: int) -> str:
        """Return the name of a channel's topic, if it is one of values; empty where it is not."""
        name = file.names.get(channel)
        if name is None:
            name, namespace = file.channels.get(channel, ""), self._namespace or ""
            name = name.removeprefix(namespace) if name.startswith(f"{namespace}/") else ""
            file.names[channel] = name = name if name in self._types else ""
        return name

    def _group(self, file: _File, pieces: list[NDArray[np.void]], batch: Batch) -> None:
        """Part records of numbers, or as long as one, by their topics."""
        if not pieces:
            return
        found = np.concatenate(pieces)
        values = found["value"].copy()
        other = found["header"][:, 1] == 0  # of a machine with the other byte order
        values[other] = values[other].byteswap()
        times = found["time"].astype(np.int64)
        channels = found["channel"]
        for channel in np.unique(channels):
            name = self._name(file, int(channel))
            mine = channels == channel
            if self._types.get(name) == _FLOAT:
                before = batch.numbers.get(name, _NONE)  # of a file that ended in damage
                batch.numbers[name] = (
                    np.concatenate((before[0], times[mine])),
                    np.concatenate((before[1], values[mine])),
                )
            elif self._types.get(name) == _TEXT:  # a short one, such as "off"
                for one in found[mine]:
                    message = one["header"].tobytes() + one["value"].tobytes()
                    self._take_text(name, int(one["time"]), message, batch)

    def _take_message(self, file: _File, content: bytes, batch: Batch) -> None:
        channel, _, time_ns, _ = _MESSAGE.unpack_from(content)
        name = self._name(file, channel)
        kind = self._types.get(name)
        message = content[_MESSAGE.size :]
        if kind == _TEXT:
            self._take_text(name, time_ns, message, batch)
        elif kind == _ARRAY and name != _PLAN:
            batch.forecasts[name] = time_ns, message
        elif kind == _ARRAY:
            plan = wire.rows(message)
            if plan is not None and len(plan[0]):
                batch.plans.append((time_ns, plan[0]))

    def _take_text(self, name: str, time_ns: int, message: bytes, batch: Batch) -> None:
        text = wire.text(message)
        if text is not None:
            batch.texts.append((name, time_ns, text))

    def _progress(self) -> str:
        sizes = sum(file.size for file in self._files.values())
        read = sum(file.size if file.over else file.offset for file in self._files.values())
        if not self.more or sizes - read < _MUCH:
            return ""
        return f"The recording is being read: {100 * read // sizes} %."


def _recent(paths: list[Path]) -> list[Path]:
    """Return the files of a bag in which the last week is, the oldest first."""
    newest: int | None = None
    for place in range(len(paths) - 1, 0, -1):
        index = read_index(paths[place])
        if index is None:
            continue  # it is being written, or its writer was killed
        last = index.statistics.message_end_time
        if newest is None:
            newest = last
        elif last < newest - _PAST_NS:
            return paths[place + 1 :]
    return paths


def _say_damage(path: Path, error: Exception) -> str:
    why = str(error) or type(error).__name__
    return f"A part of the recording {path} is damaged, and left out ({why})."


def _needed(data: bytes, start: int) -> int:
    """Return how many bytes the first record at least needs."""
    if len(data) < start + _HEAD.size:
        return start + _HEAD.size
    _, length = _HEAD.unpack_from(data, start)
    if length > _LONGEST:
        raise _DamagedError(f"a record says that it has {length} bytes")
    return start + _HEAD.size + int(length)


# --- a process that reads -------------------------------------------------------------------------


class FollowedBag:
    """A bag that is read by a process of its own.

    Attributes:
        bag: its directory.
        until_ns: all up to then was handed on (ns since 1970).
        grew: when that last changed (steady clock, s).
        problem: why not all of it can be read; empty where it can.
        progress: how far it has been read, where that takes long; otherwise empty.
        more: whether there is more to be read.
        replaced: whether it is another bag by now.
    """

    def __init__(
        self, bag: Path, namespace: str | None, on_batch: Callable[[FollowedBag, Batch], None]
    ) -> None:
        """Start to read.

        Args:
            bag: its directory.
            namespace: of its topics; None for that of the first level.
            on_batch: called in a thread of its own with each batch.
        """
        self.bag = bag
        self.until_ns, self.grew = 0, time.monotonic()
        self.problem = self.progress = ""
        self.more, self.replaced = True, False
        self._on_batch = on_batch
        self._closed = False
        arguments = [str(bag)] if namespace is None else [str(bag), namespace]
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import main; main()", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=asked_to_end_with_this(),
        )
        self._thread = threading.Thread(target=self._receive, name="bag", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process; nothing is handed on afterwards."""
        self._closed = True
        self._process.kill()

    def _receive(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            while not self._closed:
                try:
                    batch, *state = pickle.load(stream)  # noqa: S301 - from main below alone
                    self._on_batch(self, batch)
                except Exception as error:  # whatever ended it, it is shown
                    self.problem = (
                        "The recording is not read any more, and what it has of later is missing "
                        f"({type(error).__name__}{f': {error}' if str(error) else ''})."
                    )
                    self.more = False
                    break
                if batch.newest_ns > self.until_ns:
                    self.until_ns, self.grew = batch.newest_ns, time.monotonic()
                self.problem, self.progress, self.more, self.replaced = state
        self._process.kill()
        self._process.wait()


def main() -> None:
    """Read a bag, and write what is in it to the standard output."""
    end_with_parent()
    with suppress(AttributeError, OSError):  # not Linux, or a container that forbids it
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    bag, *namespace = sys.argv[1:]
    recorded = Recorded(Path(bag), *namespace)
    last: tuple[object, ...] = ()
    with suppress(BrokenPipeError, KeyboardInterrupt):
        while True:
            batch = recorded.read()
            state = (recorded.problem, recorded.progress, recorded.more, recorded.replaced)
            if (state, recorded.newest_ns) != last or batch.texts:
                last = (state, recorded.newest_ns)
                pickle.dump((batch, *state), sys.stdout.buffer)
                sys.stdout.buffer.flush()
            if not recorded.more:
                time.sleep(_LOOK_S)


# --- what stands beside a bag ---------------------------------------------------------------------


@dataclass(frozen=True)
class Dated:
    """An incident with its times as the recording has them (s since 1970).

    Attributes:
        node: that says so, or that was lost.
        part: of it; empty for the node itself.
        cause: in words.
        code: of it, for programs.
        began: when.
        ended: when; None where it lasted to the end.
    """

    node: str
    part: str
    cause: str
    code: str
    began: float
    ended: float | None

    @property
    def name(self) -> str:
        """As that of an alarm."""
        return f"{self.node}: {self.part}" if self.part else self.node

    def stands(self, now: float) -> bool:
        """Whether it has begun at a time, and is not over."""
        return self.began <= now and (self.ended is None or now < self.ended)

    @property
    def of_pump(self) -> bool:
        """Whether what the pump does is not known while it stands."""
        return self.part == "drive" or (self.node, self.part) == (PUMP, "")


def read_incidents_of(bag: Path) -> list[Dated]:
    """Return the incidents of a run whose bag is read, in the order in which they began.

    They stand in a file of their own, and in the summary where that could not be written.

    Raises:
        ValueError: they cannot be read, or not when they were.
    """
    directory = bag.parent
    try:
        found = read_incidents(directory)
        if not (directory / SUMMARY).exists():
            return _all_dated(found, {})
        summary = json.loads(read_text(directory / SUMMARY))
        found = found or [Incident(**one) for one in summary.get("incidents", ())]
        return _all_dated(found, summary)
    except (OSError, ConfigurationError, KeyError, TypeError, AttributeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"{directory / INCIDENTS} cannot be shown ({why})") from error


def _all_dated(incidents: Sequence[Incident], summary: Mapping[str, Any]) -> list[Dated]:
    """Return incidents with their times: by ticks where the site is simulated, else by the wall."""
    start, tau = 0.0, 0.0
    if any(one.began_tick is not None for one in incidents):
        start = datetime.fromisoformat(summary["start"]).timestamp()
        tau = float(summary["tau_s"])

    def at(tick: int | None, wall: str | None) -> float | None:
        if tick is not None:
            return start + tick * tau
        return None if wall is None else datetime.fromisoformat(wall).timestamp()

    dated = []
    for one in incidents:
        began = at(one.began_tick, one.began)
        assert began is not None
        whole = one.part == PROCESS
        dated.append(Dated(
            one.node, "" if whole else one.part, plain(one.cause, _MOST_TEXT),
            # A node that stays away ends the run; of another one the incident is its return.
            "started_again" if whole and one.ended else one.code,
            began, at(one.ended_tick, one.ended),
        ))
    return sorted(dated, key=lambda one: one.began)


def controller_of(bag: Path) -> str:
    """Return who commanded in a recorded run, by the summary beside its bag; empty: unknown."""
    try:
        name = json.loads(read_text(bag.parent / SUMMARY))["controller"]
    except (ConfigurationError, ValueError, KeyError, TypeError):
        return ""
    return name if isinstance(name, str) else ""
