"""Live nodes whose code fails while they run; the first argument states which.

``alone`` is a process with one node, which stops its device until the file ``stopped`` exists.
It fails, as the station's, when the file ``observed`` exists, since a test may be late to listen.
``station`` is a station whose recorder fails again and again, and ``alarms`` one whose alarms node
fails.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path

from greenroof_ros.live import station, upkeep
from greenroof_ros.live.node import LiveNode, spin
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.ros.spin import run_nodes

kind = sys.argv[1]


class Failing(LiveNode):
    def __init__(self) -> None:
        super().__init__("recorder", "recorder")

    def on_timer(self, now: float) -> None:
        if Path("observed").exists():
            print(1 / 0)

    def on_stop(self) -> None:
        while kind == "alone" and not Path("stopped").exists():
            time.sleep(0.1)


class FailingAlarms(AlarmsNode):
    def check(self, now: float) -> None:
        print(1 / 0)


sys.argv[1:] = ["--ros-args"]
if kind == "alone":
    sys.exit(run_nodes(lambda: [Failing()], spin))
upkeep.MAX_WAIT_S, upkeep.MAX_RESTARTS = 0.5, 2
working = partial(LiveNode, "weather", "weather")
makers = {"station": [Failing, working, AlarmsNode], "alarms": [working, FailingAlarms]}[kind]
sys.exit(run_nodes(lambda: [make() for make in makers], partial(station.keep_nodes, makers)))
