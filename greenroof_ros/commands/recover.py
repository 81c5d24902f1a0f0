"""Repair a damaged bag, or the bag of a run that was killed or ran out of disk space.

All intact data are copied to a new bag next to the old bag, which is left unchanged. A later report
on the run uses the new bag.

Exit codes: 0 the new bag contains all recorded data, 1 some data were lost, as stated in the
output, 2 nothing could be recovered, or bad usage
"""

from __future__ import annotations

import shutil
from pathlib import Path

from mcap.records import Channel, Message, Schema

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, Parser, command, print_lines
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.text import escape
from greenroof_ros.results import bag_write
from greenroof_ros.results.mcap import McapWriter, read_chunks


def recover(directory: Path, output: Path | None = None) -> tuple[Path, int, list[str]]:
    """Copy the intact chunks of a bag to a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default, next to the old bag.

    Returns:
        The new bag, its number of messages, and what was lost, one sentence each.

    Raises:
        ConfigurationError: if there is no bag, if the bag contains no intact chunk, or if there is
            no room for the new bag.
        OSError: if the new bag exists, or cannot be created.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    files, losses = bag_write.find_files(bag), list[str]()
    target = output or bag_write.name_recovered_bag(bag)
    if not files:
        raise ConfigurationError(
            "must be a run directory or a bag, but contains no .mcap file", file=directory
        )
    counts = dict.fromkeys((file.name for file in files), 0)
    target.mkdir(parents=True)
    try:
        for file in files:
            copy = bag_write.name_next_file(target)
            counts[file.name], lost = _copy_file(file, copy)
            if lost:
                losses.append(f"{file.name}: {lost}")
            if not counts[file.name]:
                copy.unlink(missing_ok=True)
        copies = bag_write.find_files(target)
        bag_write.write_metadata(target, copies)
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
        f"{name}: {had - counts.get(name, 0)} of its {had} messages are lost"
        for name, had in bag_write.read_recorded(bag).items() if had > counts.get(name, 0)
    ]
    return target, sum(counts.values()), losses


def _copy_file(file: Path, copy: Path) -> tuple[int, str]:
    """Copy the intact chunks of a file; return the number of messages copied, and what is lost."""
    try:
        stream = file.open("rb")
    except OSError as error:
        return 0, f"cannot be read: {error.strerror}"
    seen, copied, lost = set[tuple[type, int]](), 0, 0
    with stream, copy.open("xb") as output:
        writer = McapWriter(output)
        for length, records in read_chunks(stream):
            for record in records:
                if isinstance(record, Schema | Channel) and (type(record), record.id) not in seen:
                    seen.add((type(record), record.id))
                    writer.add(record)
            # The topics of others were defined in a lost part.
            messages = [
                each for each in records
                if isinstance(each, Message) and (Channel, each.channel_id) in seen
            ]
            for each in messages:
                writer.add_message(
                    each.channel_id, each.log_time, each.data, each.publish_time, each.sequence
                )
            writer.flush()
            copied += len(messages)
            lost += 0 if messages else length
        writer.finish()
    return copied, f"{lost} bytes are lost" if lost else ""


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
    bag, messages, losses = recover(arguments.directory, arguments.output)
    print(escape(f"{messages} messages recovered to {bag}"))
    print_lines("lost", losses)
    return EXIT_FAILED if losses else EXIT_DONE
