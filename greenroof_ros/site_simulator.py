"""Cistern and roof behind Modbus level sensors: ``python -m greenroof_ros.site_simulator``."""

from greenroof_ros.simulators.site_command import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
