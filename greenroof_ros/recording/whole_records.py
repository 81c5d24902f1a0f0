"""Reads what is whole in an mcap file, also behind what is damaged.

A chunk is whole if its checksum is right, any other record if its content fills its length. Where
no whole record begins, the next one is searched byte by byte, and what lies between is lost. Files
are read, not mapped: a bad sector, or a file that is cut meanwhile, is then an error and no signal.
"""

from __future__ import annotations

import itertools
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import MAGIC_SIZE, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from greenroof_ros.recording.bag_writer import DAMAGED

# Opcode and length of a record; a chunk's times, size, checksum and length of the compression.
_HEAD, _CHUNK = struct.Struct("<BQ"), struct.Struct("<QQQII")
_DATA_END = struct.Struct("<BQI")
# Where a record can begin: an opcode and a length below 2^40 bytes.
_BEGINS = re.compile(rb"(?=[\x01-\x0f].{5}\x00\x00\x00)", re.DOTALL)
_OPCODES = frozenset(map(int, Opcode))
_LONGEST_MESSAGE = 2**32

_READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read, Opcode.FOOTER: Footer.read, Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read, Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read, Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read, Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read, Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read, Opcode.DATA_END: DataEnd.read,
}


# How much is read at once (bytes), and what a disk reads or fails to read as a whole.
_BLOCK, _SECTOR = 1 << 20, 4096


class UnreadableError(EOFError):
    """A part of a file cannot be read, or is no longer there."""


class FileBytes:
    """The bytes of an open file, as many as it had when it was opened."""

    def __init__(self, stream: BinaryIO) -> None:
        self._descriptor = stream.fileno()
        self._size = os.fstat(self._descriptor).st_size
        self._start, self._block = 0, b""

    def __len__(self) -> int:
        return self._size

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from one place to before another, or to the end.

        Raises:
            UnreadableError: the disk does not give them, or the file has been cut.
        """
        end = min(end, self._size)
        if start < self._start or end > self._start + len(self._block):
            try:
                ahead = self._read(start, min(max(end, start + _BLOCK), self._size))
            except UnreadableError:  # of bytes behind the end, perhaps
                return self._read(start, end)
            self._start, self._block = start, ahead
        return self._block[start - self._start : max(end - self._start, 0)]

    def read_some(self, start: int, end: int) -> bytes:
        """Return bytes likewise, with zeros in place of the sectors that cannot be read."""
        try:
            return self.read(start, end)
        except UnreadableError:
            if end - start <= _SECTOR:
                return bytes(max(0, min(end, self._size) - start))
        middles = range(start - start % _SECTOR + _SECTOR, end, _SECTOR)
        return b"".join(
            self.read_some(low, high)
            for low, high in itertools.pairwise((start, *middles, end))
        )

    def _read(self, start: int, end: int) -> bytes:
        parts = []
        while start < end:
            try:
                part = os.pread(self._descriptor, end - start, start)
            except OSError as error:
                raise UnreadableError(str(error)) from error
            if not part:
                raise UnreadableError("the file has been cut")
            parts.append(part)
            start += len(part)
        return b"".join(parts)


class WholePart(NamedTuple):
    """The records of a whole chunk, or one record outside of chunks."""

    records: list[McapRecord]
    in_chunk: bool


class Damage(NamedTuple):
    """A number of bytes in which no record is whole."""

    size: int


def parts(data: FileBytes) -> Iterator[WholePart | Damage]:
    """Yield what is whole in a file, and what lies between, in the file's order."""
    at = MAGIC_SIZE
    while at < len(data) and data.read_some(at, at + MAGIC_SIZE + 1) != MCAP0_MAGIC:
        found = _part_at(data, at)
        if found is not None:
            part, at = found
            yield part
        else:
            start, at = at, _next_part(data, at)
            yield Damage(at - start)


def _next_part(data: FileBytes, at: int) -> int:
    """Return where the next whole part begins behind a damaged record; the end if there is none."""
    if at + _HEAD.size <= len(data):  # its length may be right
        end: int = at + _HEAD.size + _HEAD.unpack(data.read_some(at, at + _HEAD.size))[1]
        if _part_at(data, end) is not None:
            return end
    for start in range(at + 1, len(data), _BLOCK):
        block = data.read_some(start, start + _BLOCK + _HEAD.size)
        for match in _BEGINS.finditer(block):
            if match.start() < _BLOCK and _part_at(data, start + match.start()) is not None:
                return start + match.start()
    return len(data)


def _part_at(data: FileBytes, at: int) -> tuple[WholePart, int] | None:
    """Return what begins here, and where it ends; None if nothing whole does."""
    if at + _HEAD.size > len(data):
        return None
    start = at + _HEAD.size
    try:
        opcode, length = _HEAD.unpack(data.read(at, start))
        end = start + length
        if opcode == Opcode.CHUNK:
            return _chunk_at(data, start)
        if end > len(data):
            return None
        # A message's data fill any length, so the length is checked by what follows.
        if opcode not in _READ and (opcode != Opcode.MESSAGE or not _can_begin(data, end)):
            return None
        stream = ReadDataStream(BytesIO(data.read(start, end)))
        if opcode == Opcode.MESSAGE:
            record: McapRecord = Message.read(stream, length)
        else:
            record = _READ[opcode](stream)
    except DAMAGED:
        return None
    return (WholePart([record], in_chunk=False), end) if stream.count == length else None


