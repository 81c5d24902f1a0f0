"""Reading the intact chunks of an mcap file that is truncated, damaged, or on a failing disk.

The index of a closed file contains the positions of its chunks. Without an index, the length of
every record determines the position of the next record.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Schema
from mcap.stream_reader import MAGIC_SIZE, breakup_chunk

from greenroof_ros.results.bag_write import read_summary

_HEAD = struct.Struct("<BQ")  # a record's opcode and length
_DATA_END_SIZE = _HEAD.size + 4
_OPCODES = frozenset(map(int, Opcode))


def read_chunks(stream: BinaryIO) -> Iterator[tuple[int, list[McapRecord]]]:
    """Yield the length of every chunk (bytes) with its records, which are empty if it is lost.

    The topics and types of a closed file come first, in case the chunk that defines them is lost.
    """
    size = os.fstat(stream.fileno()).st_size
    summary: list[McapRecord] = []
    with suppress(Exception):
        summary = list(read_summary(stream))
    yield 0, [record for record in summary if isinstance(record, Schema | Channel)]
    chunks = [record for record in summary if isinstance(record, ChunkIndex)]
    for chunk in chunks:
        yield chunk.chunk_length, _read_chunk(stream, chunk.chunk_start_offset)
    if not chunks:
        yield from _read_in_order(stream, size)


def _read_in_order(stream: BinaryIO, size: int) -> Iterator[tuple[int, list[McapRecord]]]:
    """Follow the lengths of records up to the first invalid one, behind which all is lost."""
    at = accounted = MAGIC_SIZE  # what lies before the second is whole, or known to be lost
    while at < size:
        opcode, end = _read_head(stream, at)
        if opcode == Opcode.CHUNK and (records := _read_chunk(stream, at)):
            length, at = stream.tell() - at, stream.tell()  # its own data's, which are right
            accounted = at
            yield length, records
        elif (opcode, end - at) == (Opcode.DATA_END, _DATA_END_SIZE):
            return
        elif opcode not in _OPCODES or end > size:
            yield size - accounted, []
            return
        else:
            if opcode == Opcode.CHUNK:
                yield end - at, []
                accounted = end
            at = end


def _read_head(stream: BinaryIO, at: int) -> tuple[int, int]:
    """Return the opcode and the end position of a record; opcode 0 if it cannot be read."""
    with suppress(OSError, struct.error):
        stream.seek(at)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        return opcode, at + _HEAD.size + length
    return 0, at


def _read_chunk(stream: BinaryIO, at: int) -> list[McapRecord]:
    """Return the records of a chunk; none if its checksum is wrong or it cannot be read."""
    with suppress(Exception):
        stream.seek(at + _HEAD.size)
        return breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True)
    return []
