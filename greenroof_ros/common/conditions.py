"""Condition codes, ``msg_defs/conditions.yaml``: what each means, and what to do about it."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

from greenroof_ros.common.files import read_yaml, shared_directory


@dataclass(frozen=True)
class Condition:
    """What the table says of one code.

    Attributes:
        meaning: when a status has it.
        advice: what to do, in the table's words.
        by_role: what to do instead, by the role of the node.
    """

    meaning: str
    advice: str
    by_role: Mapping[str, str] = field(default_factory=dict)

    def advise(self, node: str, role: str = "") -> str:
        """Return what to do.

        Args:
            node: its fully qualified name, for the services that the advice names.
            role: of that node, as the interface calls it.
        """
        return self.by_role.get(role, self.advice).format(
            node=node,
            reset=f"ros2 service call {node}/reset std_srvs/srv/Trigger",
            release=f'ros2 service call {node}/stop std_srvs/srv/SetBool "{{data: false}}"',
        )


@functools.cache
def read_conditions() -> dict[str, Condition]:
    """Return every condition, by its code, in the order of the table."""
    table = read_yaml(shared_directory() / "msg_defs" / "conditions.yaml")
    return {code: Condition(**row) for code, row in table.items()}
