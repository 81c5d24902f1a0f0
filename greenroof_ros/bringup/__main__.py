"""``python -m greenroof_ros.bringup`` is equivalent to ``greenroof run``."""

from greenroof_ros.base.interrupts import end_on_interrupt, is_program

if is_program(__name__):
    end_on_interrupt()

from greenroof_ros.bringup.simulated import main

if __name__ == "__main__":
    main()
