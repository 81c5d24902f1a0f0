"""The bag of a live site whose recorder was killed: its files into a new bag, the last one too."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import Topic, find_namespace, read_topics
from greenroof_ros.recording.bag_files import content_of, numbered_files
from greenroof_ros.recording.bag_metadata import METADATA, FileContent, metadata
from greenroof_ros.recording.damaged_bag import read_channels, read_messages
from greenroof_ros.recording.mcap_file import McapFile


def is_live(bag: Path) -> bool:
    """Return whether a bag is of a live site: those of a simulation have a clock."""
    names = {channel.topic for file in bag.glob("*.mcap") for channel in read_channels(file)}
    return bool(names) and not any(name.endswith("/clock") for name in names)


def restore(bag: Path, target: Path) -> int:
    """Make a bag of all that is in a live one.

    A file that was closed is the same in both, where the disk can do that; else it is copied.

    Args:
        bag: that was recorded.
        target: the new one; must not exist.

    Returns:
        The number of its messages.

    Raises:
        ConfigurationError: it holds no message, or topics that no live graph has.
        OSError: the new one cannot be written.
    """
    files = [path for _, path in numbered_files(bag)]
    topics = _topics(bag, files)
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
        raise ConfigurationError("holds not one message", file=bag)
    (target / METADATA).write_text(metadata(topics, contents), encoding="utf-8")
    return sum(content.count for content in contents)


def _topics(bag: Path, files: list[Path]) -> list[Topic]:
    """Return the topics of a bag's files, with the names that they have there."""
    interface = read_topics()
    names = list(dict.fromkeys(c.topic for file in files for c in read_channels(file)))
    namespace = find_namespace(names, ["/roof/level"], bag)
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


def _rewrite(file: Path, copy: Path, topics: list[Topic]) -> FileContent | None:
    """Write a file's whole messages into another; None where it has none."""
    names = {channel.id: channel.topic for channel in read_channels(file)}
    indices = {topic.name: index for index, topic in enumerate(topics)}
    counts: dict[str, int] = {}
    times: list[int] = []
    new: McapFile | None = None
    for message in read_messages(file):
        if new is None:
            new = McapFile(copy, topics)
        name, time = names[message.channel_id], message.log_time
        new.add(new.channels[indices[name]], time, message.data, time, message.sequence)
        counts[name] = counts.get(name, 0) + 1
        times = [min([time, *times]), max([time, *times])]
    if new is None:
        return None
    new.close()
    return FileContent(copy.name, times[0], times[-1], counts)
