"""A live site with another maximum of restarts of a node, as ``-m restarting 1000 ...``."""

from __future__ import annotations

import sys

from greenroof_ros.live import upkeep
from greenroof_ros.live.live_site import main

if __name__ == "__main__":
    upkeep.MAX_RESTARTS = int(sys.argv.pop(1))
    main()
