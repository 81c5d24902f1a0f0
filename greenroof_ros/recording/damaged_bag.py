"""What is whole in a bag whose writer was killed, and a new bag of it."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, McapRecord, Message
from mcap.stream_reader import StreamReader

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import Topic, find_namespace, read_topics
from greenroof_ros.recording.bag_files import content_of, numbered_files
from greenroof_ros.recording.bag_metadata import FileContent, write_metadata
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.mcap_file import McapFile


def recovered_bag(bag: Path) -> Path:
    """Return where the recovery of a damaged bag goes unless it is told otherwise: beside it."""
    place = bag.resolve()
    return place.parent / f"{place.name}-recovered"


def restore(bag: Path, target: Path) -> str:
    """Make a bag of all that is whole in another one: ticks of a simulation, or live messages.

    A file of a live site that was closed is the same in both, where the disk can do that; else it
    is copied: there may be months of them.

    Args:
        bag: that was recorded.
        target: the new one; must not exist.

    Returns:
        How much there is in it, for people.

    Raises:
        ConfigurationError: nothing is whole, or it holds topics that are not this package's.
        OSError: the new one cannot be written.
    """
    files = [path for _, path in numbered_files(bag)]
    names = list(dict.fromkeys(c.topic for file in files for c in read_channels(file)))
    live = not any(name.endswith("/clock") for name in names)  # which a live site has not
    what = "message" if live else "tick"
    if not names:
        raise ConfigurationError(f"holds not one whole {what}", file=bag)
    topics = _topics(bag, names, "/roof/level" if live else "/clock")
    if not live:
        return f"{_rewrite_ticks(files[0], target, topics)} ticks"
    target.mkdir(parents=True)
    contents: list[FileContent] = []
    for file in files:
        copy = target / f"{target.name}_{len(contents)}.mcap"
        content = content_of(file)
        if content is not None:
            _link(file, copy)
            contents.append(replace(content, name=copy.name))
        elif (content := _rewrite(file, copy, topics)) is not None:
            contents.append(content)
    if not contents:
        target.rmdir()
        raise ConfigurationError("holds not one whole message", file=bag)
    write_metadata(target, topics, contents)
    return f"{sum(content.count for content in contents)} messages"


def _topics(bag: Path, names: list[str], needed: str) -> list[Topic]:
    """Return the topics of a bag, with the names that they have there."""
    interface = read_topics()
    namespace = find_namespace(names, [needed], bag)
    plain = {
        name: name if name in interface else name.removeprefix(namespace) for name in names
    }
    foreign = [name for name in names if plain[name] not in interface]
    if foreign:
        raise ConfigurationError(
            f"holds {', '.join(foreign)}, which is no topic of this graph", file=bag
        )
    return [replace(interface[plain[name]], name=name) for name in names]


def _link(file: Path, copy: Path) -> None:
    try:
        os.link(file, copy)
    except OSError:  # another disk, or one that knows no links
        shutil.copyfile(file, copy)


def _rewrite_ticks(file: Path, target: Path, topics: list[Topic]) -> int:
    """Write the whole ticks of a simulated run into a new bag; return how many there are."""
    writer = BagWriter(target, topics)
    for _, time_ns, messages in read_ticks(file):
        writer.write_tick(time_ns, messages)
    writer.close()
    if not writer.ticks:
        shutil.rmtree(target)
        raise ConfigurationError("holds not one whole tick", file=file)
    return writer.ticks


def _rewrite(file: Path, copy: Path, topics: list[Topic]) -> FileContent | None:
    """Write the whole messages of a file into another; None where it has none."""
    indices = {topic.name: index for index, topic in enumerate(topics)}
    names = {channel.id: channel.topic for channel in read_channels(file)}
    new: McapFile | None = None
    for message in read_messages(file):
        new = new or McapFile(copy, topics)
        new.write(message.log_time, [(indices[names[message.channel_id]], message.data)])
    if new is None:
        return None
    new.close()
    return new.content


def read_channels(path: Path) -> list[Channel]:
    """Return the channels of a bag file, which stand before its first message."""
    channels = []
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Message):
                break
            if isinstance(record, Channel):
                channels.append(record)
    return channels


def read_messages(path: Path) -> Iterator[Message]:
    """Read the messages of a bag file, up to where its writer was killed."""
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Message):
                yield record


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
