"""Cistern and roof behind Modbus level sensors: ``greenroof simulators site``."""

from greenroof_ros.simulators.site_command import main, make_parser

__all__ = ["main", "make_parser"]

if __name__ == "__main__":
    main()
