"""What a node does when it hears of its run only after the run's last tick."""

from __future__ import annotations

from array import array
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="a node's inputs are subscriptions of ROS 2")

from greenroof_ros.graph.lockstep import Lockstep
from greenroof_ros.graph.messages import LockstepError


@pytest.mark.parametrize("second", [0, 1, 2])
def test_a_run_that_is_heard_behind_its_last_tick(second: int) -> None:
    """Topics come in any order: a message after the last tick fails the run in any case."""
    lockstep = Lockstep("onoff", lambda: None, lambda: None)
    publishers = SimpleNamespace(names=list)

    def receiver(name: str) -> Any:
        entry: Any = SimpleNamespace(
            topic=SimpleNamespace(name=name), name=name, tolerates_second=False,
            receive=lambda _: None, publishers=publishers,
        )
        return lockstep.receiver(entry, None)

    level, frost = receiver("/roof/level"), receiver("/weather/frost")
    level(b"")
    frost(b"")
    run = array("d", [7.0, 0.0, 0.0])  # its last tick is 0
    if second:
        for receive in (level, frost)[:second]:  # with both messages the node acts once too often
            receive(b"")
        with pytest.raises(LockstepError, match="/roof/level came twice in tick 1"):
            lockstep.hear_run(run)
        return
    lockstep.hear_run(run)
    assert lockstep.is_over
    with pytest.raises(LockstepError, match="/roof/level came twice in tick 1"):
        level(b"")
