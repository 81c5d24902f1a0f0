"""Live nodes whose code fails while they run; the first argument states which.

``alone`` is a process with one node, which needs three seconds to stop its device. ``station`` is a
station whose recorder fails again and again, and ``alarms`` one whose alarms node fails.
"""

from __future__ import annotations

import sys
import time
from functools import partial

from greenroof_ros.live import station, upkeep
from greenroof_ros.live.node import LiveNode, spin
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.ros.spin import run_nodes


class Failing(LiveNode):
    def __init__(self, stop_s: float = 0.0) -> None:
        super().__init__("recorder", "recorder")
        self._stop_s = stop_s

    def on_timer(self, now: float) -> None:
        print(1 / 0)

    def on_stop(self) -> None:
        time.sleep(self._stop_s)


class FailingAlarms(AlarmsNode):
    def check(self, now: float) -> None:
        print(1 / 0)


kind = sys.argv[1]
sys.argv[1:] = ["--ros-args"]
if kind == "alone":
    sys.exit(run_nodes(lambda: [Failing(3.0)], spin))
upkeep.MAX_WAIT_S, upkeep.MAX_RESTARTS = 0.5, 2
working = partial(LiveNode, "weather", "weather")
makers = {"station": [Failing, working, AlarmsNode], "alarms": [working, FailingAlarms]}[kind]
sys.exit(run_nodes(lambda: [make() for make in makers], partial(station.keep_nodes, makers)))
