"""A drive that is not there, on Modbus: ``greenroof simulators drive``."""

from greenroof_ros.simulators.drive_command import main, make_parser

__all__ = ["main", "make_parser"]

if __name__ == "__main__":
    main()
