"""A bag whose recorder was killed, and that is gone on with in another file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import Topic
from greenroof_ros.recording.bag_files import numbered_files
from greenroof_ros.recording.bag_metadata import METADATA
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.cut_file import close_file
from greenroof_ros.recording.damaged_bag import read_channels


def continue_bag(directory: Path, topics: Sequence[Topic]) -> BagWriter:
    """Close the files of a bag and return what writes on in another one.

    Args:
        directory: the bag; where there is none a new one begins.
        topics: of each tick, which must be those of the bag.

    Raises:
        ConfigurationError: they are not.
        OSError: a file cannot be written.
    """
    before = []
    for _, path in numbered_files(directory):
        content = close_file(path)
        if content is None:
            path.unlink()  # not one tick was written
            continue
        names = [channel.topic for channel in read_channels(path)]
        if names != [topic.name for topic in topics]:
            raise ConfigurationError(
                f"holds {', '.join(names)}; only a bag of the same topics can be gone on with",
                file=path,
            )
        before.append(content)
    # It says that the bag is closed, which it is not from now on.
    (directory / METADATA).unlink(missing_ok=True)
    return BagWriter(directory, topics, before)
