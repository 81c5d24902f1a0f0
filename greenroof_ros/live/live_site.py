"""The command ``greenroof live``: a live site's options, its nodes, and its operation.

This module imports ROS only to run the site.
"""

from __future__ import annotations

import argparse
import atexit
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    add_site,
    command,
    describe_error,
    make_number_type,
    refuse,
)
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.files import COPIES, add_path_to_errors, replace_text
from greenroof_ros.base.parameter import Parameter, replace_infinity
from greenroof_ros.base.processes import IN_MEMORY, InterruptedRun, Signals, scratch_directory
from greenroof_ros.base.standard_error import print_line
from greenroof_ros.base.times import iso
from greenroof_ros.base.versions import versions
from greenroof_ros.controllers.outlet import OPEN
from greenroof_ros.controllers.registry import FOR_A_SITE, ControllerChoice
from greenroof_ros.forecast.live import OPEN_METEO
from greenroof_ros.interface.alarm import Alarm, read_alarms, to_record
from greenroof_ros.interface.states import EXTERNAL, PUMP, RECORDER, VALVE
from greenroof_ros.live.devices.drive import DriveEndpoint
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    DriveInUseError,
    Endpoint,
    read_endpoint,
    stop_drive,
)
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS, ModbusSensor, read_sensors
from greenroof_ros.live.pumping.limits import check_command_limit
from greenroof_ros.live.pumping.state_file import GUARD
from greenroof_ros.live.supervisor import (
    ACTUATORS_SILENT_S,
    LiveSupervisor,
    NodeFailed,
    SiteProcess,
    StopDrive,
)
from greenroof_ros.live.upkeep import silence_limit
from greenroof_ros.ros.alarms import ROLE
from greenroof_ros.ros.domain import (
    add_graph_arguments,
    bring_up,
    lock_bringup,
    prepare_ros,
    ros_arguments,
)
from greenroof_ros.simulation import output
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.options import add_controller_arguments, read_controller
from greenroof_ros.site.file import format_site, read_site

STATION = "station"
"""name of the process with all nodes but the pump's and the controller's"""
_LIVE = "greenroof_ros.live"
# What a sensor on a broker may name a file for.
_BROKER_FILES = "login", "authority"
_SWITCHES = {"open_switch", "closed_switch"}
# Length of the forecast that people are shown if the controller ignores it (h).
_SHOWN_H = 12.0


