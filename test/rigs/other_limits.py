"""Commands with other limits, as ``-m other_limits live ...``.

A node of a live site may fail a thousand times, and the checks of nodes wait for less long.
"""

from __future__ import annotations

from greenroof_ros.__main__ import main
from greenroof_ros.live import upkeep
from greenroof_ros.nodes import check

if __name__ == "__main__":
    upkeep.MAX_RESTARTS = 1000
    check.ARRIVAL_S = 60.0
    check.START_S, check.STOP_S, check.SILENCE_S = 12.0, 3.0, 1.5
    main()
