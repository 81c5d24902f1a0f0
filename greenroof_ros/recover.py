"""Repair the bag of a run whose recorder was killed: ``python -m greenroof_ros.recover DIR``."""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

from greenroof_ros.common.command_line import command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import find_namespace, read_topics
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.damaged_bag import read_ticks, recovered_bag


def recover(directory: Path, output: Path | None = None) -> tuple[Path, int]:
    """Write every whole tick of a damaged bag into a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default beside the old one.

    Returns:
        The new bag and the number of its ticks.

    Raises:
        ConfigurationError: there is no bag, it holds no whole tick, or the output exists.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    files = sorted(bag.glob("*.mcap"))
    if len(files) != 1:
        raise ConfigurationError(
            f"must be a run directory or the bag in it, with one .mcap file, not {len(files)}",
            file=directory,
        )
    target = output or recovered_bag(bag)
    if target.exists():
        raise ConfigurationError("exists already; nothing was written", file=target)
    try:
        return target, _rewrite(files[0], target)
    except OSError as error:
        shutil.rmtree(target, ignore_errors=True)
        raise ConfigurationError(
            f"cannot be written: {error.strerror}; --output puts it elsewhere", file=target
        ) from error


def _rewrite(file: Path, target: Path) -> int:
    """Write the whole ticks of a bag's file into a new bag and return their number."""
    topics = read_topics()
    writer: BagWriter | None = None
    for channels, time_ns, messages in read_ticks(file):
        if writer is None:
            names = [channel.topic for channel in channels]
            namespace = find_namespace(names, ["/clock"], file)
            foreign = [name for name in names if name.removeprefix(namespace) not in topics]
            if foreign:
                raise ConfigurationError(
                    f"holds {', '.join(foreign)}, which is no topic of this graph", file=file
                )
            writer = BagWriter(
                target,
                [replace(topics[name.removeprefix(namespace)], name=name) for name in names],
            )
        writer.write_tick(time_ns, messages)
    if writer is None:
        raise ConfigurationError("holds not one whole tick", file=file)
    writer.close()
    return writer.ticks


@command
def main() -> int:
    """Recover the bag that the command line names."""
    parser = argparse.ArgumentParser(
        prog="python -m greenroof_ros.recover",
        description="Repair the bag of a run whose recorder was killed or ran out of disk: every "
        "whole tick goes into a new bag beside the old one, which is left as it is. A report of "
        "the run then uses the new one.",
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="a run directory, or its bag")
    parser.add_argument(
        "--output", type=Path, metavar="BAG", help="the new bag (default: beside the old one)"
    )
    arguments = parser.parse_args()
    bag, ticks = recover(arguments.directory, arguments.output)
    print(f"{ticks} ticks recovered to {bag}")
    return 0


if __name__ == "__main__":
    main()
