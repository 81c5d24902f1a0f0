"""Repair the bag of a run whose recorder was killed: ``greenroof recover DIR``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path

from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message, Schema

from greenroof_ros.common.command_line import Parser, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.recording.bag_writer import (
    DAMAGED,
    FileIndex,
    bag_files,
    next_file,
    read_index,
    recovered_bag,
    start_writer,
    write_metadata,
)


def recover(directory: Path, output: Path | None = None) -> tuple[Path, str]:
    """Write every complete tick of a damaged bag, or message of a live site, to a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default it is next to the old one.

    Returns:
        The new bag, and a text with how much is in it.

    Raises:
        ConfigurationError: no bag, nothing complete in it, or the output exists or is unwritable.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    if not bag_files(bag):
        raise ConfigurationError(
            "must be the directory of a run or its bag, but has no .mcap file", file=directory
        )
    target = output or recovered_bag(bag)
    if target.exists():
        raise ConfigurationError("already exists; nothing was written", file=target)
    try:
        return target, restore(bag.resolve(), target)
    except OSError as error:
        shutil.rmtree(target, ignore_errors=True)
        raise ConfigurationError(
            f"cannot be written: {error.strerror}; --output puts it elsewhere", file=target
        ) from error


def restore(bag: Path, target: Path) -> str:
    """Write all that is complete in one bag to another: ticks of a simulation, or live messages.

    A file that was closed is hard-linked, because there may be months of them, or copied if the
    target is on another disk or the disk does not support links.

    Args:
        bag: the recorded bag.
        target: the new bag; must not exist.

    Returns:
        A text with how much is in it.

    Raises:
        ConfigurationError: nothing is complete.
        OSError: the new bag cannot be written.
    """
    files = bag_files(bag)
    target.mkdir(parents=True)
    restored: dict[Path, FileIndex] = {}
    for file in files:
        copy = next_file(list(restored), target)
        index = read_index(file)
        # Read the newest file in full: its middle can be damaged although its end is intact.
        if index is not None and (
            file != files[-1]
            or sum(1 for _ in _messages(file)) == index.statistics.message_count
        ):
            _link(file, copy)
        else:
            _rewrite(file, copy)
        index = read_index(copy)
        if index is not None and index.statistics.message_count:
            restored[copy] = index
        else:
            copy.unlink()
    if not restored:
        target.rmdir()
        raise ConfigurationError("does not hold a single complete tick or message", file=bag)
    write_metadata(target, restored.values())
    count = sum(index.statistics.message_count for index in restored.values())
    per_tick = _per_tick(next(iter(restored.values())).channels)
    return f"{count} messages" if per_tick == 1 else f"{count // per_tick} ticks"


def _link(file: Path, copy: Path) -> None:
    try:
        os.link(file, copy)
    except OSError:  # another disk, or one without links
        shutil.copyfile(file, copy)


def _rewrite(file: Path, copy: Path) -> None:
    """Write a file's complete messages to another file; for a simulation its complete ticks."""
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    per_tick = 1
    with copy.open("xb") as stream:
        writer = start_writer(stream)
        for _, group in groupby(_messages(file), key=lambda message: message[2].log_time):
            together = list(group)
            if not channels:
                per_tick = _per_tick([channel for _, channel, _ in together])
            if len(together) < per_tick:
                break
            for schema, channel, message in together:
                if channel.id not in channels:
                    if schema is not None and schema.id not in schemas:
                        schemas[schema.id] = writer.register_schema(
                            schema.name, schema.encoding, schema.data
                        )
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding,
                        schemas.get(channel.schema_id, 0), channel.metadata,
                    )
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time,
                    message.sequence,
                )
        writer.finish()


def _per_tick(channels: Collection[Channel]) -> int:
    """Return how many messages a tick has, from the channels of the first messages.

    A live site has no clock and no ticks: each message counts by itself.
    """
    return len(channels) if any(channel.topic.endswith("/clock") for channel in channels) else 1


def _messages(file: Path) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """Yield the messages of a file up to its first damaged or incomplete chunk."""
    with file.open("rb") as stream, suppress(*DAMAGED):
        reader = NonSeekingReader(stream, validate_crcs=True)
        yield from reader.iter_messages(log_time_order=False)


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof recover",
        description="Repair the bag of a run whose recorder was killed or ran out of disk: every "
        "complete tick, or every message of a live site, goes into a new bag next to the old one, "
        "which stays unchanged. A report of the run then uses the new one.",
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="a run directory, or its bag")
    parser.add_argument(
        "--output", type=Path, metavar="BAG", help="the new bag (default: next to the old one)"
    )
    return parser


@command
def main() -> int:
    """Recover the bag named on the command line."""
    arguments = make_parser().parse_args()
    bag, amount = recover(arguments.directory, arguments.output)
    print(f"{amount} recovered to {bag}")
    return 0


if __name__ == "__main__":
    main()
