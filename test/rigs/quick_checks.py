"""The checks of nodes with shorter limits, as ``-m quick_checks check-pump ...``."""

from __future__ import annotations

from greenroof_ros.__main__ import main
from greenroof_ros.nodes import check

if __name__ == "__main__":
    check.ARRIVAL_S = 60.0
    check.START_S, check.STOP_S, check.SILENCE_S = 12.0, 3.0, 1.5
    main()
