"""A live site as the command line asks for it, and its nodes with what each needs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from greenroof_ros.bringup.drive import DriveChoice, chosen_drive, refuse
from greenroof_ros.common.command_line import within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.drives.modbus_line import parse_address
from greenroof_ros.drives.sensor_file import TANKS, read_sensors
from greenroof_ros.experiment.options import controller_from_arguments
from greenroof_ros.forecast.choice import MODELS
from greenroof_ros.graph.supervision import PUMP, RECORDER
from greenroof_ros.model.site import read_site

EXTERNAL = "external"

# By where it is refused: the options that only the other way to run has, and what is said of them.
_REFUSED = {
    "live": (
        ("start", "hours", "initial", "cistern", "roof", "evapotranspiration", "gaps",
         "forecast_skill", "forecast_seed", "forecast_members", "forecast_delay", "dressed",
         "roof_noise", "roof_offset", "noise_seed", "minimum_on", "minimum_off", "output",
         "speed", "json"),
        "is for a simulated site; live, time, weather and levels are the site's own",
    ),
    "simulated": (
        ("sensors", "thermometer", "restarts", "bag_limit"),
        "is for a live site: greenroof live, or bringup --plant external",
    ),
}
# Size of one file of the bag (MB), where the whole may be ten times that.
_BAG_FILE_MB = 100.0


@dataclass(frozen=True)
class Expected:
    """Something that is expected at the start of a site.

    Attributes:
        what: it is.
        where: it comes from.
        to_do: while it does not come.
        needed: whether the pump stands without it.
        well: levels of the diagnosis at which it is there.
    """

    what: str
    where: str
    to_do: str
    needed: bool = True
    well: tuple[str, ...] = ("OK",)


@dataclass(frozen=True)
class LiveNode:
    """A node of a live site.

    Attributes:
        name: of the node.
        module: that it is.
        arguments: of its command line.
        parameters: that bringup decides.
        expected: what the site needs of it, by the part of the node that says how that is.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    parameters: dict[str, Any]
    expected: dict[str, Expected] = field(default_factory=dict)


@dataclass(frozen=True)
class LiveSite:
    """What bringup keeps up on a live site.

    Attributes:
        site_file: the parameters of Table I.
        controller: which.
        parameters: its parameters, all of them.
        sensors: sensor file; None where the levels come from somebody else's nodes.
        weather: whether the weather node is bringup's, and not somebody else's.
        forecast: forecast file; None where there is none, or the weather is somebody else's.
        drive: of the pump; None where it is somebody else's.
        bag_limit: size of the bag beyond which the oldest of it is removed (MB); None for no bag.
    """

    site_file: Path
    controller: ControllerChoice
    parameters: dict[str, float]
    sensors: Path | None
    weather: bool
    forecast: Path | None
    drive: DriveChoice | None
    bag_limit: float | None

    def files(self) -> dict[str, Path]:
        """Return the files that it is started with, but for the forecast, which is replaced."""
        files = {
            "site": self.site_file, "sensors": self.sensors,
            "drive": self.drive.file if self.drive is not None else None,
        }
        return {name: file for name, file in files.items() if file is not None}

    def nodes(self, state: Path, place: Path) -> Iterator[LiveNode]:
        """Return its nodes.

        Args:
            state: the directory of all that is kept.
            place: where the copies of :meth:`files` are, each in a directory of its name.
        """
        kept = {name: place / name / file.name for name, file in self.files().items()}
        common = {"live": True, "site_file": str(kept["site"])}
        if self.sensors is not None:
            sensors = read_sensors(self.sensors)
            for tank in TANKS:
                yield LiveNode(
                    f"{tank}_sensor", "greenroof_ros.nodes.level_sensor", ("--tank", tank),
                    {"sensors_file": str(kept["sensors"])},
                    {"sensor": Expected(
                        f"level of the {tank}", getattr(sensors, tank).address,
                        "check the sensor's power and cable, and its address in "
                        f"{self.sensors.name}",
                    )},
                )
        if self.weather:
            yield LiveNode(
                "weather", "greenroof_ros.nodes.weather", (),
                {
                    **common,
                    "forecast": str(self.forecast or ""),
                    "horizon": self.parameters.get("horizon", 0.0),
                    "all_members": self.controller.ensemble,
                },
                self._expected_weather(),
            )
        inputs = Expected(
            f"inputs of {self.controller.name}", "your own nodes",
            "start the nodes that publish them",
        )
        yield LiveNode(
            self.controller.name, "greenroof_ros.nodes.controller",
            ("--controller", self.controller.reference),
            {**common, **self.parameters, "state_file": str(state / "controller.json")},
            {} if self.sensors is not None and self.weather else {"inputs": inputs},
        )
        if self.drive is not None:
            drive = replace(self.drive, file=kept["drive"])
            yield LiveNode(
                PUMP, "greenroof_ros.nodes.pump", (),
                {**common, **drive.parameters(state / "pump.json")},
                {"drive": Expected(
                    "drive", self.drive.at,
                    "check its power and cable, and the address of --drive-at",
                )},
            )
        if self.bag_limit is not None:
            yield LiveNode(
                RECORDER, "greenroof_ros.nodes.live_recorder", (),
                {
                    "directory": str(state / "bag"),
                    "file_limit": min(_BAG_FILE_MB, self.bag_limit / 10),
                    "total_limit": self.bag_limit,
                },
            )

    def _expected_weather(self) -> dict[str, Expected]:
        """Return what the weather node must have: frost is known by a forecast or a thermometer."""
        if self.forecast is None:
            return {"frost": Expected(
                "frost", "/gauge/temperature",
                "start the node that publishes /gauge/temperature (degC)", well=("OK", "WARN"),
            )}
        return {
            "forecast": Expected(
                "forecast", str(self.forecast),
                "put a newer file in its place, which is read by itself; without one on/off waters",
                needed=False,
            ),
            "frost": Expected(
                "frost", "the forecast",
                "let the forecast have a column of temperature, or a node publish "
                "/gauge/temperature", well=("OK", "WARN"),
            ),
        }


