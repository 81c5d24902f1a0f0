"""The files of a bag, and what is in those of them that were closed."""

from __future__ import annotations

import re
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from greenroof_ros.recording.bag_metadata import FileContent


def numbered_files(bag: Path) -> list[tuple[int, Path]]:
    """Return the files of a bag with their numbers, the oldest first."""
    return sorted(
        (int(match[1]), path)
        for path in bag.glob("*.mcap") if (match := re.search(r"_(\d+)\.mcap$", path.name))
    )


def content_of(path: Path) -> FileContent | None:
    """Return what is in a file by its index; None where it was not closed."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, OSError, ValueError):
        return None
    if summary is None or summary.statistics is None:
        return None
    statistics = summary.statistics
    return FileContent(
        path.name, statistics.message_start_time, statistics.message_end_time,
        {
            channel.topic: statistics.channel_message_counts.get(number, 0)
            for number, channel in summary.channels.items()
        },
    )
