"""The topics that a node subscribes to: their newest values, and who should publish them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.publishers import Publishers
from greenroof_ros.graph.states import ROLES
from greenroof_ros.graph.validation import Input


class Inputs:
    """The inputs of a node, by the names of their topics in the interface.

    Attributes:
        entries: the newest value of each.
        publishers: of each.
        names: what to call a node that has not been seen, by its role.
    """

    def __init__(self, role: str, interface: dict[str, Topic]) -> None:
        """Begin without any.

        Args:
            role: of the node.
            interface: every topic of the graph.
        """
        self.entries: dict[str, Input] = {}
        self.publishers: dict[str, Publishers] = {}
        self.names = dict(ROLES)
        self._role = role
        self._interface = interface

    def absent(self) -> dict[str, list[str]]:
        """Return the topics that nobody is heard on, by the role of who should publish them."""
        return self.by_role([
            name for name, publishers in self.publishers.items() if not publishers.heard
        ])

    def by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return some of the topics, by the role of who should publish them."""
        topics = {name: self._interface[name] for name in self.publishers}
        return by_publisher(names, topics, self._role)

    def say(self, silent: Mapping[str, Collection[str]]) -> str:
        """Name topics, and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.entries[name].name for name in names)} from "
            f"{self.call(role, names)}"
            for role, names in silent.items()
        )

    def call(self, role: str, names: Iterable[str] = ()) -> str:
        """Return what to call the node of a role: its name, where it publishes one of some topics.

        Args:
            role: of the interface.
            names: of topics.
        """
        found = [node for name in names for node in self.publishers[name].names()]
        return found[0] if found else self.names.get(role, role)


def root_causes(roles: Collection[str], topics: Iterable[Topic]) -> set[str]:
    """Return which of some silent roles do not themselves wait for another of them, or else all.

    Args:
        roles: from which nothing comes.
        topics: of the interface, which says who waits for whom.
    """
    waiting = {
        role
        for topic in topics
        for role in roles
        if topic.per_tick and role in topic.subscribers
        and any(other in roles and other != role for other in topic.publishers)
    }
    return set(roles) - waiting or set(roles)


def by_publisher(
    absent: Collection[str], topics: Mapping[str, Topic], own: str
) -> dict[str, list[str]]:
    """Return topics on which there is nothing, by the role of who should publish them.

    Where the interface names two, the plant or a pump driver, it is the first of whom nothing else
    is here.

    Args:
        absent: names of those topics.
        topics: all that a node subscribes to, by name.
        own: role of that node.
    """
    here = {own} | {topic.publishers[0] for name, topic in topics.items() if name not in absent}
    roles: dict[str, list[str]] = {}
    for name in absent:
        candidates = topics[name].publishers
        role = next((role for role in candidates if role not in here), candidates[-1])
        roles.setdefault(role, []).append(name)
    return roles
