"""The publishers of a node's inputs, and the detection of missing, silent and extra publishers.

No tick depends on this module. A node checks its peers at intervals of the steady clock.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from greenroof_ros.interface.states import ROLES
from greenroof_ros.ros.publishers import Publishers


class Peers:
    """The nodes that publish a node's inputs.

    Attributes:
        publishers: the publishers of every input, keyed by the topic's name in the interface.
    """

    def __init__(self) -> None:
        """Create the collection of peers, without inputs yet."""
        self.publishers: dict[str, Publishers] = {}

    # --- who is missing ---------------------------------------------------------------------

    def absent(self) -> dict[str, list[str]]:
        """Return the required inputs without a compatible publisher, by the missing role."""
        return self._by_role([
            name for name, publishers in self.publishers.items()
            if not publishers.optional and not publishers.compatible
        ])

    def _by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return inputs, grouped by the role that should publish each of them.

        If the interface names two roles for an input, the last one is meant: the flow of a pump
        that the plant does not simulate is missing from the pump driver.
        """
        roles: dict[str, list[str]] = {}
        for name in names:
            roles.setdefault(self.publishers[name].topic.publishers[-1], []).append(name)
        return roles

    def describe(self, missing: Mapping[str, Iterable[str]]) -> str:
        """Return a text that lists missing topics and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.publishers[name].full_name for name in names)} from "
            f"{self.name_of(role)}" for role, names in missing.items()
        )

    def describe_silent(self, names: Collection[str]) -> str:
        """Return a text about the node that all other missing nodes are waiting for.

        Args:
            names: the awaited topics in the order of the node's inputs (weather, controller, pump),
                in which each node waits for the nodes before it.
        """
        return self.describe(dict([*self._by_role(names).items()][:1]))

    def name_of(self, role: str) -> str:
        """Return the name of the node in a role, or the role's usual name if no node has it."""
        return next((
            name for publishers in self.publishers.values() if role in publishers.topic.publishers
            for name in publishers.names()
        ), ROLES.get(role, role))

    # --- what is wrong ----------------------------------------------------------------------

    def warnings(self) -> list[str]:
        """Return a sentence for every input that has incompatible publishers."""
        return [
            f"{publishers.full_name} {problem}" for publishers in self.publishers.values()
            if (problem := publishers.describe_incompatible())
        ]

    def describe_second(self) -> str:
        """Return a sentence about the first input with a second publisher; empty for none."""
        return next((
            f"{publishers.full_name} {second}" for publishers in self.publishers.values()
            if (second := publishers.describe_second())
        ), "")
