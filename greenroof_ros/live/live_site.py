"""A live site as described on the command line, and its nodes with their parameters."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from greenroof_ros.base.command_line import Parser, add_site, make_number_type, refuse
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.decide import find_place
from greenroof_ros.controllers.registry import EXTERNAL, FOR_A_SITE, ControllerChoice
from greenroof_ros.forecast.service import ENSEMBLE, FORECAST, OPEN_METEO
from greenroof_ros.interface.states import PUMP, RECORDER
from greenroof_ros.live.devices.drive import DriveEndpoint
from greenroof_ros.live.devices.sensor_file import QUANTITIES, ModbusSensor, Sensors, read_sensors
from greenroof_ros.live.drive_choice import DriveChoice, add_drive_arguments, read_drive_choice
from greenroof_ros.live.heartbeat import NOT_REQUIRED
from greenroof_ros.live.pumping.state_file import GUARD, STATE_FILE
from greenroof_ros.live.supervisor import STATION, NodeSetup, ProcessStart
from greenroof_ros.live.valve import refuse_valve
from greenroof_ros.ros.alarms import ROLE
from greenroof_ros.ros.arguments import add_graph_arguments
from greenroof_ros.simulation.options import (
    add_controller_arguments,
    read_controller,
)
from greenroof_ros.site.file import read_site

# Minimum size of a bag (MB).
MIN_BAG_MB = 2.0
# Length of the forecast that people are shown if the controller ignores it (h).
_SHOWN_H = 12.0


class LiveSite:
    """Configuration of a live site that bringup runs.

    Attributes:
        site_file: the site file.
        tau: duration of the site's tick (s).
        controller: the chosen controller.
        parameters: all parameters of the controller.
        sensors: sensor file; None if the user's own nodes publish the levels.
        sensed: content of the sensor file; None without a sensor file.
        weather: whether bringup starts the weather node; if not, the user runs one.
        forecast: forecast file, or ``open-meteo`` to fetch forecasts from Open-Meteo; None if there
            is no forecast or the user runs the weather node.
        drive: the pump's drive; None if the user's own node runs the pump.
        bag_limit: size beyond which the bag's oldest files are removed (MB).
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Check the command line and read the files that it names.

        Raises:
            ConfigurationError: if an option, or a file that it names, is invalid or missing.
        """
        self.site_file: Path = arguments.site
        site = read_site(self.site_file)
        refuse_valve(site, self.site_file)
        self.tau = site.tau
        self.controller, parameters = read_controller(arguments)
        self.parameters = self.controller.complete_parameters(site, parameters)
        self.drive = drive = read_drive_choice(arguments)
        others_weather, has_forecast = arguments.weather is not None, arguments.forecast is not None
        refuse(
            (arguments.sensors is None, "--sensors FILE", None,
             "is missing: a live site needs this file, which describes the level sensors; "
             "alternatively, use --sensors external if your own nodes publish /cistern/level "
             "and /roof/level"),
            (drive is None and not arguments.pump, "--drive NAME", None,
             "is missing: a live site needs this option for the make of the pump's drive, and "
             "--drive-at for its address; alternatively, use --pump external if your own node runs "
             "the pump"),
            (others_weather and has_forecast, "--forecast", arguments.forecast,
             "is for the weather node, which --weather external replaces"),
            (not others_weather and not has_forecast and self.controller.needs_forecast,
             "--forecast FILE.csv", None,
             f"is missing: {self.controller.name} needs a forecast; alternatively, use "
             "--weather external if your own node publishes the forecast, or --controller onoff or "
             "lookahead, which need no forecast"),
        )
        self.sensors = None
        self.sensed: Sensors | None = None
        if arguments.sensors != EXTERNAL:
            self.sensors = Path(arguments.sensors).resolve()
            refuse((
                not self.sensors.is_file(), "--sensors", arguments.sensors,
                "must be an existing file",
            ))
            self.sensed = read_sensors(self.sensors)
            if drive is not None:
                _refuse_shared_line(drive, self.sensed)
        has_thermometer = self.sensed is not None and self.sensed.thermometer is not None
        refuse(
            (not others_weather and not has_forecast and arguments.thermometer is None
             and not has_thermometer,
             "--thermometer external", None,
             "is missing: without --forecast FILE.csv, frost can only be detected with a "
             "thermometer; use this option if your own node publishes /gauge/temperature (degC), "
             "or add a thermometer to the sensor file, or specify a forecast"),
            (has_thermometer and arguments.thermometer is not None, "--thermometer", EXTERNAL,
             "contradicts the sensor file, which contains a thermometer"),
        )
        self.weather = not others_weather
        self.forecast = _forecast(arguments)
        self.bag_limit: float = arguments.bag_limit

    def files(self) -> dict[str, Path]:
        """Return the files that the nodes read, by name, except for the forecast, which changes."""
        files = {
            "site": self.site_file, "sensors": self.sensors,
            "drive": Path(self.drive.drive) if self.drive is not None else None,
        }
        return {name: file for name, file in files.items() if file is not None}

    def broker_files(self) -> list[Path]:
        """Return the login and certificate files that the nodes read."""
        files = [] if self.drive is None else [self.drive.broker_login, self.drive.broker_authority]
        for sensor in self.sensed.by_section.values() if self.sensed else ():
            files += [getattr(sensor, key, "") for key in ("login", "authority")]
        return [Path(file) for file in files if file]

    def processes(self, state: Path) -> Iterator[ProcessStart]:
        """Yield the processes that bringup starts; ``state`` is the site's directory.

        What the user wrote and what drives the pump each have a process of their own.
        """
        common = {"site_file": str(self.site_file)}
        nodes, options = dict[str, NodeSetup](), list[str]()
        if self.sensed is not None:
            options += "--sensors", str(self.sensors)
            nodes |= {
                QUANTITIES[section].node: NodeSetup("greenroof_ros.live.sensors", {})
                for section in self.sensed.by_section
            }
        if self.weather:
            options.append("--weather")
            forecast = {"forecast": str(self.forecast or "")}
            if self.forecast == OPEN_METEO:
                forecast = {
                    "forecast": str(state / "forecast.csv"),
                    "fetch": ENSEMBLE if self.controller.ensemble else FORECAST,
                }
            # On/off control ignores the forecast, which then is for people alone.
            ignored = self.controller.reference == "onoff"
            nodes["weather"] = NodeSetup("greenroof_ros.live.weather", {
                **common,
                **forecast,
                "horizon": self.parameters.get("horizon", _SHOWN_H if ignored else 0.0),
                "all_members": self.controller.ensemble,
            })
        nodes[RECORDER] = NodeSetup("greenroof_ros.live.recorder", {
            "directory": str(state / "bag"), "total_limit": self.bag_limit,
        })
        pump, module = PUMP, "greenroof_ros.live.pump"
        if self.drive is None:
            pump, module = GUARD, "greenroof_ros.live.external_pump"
        expected = {*nodes, self.controller.name, pump}
        nodes[ROLE] = NodeSetup("greenroof_ros.nodes.alarms", {
            "directory": str(state), "expected": " ".join(sorted(expected - NOT_REQUIRED)),
        })
        yield ProcessStart(STATION, "greenroof_ros.live.station", tuple(options), nodes)
        yield ProcessStart(
            self.controller.name, "greenroof_ros.live.controller",
            ("--controller", self.controller.reference), {
                self.controller.name: NodeSetup("greenroof_ros.live.controller", {
                    **common, **self.parameters,
                    # A controller cannot use what another one has learned.
                    "state_file": str(state / f"{self.controller.name}.json"),
                    "external_pump": self.drive is None,
                }),
            },
            partial(_give_up, self.controller),
        )
        drive = {} if self.drive is None else vars(self.drive)
        yield ProcessStart(pump, module, (), {
            pump: NodeSetup(module, {
                **common, **drive, "state_file": str(state / STATE_FILE),
            }),
        })


def make_parser() -> Parser:
    """Return the parser for the command line of a live site."""
    parser = Parser(
        prog="greenroof live",
        usage="%(prog)s [options]",
        description="Operate a real site with sensors and a pump in real time; nothing is "
        "simulated. The command runs until it receives Ctrl-C or SIGTERM; it then stops the pump, "
        "and then the nodes.",
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
        help="read the Modbus or MQTT sensors that this file describes (see "
        "config/sensors.yaml); external: your own nodes publish the levels",
    )
    group.add_argument(
        "--forecast", metavar="{FILE.csv,open-meteo}",
        help="read forecasts from FILE.csv, and read the file again whenever it is replaced; "
            "open-meteo: fetch forecasts from Open-Meteo for the location of the site, according "
            "to the weather node's parameters fetch_... (--node-parameters), and keep them in "
            "the state directory. With a thermometer, onoff and lookahead need no forecast",
    )
    group.add_argument(
        "--thermometer", choices=[EXTERNAL],
        help="external: your own node publishes /gauge/temperature (degC), because the sensor file "
            "contains no thermometer; without --forecast, nothing else can indicate frost",
    )
    group.add_argument(
        "--weather", choices=[EXTERNAL],
        help="external: your own node publishes the weather and the forecast",
    )
    group.add_argument(
        "--state", type=Path, default=Path("live"), metavar="DIR",
        help="directory for the state that must survive a restart (holds, faults, pump usage in "
            "the last 24 h), the bag, the logs and the summary (default: live)",
    )
    group.add_argument(
        "--bag-limit", type=make_number_type(MIN_BAG_MB, 1e9), default=10_000.0, metavar="MB",
        help="remove the bag's oldest files when the bag exceeds this size (default: %(default)g "
            "MB); the size is also limited to nine tenths of the disk space that is free at the "
            "start",
    )
    add_graph_arguments(parser)
    add_drive_arguments(parser)
    return parser


def _give_up(controller: ControllerChoice, why: str) -> tuple[str, ...]:
    """Return the arguments for the node of a controller that can no longer be run.

    The location of the controller's code is added to the reason, since a process may end without a
    message.
    """
    file, line = find_place(controller.kind, "command")
    why = f"{why} ({controller.reference} is in {file}, line {line})"
    text = json.dumps(why.encode(errors="replace").decode(), ensure_ascii=False)  # as YAML
    return (
        "--controller", "onoff",
        "--ros-args", "-r", f"__node:={controller.name}", "-p", f"given_up:={text}", "--",
    )


def _forecast(arguments: argparse.Namespace) -> Path | str | None:
    """Return the forecast file, or ``open-meteo`` if forecasts are fetched; None without forecasts.

    The file may be written later; the weather node reports a missing file.

    Raises:
        ConfigurationError: if the value is not the name of a CSV file.
    """
    if arguments.forecast in (None, OPEN_METEO):
        return arguments.forecast
    file = Path(arguments.forecast).resolve()
    refuse((
        file.suffix.lower() != ".csv" or file.is_dir(), "--forecast", arguments.forecast,
        "must be a FILE.csv, which is read again whenever it is replaced; only simulated runs read "
        "other kinds of files",
    ))
    return file


def _refuse_shared_line(drive: DriveChoice, sensors: Sensors) -> None:
    """Reject a serial line shared by a sensor and the drive, since only one program can open it.

    Raises:
        ConfigurationError: if the line is shared, or the drive's file or address is invalid.
    """
    endpoint = drive.read()
    if not isinstance(endpoint, DriveEndpoint):
        return
    for section, sensor in sensors.by_section.items():
        if endpoint.address.line and isinstance(sensor, ModbusSensor) and (
            sensor.connection == endpoint.address.canonical_name(0)
        ):
            raise ConfigurationError(
                f"is also the serial line of sensor {section}, but only one program can open "
                "a serial line: connect a Modbus TCP gateway to this line, or use another line",
                key="--drive-at", value=drive.address,
            )
