"""The drive of a live site, as chosen on the command line."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.base.command_line import refuse
from greenroof_ros.controllers.registry import EXTERNAL
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    DriveInUseError,
    Endpoint,
    read_endpoint,
    stop_drive,
)
from greenroof_ros.live.supervisor import StopDrive

_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: now only the drive's own timeout can stop it, if it is on; check the "
    "pump, and stop it at the drive's panel or at the main switch"
)


@dataclass(frozen=True)
class DriveChoice:
    """A drive and its address; every attribute is a parameter of the pump node.

    Attributes:
        drive: the drive file, which describes the drive.
        address: address of the drive, as the user specified it.
        broker_login: login file for a relay's broker; empty for none.
        broker_authority: file of trusted certificates for a relay's broker; empty for the system's
            certificates.
    """

    drive: str
    address: str
    broker_login: str = ""
    broker_authority: str = ""

    def read(self) -> Endpoint:
        """Return the parsed description and address of the drive.

        Raises:
            ConfigurationError: if the file or the address is invalid.
        """
        return read_endpoint(
            Path(self.drive), self.address, "--drive-at", self.broker_login, self.broker_authority
        )

    def stopper(self) -> StopDrive:
        """Return a function that stops the drive without the pump node.

        The function takes the pump node's process id, and whether that node has reached the drive.
        It returns whether the pump may be running after that, and the outcome in words. A drive
        that another program controls is left alone. A drive that nobody has reached runs no pump:
        its own timeout would have stopped a pump that was left on before.

        Raises:
            ConfigurationError: if the file or the address is invalid.
        """
        endpoint = self.read()
        endpoint.connection()  # load its library now, since the disk may hang when it is needed

        def stop(pump_node: int, reached: bool) -> tuple[bool, str]:
            try:
                status = stop_drive(endpoint, driver=pump_node)
            except DriveInUseError as error:
                return True, (
                    f"another program (process {error.holder}) controls the drive, and the pump "
                    "may be running: the drive is left to that program"
                )
            except Exception as error:  # whatever the error, someone must check the pump
                warning = _MAY_RUN if reached else "the drive has not responded since the start"
                return reached, f"bringup could not stop the drive: {error}; {warning}"
            message = f"bringup commanded the drive to stop; the drive then reported: {status}"
            return not status.at_rest, message if status.at_rest else f"{message}; {_MAY_RUN}"

        return stop


def add_drive_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the drive to a command's parser."""
    group = parser.add_argument_group(
        "the drive", "The pump node runs a drive over Modbus, or a relay over MQTT.")
    options = {
        "--drive": "{NAME,FILE}", "--drive-at": "ADDRESS", "--broker-login": "FILE",
        "--broker-authority": "FILE",
    }
    for parameter, (option, metavar) in zip(CHOICE, options.items(), strict=True):
        group.add_argument(option, default="", metavar=metavar, help=parameter.meaning)


def read_drive_choice(arguments: argparse.Namespace) -> DriveChoice | None:
    """Return the drive that the command line specifies; None if it specifies none.

    Raises:
        ConfigurationError: if the drive file does not exist, or the options are inconsistent.
    """
    drive, at = arguments.drive, arguments.drive_at
    refuse(
        (bool(drive) != bool(at), "--drive", drive,
         "and --drive-at (tcp://192.168.0.20:502, /dev/ttyUSB0, mqtt://...) require each other"),
        (drive and arguments.pump == EXTERNAL, "--pump", EXTERNAL,
         "assigns the pump to your own node, but --drive to the pump node; use only one of them"),
    )
    if not drive:
        return None
    files = (arguments.broker_login, arguments.broker_authority)
    absolute = (str(Path(file).resolve()) if file else "" for file in files)
    return DriveChoice(str(find_drive_file(drive).resolve()), at, *absolute)