class LiveSite:
    """Configuration of a live site that bringup runs.

    Attributes:
        controller: the chosen controller.
        parameters: all parameters of the controller.
        drive: the pump's drive; None if the user's own node runs the pump.
        drive_at: address of the drive; None if there is none.
        tau: duration of the site's tick (s).
        forecast: forecast file, or ``open-meteo`` to fetch forecasts; None if there is no forecast
            or the user runs the weather node.
        files: files that the nodes read, except for the site file, and for the forecast, which
            changes.
        nodes: Python module of every node, and the parameters that bringup sets, by node.
        processes: the processes that run the nodes, in the order in which they end.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Check the command line and read the files that it names.

        Raises:
            ConfigurationError: if an option, or a file that it names, is invalid or missing.
        """
        site = read_site(arguments.site)
        self.tau = site.tau
        self.controller, given = read_controller(arguments)
        self.parameters = self.controller.complete_parameters(site, given)
        drive, valve = read_drive(arguments), read_drive(arguments, "valve")
        self.drive_at = drive.get("address")
        self.drive: Endpoint | None = None
        if drive:
            path, at, *broker = drive.values()
            self.drive = read_endpoint(Path(path), at, "--drive-at", *broker)
        sensors: dict[str, Any] = {}
        if arguments.sensors not in (None, EXTERNAL):
            arguments.sensors = str(Path(arguments.sensors).resolve())
            sensors = {**read_sensors(Path(arguments.sensors)).by_section}
        if arguments.forecast not in (None, OPEN_METEO):
            arguments.forecast = file = str(Path(arguments.forecast).resolve())
            refuse((not file.lower().endswith(".csv"), "--forecast", file,
                    "must be a FILE.csv, which is read again whenever it is replaced"))
        may_stay_open = site.valve_without_power == "may_stay_open"
        external = arguments.sensors == EXTERNAL
        has_switches = may_stay_open if external else {*sensors} >= _SWITCHES
        sees_frost = external or "thermometer" in sensors
        has_weather = arguments.weather is None
        lacks_forecast = has_weather and arguments.forecast is None
        for option, is_missing in {
            "--sensors": arguments.sensors is None,
            "--drive, or --pump external":
                site.irrigated and not drive and not arguments.pump,
            "--valve, and --valve-at": site.low_outlet_valve and not valve,
            "the level of the roof in --sensors":
                site.irrigated and bool(sensors) and "roof" not in sensors,
            "each of both end switches in --sensors": len(_SWITCHES & {*sensors}) == 1
                or (may_stay_open and not has_switches),
            "--forecast, or a controller without a forecast, such as onoff":
                lacks_forecast and self.controller.needs_forecast,
            "--forecast, or a thermometer, which shows frost": lacks_forecast
                and site.stops_in_frost and not sees_frost,
        }.items():
            refuse((is_missing, option, None, "is missing; what nodes of your own publish is "
                    "external, see greenroof live --help"))
        refuse(
            (drive and arguments.pump, "--pump", EXTERNAL, "assigns the pump to your own node, but "
             "--drive to the pump node; use only one of them"),
            (not site.irrigated and (drive or arguments.pump), "--drive or --pump",
             arguments.drive or arguments.pump, "does not fit a site without a pump"),
            (valve and not site.low_outlet_valve, "--valve", arguments.valve,
             "does not fit a site without a valve (low_outlet_valve)"),
            (isinstance(self.drive, DriveEndpoint) and self.drive.address.line and any(
                sensor.place.connection == self.drive.address.connection
                for sensor in sensors.values() if isinstance(sensor, ModbusSensor)
             ), "--drive-at", arguments.drive_at,
             "is also the serial line of a sensor, but only one program can open a serial line: "
             "use another line, or a Modbus TCP gateway"),
        )
        self.forecast: str | None = arguments.forecast
        of_sensors = [getattr(each, key, "") for each in sensors.values() for key in _BROKER_FILES]
        of_drive = [
            value for device in (drive, valve) for name, value in device.items()
            if name != "address"
        ]
        own = [arguments.sensors] if sensors else []
        self.files = [Path(file) for file in (*own, *of_drive, *of_sensors) if file]
        state = arguments.state.resolve()
        pump, module = (PUMP, "pump") if drive else (GUARD, "external_pump")
        name, common = self.controller.name, {"site_file": str(arguments.site)}
        self.nodes: dict[str, tuple[str, dict[str, Any]]] = {}
        if site.irrigated:
            self.nodes[pump] = f"{_LIVE}.{module}", {
                **common, **drive, "state_file": str(state / f"{PUMP}.json"),
            }
        if valve:
            self.nodes[VALVE] = f"{_LIVE}.{VALVE}", {
                **common, **valve, "state_file": str(state / f"{VALVE}.json"),
                "has_switches": has_switches,
                "opens_in_wet_weather": self.parameters.get("outlet") == OPEN
                or getattr(self.controller.kind, "opens_in_wet_weather", False),
            }
        actuators = [*self.nodes]
        self.nodes |= {
            name: (f"{_LIVE}.controller", {
                **common, **self.parameters, "external_pump": site.irrigated and not drive,
                # A controller cannot use what another one has learned.
                "state_file": str(state / f"{name}.json"),
            }),
            **{QUANTITIES[each].live_publishers[0]: (f"{_LIVE}.station", {}) for each in sensors},
            RECORDER: (f"{_LIVE}.recorder", {
                "directory": str(state / "bag"), "total_limit": arguments.bag_limit,
            }),
        }
        if has_weather:
            kind, fetched = self.controller, arguments.forecast == OPEN_METEO
            all_members, outlet_horizon = find_needs(kind, self.parameters)
            # On/off control ignores the forecast, which then is for people alone.
            shown = _SHOWN_H if kind.reference == "onoff" else 0.0
            self.nodes["weather"] = f"{_LIVE}.weather", {
                **common,
                "forecast": str(state / "forecast.csv") if fetched else arguments.forecast or "",
                "fetch": fetched, "all_members": all_members, "outlet_horizon": outlet_horizon,
                "horizon": self.parameters.get("horizon", shown),
            }
        gauges = {QUANTITIES[each].live_publishers[0] for each in {*sensors} - {*TANKS}}
        self.nodes[ROLE] = "greenroof_ros.nodes.alarms", {
            "directory": str(state),
            "expected": " ".join(sorted({*self.nodes} - gauges - {RECORDER})),
        }
        station = [f"{_LIVE}.{STATION}", *(["--weather"] if has_weather else [])]
        if sensors:
            station += "--sensors", arguments.sensors
        words = [f"{_LIVE}.controller", "--controller", self.controller.reference]
        logs, limit = state / "log", silence_limit(site.tau)
        self.processes = (
            *(SiteProcess(each, [self.nodes[each][0]], logs, ACTUATORS_SILENT_S)
              for each in actuators),
            SiteProcess(name, words, logs, limit),
            SiteProcess(STATION, station, logs, limit),
        )


