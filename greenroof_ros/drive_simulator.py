"""A drive that is not there, on Modbus: ``python -m greenroof_ros.drive_simulator``."""

from greenroof_ros.simulators.drive_command import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
