"""What is whole in a bag whose writer was killed, and where it is put."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader


def recovered_bag(bag: Path) -> Path:
    """Return where the recovery of a damaged bag goes unless it is told otherwise: beside it."""
    place = bag.resolve()
    return place.parent / f"{place.name}-recovered"


def read_head(path: Path) -> tuple[list[Schema], list[Channel]]:
    """Return the schemas and channels of a bag file, which stand before its first message."""
    schemas, channels = [], []
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Message):
                break
            if isinstance(record, Schema):
                schemas.append(record)
            elif isinstance(record, Channel):
                channels.append(record)
    return schemas, channels


def read_channels(path: Path) -> list[Channel]:
    """Return the channels of a bag file."""
    return read_head(path)[1]


def read_messages(path: Path) -> Iterator[Message]:
    """Read the messages of a bag file, up to where its writer was killed."""
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Message):
                yield record


def read_ticks(path: Path, first: int = 0) -> Iterator[tuple[list[Channel], int, list[bytes]]]:
    """Read the whole ticks of a bag file, up to where its writer was killed.

    Args:
        path: an ``.mcap`` file of :class:`BagWriter`, whole or cut short.
        first: the tick with which it begins.

    Yields:
        For each tick the channels, its time (ns) and the serialised message of each channel.
    """
    channels: list[Channel] = []
    tick: list[Message] = []
    index = first
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Channel) and all(record.id != c.id for c in channels):
                channels.append(record)
            elif isinstance(record, Message):
                if record.sequence != index:
                    return
                tick.append(record)
                if len(tick) == len(channels):
                    yield channels, tick[0].log_time, [message.data for message in tick]
                    tick = []
                    index += 1


def _records(stream: BinaryIO) -> Iterator[McapRecord]:
    """Read the records of a file up to the first that is not whole."""
    try:
        yield from StreamReader(stream, validate_crcs=True).records
    except (McapError, EOFError, ValueError, struct.error, zstandard.ZstdError):
        return  # this is where the writer was killed; every chunk before it is whole
