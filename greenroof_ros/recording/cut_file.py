"""An mcap file of a bag whose writer was killed, closed where it is whole.

Behind each chunk stands what is in it, so that nothing has to be read again: that of a day takes
milliseconds, while a run waits.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Schema,
    Statistics,
    SummaryOffset,
)

from greenroof_ros.recording.bag_files import content_of
from greenroof_ros.recording.bag_metadata import FileContent
from greenroof_ros.recording.damaged_bag import read_head

MAGIC = b"\x89MCAP0\r\n"
# Opcode and length of a record; the head of a chunk; the head and the length of an entry of a
# message index: https://mcap.dev/spec.
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_INDEX = struct.Struct("<HI")
_ENTRY = 16


class _Whole(NamedTuple):
    """The chunks of a file up to the last behind which every tick is whole."""

    end: int  # offset of what follows
    chunks: list[ChunkIndex]
    counts: dict[int, int]  # messages of each channel


def close_file(path: Path) -> FileContent | None:
    """Close a file behind its last whole tick, as if its writer had, and say what is in it.

    Args:
        path: of :class:`greenroof_ros.recording.bag_writer.BagWriter`; it may be closed already.

    Returns:
        None where it holds no tick; it stays as it is.

    Raises:
        OSError: it cannot be written.
    """
    with path.open("r+b") as stream:
        if not _is_closed(stream):
            schemas, channels = read_head(path)
            whole = _whole_ticks(stream, len(channels))
            if not whole.chunks:
                return None
            stream.seek(whole.end)
            stream.truncate()
            stream.write(_end(whole, schemas, channels))
    content = content_of(path)
    return content if content is not None and content.ticks else None


def _is_closed(stream: BinaryIO) -> bool:
    size = stream.seek(0, 2)
    if size < 2 * len(MAGIC):
        return False
    stream.seek(-len(MAGIC), 2)
    return stream.read() == MAGIC


def _records(stream: BinaryIO) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, offset and length, with its head, of each record that is there in full."""
    size = stream.seek(0, 2)
    offset = len(MAGIC)
    while offset + _RECORD.size <= size:
        stream.seek(offset)
        opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
        length += _RECORD.size
        if offset + length > size:
            return
        yield opcode, offset, length
        offset += length


def _whole_ticks(stream: BinaryIO, channels: int) -> _Whole:
    whole = _Whole(len(MAGIC), [], {})
    found: list[ChunkIndex] = []
    counts: dict[int, int] = {}
    for opcode, offset, length in _records(stream):
        stream.seek(offset + _RECORD.size)
        if opcode == Opcode.CHUNK:
            start, end, uncompressed, _, name = _CHUNK.unpack(stream.read(_CHUNK.size))
            compression = stream.read(name).decode()
            (compressed,) = struct.unpack("<Q", stream.read(8))
            found.append(ChunkIndex(
                length, offset, compression, compressed, end, 0, {}, start, uncompressed
            ))
        elif opcode == Opcode.MESSAGE_INDEX and found:
            channel, size = _INDEX.unpack(stream.read(_INDEX.size))
            counts[channel] = counts.get(channel, 0) + size // _ENTRY
            found[-1].message_index_offsets[channel] = offset
            found[-1].message_index_length += length
            if (
                len(found[-1].message_index_offsets) == len(counts) == channels
                and len(set(counts.values())) == 1
            ):
                whole = _Whole(offset + length, list(found), dict(counts))
    return whole


def _end(whole: _Whole, schemas: list[Schema], channels: list[Channel]) -> bytes:
    """Return what stands behind the chunks of a closed file."""
    data_end = RecordBuilder()
    DataEnd(0).write(data_end)
    head = data_end.end()
    summary_start = whole.end + len(head)
    builder = RecordBuilder()
    offsets = []
    statistics = Statistics(
        attachment_count=0, channel_count=len(channels), channel_message_counts=whole.counts,
        chunk_count=len(whole.chunks), message_count=sum(whole.counts.values()),
        message_end_time=max(chunk.message_end_time for chunk in whole.chunks),
        message_start_time=min(chunk.message_start_time for chunk in whole.chunks),
        metadata_count=0, schema_count=len(schemas),
    )
    for opcode, records in (
        (Opcode.SCHEMA, schemas), (Opcode.CHANNEL, channels), (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, whole.chunks),
    ):
        start = builder.count
        for record in records:
            record.write(builder)
        offsets.append(SummaryOffset(
            group_opcode=opcode, group_start=summary_start + start,
            group_length=builder.count - start,
        ))
    offsets_start = summary_start + builder.count
    for offset in offsets:
        offset.write(builder)
    footer = RecordBuilder()
    # Without a checksum of the summary (0): the data has its own.
    Footer(summary_start=summary_start, summary_offset_start=offsets_start, summary_crc=0).write(
        footer
    )
    return bytes(head + builder.end() + footer.end() + MAGIC)
