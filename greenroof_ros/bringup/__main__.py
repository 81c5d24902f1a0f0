"""``python -m greenroof_ros.bringup`` is equivalent to ``greenroof run``."""

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

from greenroof_ros.bringup.simulated import main

if __name__ == "__main__":
    main()
