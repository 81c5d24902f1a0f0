"""Watch a node's peers in a simulated run: missing ones, duplicates, and a plant that has gone."""

from __future__ import annotations

import math

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.lockstep import CLOCK, PLANT
from greenroof_ros.graph.messages import LockstepError
from greenroof_ros.graph.supervision import FINISHED

# How often publishers are counted (s): counting takes at least a tenth of a millisecond.
_COUNT_S = 0.25
# How long peers must be missing before this is logged, and how often it is repeated (s).
_PATIENCE_S, _AGAIN_S = 2.0, 5.0


class Peers:
    """Watches the peers of a node.

    Attributes:
        over: whether the node may end by itself: it has no supervisor, the run is over, all that it
            published has arrived, and the plant has gone or is this node.
    """

    def __init__(self, node: LinkedNode) -> None:
        """Do nothing yet.

        Args:
            node: a node of a simulated graph.
        """
        self.over = False
        self._node = node
        self._counted = 0.0
        self._missing: list[str] = []
        self._say_at = math.inf

    def look(self, now: float) -> None:
        """Count publishers, log which peers are missing, and find the end of the run.

        A node with a supervisor ends only when asked to: the supervisor needs each node's last
        report, and names the node that failed first.

        Args:
            now: time on the steady clock (s).

        Raises:
            LockstepError: the plant ended during the run, or a second publisher appeared in it.
            OccupiedError: a topic had a second publisher before the run.
        """
        node = self._node
        if now - self._counted < _COUNT_S:
            return
        self._counted = now
        alone = not node.reports.supervisor.given
        if node.reports.state == FINISHED:
            # The plant leaves first: until then a node may still need this node's messages.
            self.over = alone and node.all_arrived() and (
                node.role == PLANT or self._plant_has_gone()
            )
            return
        for entry in node.inputs.by_name.values():
            publishers = entry.publishers
            if not entry.tolerates_second and publishers.count > 1 and publishers.heard > 1:
                # Before the run it is a wrong set-up, later a failure.
                kind = LockstepError if node.acted else OccupiedError
                raise kind(publishers.sentence(now))
        if node.lockstep.is_over:  # /run arrived after the messages of the last tick
            node.finish()
            return
        if not node.acted:
            self._say_missing(now)
        if node.lockstep.run is not None and alone and self._plant_has_gone():
            raise LockstepError("plant has ended, and the run with it")

    def _plant_has_gone(self) -> bool:
        clock = self._node.inputs.by_name.get(CLOCK)
        return clock is not None and clock.publishers.count == 0

    def _say_missing(self, now: float) -> None:
        """Log which peers are missing before the run: after 2 s, then every 5 s."""
        missing = sorted(map(self._node.inputs.call, self._waiting()))
        if missing != self._missing:
            self._missing, self._say_at = missing, now + _PATIENCE_S
        if now > self._say_at:
            self._node.get_logger().info(
                f"waiting for {', '.join(missing)}" if missing else "all nodes are here"
            )
            self._say_at = now + _AGAIN_S if missing else math.inf

    def _waiting(self) -> set[str]:
        """Return the roles that the node waits for; if none, those that its peers wait for."""
        node = self._node
        return set(node.inputs.absent()) or {
            topic.publishers[0] for topic in node.interface.values()
            if topic.per_tick and not topic.optional and node.role not in topic.publishers
            and not node.count_publishers(topic.graph_name)
        }
