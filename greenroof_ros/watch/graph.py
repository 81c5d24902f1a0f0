"""The graph that is watched, by its nodes' reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from greenroof_ros.interface.states import PLANT
from greenroof_ros.ros.reports import NodeReport, Reports
from greenroof_ros.watch.words import number_in

# After this silence (s), a run without its plant is over.
_GONE_S = 10.0


class Graph(Reports):
    """The nodes in one namespace.

    Attributes:
        offered: names of the nodes that offer a hold service for the pump, and so may control it,
            whatever is reported, each with the number of nodes that have this name.
    """

    def __init__(self, namespace: str = "") -> None:
        """Start without nodes in a namespace such as ``/site1``; empty for none."""
        super().__init__(namespace)
        self.offered: Mapping[str, int] = {}
        self._began: float | None = None  # when its plant began (steady clock, s); -1 if live

    def node(self, role: str, wall: float) -> NodeReport | None:
        """Return the node with a role: the first one that is there, or the last one that was."""
        nodes = [node for node in self.nodes.values() if node.role == role]
        online = [node for node in nodes if node.is_online(wall)]
        last = max(nodes, key=lambda node: node.received_at, default=None)
        return min(online, key=lambda node: node.began, default=last)

    def mode(self, wall: float) -> str:
        """Return the kind of graph: ``none``, ``simulated``, ``live`` or ``ended``."""
        plant = self.node(PLANT, wall)
        if plant is not None and not plant.has_ended and wall - plant.received_at < _GONE_S:
            return "simulated"
        # A live site is not over: if its program ends or falls silent, nobody waters the roof.
        if any("run_length" not in node.values for node in self.nodes.values()):
            return "live"
        return "none" if plant is None else "ended"  # without a plant, nodes wait for theirs

    def is_of_another_run(self, wall: float) -> bool:
        """Return whether another run or site has replaced the one before; forget what has ended."""
        plant, mode, before = self.node(PLANT, wall), self.mode(wall), self._began
        if mode == "none":
            return False
        self._began = -1.0 if mode == "live" or plant is None else plant.began
        if before in (None, self._began):
            return False
        self.nodes = {name: node for name, node in self.nodes.items() if node.is_online(wall)}
        return True

    def factor(self, wall: float, tau: float) -> float:
        """Return the ratio of simulated to wall time so far; NaN if it is unknown."""
        values = {} if (plant := self.node(PLANT, wall)) is None else plant.values
        tick, lasted = (number_in(values, key) or 0.0 for key in ("tick", "up_s"))
        return tick * tau / lasted if tick > 0 and lasted > 0 else math.nan

    def site(self, wall: float) -> Path | None:
        """Return the site file of the graph; None if it is not on this machine."""
        for role in (PLANT, "controller"):
            node = self.node(role, wall)
            text = None if node is None else node.values.get("site")
            with suppress(OSError, ValueError):
                if isinstance(text, str) and text.startswith("/") and Path(text).exists():
                    return Path(text)
        return None