def read_drive(arguments: argparse.Namespace, option: str = "drive") -> dict[str, str]:
    """Return the parameters (CHOICE) of a drive or a relay; empty if there is none.

    Args:
        arguments: the parsed command line.
        option: name of the option that chooses it: ``drive`` or ``valve``.

    Raises:
        ConfigurationError: if its file does not exist, or only one of two options is given.
    """
    name, at = getattr(arguments, option), getattr(arguments, f"{option}_at")
    refuse((bool(name) != bool(at), f"--{option}", name,
            f"and --{option}-at (tcp://192.168.0.20:502, /dev/ttyUSB0, mqtt://...) require each "
            "other"))
    files = arguments.broker_login, arguments.broker_authority
    absolute = [str(Path(file).resolve()) if file else "" for file in files]
    values = [str(find_drive_file(name).resolve()), at, *absolute] if name else []
    return {parameter.name: value for parameter, value in zip(CHOICE, values, strict=False)}


def make_parser() -> Parser:
    """Return the parser for the command line of a live site."""
    parser = Parser(
        prog="greenroof live",
        description="Operate a real site with its sensors, pump and outlet valve in real "
        "time; nothing is simulated. The command runs until it receives Ctrl-C or SIGTERM; it then "
        "stops the pump, closes the valve, and ends the nodes.",
        epilog="examples:\n"
        "  greenroof live --sensors sensors.yaml --forecast forecast.csv \\\n"
        "    --drive danfoss_fc202 --drive-at /dev/ttyUSB0\n\n"
        "exit codes: 0 stopped on request, 1 a node failed, or the pump may run on, 2 bad usage or "
        "configuration, 3 a graph is already running",
    )
    group = parser.add_argument_group("the site")
    add_controller_arguments(parser, group, default=FOR_A_SITE)
    add_site(group)
    group.add_argument(
        "--sensors", metavar="{FILE,external}",
        help="read the sensors that this file describes (see config/sensors.yaml); external: your "
        "own nodes publish /cistern/level, /roof/level and, without a forecast, "
        "/gauge/temperature; for a valve also /gauge/precipitation and, if it may stay open "
        "without power, /outlet/open_switch and /outlet/closed_switch",
    )
    weather = group.add_mutually_exclusive_group()
    weather.add_argument(
        "--forecast", metavar="{FILE.csv,open-meteo}",
        help="read forecasts from FILE.csv, again whenever it is replaced; open-meteo: fetch them "
        "from Open-Meteo for the location of the site. With a thermometer, onoff and lookahead "
        "need no forecast",
    )
    weather.add_argument(
        "--weather", choices=[EXTERNAL],
        help="external: your own node publishes the weather and the forecast",
    )
    group.add_argument(
        "--state", type=Path, default=Path("live"), metavar="DIR",
        help="directory for the state that must survive a restart (holds, faults, pump usage in "
        "the last 24 h), the bag, the logs and the summary (default: live)",
    )
    group.add_argument(
        "--bag-limit", type=make_number_type(2, 1e9), default=10_000.0, metavar="MB",
        help="remove the bag's oldest files when the bag exceeds this size, or nine tenths of the "
        "disk space for it at the start (default: %(default)g MB)",
    )
    add_graph_arguments(parser)
    add_drive(parser)
    valve = parser.add_argument_group("the outlet valve", "A relay over MQTT: on opens the valve.")
    for option, parameter in zip(("--valve", "--valve-at"), CHOICE, strict=False):
        valve.add_argument(option, default="", metavar="RELAY", help=parameter.meaning)
    return parser


def add_drive(parser: Parser) -> None:
    """Add the options that choose a drive."""
    group = parser.add_argument_group("the drive", "A drive over Modbus, or a relay over MQTT.")
    options = {
        "--drive": "{NAME,FILE}", "--drive-at": "ADDRESS", "--broker-login": "FILE",
        "--broker-authority": "FILE",
    }
    for parameter, (option, metavar) in zip(CHOICE, options.items(), strict=True):
        group.add_argument(option, default="", metavar=metavar, help=parameter.meaning)