def _chunk_at(data: FileBytes, at: int) -> tuple[WholePart, int] | None:
    """Return a whole chunk; its own length of its data counts, not its record's."""
    first, last, size, checksum, letters = _CHUNK.unpack(data.read(at, at + _CHUNK.size))
    at += _CHUNK.size
    compression = data.read(at, at + letters) if letters <= 4 else b"unknown"
    if compression not in (b"", b"lz4", b"zstd"):
        return None
    start = at + letters + 8
    end = start + struct.unpack("<Q", data.read(start - 8, start))[0]
    if end > len(data):
        return None
    chunk = Chunk(compression.decode(), data.read(start, end), last, first, checksum, size)
    return WholePart(breakup_chunk(chunk, validate_crc=True), in_chunk=True), end


def _can_begin(data: FileBytes, at: int) -> bool:
    if at + _HEAD.size > len(data):
        rest = data.read(at, len(data))
        return rest in (b"", MCAP0_MAGIC) or rest[0] in _OPCODES
    opcode, length = _HEAD.unpack(data.read(at, at + _HEAD.size))
    return opcode in _OPCODES and length < _LONGEST_MESSAGE


class Contents(NamedTuple):
    """What a file holds, and what it should hold.

    Attributes:
        in_chunks: whether its messages are in chunks.
        schemas: by number.
        channels: by number.
        counts: number of whole messages, by the number of their channel.
        expected: number of messages that it held, by channel, as far as it states this.
        closed: whether its summary is whole; ``expected`` is then complete.
        damaged: number of bytes in which messages may be lost.
        together: how many messages most often share one time.
    """

    in_chunks: bool
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    counts: Counter[int]
    expected: Counter[int]
    closed: bool
    damaged: int
    together: int


class _Tally:
    """Counts the records outside of chunks, or those inside; attributes as in Contents."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self._sizes: Counter[int] = Counter()  # how often so many messages share a time
        self._time, self._size = -1, 0

    def add(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Message):
            self.counts[record.channel_id] += 1
            if record.log_time != self._time:
                self._sizes[self._size] += 1
                self._time, self._size = record.log_time, 0
            self._size += 1

    @property
    def together(self) -> int:
        sizes = self._sizes + Counter([self._size])
        return max(sizes, key=lambda size: (size > 0, sizes[size], size))


def read_contents(data: FileBytes) -> Contents:
    """Read a whole file, and return what it holds."""
    loose, chunked = _Tally(), _Tally()
    indexed: Counter[int] = Counter()
    damaged, ended, in_chunks = 0, False, False
    for part in parts(data):
        if isinstance(part, Damage):
            damaged += 0 if ended else part.size
            continue
        in_chunks |= part.in_chunk
        for record in part.records:
            (chunked if part.in_chunk else loose).add(record)
            if isinstance(record, MessageIndex):
                indexed[record.channel_id] += len(record.records)
            ended |= isinstance(record, DataEnd)
    tally = chunked if in_chunks else loose
    summary = _summary(data)
    for record in summary:
        tally.add(record)
    counted = [record for record in summary if isinstance(record, Statistics)]
    return Contents(
        in_chunks, tally.schemas, tally.channels, tally.counts,
        Counter(counted[0].channel_message_counts) if counted else indexed,
        bool(counted), damaged, tally.together,
    )


def is_intact(data: FileBytes) -> bool:
    """Return whether no bit of a closed file has changed, as its checksums show.

    Without a checksum of its data, which other recorders leave out, that is unknown: false.
    """
    footer = _footer(data)
    start = footer.summary_start - _DATA_END.size if footer is not None else 0
    if start < MAGIC_SIZE or not _summary(data):
        return False
    checksum = 0
    try:
        for at in range(0, start, _BLOCK):
            checksum = zlib.crc32(data.read(at, min(at + _BLOCK, start)), checksum)
        end = data.read(start, start + _DATA_END.size)
        magic = data.read(len(data) - MAGIC_SIZE, len(data))
    except UnreadableError:
        return False
    return magic == MCAP0_MAGIC and end == _DATA_END.pack(Opcode.DATA_END, 4, checksum)


def _footer(data: FileBytes) -> Footer | None:
    found = _part_at(data, max(0, len(data) - MAGIC_SIZE - FOOTER_SIZE))
    record = found[0].records[0] if found is not None and found[0].records else None
    return record if isinstance(record, Footer) else None


def _summary(data: FileBytes) -> list[McapRecord]:
    """Return the records of the summary; none if the file was not closed, or it is damaged."""
    footer = _footer(data)
    if footer is None or footer.summary_start < MAGIC_SIZE:
        return []
    records: list[McapRecord] = []
    at, end = footer.summary_start, len(data) - MAGIC_SIZE - FOOTER_SIZE
    summary = data.read_some(at, end + FOOTER_SIZE - 4)
    if footer.summary_crc not in (0, zlib.crc32(summary)):
        return []
    while at < end:
        found = _part_at(data, at)
        if found is None:
            return []
        records += found[0].records
        at = found[1]
    return records


def read_whole_messages(
    data: FileBytes, contents: Contents
) -> Iterator[tuple[Channel, Message] | Damage]:
    """Yield the messages of a file whose channels are known, and the damage between them."""
    for part in parts(data):
        if isinstance(part, Damage):
            yield part
        elif part.in_chunk == contents.in_chunks:
            for record in part.records:
                if isinstance(record, Message) and record.channel_id in contents.channels:
                    yield contents.channels[record.channel_id], record
