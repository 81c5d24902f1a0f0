"""A live site as the command line asks for it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.bringup.drive import DriveChoice, chosen_drive, own_parameters
from greenroof_ros.common.command_line import within
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.drives.address import parse_address
from greenroof_ros.drives.sensor_file import TANKS, read_sensors
from greenroof_ros.experiment.options import controller_from_arguments
from greenroof_ros.forecast.choice import FILE, choose
from greenroof_ros.model.site import read_site

EXTERNAL = "external"

# What only a simulation has, with the value that stands for 'not given'.
_SIMULATED = (
    "start", "hours", "initial", "cistern", "roof", "evapotranspiration", "gaps", "forecast_skill",
    "forecast_seed", "forecast_members", "forecast_delay", "roof_noise", "roof_offset",
    "noise_seed", "minimum_on", "minimum_off", "output", "speed", "json",
)
_LIVE = ("sensors", "thermometer", "restarts", "bag_limit")


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
        state: the directory of all that is kept.
        namespace: such as ``/site1``; empty for none.
        silence_s: how long a node may say nothing before it is killed (s).
        restarts: of one node within ten minutes before the site is stopped.
        record: whether there is a bag.
        bag_limit: its size beyond which the oldest of it is removed (MB).
        node_parameters: ROS 2 parameter file of a user's own; None without.
    """

    site_file: Path
    controller: ControllerChoice
    parameters: dict[str, float]
    sensors: Path | None
    weather: bool
    forecast: Path | None
    drive: DriveChoice | None
    state: Path
    namespace: str
    silence_s: float
    restarts: int
    record: bool
    bag_limit: float
    node_parameters: Path | None


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


def live_site(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> LiveSite:
    """Return the site that a command line with ``--plant external`` asks for.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong, or one is missing.
    """
    for name in _given(parser, arguments, _SIMULATED):
        raise ConfigurationError(
            "is for a simulated site; live, time, weather and levels are the site's own",
            key=_option(name),
        )
    controller, parameters = controller_from_arguments(arguments)
    site_file: Path = arguments.site or shared_directory() / "config" / "site.yaml"
    read_site(site_file)
    if arguments.sensors is None:
        raise ConfigurationError(
            "is missing: live, it says where the levels are read; or --sensors external, where "
            "nodes of your own publish /cistern/level and /roof/level", key="--sensors FILE",
        )
    drive = chosen_drive(arguments)
    if drive is None and arguments.pump != EXTERNAL:
        raise ConfigurationError(
            "is missing: live, it says which drive the pump has, and --drive-at where; or --pump "
            "external, where a node of your own takes /pump/command", key="--drive NAME",
        )
    sensors = None
    if arguments.sensors != EXTERNAL:
        sensors = _readable(Path(arguments.sensors), "--sensors")
        if drive is not None:
            _refuse_shared_line(drive, sensors)
    return LiveSite(
        site_file=site_file,
        controller=controller,
        parameters=parameters,
        sensors=sensors,
        weather=arguments.weather is None,
        forecast=_forecast(parser, arguments, controller),
        drive=drive,
        state=arguments.state or Path("live"),
        namespace=arguments.namespace,
        silence_s=arguments.peer_limit,
        restarts=arguments.restarts,
        record=not arguments.no_record,
        bag_limit=arguments.bag_limit,
        node_parameters=own_parameters(arguments),
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


def refuse_live_options(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Refuse in a simulation what only a live site has.

    Raises:
        ConfigurationError: there is such an option.
    """
    for name in _given(parser, arguments, _LIVE):
        raise ConfigurationError(
            "is for a live site: greenroof live, or bringup --plant external", key=_option(name)
        )
    if arguments.weather == [EXTERNAL]:
        raise ConfigurationError(
            "is for a live site: greenroof live, or bringup --plant external",
            key="--weather", value=EXTERNAL,
        )


def _forecast(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, controller: ControllerChoice
) -> Path | None:
    """Return the forecast file; None where there is none, or the weather is somebody else's."""
    given = arguments.forecast != parser.get_default("forecast")
    if arguments.weather is not None and arguments.weather != [EXTERNAL]:
        raise ConfigurationError(
            "must be external, or not given: live, the weather is that of --forecast FILE.csv",
            key="--weather", value=" ".join(arguments.weather),
        )
    if arguments.weather == [EXTERNAL]:
        if given:
            raise ConfigurationError(
                "is of the weather node, which --weather external leaves to somebody else",
                key="--forecast", value=arguments.forecast,
            )
        return None
    if not given and controller.needs_forecast:
        raise ConfigurationError(
            f"is missing: live, it is what {controller.name} knows of the weather to come; or "
            "--weather external, where a node of your own publishes it; or --controller onoff, "
            "which needs none", key="--forecast FILE.csv",
        )
    if not given and arguments.thermometer is None:
        raise ConfigurationError(
            "is missing: without --forecast FILE.csv only a thermometer can say whether there is "
            "frost; let a node of your own publish /gauge/temperature (degC) and give "
            "--thermometer external, or give a forecast", key="--thermometer external",
        )
    if not given:
        return None
    try:
        choice = choose(arguments.forecast)
    except ValueError:
        choice = None
    if choice is None or choice.model != FILE or choice.file is None:
        raise ConfigurationError(
            "must be a FILE.csv of forecasts: live, nothing else is known",
            key="--forecast", value=arguments.forecast,
        )
    return _readable(choice.file, "--forecast")


def _readable(file: Path, option: str) -> Path:
    """Return a file's whole path; what is in it the node that reads it says.

    Raises:
        ConfigurationError: there is no such file.
    """
    if not file.is_file():
        raise ConfigurationError("must be a file that is there", key=option, value=str(file))
    return file.resolve()


def _given(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, names: tuple[str, ...]
) -> list[str]:
    """Return which of some options a command line has."""
    return [name for name in names if getattr(arguments, name) != parser.get_default(name)]


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
