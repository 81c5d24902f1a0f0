"""The whole ticks of a bag whose writer was killed, and where they are put."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader


def recovered_bag(bag: Path) -> Path:
    """Return where the recovery of a damaged bag goes unless it is told otherwise: beside it."""
    place = bag.resolve()
    return place.parent / f"{place.name}-recovered"


def read_ticks(path: Path) -> Iterator[tuple[list[Channel], int, list[bytes]]]:
    """Read the whole ticks of a bag file, up to where its writer was killed.

    Args:
        path: an ``.mcap`` file of :class:`BagWriter`, whole or cut short.

    Yields:
        For each tick the channels, its time (ns) and the serialised message of each channel.
    """
    channels: list[Channel] = []
    tick: list[Message] = []
    index = 0
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
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
        except (McapError, EOFError, ValueError, struct.error, zstandard.ZstdError):
            return  # this is where the writer was killed; every chunk before it is whole
