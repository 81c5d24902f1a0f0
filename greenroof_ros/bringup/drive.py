"""What ``run`` and ``live`` have in common: graph, and the drive behind the pump node."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_INTERRUPTED, namespace, within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.drives.drive_file import find_drive_file
from greenroof_ros.drives.placed import Placed, place_drive
from greenroof_ros.experiment.run_directory import writable
from greenroof_ros.graph.domain import importing_ros
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.graph.supervisor import NodeStart, StopDrive
from greenroof_ros.pumping.ledger import state_directory
from greenroof_ros.watch.beside import watcher

# What is somebody else's node.
EXTERNAL = "external"
_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: only the drive's own communication timeout stops it now, if that is "
    "on; look at the pump, and stop it at the drive's panel or its switch"
)
# How long the drive simulator, which may have been started just before, may take to answer (s).
_SIMULATOR_S = 30.0
# Parameters of a node that bringup alone decides, and its options for them. By the plant's a real
# drive would run at another speed than the one that was checked.
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
    """A drive, and where it is.

    Attributes:
        file: says what it is like.
        at: its address, as the user wrote it.
        login: of a relay's broker; empty for none.
        authority: of it: trusted certificates; empty for the system's.
    """

    file: Path
    at: str
    login: str = ""
    authority: str = ""

    def read(self) -> Placed:
        """Return what the drive is like, and where it is.

        Raises:
            ConfigurationError: the file or the address is wrong.
        """
        return place_drive(self.file, self.at, "--drive-at", self.login, self.authority)

    def state_file(self, state: Path | None) -> Path:
        """Return where a stop or a fault of this drive is kept; its directory is made.

        It is the drive's, not a run's, so that a fault outlives the run that found it; and the same
        for each way to write the address.

        Args:
            state: the directory that ``--state`` names; None for the drive's own.

        Raises:
            ConfigurationError: the file or the address is wrong, the host is not known, or the
                directory cannot be made.
        """
        if state is not None:
            record = state.resolve() / "pump.json"
        else:
            try:
                place = self.read().place()
            except OSError as error:
                raise ConfigurationError(
                    f"the host is not found ({error.strerror})", key="--drive-at", value=self.at
                ) from error
            name = re.sub(r"[^A-Za-z0-9._]+", "-", f"{self.file.stem}-{place}")
            record = state_directory() / f"{name}.json"
        with writable(record.parent, "--state"):
            record.parent.mkdir(parents=True, exist_ok=True)
        return record

    def parameters(self, state_file: Path) -> dict[str, Any]:
        """Return the parameters of the pump node that follow from it.

        Args:
            state_file: of what must survive a restart of the node.
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
        """Refuse a speed other than real time but for the drive simulator, which is waited for.

        The pump node looks again, on each of its connections.

        Args:
            speed: simulated time per wall time; 0 for as fast as it goes.
            check: called again and again; raises what ends the wait.

        Raises:
            ConfigurationError: it is not that simulator, or nobody answers.
        """
        if speed == 1:
            return
        from greenroof_ros.drives.drive import no_real_time
        from greenroof_ros.drives.modbus_line import DriveError

        placed = self.read()
        until = time.monotonic() + _SIMULATOR_S
        why: str | None = None
        while why is None:
            check()
            drive = placed.connection()
            try:
                if placed.is_here:
                    drive.line.connect()
                why = drive.why_no_simulator()
            except DriveError as error:
                if time.monotonic() > until:
                    why = f"nobody answers there ({error})"
                time.sleep(0.1)
            finally:
                drive.line.close()
        if why:
            raise no_real_time(why, "--speed", speed)

    def stopper(self) -> StopDrive:
        """Return what stops the drive without the pump node, whose process it is given.

        It returns whether the drive says that the pump stands, and what came of it, in words. A
        drive that another program runs is left to that, and whether it stands is not known.

        Raises:
            ConfigurationError: the file or the address is wrong.
        """
        from greenroof_ros.drives.exchange import stop_drive
        from greenroof_ros.drives.lock import DriveInUseError

        placed = self.read()
        placed.connection()  # loads its library: when it is needed the disk may hang

        def stop(pump_node: int) -> tuple[bool, str]:
            try:
                status = stop_drive(placed, driver=pump_node)
            except DriveInUseError as error:
                return False, (
                    f"another program (process {error.holder}) runs the drive, and may run the "
                    "pump: the drive is left to it"
                )
            except Exception as error:  # whatever it is, somebody must look at the pump
                return False, f"bringup could not stop the drive: {error}; {_MAY_RUN}"
            message = f"bringup ordered the drive to stop; it then reported: {status}"
            return (True, message) if status.stands else (False, f"{message}; {_MAY_RUN}")

        return stop


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of any graph, and of its drive.

    Args:
        parser: of the command.
        pump: the default of ``--pump``, which else can be ``external`` only.
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
        "greenroof_ros[watch]",
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


def bring_up(
    arguments: argparse.Namespace, site_file: Path, start: Callable[[Signals], int]
) -> int:
    """Start a graph, with the page of it if it was asked for; return the exit code.

    Args:
        arguments: the command line.
        site_file: of the site.
        start: returns the exit code.
    """
    try:
        with watcher(arguments.namespace, site_file) if arguments.watch else nullcontext():
            return start(Signals())
    except InterruptedRun as error:  # before a node was started
        print(error, file=sys.stderr)
        return EXIT_INTERRUPTED


def refuse(*rules: tuple[bool, str, object, str]) -> None:
    """Refuse a command line by the first rule that it breaks.

    Args:
        rules: of each whether it is broken, the option, its value, and what would be right.

    Raises:
        ConfigurationError: it breaks one.
    """
    for broken, option, value, expected in rules:
        if broken:
            raise ConfigurationError(expected, key=option, value=value)


def chosen_drive(arguments: argparse.Namespace) -> DriveChoice | None:
    """Return the drive that a command line names, if it does.

    Raises:
        ConfigurationError: there is no such drive file, or something is missing.
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


def own_parameters(
    arguments: argparse.Namespace, nodes: Sequence[NodeStart], controller: ControllerChoice
) -> list[Path]:
    """Return the parameter file of a user's own, if there is one.

    Args:
        arguments: the command line.
        nodes: that are started.
        controller: of the graph.

    Raises:
        ConfigurationError: it is not there; or says what would have no effect; or something else of
            the drive than bringup, which would then stop another drive than the pump node runs; or
            of the speed, which bringup has checked; or there is no ROS 2.
    """
    file: Path | None = arguments.node_parameters
    if file is None:
        return []
    refuse((not file.is_file(), "--node-parameters", str(file), "must be an existing file"))
    with importing_ros():
        from greenroof_ros.graph.parameters import refuse_unknown_in
    modules = {f"{arguments.namespace}/{node.name}": node.module for node in nodes}
    refuse_unknown_in(file, modules, controller, _OF_BRINGUP)
    return [file]
