"""A bag's ``metadata.yaml``, by which rosbag2 and rosbags know its files and topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.interface import Qos, Topic

METADATA = "metadata.yaml"

# rosbag2's metadata version and RMW_DURATION_INFINITE, which stands for "no limit".
_METADATA_VERSION = 9
_INFINITE = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class FileContent:
    """What is in one file of a bag.

    Attributes:
        name: of the file.
        first_ns: time of its first message, nanoseconds since 1970; 0 where there is none.
        last_ns: likewise of its last.
        counts: how many messages it holds, by topic.
    """

    name: str
    first_ns: int
    last_ns: int
    counts: Mapping[str, int]

    @property
    def count(self) -> int:
        """How many messages it holds."""
        return sum(self.counts.values())

    @property
    def ticks(self) -> int:
        """How many whole ticks it holds, of those in which each topic has one."""
        return min(self.counts.values(), default=0)


def offered_profiles(topic: Topic) -> str:
    """Return a topic's profiles as its channel in an mcap file has them, a YAML text."""
    return _yaml([_qos_profile(topic.qos)])


def write_metadata(
    bag: Path, topics: Sequence[Topic], files: Sequence[FileContent]
) -> None:
    """Write ``metadata.yaml`` in one step: a reader finds the old text or the new one.

    Args:
        bag: its directory.
        topics: of the bag, in its order.
        files: of the bag that are closed, one at least, in theirs.

    Raises:
        OSError: it cannot be written; the old one is as it was.
    """
    part = bag / f".{METADATA}.part"
    try:
        part.write_text(_metadata(topics, files), encoding="utf-8")
        part.replace(bag / METADATA)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _metadata(topics: Sequence[Topic], files: Sequence[FileContent]) -> str:
    types = read_yaml(shared_directory() / "msg_defs" / "types.yaml")
    first = min(file.first_ns for file in files)
    last = max(file.last_ns for file in files)
    return _yaml(
        {
            "rosbag2_bagfile_information": {
                "version": _METADATA_VERSION,
                "storage_identifier": "mcap",
                "duration": {"nanoseconds": last - first},
                "starting_time": {"nanoseconds_since_epoch": first},
                "message_count": sum(file.count for file in files),
                "topics_with_message_count": [
                    {
                        "topic_metadata": {
                            "name": topic.name,
                            "type": topic.type,
                            "serialization_format": "cdr",
                            "offered_qos_profiles": [_qos_profile(topic.qos)],
                            "type_description_hash": types[topic.type]["hash"],
                        },
                        "message_count": sum(file.counts.get(topic.name, 0) for file in files),
                    }
                    for topic in topics
                ],
                # Of whole files; the chunks in them are compressed, which mcap says itself.
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [file.name for file in files],
                "files": [
                    {
                        "path": file.name,
                        "starting_time": {"nanoseconds_since_epoch": file.first_ns},
                        "duration": {"nanoseconds": file.last_ns - file.first_ns},
                        "message_count": file.count,
                    }
                    for file in files
                ],
                "custom_data": None,
                "ros_distro": "jazzy",
            }
        }
    )


def _qos_profile(qos: Qos) -> dict[str, Any]:
    """Return a profile as rosbag2 writes it down."""
    lease = dict(_INFINITE)
    if qos.lease_s != float("inf"):
        lease = {"sec": int(qos.lease_s), "nsec": round(qos.lease_s % 1 * 1e9)}
    return {
        "history": "keep_last",
        "depth": qos.depth,
        "reliability": qos.reliability,
        "durability": qos.durability,
        "deadline": dict(_INFINITE),
        "lifespan": dict(_INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": lease,
        "avoid_ros_namespace_conventions": False,
    }


def _yaml(content: object) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=False, width=10_000)