def describe_nodes(
    modules: Mapping[str, str], controller: ControllerChoice, site_file: Path
) -> dict[str, Iterable[Parameter]]:
    """Return the parameters of every node that bringup runs, by the node's name.

    Args:
        modules: module of every node, by the node's name.
        controller: the site's controller.
        site_file: file of the site.
    """
    return {
        name: import_module(module).parameters(
            controller if module.endswith(".controller") else read_site(site_file)
        ) for name, module in modules.items()
    }


# Interval at which systemd is notified (s); and how long to wait at the end until the logs and the
# summary are written (s).
_NOTIFY_S, _WRITTEN_S = 1.0, 5.0
_MAY_RUN = (
    "THE PUMP MAY BE RUNNING: now only the drive's own timeout can stop it, if it is on; check the "
    "pump, and stop it at the drive's panel or at the main switch"
)


@command
def main() -> int:
    """Start the site, and keep it running until a signal stops it."""
    # A full disk does not count as a logging error: lines that do not fit are lost. There is no
    # flush at exit, which would block on a hung disk, and every line is flushed when it is written.
    logging.raiseExceptions = False
    atexit.unregister(logging.shutdown)
    arguments = make_parser().parse_args()
    site = LiveSite(arguments)
    return bring_up(arguments, partial(_run, site, arguments), EXIT_DONE)


def _run(site: LiveSite, arguments: argparse.Namespace, signals: Signals) -> int:
    """Start the nodes of a live site, and keep them running until a signal arrives.

    Returns:
        The exit code: 0 if the site was stopped on request and the pump is stopped.

    Raises:
        ConfigurationError: if a graph is already running, ROS 2 is missing, or a parameter file is
            invalid.
        OSError: if the directory cannot be created, or the configuration cannot be written.
    """
    namespace, nodes = arguments.namespace, site.nodes
    prepare_ros()
    from greenroof_ros.live.actuator import COMMAND_LIMIT
    from greenroof_ros.ros.parameters import find_value, node_parameter_files

    modules = {name: module for name, (module, _) in nodes.items()}
    described = partial(describe_nodes, modules, site.controller, arguments.site)
    user_files = node_parameter_files(arguments, described, site.parameters)
    pump = site.processes[0].name
    limit = find_value(user_files, f"{namespace}/{pump}", COMMAND_LIMIT)
    check_command_limit(limit, site.tau, f"parameter {COMMAND_LIMIT.name} of {pump}")
    state = arguments.state.resolve()
    with lock_bringup(namespace, state), scratch_directory(IN_MEMORY) as memory:
        (state / "log").mkdir(parents=True, exist_ok=True)
        given = {name: own for name, (_, own) in nodes.items()}
        parameters = output.write_parameters(memory, given)
        files = _StartedFiles(memory, arguments.site, [parameters, *user_files, *site.files])
        files.write()
        kept = state / "configuration" / output.SITE_FILE  # for those who read the bag later
        DISK.do(partial(_try, partial(replace_text, kept, files.site, parents=True)))
        write = _summarize(site, state)
        supervisor = LiveSupervisor(
            site.processes,
            ros_arguments(map(files.copy_of, [parameters, *user_files]), namespace),
            make_stopper(site.drive) if site.drive is not None else None, _tell, files.write,
        )
        try:
            write(output.RUNNING, None)
            _supervise(supervisor, signals)
        except Exception as error:  # whatever the error, the summary must not state "running"
            signals.ignore()
            return _end(write, supervisor.may_run, error)


def make_stopper(drive: Endpoint) -> StopDrive:
    """Return a function that stops a drive without the pump node.

    A drive that another program controls is left alone. A drive that nobody has reached runs no
    pump: its own timeout would have stopped a pump that was left on before.
    """
    drive.connection()  # load its library now, since the disk may hang when it is needed

    def stop(pump_node: int, reached: bool) -> tuple[bool, str]:
        try:
            status = stop_drive(drive, driver=pump_node)
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


def notify(line: str) -> None:
    """Send a line, such as ``READY=1``, to systemd if systemd started this process."""
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # an abstract socket
    # A service manager that restarts or is slow must not stop the process that it watches.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(line.encode(), address)


def _tell(text: str) -> None:
    """Print lines for human readers; the last one is the status in systemd."""
    print_line(text)
    notify("STATUS=" + text.rpartition("\n")[2])