def add_live_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that only a live site has."""
    group = parser.add_argument_group(
        "live",
        "A site with sensors, at the system's time. It has no end: Ctrl-C or SIGTERM stops the\n"
        "pump, and then the nodes. --forecast FILE.csv is read again when it is replaced; onoff\n"
        "needs none beside a thermometer. With --weather external the weather, now and ahead, is\n"
        "from a node of somebody else's.",
    )
    group.add_argument(
        "--plant", choices=["internal", EXTERNAL], default="internal",
        help="of bringup. external: no plant is simulated, the site is live (default: %(default)s)",
    )
    group.add_argument(
        "--sensors", metavar="{FILE,external}",
        help="sensor file of the level sensors (see config/sensors.yaml); external: somebody "
        "else's nodes publish the levels",
    )
    group.add_argument(
        "--thermometer", choices=[EXTERNAL],
        help="external: a node of your own publishes /gauge/temperature (degC); without --forecast "
        "nothing else can say whether there is frost",
    )
    group.add_argument(
        "--restarts", type=within(0, 1000, int), default=10, metavar="N",
        help="a node that fails is started again after 1, 2, 4, ... 10 s; after more than N times "
        "in ten minutes the site is stopped (default: %(default)s)",
    )
    group.add_argument(
        "--bag-limit", type=within(2, 1e9), default=10_000.0, metavar="MB",
        help="size of the bag beyond which its oldest files are removed (default: %(default)g MB)",
    )


def refuse_options(way: str, parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Refuse what only the other way to run has.

    Args:
        way: ``live`` or ``simulated``.
        parser: knows the defaults.
        given: the command line.

    Raises:
        ConfigurationError: there is such an option.
    """
    names, why = _REFUSED[way]
    for name in names:
        if getattr(given, name) != parser.get_default(name):
            raise ConfigurationError(why, key=f"--{name.replace('_', '-')}")
    if way == "simulated" and given.weather == [EXTERNAL]:
        raise ConfigurationError(why, key="--weather", value=EXTERNAL)


def live_site(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> LiveSite:
    """Return the site that a command line with ``--plant external`` asks for.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong, or one is missing.
    """
    refuse_options("live", parser, arguments)
    site_file: Path = arguments.site or shared_directory() / "config" / "site.yaml"
    controller, parameters = controller_from_arguments(arguments, read_site(site_file))
    drive = chosen_drive(arguments)
    others_weather = arguments.weather == [EXTERNAL]
    has_forecast = arguments.forecast != parser.get_default("forecast")
    refuse(
        (arguments.sensors is None, "--sensors FILE", None,
         "is missing: live, it says where the levels are read; or --sensors external, where "
         "nodes of your own publish /cistern/level and /roof/level"),
        (drive is None and arguments.pump != EXTERNAL, "--drive NAME", None,
         "is missing: live, it says which drive the pump has, and --drive-at where; or --pump "
         "external, where a node of your own takes /pump/command"),
        (not others_weather and arguments.weather is not None,
         "--weather", " ".join(arguments.weather or []),
         "must be external, or not given: live, the weather is that of --forecast FILE.csv"),
        (others_weather and has_forecast, "--forecast", arguments.forecast,
         "is of the weather node, which --weather external leaves to somebody else"),
        (has_forecast and arguments.forecast in MODELS, "--forecast", arguments.forecast,
         "must be a FILE.csv of forecasts: live, nothing else is known"),
        (not others_weather and not has_forecast and controller.needs_forecast,
         "--forecast FILE.csv", None,
         f"is missing: live, it is what {controller.name} knows of the weather to come; or "
         "--weather external, where a node of your own publishes it; or --controller onoff, "
         "which needs none"),
        (not others_weather and not has_forecast and arguments.thermometer is None,
         "--thermometer external", None,
         "is missing: without --forecast FILE.csv only a thermometer can say whether there is "
         "frost; let a node of your own publish /gauge/temperature (degC) and give "
         "--thermometer external, or give a forecast"),
    )
    sensors = None
    if arguments.sensors != EXTERNAL:
        sensors = _readable(arguments.sensors, "--sensors")
        if drive is not None:
            _refuse_shared_line(drive, sensors)
    return LiveSite(
        site_file=site_file,
        controller=controller,
        parameters=parameters,
        sensors=sensors,
        weather=not others_weather,
        forecast=_readable(arguments.forecast, "--forecast") if has_forecast else None,
        drive=drive,
        bag_limit=None if arguments.no_record else arguments.bag_limit,
    )


def _refuse_shared_line(drive: DriveChoice, sensors: Path) -> None:
    """Refuse a serial line that a sensor shares with the drive: one program alone can open it.

    Raises:
        ConfigurationError: it is shared, or a file or the address is wrong.
    """
    _, address = drive.read()
    levels = read_sensors(sensors)
    for tank in TANKS:
        if address.shares_line(parse_address(getattr(levels, tank).address)):
            raise ConfigurationError(
                f"is the serial line of the {tank}'s sensor, too, which one program alone can "
                "open: put a Modbus TCP gateway on it, or take another line",
                key="--drive-at", value=drive.at,
            )


def _readable(file: str, option: str) -> Path:
    """Return a file's whole path; what is in it the node that reads it says.

    Raises:
        ConfigurationError: there is no such file.
    """
    refuse((not Path(file).is_file(), option, file, "must be a file that is there"))
    return Path(file).resolve()
