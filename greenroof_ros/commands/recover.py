"""Repair a damaged bag, or the bag of a run that was killed: ``greenroof recover DIR``."""

from __future__ import annotations

import os
import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Message

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED, Parser, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml
from greenroof_ros.common.times import from_epoch_ns, to_people
from greenroof_ros.recording.bag_writer import (
    METADATA,
    FileIndex,
    bag_files,
    next_file,
    read_index,
    recovered_bag,
    write_metadata,
)
from greenroof_ros.recording.mcap_writer import McapWriter
from greenroof_ros.recording.whole_records import (
    Contents,
    Damage,
    FileBytes,
    is_intact,
    read_contents,
    read_whole_messages,
)

# The times of the last message before a loss and of the first behind it (ns), if there are any.
_Gap = tuple[int | None, int | None]


def recover(directory: Path, output: Path | None = None) -> tuple[Path, Restored]:
    """Write every complete tick of a damaged bag, or message of a live site, to a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default it is next to the old one.

    Returns:
        The new bag, how much is in it, and what was lost.

    Raises:
        ConfigurationError: no bag, nothing complete in it, or the output exists or is unwritable.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    if not mcap_files(bag):
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


def mcap_files(bag: Path) -> list[Path]:
    """Return the files of a bag, the oldest first; other recorders may not number them."""
    return bag_files(bag) or sorted(bag.glob("*.mcap"))


class Restored(NamedTuple):
    """What a new bag holds.

    Attributes:
        amount: number of ticks or messages, in words.
        losses: what was lost, one sentence for each damaged or missing file.
    """

    amount: str
    losses: list[str]


class _Listed(NamedTuple):
    """What ``metadata.yaml`` records of a file: messages, and the times of first and last (ns)."""

    messages: int
    start: int
    end: int


def restore(bag: Path, target: Path) -> Restored:
    """Write all that is complete in one bag to another: ticks of a simulation, or live messages.

    Every file is read in full. A file whose checksums are right is hard-linked, because there may
    be months of them, or copied if the target is on another disk or the disk has no links.

    Args:
        bag: the recorded bag.
        target: the new bag; must not exist.

    Returns:
        How much is in it, and what was lost.

    Raises:
        ConfigurationError: nothing is complete.
        OSError: the new bag cannot be written.
    """
    files, listed = mcap_files(bag), _listed(bag)
    target.mkdir(parents=True)
    restored: dict[Path, FileIndex] = {}
    losses = [_missing(name, listed.get(name)) for name in _missing_files(files, listed)]
    together = 1
    for file in files:
        copy = next_file(list(restored), target)
        per_tick, loss = _restore_file(file, copy, listed.get(file.name))
        losses += [loss] if loss else []
        index = read_index(copy) if copy.exists() else None
        if index is not None and index.statistics.message_count:
            restored[copy], together = index, per_tick
        else:
            copy.unlink(missing_ok=True)
    if not restored:
        target.rmdir()
        raise ConfigurationError("does not hold a single complete tick or message", file=bag)
    write_metadata(target, restored.values())
    count = sum(index.statistics.message_count for index in restored.values())
    return Restored(_amount(count, together), losses)


def _amount(messages: int, per_tick: int) -> str:
    return f"{messages} messages" if per_tick == 1 else f"{messages // per_tick} ticks"


def _listed(bag: Path) -> dict[str, _Listed]:
    """Return what a bag's metadata states about its files; nothing if it is missing or damaged."""
    with suppress(ConfigurationError, KeyError, TypeError, ValueError):
        about = read_yaml(bag / METADATA)["rosbag2_bagfile_information"]
        return {
            str(file["path"]): _Listed(
                int(file["message_count"]),
                start := int(file["starting_time"]["nanoseconds_since_epoch"]),
                start + int(file["duration"]["nanoseconds"]),
            )
            for file in about["files"]
        }
    return {}


def _missing_files(files: list[Path], listed: Mapping[str, _Listed]) -> list[str]:
    """Return the names of files that are not there; without metadata, of those between others."""
    there = {file.name for file in files}
    if listed or not all("_" in name for name in there):
        return [name for name in listed if name not in there]
    first, last = (int(file.stem.rpartition("_")[2]) for file in (files[0], files[-1]))
    prefix = files[0].stem.rpartition("_")[0]
    names = (f"{prefix}_{number}.mcap" for number in range(first, last))
    return [name for name in names if name not in there]


def _missing(name: str, listed: _Listed | None) -> str:
    if listed is None:
        return f"{name} is missing, with all its messages"
    between = _between((listed.start, listed.end))
    return f"{name} is missing, with its {listed.messages} messages {between}"


