"""``python -m greenroof_ros.bringup`` is ``greenroof run``."""

from greenroof_ros.bringup.simulated import main

if __name__ == "__main__":
    main()
