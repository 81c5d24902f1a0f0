"""The interface, ``msg_defs/topics.yaml``: every topic of the graph."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from greenroof_ros.common.files import read_yaml, shared_directory


@dataclass(frozen=True)
class Qos:
    """A quality of service profile; history is always keep-last, liveliness automatic.

    Attributes:
        name: the profile's name in the contract.
        reliability: ``reliable`` or ``best_effort``.
        durability: ``transient_local`` or ``volatile``.
        depth: how many messages are kept.
        lease_s: liveliness lease (s), infinite unless given.
    """

    name: str
    reliability: str
    durability: str
    depth: int
    lease_s: float = math.inf


@dataclass(frozen=True)
class Topic:
    """One topic of the graph; ``msg_defs/topics.yaml`` explains each attribute."""

    name: str
    type: str
    unit: str
    low: float
    high: float
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    per_tick: bool
    qos: Qos
    meaning: str

    @property
    def relative_name(self) -> str:
        """The name that nodes use: relative, so that a namespace holds a roof, except /clock."""
        return self.name if self.name == "/clock" else self.name.removeprefix("/")


def read_topics() -> dict[str, Topic]:
    """Read the contract; the order is that of the file, and of each tick in a bag."""
    contract: dict[str, Any] = read_yaml(shared_directory() / "msg_defs" / "topics.yaml")
    profiles = {name: Qos(name=name, **profile) for name, profile in contract["qos"].items()}
    topics = {}
    for name, entry in contract["topics"].items():
        low, high = entry.get("range", (-math.inf, math.inf))
        topics[name] = Topic(
            name=name,
            type=entry["type"],
            unit=entry["unit"],
            # No bound in the contract still means a finite value.
            low=max(low, -sys.float_info.max),
            high=min(high, sys.float_info.max),
            publishers=tuple(entry["publishers"]),
            subscribers=tuple(entry["subscribers"]),
            per_tick=entry["per_tick"],
            qos=profiles[entry["qos"]],
            meaning=entry["meaning"],
        )
    return topics


def recorded_topics(publishers: Iterable[str]) -> list[Topic]:
    """Return the topics that a graph of these publishing nodes has each tick, in bag order."""
    nodes = set(publishers)
    return [
        topic
        for topic in read_topics().values()
        if topic.per_tick and nodes.intersection(topic.publishers)
    ]


def markdown_table(topics: Iterable[Topic]) -> str:
    """Return the contract as a Markdown table."""
    rows = ["| topic | type | unit | published by | taken by | meaning |", "|" + "---|" * 6]
    for topic in topics:
        rows.append(
            f"| `{topic.name}` | {topic.type.replace('/msg/', '/')} | {topic.unit} "
            f"| {', '.join(topic.publishers)} | {', '.join(topic.subscribers)} "
            f"| {topic.meaning} |"
        )
    return "\n".join(rows)
