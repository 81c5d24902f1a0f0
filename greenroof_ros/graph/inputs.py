"""The topics that a node subscribes to: their newest values, and who should publish them."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.peers import Peers, by_publisher
from greenroof_ros.graph.validation import Input


class PublisherCount(Protocol):
    """How many publishers a topic has, as far as a trigger counts them."""

    @property
    def count(self) -> int:
        """Of those that count."""
        ...

    def names(self) -> list[str]:
        """Return the names of the publishers' nodes, as far as they are known."""
        ...


class Inputs:
    """The inputs of a node, by the names of their topics in the interface.

    Attributes:
        entries: the newest value of each.
        publishers: how many each has.
    """

    def __init__(self, role: str, interface: dict[str, Topic], peers: Peers) -> None:
        """Begin without any.

        Args:
            role: of the node.
            interface: every topic of the graph.
            peers: of the node, which have names.
        """
        self.entries: dict[str, Input] = {}
        self.publishers: dict[str, PublisherCount] = {}
        self._role = role
        self._interface = interface
        self._peers = peers

    def publisher_of(self, name: str) -> str:
        """Return the role of who publishes a topic."""
        return next(who for who in self._interface[name].publishers if who != self._role)

    def absent(self) -> dict[str, list[str]]:
        """Return the topics without a publisher, by the role of who should publish them."""
        return self.by_role([
            name for name, publishers in self.publishers.items() if not publishers.count
        ])

    def by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return some of the topics, by the role of who should publish them."""
        topics = {name: self._interface[name] for name in self.publishers}
        return by_publisher(names, topics, self._role)

    def say(self, silent: dict[str, list[str]]) -> str:
        """Name topics, and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.entries[name].name for name in names)} from "
            f"{self._peers.call(role, self.publishers[names[0]].names())}"
            for role, names in silent.items()
        )
