"""A run: which site, weather, controller and initial state, from when, for how long."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from pathlib import Path

from greenroof_ros.controllers import Controller
from greenroof_ros.errors import ConfigurationError
from greenroof_ros.files import YamlMapping, number, read_yaml, shared_directory
from greenroof_ros.site import Site, read_site
from greenroof_ros.weather import Weather, WeatherSeries, parse_time, read_weather

DEFAULT_START = "2021-07-07T02:00-05:00"

# Table II: the volumes at which the outlet and the target are, times these.
INITIAL_STATES = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}

# The parameters that each controller's YAML file holds.
CONTROLLERS = {"mpc": ("weight", "max_command"), "onoff": ("fraction",)}


def initial_state(site: Site, name: str) -> tuple[float, float]:
    """Return the volumes x1 and x2 (m3) of one of the paper's initial states, Table II."""
    cistern, roof = INITIAL_STATES[name]
    return site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof


def read_parameters(path: Path, controller: str) -> dict[str, float]:
    """Read a controller's parameters from its ROS 2 parameter file.

    Raises:
        ConfigurationError: the file or a value in it is wrong.
    """
    mapping = read_yaml(path)
    section = mapping.get(controller)
    if not isinstance(section, YamlMapping) or not isinstance(
        section.get("ros__parameters"), YamlMapping
    ):
        raise ConfigurationError(
            f"must hold '{controller}:' and in it 'ros__parameters:'", file=path
        )
    parameters: YamlMapping = section["ros__parameters"]
    for key, line in parameters.lines.items():
        if key not in CONTROLLERS[controller]:
            raise ConfigurationError(
                f"is not a parameter of {controller}; they are "
                + ", ".join(CONTROLLERS[controller]),
                file=path, line=line, key=key,
            )
    values = {}
    for key in CONTROLLERS[controller]:
        if key not in parameters:
            raise ConfigurationError("is missing", file=path, key=key)
        values[key] = number(path, parameters, key)
        reason = refused_parameter(key, values[key])
        if reason:
            raise ConfigurationError(
                reason, file=path, line=parameters.lines[key], key=key, value=parameters[key]
            )
    return values


def refused_parameter(name: str, value: float) -> str | None:
    """Say why a controller's parameter cannot be used, or None if it can."""
    if not value > 0:
        return "must be greater than 0"
    if name != "max_command" and not math.isfinite(value):
        return "must be finite"
    return None


def make_controller(name: str, site: Site, parameters: dict[str, float]) -> Controller:
    """Make a controller of the given name; the solver is imported only where it is used."""
    if name == "mpc":
        from greenroof_ros.controllers.mpc import Mpc

        return Mpc(site, parameters["weight"], parameters["max_command"])
    from greenroof_ros.controllers.onoff import OnOff

    return OnOff(site, parameters["fraction"])


@dataclass(frozen=True)
class Run:
    """Everything that decides a run's numbers.

    Attributes:
        site_file: where the site was read from.
        site: Table I.
        weather: hourly records.
        series: the same, tick by tick.
        start: time of tick 0.
        steps: N; the states are x_0..x_N.
        controller: ``mpc`` or ``onoff``.
        parameters: the controller's.
        initial: name of the initial state, or ``custom``.
        x1: initial volume in the cistern (m3).
        x2: initial volume on the roof (m3).
    """

    site_file: Path
    site: Site
    weather: Weather
    series: WeatherSeries
    start: datetime
    steps: int
    controller: str
    parameters: dict[str, float]
    initial: str
    x1: float
    x2: float

    @property
    def start_ns(self) -> int:
        """Time of tick 0 in nanoseconds since 1970."""
        return epoch_ns(self.start)


def epoch_ns(time: datetime) -> int:
    """Nanoseconds since 1970-01-01 UTC, without a rounding on the way."""
    epoch = datetime.fromisoformat("1970-01-01T00:00+00:00")
    return (time - epoch) // timedelta(microseconds=1) * 1000


def positive(text: str) -> float:
    """Parse an option that must be a finite number greater than 0."""
    value = float(text)
    if not (value > 0 and math.isfinite(value)):
        raise ValueError
    return value


positive.__name__ = "number greater than 0"  # argparse puts it into its message


def _volume(text: str) -> float:
    value = float(text)
    if not (value >= 0 and math.isfinite(value)):
        raise ValueError
    return value


