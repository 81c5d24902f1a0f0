"""Reads what is whole in an mcap file, also behind what is damaged.

A chunk is whole if its checksum is right, any other record if its content fills its length. Where
no whole record begins, the next one is searched byte by byte, and what lies between is lost.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from mmap import mmap
from typing import NamedTuple

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


class Part(NamedTuple):
    """The records of a whole chunk, or one record outside of chunks."""

    records: list[McapRecord]
    in_chunk: bool


class Damage(NamedTuple):
    """A number of bytes in which no record is whole."""

    size: int


def parts(data: mmap) -> Iterator[Part | Damage]:
    """Yield what is whole in a file, and what lies between, in the file's order."""
    at = MAGIC_SIZE
    while at < len(data) and data[at : at + MAGIC_SIZE + 1] != MCAP0_MAGIC:
        found = _part_at(data, at)
        if found is not None:
            part, at = found
            yield part
        else:
            start, at = at, _next_part(data, at)
            yield Damage(at - start)


def _next_part(data: mmap, at: int) -> int:
    """Return where the next whole part begins behind a damaged record; the end if there is none."""
    if at + _HEAD.size <= len(data):  # its length may be right
        end: int = at + _HEAD.size + _HEAD.unpack_from(data, at)[1]
        if _part_at(data, end) is not None:
            return end
    begins = (match.start() for match in _BEGINS.finditer(data, at + 1))
    return next((begin for begin in begins if _part_at(data, begin) is not None), len(data))


def _part_at(data: mmap, at: int) -> tuple[Part, int] | None:
    """Return what begins here, and where it ends; None if nothing whole does."""
    if at + _HEAD.size > len(data):
        return None
    opcode, length = _HEAD.unpack_from(data, at)
    start = at + _HEAD.size
    end = start + length
    try:
        if opcode == Opcode.CHUNK:
            return _chunk_at(data, start)
        if end > len(data):
            return None
        data.seek(start)
        stream = ReadDataStream(data)  # type: ignore[arg-type]  # it only reads
        if opcode == Opcode.MESSAGE:
            # Its data fill any length, so the length is checked by what follows.
            if not _can_begin(data, end):
                return None
            record: McapRecord = Message.read(stream, length)
        elif opcode in _READ:
            record = _READ[opcode](stream)
        else:
            return None
    except DAMAGED:
        return None
    return (Part([record], in_chunk=False), end) if stream.count == length else None


def _chunk_at(data: mmap, at: int) -> tuple[Part, int] | None:
    """Return a whole chunk; its own length of its data counts, not its record's."""
    first, last, size, checksum, letters = _CHUNK.unpack_from(data, at)
    at += _CHUNK.size
    compression = data[at : at + letters] if letters <= 4 else b"unknown"
    if compression not in (b"", b"lz4", b"zstd"):
        return None
    start = at + letters + 8
    end = start + struct.unpack_from("<Q", data, start - 8)[0]
    if end > len(data):
        return None
    chunk = Chunk(compression.decode(), data[start:end], last, first, checksum, size)
    return Part(breakup_chunk(chunk, validate_crc=True), in_chunk=True), end


def _can_begin(data: mmap, at: int) -> bool:
    if at + _HEAD.size > len(data):
        return data[at:] in (b"", MCAP0_MAGIC) or data[at] in _OPCODES
    opcode, length = _HEAD.unpack_from(data, at)
    return opcode in _OPCODES and length < _LONGEST_MESSAGE


class Contents(NamedTuple):
    """What a file holds, and what it should hold.

    Attributes:
        in_chunks: whether its messages are in chunks.
        schemas: by number.
        channels: by number.
        counts: number of whole messages, by the number of their channel.
        expected: number of messages that it held, by channel, as far as it says so itself.
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


def read_contents(data: mmap) -> Contents:
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


def is_intact(data: mmap) -> bool:
    """Return whether no bit of a closed file has changed, as its checksums say.

    Without a checksum of its data, which other recorders leave out, that is unknown: false.
    """
    footer = _footer(data)
    start = footer.summary_start - _DATA_END.size if footer is not None else 0
    if start < MAGIC_SIZE or data[-MAGIC_SIZE:] != MCAP0_MAGIC or not _summary(data):
        return False
    opcode, length, checksum = _DATA_END.unpack_from(data, start)
    with memoryview(data) as whole, whole[:start] as before:
        return (opcode, length, checksum) == (Opcode.DATA_END, 4, zlib.crc32(before))


def _footer(data: mmap) -> Footer | None:
    found = _part_at(data, max(0, len(data) - MAGIC_SIZE - FOOTER_SIZE))
    record = found[0].records[0] if found is not None and found[0].records else None
    return record if isinstance(record, Footer) else None


def _summary(data: mmap) -> list[McapRecord]:
    """Return the records of the summary; none if the file was not closed, or it is damaged."""
    footer = _footer(data)
    if footer is None or footer.summary_start < MAGIC_SIZE:
        return []
    records: list[McapRecord] = []
    at, end = footer.summary_start, len(data) - MAGIC_SIZE - FOOTER_SIZE
    if footer.summary_crc not in (0, zlib.crc32(data[at : end + FOOTER_SIZE - 4])):
        return []
    while at < end:
        found = _part_at(data, at)
        if found is None:
            return []
        records += found[0].records
        at = found[1]
    return records


def whole_messages(data: mmap, contents: Contents) -> Iterator[tuple[Channel, Message] | Damage]:
    """Yield the messages of a file whose channels are known, and the damage between them."""
    for part in parts(data):
        if isinstance(part, Damage):
            yield part
        elif part.in_chunk == contents.in_chunks:
            for record in part.records:
                if isinstance(record, Message) and record.channel_id in contents.channels:
                    yield contents.channels[record.channel_id], record
