"""What ``run`` and ``live`` share: the options of the graph, and the drive of the pump node."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import add_foxglove, namespace, within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.experiment.run_directory import writable
from greenroof_ros.graph.domain import importing_ros
from greenroof_ros.graph.states import PUMP
from greenroof_ros.live.drives.drive_file import find_drive_file
from greenroof_ros.live.drives.endpoint import Endpoint, read_endpoint
from greenroof_ros.live.pumping.ledger import state_directory
from greenroof_ros.live.supervisor import StopDrive

# Option value for a node that the user runs.
EXTERNAL = "external"
_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: only the drive's own communication timeout stops it now, if that is "
    "on; look at the pump, and stop it at the drive's panel or its switch"
)
# How long the drive simulator may take to answer (s): it may have been started just before.
_SIMULATOR_S = 30.0
# Parameters that only bringup sets, by node, each with its option of bringup. If the plant's could
# be overridden, a real drive would run at another speed than the one that was checked.
_OF_BRINGUP = {
    PUMP: {
        "drive": "--drive",
        "address": "--drive-at",
        "broker_login": "--broker-login",
        "broker_authority": "--broker-authority",
        "state_file": "--state",
    },
    "plant": {"speed": "--speed", "pump": "--pump"},
}


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
        from greenroof_ros.live.drives.drive import real_time_error
        from greenroof_ros.live.drives.modbus_line import DriveError

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
                    why = f"nobody answers there ({error})"
                time.sleep(0.1)
            finally:
                drive.line.close()
        if why:
            raise real_time_error(why, "--speed", speed)

    def stopper(self) -> StopDrive:
        """Return a function that stops the drive without the pump node.

        It takes the pump node's process id, and returns whether the drive reports the pump at rest,
        and the outcome in words. A drive that another program runs is left alone, with False.

        Raises:
            ConfigurationError: the file or the address is wrong.
        """
        from greenroof_ros.live.drives.exchange import stop_drive
        from greenroof_ros.live.drives.lock import DriveInUseError

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
            except Exception as error:  # whatever the error, somebody must check the pump
                return False, f"bringup could not stop the drive: {error}; {_MAY_RUN}"
            message = f"bringup ordered the drive to stop; it then reported: {status}"
            return (True, message) if status.at_rest else (False, f"{message}; {_MAY_RUN}")

        return stop


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of the graph and its drive.

    Args:
        parser: the command's parser.
        pump: the default of ``--pump``; if empty, ``external`` is the only choice.
    """
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=[*filter(None, [pump]), EXTERNAL], default=pump,
        help="external: /pump/flow comes from a pump driver that you start yourself"
        + (f" (default: {pump})" if pump else ""),
    )
    group.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="put the whole graph, including its clock, under /NAME, so that several run side by "
        "side in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, at least 2 s: joining nodes listen for one "
        "second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a browser, whose address is printed. The page ends with "
        "the graph; the graph does not need it. The page of greenroof watch stays. Needs "
        "the extra [watch]",
    )
    add_foxglove(
        group, "serve the graph to Foxglove or Lichtblick on this machine, at the address that is "
        "printed, until the graph ends; the graph does not need it.",
    )
    group = parser.add_argument_group(
        "the drive",
        "With --drive the pump node takes the commands and runs a drive over Modbus, or a relay\n"
        "over MQTT, real or simulated.",
    )
    group.add_argument(
        "--drive", metavar="{NAME,FILE}",
        help="make of the drive: a name in config/drives/, or a drive file",
    )
    group.add_argument(
        "--drive-at", metavar="ADDRESS",
        help="its address: tcp://HOST:PORT if it has its own Ethernet port, gateway://HOST:PORT "
        "for a gateway to its serial port, or a serial line such as /dev/ttyUSB0; append a comma "
        "and its device id if that differs from its file's, such as gateway://HOST:PORT,17; for a "
        "relay mqtt://HOST[:PORT]/DEVICE (its topic at a broker), mqtts:// for TLS",
    )
    for option, metavar, meaning in (
        ("--broker-login", "FILE", "for a relay: YAML file with username and password"),
        ("--broker-authority", "FILE", "for a relay: file of trusted certificates (PEM), if the "
         "system does not know the broker's"),
    ):
        group.add_argument(option, default="", metavar=metavar, help=meaning)
    group.add_argument(
        "--state", type=Path, metavar="DIR",
        help="directory for what must survive a restart: a stop, a fault, the pump's use of the "
        "day; live, also for bag, logs and summary (default: the drive's own, a file by its "
        "address in ~/.local/state/greenroof_ros; live: live)",
    )
    group.add_argument(
        "--node-parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file for what bringup does not decide, such as the pump node's "
        "limits; each node's --help lists its parameters; unknown ones are refused. The drive, "
        "its address and its state directory are set only by --drive, --drive-at and --state",
    )


def refuse(*rules: tuple[bool, str, object, str]) -> None:
    """Refuse a command line if it breaks a rule; report the first one that it breaks.

    Args:
        rules: each is (whether it is broken, the option, its value, what is expected).

    Raises:
        ConfigurationError: a rule is broken.
    """
    for broken, option, value, expected in rules:
        if broken:
            raise ConfigurationError(expected, key=option, value=value)


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
         "leaves the pump to somebody else's node, --drive to the pump node; give only one"),
    )
    files = [
        str(Path(file).resolve()) if file else ""
        for file in (arguments.broker_login, arguments.broker_authority)
    ]
    return None if drive is None else DriveChoice(find_drive_file(drive).resolve(), at, *files)


def node_parameter_files(
    arguments: argparse.Namespace, modules: Mapping[str, str], controller: ControllerChoice
) -> list[Path]:
    """Return the file given by ``--node-parameters``, in a list; an empty list if there is none.

    Args:
        arguments: the command line.
        modules: the module of each node that bringup runs, by the node's name.
        controller: the graph's controller.

    Raises:
        ConfigurationError: the file does not exist or sets something without effect; it sets the
            drive (bringup would then stop the wrong one), its state file or the speed (which
            bringup has checked); or ROS 2 is not installed.
    """
    file: Path | None = arguments.node_parameters
    if file is None:
        return []
    refuse((not file.is_file(), "--node-parameters", str(file), "must be an existing file"))
    with importing_ros():
        from greenroof_ros.graph.parameters import refuse_unknown_in
    named = {f"{arguments.namespace}/{name}": module for name, module in modules.items()}
    refuse_unknown_in(file, named, controller, _OF_BRINGUP)
    return [file]
