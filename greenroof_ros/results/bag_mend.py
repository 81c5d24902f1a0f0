"""Reading the intact chunks of an mcap file that is truncated, damaged, or on a failing disk.

The index of a closed file contains the positions of its chunks. Without an index, the length of
every record determines the position of the next record.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk

from greenroof_ros.results.bag_write import DAMAGED, seek_summary

_HEAD = struct.Struct("<BQ")  # a record's opcode and length
_DATA_END_SIZE = _HEAD.size + 4
_OPCODES = frozenset(map(int, Opcode))


def read_whole_chunks(stream: BinaryIO) -> Iterator[list[McapRecord] | int]:
    """Yield the records of every intact chunk, and the number of bytes lost between chunks.

    The topics and types of a closed file come first, in case the chunk that defines them is lost.

    Yields:
        A list of records, or a number of lost bytes.
    """
    size = os.fstat(stream.fileno()).st_size
    summary = _read_summary(stream)
    yield [record for record in summary if isinstance(record, Schema | Channel)]
    chunks = [record for record in summary if isinstance(record, ChunkIndex)]
    for chunk in chunks:
        records = _read_chunk(stream, chunk.chunk_start_offset)
        yield chunk.chunk_length if records is None else records
    if not chunks:
        yield from _read_in_order(stream, size)


def _read_in_order(stream: BinaryIO, size: int) -> Iterator[list[McapRecord] | int]:
    """Yield records and losses by following the lengths of records up to the first invalid one."""
    at = accounted = MAGIC_SIZE  # what lies before the second is whole, or known to be lost
    while at < size:
        opcode, end = _read_head(stream, at)
        records = _read_chunk(stream, at) if opcode == Opcode.CHUNK else None
        if records is not None:
            at = accounted = stream.tell()  # from the length of its own data, which is right
            yield records
            continue
        if (opcode, end - at) == (Opcode.DATA_END, _DATA_END_SIZE):
            return
        if opcode not in _OPCODES or end > size:
            yield size - accounted
            return
        if opcode == Opcode.CHUNK:
            yield end - at
            accounted = end
        at = end


def _read_summary(stream: BinaryIO) -> list[McapRecord]:
    """Return the records of a file's summary; an empty list if it is missing or damaged."""
    with suppress(OSError, *DAMAGED):
        if (footer := seek_summary(stream)) is not None:
            summary = stream.read()
            if footer.summary_crc in (0, zlib.crc32(summary[: -MAGIC_SIZE - 4])):
                return list(StreamReader(BytesIO(summary), skip_magic=True).records)
    return []


def _read_head(stream: BinaryIO, at: int) -> tuple[int, int]:
    """Return the opcode and the end position of a record; opcode 0 if it cannot be read."""
    with suppress(OSError, struct.error):
        stream.seek(at)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        return opcode, at + _HEAD.size + length
    return 0, at


def _read_chunk(stream: BinaryIO, at: int) -> list[McapRecord] | None:
    """Return the records of a chunk; None if its checksum is wrong or it cannot be read."""
    try:
        stream.seek(at + _HEAD.size)
        records = breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True)
        return records or None  # a head of zeros stands for an empty chunk without a checksum
    except (OSError, *DAMAGED):
        return None