_volume.__name__ = "volume in m3"


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide a run's numbers, the same for ``simulate`` and ``bringup``."""
    group = parser.add_argument_group("the run")
    group.add_argument(
        "--controller", choices=sorted(CONTROLLERS), default="mpc",
        help="mpc sees the weather coming, onoff does not (default: %(default)s)",
    )
    group.add_argument(
        "--initial", choices=list(INITIAL_STATES), default=None,
        help="initial levels of cistern and roof, Table II of the paper (default: low-low)",
    )
    group.add_argument(
        "--cistern", type=_volume, metavar="V",
        help="instead of --initial: volume in the cistern (m3); --roof must be given too",
    )
    group.add_argument(
        "--roof", type=_volume, metavar="V", help="instead of --initial: volume on the roof (m3)"
    )
    group.add_argument(
        "--hours", type=positive, metavar="H",
        help="length of the run in simulated hours (default: N of the site file, 12 h)",
    )
    group.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site file (default: the paper's, config/site.yaml)",
    )
    group.add_argument(
        "--weather", type=Path, metavar="FILE",
        help="weather file (default: config/weather/toronto_2021-07.csv)",
    )
    group.add_argument(
        "--start", default=None, metavar="ISO",
        help="time of the first tick, such as 2021-07-07T02:00-05:00; without an offset it is in "
        f"the weather file's own (default: {DEFAULT_START}, the paper's window)",
    )
    group.add_argument(
        "--weight", type=positive, metavar="LAMBDA",
        help="mpc: price of pumping, lambda in the paper, 1e-5 to 0.1 there "
        "(default: config/mpc.yaml)",
    )
    group.add_argument(
        "--fraction", type=positive, metavar="V",
        help="onoff: command when pumping, v in the paper, 0.2 to 2 there "
        "(default: config/onoff.yaml)",
    )


def _speed(text: str) -> float:
    return 0.0 if text == "max" else positive(text)


_speed.__name__ = "speed: max, or a factor greater than 0"


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide where a run goes and how fast, not its numbers."""
    group = parser.add_argument_group("output and pace")
    group.add_argument(
        "--output", type=Path, metavar="DIR",
        help="directory of the run, new or empty (default: a dated one under runs/)",
    )
    group.add_argument(
        "--no-record", action="store_true", help="no bag (simulate never writes one)"
    )
    group.add_argument(
        "--speed", type=_speed, default=0.0, metavar="{max|FACTOR}",
        help="simulated time per wall time; 1 is real time (default: max)",
    )
    group.add_argument(
        "--json", action="store_true", help="print the summary as JSON instead of a table"
    )


def run_from_arguments(arguments: argparse.Namespace) -> Run:
    """Build and check the run that a command line asks for.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong.
    """
    name: str = arguments.controller
    for option, controller in (("weight", "mpc"), ("fraction", "onoff")):
        if getattr(arguments, option) is not None and name != controller:
            raise ConfigurationError(
                f"is an option of {controller}; the controller is {name}", key=f"--{option}"
            )
    shared = shared_directory()
    site_file: Path = arguments.site or shared / "config" / "site.yaml"
    site = read_site(site_file)
    parameters = read_parameters(shared / "config" / f"{name}.yaml", name)
    if arguments.weight is not None:
        parameters["weight"] = arguments.weight
    if arguments.fraction is not None:
        parameters["fraction"] = arguments.fraction

    if (arguments.cistern is None) != (arguments.roof is None):
        raise ConfigurationError("must be given together", key="--cistern and --roof")
    if arguments.cistern is not None:
        if arguments.initial is not None:
            raise ConfigurationError(
                "says the initial state twice with --cistern and --roof", key="--initial"
            )
        initial, x1, x2 = "custom", arguments.cistern, arguments.roof
    else:
        initial = arguments.initial or "low-low"
        x1, x2 = initial_state(site, initial)

    steps = site.N
    if arguments.hours is not None:
        ticks = arguments.hours * 3600 / site.tau
        steps = round(ticks) if math.isfinite(ticks) else 0
        if steps < 1 or not math.isclose(steps * site.tau, arguments.hours * 3600, rel_tol=1e-9):
            raise ConfigurationError(
                f"must be a whole number of ticks of {site.tau:g} s, at least one",
                key="--hours", value=arguments.hours,
            )
    weather = read_weather(
        arguments.weather or shared / "config" / "weather" / "toronto_2021-07.csv"
    )
    start = read_start(arguments.start or DEFAULT_START, weather.first.tzinfo)
    return Run(
        site_file=site_file,
        site=site,
        weather=weather,
        series=WeatherSeries(weather, site, start, steps),
        start=start,
        steps=steps,
        controller=name,
        parameters=parameters,
        initial=initial,
        x1=x1,
        x2=x2,
    )


def read_start(text: str, zone: tzinfo | None = None) -> datetime:
    """Read a start time; without an offset from UTC it is in the given zone.

    Raises:
        ConfigurationError: it is not an ISO 8601 time, or has no offset where there is no zone.
    """
    try:
        start = parse_time(text)
    except ValueError:
        raise ConfigurationError(
            "must be a time such as 2021-07-07T02:00-05:00, from 1971 to 2037",
            key="start", value=text,
        ) from None
    if start.utcoffset() is not None:
        return start
    if zone is None:
        raise ConfigurationError(
            "must say its offset from UTC, as in 2021-07-07T02:00-05:00", key="start", value=text
        )
    return start.replace(tzinfo=zone)
