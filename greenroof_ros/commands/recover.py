"""Repair a damaged bag, or the bag of a run that was killed or ran out of disk space.

All intact data are copied to a new bag next to the old bag, which is left unchanged. A later report
on the run uses the new bag.

Exit codes: 0 the new bag contains all recorded data, 1 some data were lost, as stated in the
output, 2 nothing could be recovered, or bad usage
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Message, Schema

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, Parser, command, print_lines
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import from_epoch_ns, to_people
from greenroof_ros.results.bag_mend import read_chunks
from greenroof_ros.results.bag_write import (
    find_files,
    name_next_file,
    name_recovered_bag,
    read_recorded,
    write_metadata,
)
from greenroof_ros.results.mcap import McapWriter


class Recovered(NamedTuple):
    """The result of recovering a bag.

    Attributes:
        bag: the new bag.
        messages: number of messages in the new bag.
        losses: descriptions of the losses, one sentence each.
    """

    bag: Path
    messages: int
    losses: list[str]


def recover(directory: Path, output: Path | None = None) -> Recovered:
    """Copy the intact chunks of a bag to a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default, next to the old bag.

    Raises:
        ConfigurationError: if there is no bag, if the bag contains no intact chunk, or if the
            output exists or cannot be written.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    files = find_files(bag) or sorted(bag.glob("*.mcap"))  # other recorders may not number them
    if not files:
        raise ConfigurationError(
            "must be a run directory or a bag, but contains no .mcap file", file=directory
        )
    target = output or name_recovered_bag(bag)
    if target.exists():
        raise ConfigurationError("already exists; nothing was written", file=target)
    recorded, counts, losses = read_recorded(bag), dict[str, int](), list[str]()
    try:
        target.mkdir(parents=True)
        for file in files:
            copy = name_next_file(target)
            counts[file.name], lost = _copy_file(file, copy, recorded.get(file.name, (0, 0)))
            losses += lost
            if not counts[file.name]:
                copy.unlink(missing_ok=True)
        copies = find_files(target)
        write_metadata(target, copies)
    except OSError as error:
        shutil.rmtree(target, ignore_errors=True)
        raise ConfigurationError(
            f"cannot be written: {error.strerror}; use --output to write the bag elsewhere",
            file=target,
        ) from error
    if not copies:
        shutil.rmtree(target)
        raise ConfigurationError("does not contain an intact chunk of messages", file=bag)
    losses += [
        f"{name}: {missing} of its {had} messages are lost" for name, (had, _) in recorded.items()
        if (missing := had - counts.get(name, 0)) > 0
    ]
    return Recovered(target, sum(counts.values()), losses)


def _copy_file(file: Path, copy: Path, had: tuple[int, int]) -> tuple[int, list[str]]:
    """Copy the intact chunks of a file; return the number of messages copied and the losses.

    Args:
        file: the file.
        copy: its copy, which must not exist.
        had: the file's number of messages and its size (bytes) when it was closed; 0 if unknown.
    """
    def lose(size: int, end: str) -> None:
        start = "the beginning" if last is None else to_people(from_epoch_ns(last))
        losses.append(f"{file.name}: {size} bytes are lost between {start} and {end}")

    try:
        stream = file.open("rb")
    except OSError as error:
        return 0, [f"{file.name} cannot be read: {error.strerror}"]
    seen, losses = set[tuple[type, int]](), list[str]()
    copied = lost = 0
    last: int | None = None  # time of the last message written (ns)
    size = os.fstat(stream.fileno()).st_size
    with stream, copy.open("xb") as output:
        writer = McapWriter(output)
        for length, records in read_chunks(stream):
            for record in records:
                if isinstance(record, Schema | Channel) and (type(record), record.id) not in seen:
                    seen.add((type(record), record.id))
                    if isinstance(record, Channel) and (Schema, record.schema_id) not in seen:
                        record.schema_id = 0  # its type was defined in the lost part
                    writer.add(record)
            messages = [record for record in records if isinstance(record, Message)]
            # The topics of the others were defined in the lost part.
            known = [message for message in messages if (Channel, message.channel_id) in seen]
            if known and lost:
                lose(lost, to_people(from_epoch_ns(known[0].log_time)))
                lost = 0
            for message in known:
                last = message.log_time
                writer.add_message(
                    message.channel_id, last, message.data, message.publish_time, message.sequence
                )
            writer.flush()
            copied += len(known)
            if not records or len(known) < len(messages):
                lost += length - length * len(known) // max(len(messages), 1)
        writer.finish()
    if copied < had[0]:
        lost += max(0, had[1] - size)  # cut off
    if lost:
        lose(lost, "the end")
    return copied, losses


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("recover", __doc__, "DIR [options]")
    parser.add_argument(
        "directory", type=Path, metavar="DIR",
        help="bag to repair, or run directory that contains the bag to repair",
    )
    parser.add_argument(
        "--output", type=Path, metavar="BAG",
        help="write the new bag to this path (default: next to the old bag)",
    )
    return parser


@command
def main() -> int:
    """Recover the bag named on the command line."""
    arguments = make_parser().parse_args()
    recovered = recover(arguments.directory, arguments.output)
    print(escape(f"{recovered.messages} messages recovered to {recovered.bag}"))
    print_lines("lost", recovered.losses)
    return EXIT_FAILED if recovered.losses else EXIT_DONE
