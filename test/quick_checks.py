"""The checks of nodes with shorter limits, as ``-m quick_checks check-pump ...``."""

from __future__ import annotations

from greenroof_ros.__main__ import main
from greenroof_ros.commands.checks import controller, node, pump_driver

if __name__ == "__main__":
    node.ARRIVAL_S, controller.ANSWER_S = 60.0, 2.0
    pump_driver.START_S, pump_driver.STOP_S, pump_driver.SILENCE_S = 12.0, 3.0, 1.5
    main()