def _restore_file(file: Path, copy: Path, listed: _Listed | None) -> tuple[int, str]:
    """Link a whole file, or write what is whole in it to another file.

    Returns:
        The number of messages that make a tick, and what was lost; empty if nothing was.
    """
    had = 0 if listed is None else listed.messages
    try:
        stream = file.open("rb")
    except OSError as error:
        return 1, f"{file.name}, with {had or 'all its'} messages, cannot be read: {error.strerror}"
    with stream:
        data = FileBytes(stream)
        if not len(data):
            return 1, f"{file.name} is empty; it had {had} messages" if had else ""
        contents = read_contents(data)
        clock = any(channel.topic.endswith("/clock") for channel in contents.channels.values())
        per_tick = contents.together if clock else 1
        if is_intact(data):
            _link(file, copy)
            return per_tick, ""
        written, gaps = _rewrite(data, contents, per_tick, copy)
    return per_tick, _loss(file.name, contents, per_tick, listed, written, gaps)


def _link(file: Path, copy: Path) -> None:
    try:
        os.link(file, copy)
    except OSError:  # another disk, or one without links
        shutil.copyfile(file, copy)


def _rewrite(
    data: FileBytes, contents: Contents, per_tick: int, copy: Path
) -> tuple[Counter[int], list[_Gap]]:
    """Write a file's whole messages to another file; for a simulation its complete ticks.

    Returns:
        The number of messages written, by channel, and where messages may be lost.
    """
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    written: Counter[int] = Counter()
    gaps: list[_Gap] = []
    last: int | None = None  # time of the last message written
    damaged = False
    with copy.open("xb") as stream:
        writer = McapWriter(stream)
        for time, together in _groups(read_whole_messages(data, contents)):
            if time is None or len(together) < per_tick:
                damaged = True
                continue
            if damaged:
                gaps.append((last, time))
            last, damaged = time, False
            for channel, message in together:
                schema = contents.schemas.get(channel.schema_id)
                if schema is not None and schema.id not in schemas:
                    schemas[schema.id] = writer.add_schema(
                        schema.name, schema.encoding, schema.data
                    )
                if channel.id not in channels:
                    channels[channel.id] = writer.add_channel(
                        channel.topic, channel.message_encoding,
                        schemas.get(channel.schema_id, 0), channel.metadata,
                    )
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time,
                    message.sequence,
                )
                written[channel.id] += 1
        writer.finish()
    return written, [*gaps, (last, None)] if damaged else gaps


def _groups(
    messages: Iterator[tuple[Channel, Message] | Damage],
) -> Iterator[tuple[int | None, list[tuple[Channel, Message]]]]:
    """Yield messages with one time together; for damage no time and no messages."""
    for time, group in groupby(
        messages, lambda item: None if isinstance(item, Damage) else item[1].log_time
    ):
        yield time, [item for item in group if not isinstance(item, Damage)]


def _loss(
    name: str, contents: Contents, per_tick: int, listed: _Listed | None, written: Counter[int],
    gaps: list[_Gap],
) -> str:
    """Return what was lost of a file, in words; empty if nothing was."""
    exact = contents.closed or listed is not None
    had = contents.expected.total()
    if not contents.closed:
        had = max(had, contents.counts.total(), listed.messages if listed is not None else 0)
    lost = had - written.total()
    if lost <= 0 and (exact or not contents.damaged):
        return ""
    if lost > 0:
        unit = "messages" if per_tick == 1 else "ticks"
        what = (
            f"{'' if exact else 'at minimum '}{-(-lost // per_tick)} of {-(-had // per_tick)} "
            f"{unit} are lost"
        )
        by_topic = {
            contents.channels[number].topic: count
            for number, count in (contents.expected - written).items()
            if number in contents.channels
        }
        if per_tick == 1 and by_topic:
            topics = ", ".join(f"{topic} {by_topic[topic]}" for topic in sorted(by_topic))
            what += f" ({topics})"
    else:
        what = "messages may be lost"
    where = "".join(f", {_between(gap)}" for gap in gaps)
    unread = f"; {contents.damaged} bytes cannot be read" if contents.damaged else ""
    return f"{name}: {what}{where}{unread}"


def _between(gap: _Gap) -> str:
    """Return a time between two messages in words, in UTC."""
    first, last = ("" if time is None else to_people(from_epoch_ns(time)) for time in gap)
    if first and last:
        return f"between {first} and {last}"
    return f"after {first}" if first else f"before {last}" if last else "from first to last"


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof recover",
        description="Repair a damaged bag, or the bag of a run that was killed or ran out of disk: "
        "every complete tick, or every message of a live site, goes into a new bag next to the old "
        "one, which stays unchanged. A report of the run then uses the new one.",
        epilog="exit codes: 0 the new bag has all that was recorded, 1 some of it was lost, as the "
        "messages state, 2 nothing could be recovered, or bad usage",
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
    bag, restored = recover(arguments.directory, arguments.output)
    print(f"{restored.amount} recovered to {bag}")
    for loss in restored.losses:
        print(f"lost: {loss}", file=sys.stderr)
    return EXIT_FAILED if restored.losses else EXIT_DONE