def _supervise(supervisor: LiveSupervisor, signals: Signals) -> NoReturn:
    """Start and monitor the processes until an error ends the site, and end them.

    Raises:
        InterruptedRun: if a signal arrived.
        NodeFailed: if the site cannot be kept running.
    """
    notify("READY=1")
    notified = 0.0
    try:
        while True:
            supervisor.read()
            signals.check()  # before update(): what a service manager stops has not failed
            supervisor.update()
            now = time.monotonic()
            if now - notified >= _NOTIFY_S:
                notified = now
                notify("WATCHDOG=1")
    finally:
        notify("STOPPING=1")
        _tell("stopping the pump, and then the nodes")
        supervisor.end()


def _end(write: Callable[[str, str], None], may_run: str, error: Exception) -> int:
    """Record and print the reason why the site ended; return the exit code."""
    is_done = isinstance(error, InterruptedRun) and not may_run
    known = isinstance(error, (InterruptedRun, NodeFailed))
    reason = str(error) if known else describe_error(error)
    reason = "; ".join(filter(None, (reason, may_run)))
    write(output.DONE if is_done else output.FAILED, reason)
    DISK.wait(_WRITTEN_S)
    _tell(f"done: {reason}" if is_done else f"error: {reason}")
    if is_done:
        return EXIT_DONE
    return error.code if isinstance(error, NodeFailed) and not may_run else EXIT_FAILED


def _summarize(site: LiveSite, directory: Path) -> Callable[[str, str | None], None]:
    """Return a function that writes the site's summary with a status and a reason, and its alarms.

    The disk thread writes it, so that no disk stops the site.
    """
    setting: dict[str, Any] = {
        "began": iso(time.time()),
        "controller": site.controller.name,
        "parameters": replace_infinity(site.parameters),
        "forecast": site.forecast,
        "drive_at": site.drive_at,
        "versions": versions(),
    }

    before = max((alarm.number for alarm in _list_alarms(directory)), default=0)

    def write(values: dict[str, Any]) -> None:
        new = [to_record(each) for each in _list_alarms(directory) if each.number > before]
        output.write_summary({**values, **setting, "alarms": new}, directory)

    def queue(status: str, reason: str | None) -> None:
        ended = None if status == output.RUNNING else iso(time.time())
        values = {"status": status, "reason": reason, "ended": ended}
        DISK.do(partial(_try, partial(write, values)))

    return queue


def _list_alarms(directory: Path) -> list[Alarm]:
    try:
        return read_alarms(directory)
    except (OSError, ValueError):  # the alarms node reports it
        return []


def _try(write: Callable[[], object]) -> None:
    """Write a file for those who look at the site later; warn if this fails."""
    try:
        write()
    except OSError as error:
        print_line(f"warning: {error.filename}: {error.strerror}; the file is not written")


class _StartedFiles:
    """The files with which a site is started, whose content its nodes read even after a restart.

    Nodes read copies, since the originals may be edited. Only the forecast, which is replaced in
    place, and the controller's code are read from their original paths. The copies are stored in
    memory, since the disk may be full after a power cut, with no one there to free space. A
    clean-up program may remove the copies, as may systemd when their user logs out, so missing or
    damaged copies are written again before every start of a node.

    Attributes:
        site: the content of the site file, without references to other files.
    """

    def __init__(self, directory: Path, site_file: Path, files: Sequence[Path]) -> None:
        """Read the files.

        Args:
            directory: directory of the copies.
            site_file: the site file.
            files: the other files.

        Raises:
            OSError: if a file cannot be read.
        """
        self._directory, self.site = directory, format_site(read_site(site_file))
        # The content and the mode of each copy: logins must stay private.
        self._copies = {self.copy_of(site_file): (self.site.encode(), 0o644)} | {
            self.copy_of(file): (file.read_bytes(), file.stat().st_mode & 0o777) for file in files
        }

    def copy_of(self, file: Path) -> Path:
        """Return the path of a file's copy."""
        return Path(f"{self._directory}{file.absolute()}")

    def write(self) -> dict[str, str]:
        """Write the copies that are missing or damaged; return the environment that names them.

        Raises:
            OSError: if the copies cannot be written.
        """
        for copy, (content, mode) in self._copies.items():
            with suppress(OSError):
                if copy.read_bytes() == content:
                    continue
            with add_path_to_errors(self._directory):
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.unlink(missing_ok=True)
                with open(copy, "wb", opener=partial(os.open, mode=mode)) as stream:
                    stream.write(content)
        self._directory.chmod(0o755)  # the page may run as another user
        return {COPIES: str(self._directory)}
