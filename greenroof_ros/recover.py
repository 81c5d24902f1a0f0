"""Repair the bag of a run whose recorder was killed: ``greenroof recover DIR``."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from greenroof_ros.common.command_line import command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.recording.bag_writer import bag_files
from greenroof_ros.recording.damaged_bag import recovered_bag, restore


def recover(directory: Path, output: Path | None = None) -> tuple[Path, str]:
    """Write every whole tick of a damaged bag, or message of a live site, into a new bag.

    Args:
        directory: a run directory, or the bag in it.
        output: the new bag, which must not exist; by default beside the old one.

    Returns:
        The new bag, and how much is in it, for people.

    Raises:
        ConfigurationError: there is no bag, it holds no whole tick, or the output exists.
    """
    bag = directory / "bag" if (directory / "bag").is_dir() else directory
    if not bag_files(bag):
        raise ConfigurationError(
            "must be a run directory or the bag in it, and holds no .mcap file", file=directory
        )
    target = output or recovered_bag(bag)
    if target.exists():
        raise ConfigurationError("exists already; nothing was written", file=target)
    try:
        return target, restore(bag.resolve(), target)
    except OSError as error:
        shutil.rmtree(target, ignore_errors=True)
        raise ConfigurationError(
            f"cannot be written: {error.strerror}; --output puts it elsewhere", file=target
        ) from error


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof recover",
        description="Repair the bag of a run whose recorder was killed or ran out of disk: every "
        "whole tick, or every message of a live site, goes into a new bag beside the old one, "
        "which is left as it is. A report of the run then uses the new one.",
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="a run directory, or its bag")
    parser.add_argument(
        "--output", type=Path, metavar="BAG", help="the new bag (default: beside the old one)"
    )
    return parser


@command
def main() -> int:
    """Recover the bag that the command line names."""
    arguments = make_parser().parse_args()
    bag, amount = recover(arguments.directory, arguments.output)
    print(f"{amount} recovered to {bag}")
    return 0


if __name__ == "__main__":
    main()
