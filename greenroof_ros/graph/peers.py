"""A node's peers in a simulated run, by the wall clock: who is missing, too many, or gone."""

from __future__ import annotations

import math

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.lockstep import CLOCK, PLANT
from greenroof_ros.graph.messages import LockstepError
from greenroof_ros.graph.supervision import FINISHED

# How often publishers are counted (s): asking takes a tenth of a millisecond and more.
_COUNT_S = 0.25
# How long somebody must be missing before it is said, and how often it is said again (s).
_PATIENCE_S, _AGAIN_S = 2.0, 5.0


class Peers:
    """Looks at the peers of a node.

    Attributes:
        over: whether the node may end by itself: nobody supervises it, the run is over, and all
            that it said has arrived.
    """

    def __init__(self, node: LinkedNode) -> None:
        """Look at nothing yet.

        Args:
            node: of a simulated graph.
        """
        self.over = False
        self._node = node
        self._counted = 0.0
        self._missing: list[str] = []
        self._say_at = math.inf

    def look(self, now: float) -> None:
        """Count publishers, say who is missing, and end with the run.

        A node that somebody supervises ends when it is asked to: the supervisor needs the last word
        of each, and names the node that failed first.

        Args:
            now: of the steady clock (s).

        Raises:
            LockstepError: the plant went in the run, or a second publisher came.
            OccupiedError: a second publisher was there before the run.
        """
        node = self._node
        if now - self._counted < _COUNT_S:
            return
        self._counted = now
        alone = not node.reports.supervisor.given
        if node.reports.state == FINISHED:
            # The plant leaves first: until then somebody may need what the node said.
            self.over = alone and node.all_arrived() and (
                node.role == PLANT or self._plant_has_gone()
            )
            return
        for entry in node.inputs.by_name.values():
            publishers = entry.publishers
            if not entry.tolerates_second and publishers.count > 1 and publishers.heard > 1:
                # A wrong set-up before the run, then a failure.
                kind = LockstepError if node.acted else OccupiedError
                raise kind(publishers.sentence(now))
        if node.lockstep.is_over:  # what the plant says of the run came behind the last tick
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
        """Say who is missing before the run: once that lasts, and again and again."""
        missing = sorted(map(self._node.inputs.call, self._waiting()))
        if missing != self._missing:
            self._missing, self._say_at = missing, now + _PATIENCE_S
        if now > self._say_at:
            self._node.get_logger().info(
                f"waiting for {', '.join(missing)}" if missing else "all nodes are here"
            )
            self._say_at = now + _AGAIN_S if missing else math.inf

    def _waiting(self) -> set[str]:
        """Return the roles for whom the node waits; where it has all, for whom the others do."""
        node = self._node
        return set(node.inputs.absent()) or {
            topic.publishers[0] for topic in node.interface.values()
            if topic.per_tick and not topic.optional and node.role not in topic.publishers
            and not node.count_publishers(topic.graph_name)
        }
