"""The drive of the pump node, as ``run`` and ``live`` choose it."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import refuse
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import state_directory
from greenroof_ros.controllers.registry import EXTERNAL
from greenroof_ros.experiment.run_directory import writable
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.endpoint import Endpoint, read_endpoint
from greenroof_ros.live.supervisor import StopDrive

_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: only the drive's own communication timeout stops it now, if that is "
    "on; look at the pump, and stop it at the drive's panel or its switch"
)
# How long the drive simulator may take to answer (s): it may have been started just before.
_SIMULATOR_S = 30.0


@dataclass(frozen=True)
class DriveChoice:
    """A drive and its address.

    Attributes:
        file: the drive file, which describes the drive.
        at: the address as the user wrote it.
        login: login file for a relay's broker; empty for none.
        authority: file of certificates to trust for that broker; empty for the system's.
    """

    file: Path
    at: str
    login: str = ""
    authority: str = ""

    def read(self) -> Endpoint:
        """Return the drive's description and its address, both parsed.

        Raises:
            ConfigurationError: the file or the address is wrong.
        """
        return read_endpoint(self.file, self.at, "--drive-at", self.login, self.authority)

    def state_file(self, state: Path | None) -> Path:
        """Return the file that keeps this drive's holds and faults, and create its directory.

        By default the file belongs to the drive, not to a run: a fault outlives the run in which it
        was found. Its name is the same for every spelling of the address.

        Args:
            state: the directory given by ``--state``; None for the drive's own.

        Raises:
            ConfigurationError: the file or the address is wrong, the host is unknown, or the
                directory cannot be created.
        """
        if state is not None:
            record = state.resolve() / "pump.json"
        else:
            try:
                canonical_name = self.read().canonical_name()
            except OSError as error:
                raise ConfigurationError(
                    f"the host is not found ({error.strerror})", key="--drive-at", value=self.at
                ) from error
            name = re.sub(r"[^A-Za-z0-9._]+", "-", f"{self.file.stem}-{canonical_name}")
            record = state_directory() / f"{name}.json"
        with writable(record.parent, "--state"):
            record.parent.mkdir(parents=True, exist_ok=True)
        return record

    def parameters(self, state_file: Path) -> dict[str, Any]:
        """Return the pump node's parameters for this drive.

        Args:
            state_file: file for what must survive a restart of the node.
        """
        return {
            "drive": str(self.file),
            "address": self.at,
            "broker_login": self.login,
            "broker_authority": self.authority,
            "state_file": str(state_file),
            "autostart": True,
        }

    def refuse_speed(self, speed: float, check: Callable[[], None]) -> None:
        """Allow a speed other than real time for the drive simulator only; wait until it answers.

        The pump node repeats this check on each connection.

        Args:
            speed: simulated time per wall time; 0 for as fast as possible.
            check: called repeatedly; it can raise to end the wait.

        Raises:
            ConfigurationError: the drive is not that simulator, or nothing answers.
        """
        if speed == 1:
            return
        from greenroof_ros.live.devices.drive import real_time_error
        from greenroof_ros.live.devices.modbus_line import DriveError

        endpoint = self.read()
        until = time.monotonic() + _SIMULATOR_S
        why: str | None = None
        while why is None:
            check()
            drive = endpoint.connection()
            try:
                if endpoint.is_on_this_machine:
                    drive.line.connect()
                why = drive.simulator_problem()
            except DriveError as error:
                if time.monotonic() > until:
                    why = f"no one answers there ({error})"
                time.sleep(0.1)
            finally:
                drive.line.close()
        if why:
            raise real_time_error(why, "--speed", speed)

    def stopper(self) -> StopDrive:
        """Return a function that stops the drive without the pump node.

        It takes the pump node's process id, and returns whether the drive reports the pump as
        stopped, and the outcome in words. A drive that another program runs is left alone, with
        False.

        Raises:
            ConfigurationError: the file or the address is wrong.
        """
        from greenroof_ros.live.devices.exchange import stop_drive
        from greenroof_ros.live.devices.lock import DriveInUseError

        endpoint = self.read()
        endpoint.connection()  # loads its library now: the disk may hang when it is needed

        def stop(pump_node: int) -> tuple[bool, str]:
            try:
                status = stop_drive(endpoint, driver=pump_node)
            except DriveInUseError as error:
                return False, (
                    f"another program (process {error.holder}) runs the drive, and may run the "
                    "pump: the drive is left to it"
                )
            except Exception as error:  # for any error, someone must check the pump
                return False, f"bringup could not stop the drive: {error}; {_MAY_RUN}"
            message = f"bringup ordered the drive to stop; it then reported: {status}"
            return (True, message) if status.at_rest else (False, f"{message}; {_MAY_RUN}")

        return stop


def chosen_drive(arguments: argparse.Namespace) -> DriveChoice | None:
    """Return the drive that the command line names; None if it names none.

    Raises:
        ConfigurationError: there is no such drive file, or the options are inconsistent.
    """
    drive, at = arguments.drive, arguments.drive_at
    refuse(
        (drive is None and at is not None, "--drive-at", at,
         "needs --drive, the make of the drive"),
        (drive is not None and at is None, "--drive", drive,
         "needs --drive-at, such as tcp://192.168.0.20:502, gateway://..., /dev/ttyUSB0 or "
         "mqtt://..."),
        (drive is not None and arguments.pump == EXTERNAL, "--pump", EXTERNAL,
         "leaves the pump to someone else's node, --drive to the pump node; give only one"),
    )
    files = [
        str(Path(file).resolve()) if file else ""
        for file in (arguments.broker_login, arguments.broker_authority)
    ]
    return None if drive is None else DriveChoice(find_drive_file(drive).resolve(), at, *files)
