"""Live nodes whose code fails while they run; the first argument states which.

``alone`` is a process with one node, which needs three seconds to stop its device. ``station`` is a
station of two nodes, of which the first fails again and again, and the second goes on.
"""

from __future__ import annotations

import sys
import time
from functools import partial

from greenroof_ros.live import restarts, station
from greenroof_ros.live.node import LiveNode, spin
from greenroof_ros.ros.executable import run_nodes


class Failing(LiveNode):
    def __init__(self, stop_s: float) -> None:
        super().__init__("recorder", "recorder")
        self._stop_s = stop_s

    def on_timer(self, now: float) -> None:
        print(1 / 0)

    def on_stop(self) -> None:
        time.sleep(self._stop_s)


class Working(LiveNode):
    def __init__(self) -> None:
        super().__init__("weather", "weather")


kind = sys.argv[1]
sys.argv[1:] = ["--ros-args"]
if kind == "alone":
    sys.exit(run_nodes(partial(Failing, 3.0), spin))
restarts.MAX_WAIT_S, restarts.MAX_RESTARTS = 0.5, 2
makers = [partial(Failing, 0.0), Working]
sys.exit(run_nodes(lambda: [make() for make in makers], partial(station.keep_nodes, makers)))
