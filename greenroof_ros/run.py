"""A run: which site, weather, controller and initial state, from when, for how long."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, tzinfo
from pathlib import Path

from greenroof_ros.controllers import Controller
from greenroof_ros.errors import ConfigurationError
from greenroof_ros.files import YamlMapping, number, read_yaml, shared_directory
from greenroof_ros.forecast import Forecast, make_forecast
from greenroof_ros.forecast_models import MODELS, OPTIONS, ForecastChoice, choose
from greenroof_ros.imperfections import RANGES, Imperfections
from greenroof_ros.site import Site, read_site
from greenroof_ros.topics import Topic, read_topics
from greenroof_ros.weather import Weather, WeatherSeries, read_weather
from greenroof_ros.weather_csv import parse_time

DEFAULT_START = "2021-07-07T02:00-05:00"

# Table II: the volumes at which the outlet and the target are, times these.
INITIAL_STATES = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}

# How far the controllers that plan trust the level sensor (s) and the forecast (h).
_TRUST = {"smoothing": (0.0, 3600.0), "patience": (0.0, 1e6)}
# The parameters of each controller, in its YAML file and of its node, with their range; whole
# numbers where its ends are. A planner pumps nothing at commands below 1e-5.
CONTROLLERS = {
    "mpc": {"weight": (1e-9, 1e6), "max_command": (1e-9, math.inf)},
    "onoff": {"fraction": (1e-9, 1e6)},
    "planning_mpc": {
        "horizon": (0.1, 48.0),
        "max_command": (1e-5, math.inf),
        "power": (1, 2),
        "energy_weight": (0.0, 1e9),
        "start_weight": (0.0, 1e5),
        **_TRUST,
    },
    "anticipating_onoff": {"horizon": (0.1, 48.0), "fraction": (1e-9, 1e6), **_TRUST},
    "scenario_mpc": {
        "horizon": (0.1, 48.0),
        "max_command": (1e-5, math.inf),
        "level": (0.0, 0.99),
        "recourse": (0.0, 48.0),
        **_TRUST,
    },
}
# Those that take all members of an ensemble of forecasts; the others are told its first.
TAKE_ENSEMBLES = ("scenario_mpc",)
# A year of seconds, as much as fits into memory and patience.
_MOST_STEPS = 31_622_400


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
        wrong = wrong_parameter(controller, key, values[key])
        if wrong:
            raise ConfigurationError(
                wrong, file=path, line=parameters.lines[key], key=key, value=parameters[key],
            )
    return values


def wrong_parameter(controller: str, key: str, value: float) -> str:
    """Return what a controller's parameter must be, if it is not; otherwise nothing."""
    low, high = CONTROLLERS[controller][key]
    whole = isinstance(low, int)
    if low <= value <= high and not (whole and value % 1):
        return ""
    return f"must be {'a whole number ' if whole else ''}from {low:g} to {high:g}"


def make_controller(name: str, site: Site, parameters: dict[str, float]) -> Controller:
    """Make a controller of the given name; the solver is imported only where it is used."""
    if name == "mpc":
        from greenroof_ros.controllers.mpc import Mpc

        return Mpc(site, parameters["weight"], parameters["max_command"])
    if name == "planning_mpc":
        from greenroof_ros.controllers.planning_mpc import PlanningMpc
        from greenroof_ros.controllers.planning_program import Prices

        return PlanningMpc(
            site, parameters["horizon"], parameters["max_command"], parameters["power"],
            Prices(parameters["energy_weight"], parameters["start_weight"]),
            smoothing=parameters["smoothing"],
            patience=parameters["patience"],
        )
    if name == "scenario_mpc":
        from greenroof_ros.controllers.planning_mpc import PlanningMpc
        from greenroof_ros.controllers.planning_program import Ensemble

        return PlanningMpc(
            site, parameters["horizon"], parameters["max_command"],
            ensemble=Ensemble(parameters["level"], parameters["recourse"] * 3600),
            smoothing=parameters["smoothing"],
            patience=parameters["patience"],
        )
    if name == "anticipating_onoff":
        from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff

        return AnticipatingOnOff(
            site, parameters["horizon"], parameters["fraction"],
            parameters["smoothing"], parameters["patience"],
        )
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
        forecast: what the controller is told of it.
        start: time of tick 0.
        steps: N; the states are x_0..x_N.
        controller: its name, one of :data:`CONTROLLERS`.
        parameters: the controller's.
        initial: name of the initial state, or ``custom``.
        x1: initial volume in the cistern (m3).
        x2: initial volume on the roof (m3).
        forecast_choice: which forecasts those are.
        imperfections: of level sensor and pumps.
    """

    site_file: Path
    site: Site
    weather: Weather
    series: WeatherSeries
    forecast: Forecast
    start: datetime
    steps: int
    controller: str
    parameters: dict[str, float]
    initial: str
    x1: float
    x2: float
    forecast_choice: ForecastChoice = field(default_factory=ForecastChoice)
    imperfections: Imperfections = field(default_factory=Imperfections)


def epoch_ns(time: datetime) -> int:
    """Nanoseconds since 1970-01-01 UTC, without a rounding on the way."""
    epoch = datetime.fromisoformat("1970-01-01T00:00+00:00")
    return (time - epoch) // timedelta(microseconds=1) * 1000


def within(
    low: float, high: float, kind: Callable[[str], float] = float
) -> Callable[[str], float]:
    """Return what parses an option that must be a number, with ``int`` a whole one, in a range."""

    def parse(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            raise ValueError
        return value

    # argparse puts it into its message
    parse.__name__ = (
        f"whole number from {low} to {high}" if kind is int
        else f"number from {low:g} to {high:g}"
    )
    return parse


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide a run's numbers, the same for ``simulate`` and ``bringup``."""
    group = parser.add_argument_group("the run")
    group.add_argument(
        "--controller", choices=sorted(CONTROLLERS), default="mpc",
        help="mpc, the paper's, sees 10 s ahead, planning_mpc half a day, and scenario_mpc that in "
        "an ensemble of forecasts; onoff, the paper's, does not look ahead, and anticipating_onoff "
        "leaves room for what comes (default: %(default)s)",
    )
    group.add_argument(
        "--initial", choices=list(INITIAL_STATES), default=None,
        help="initial levels of cistern and roof, Table II of the paper (default: low-low)",
    )
    group.add_argument(
        "--cistern", type=within(0, 1e9), metavar="V",
        help="instead of --initial: volume in the cistern (m3); --roof must be given too",
    )
    group.add_argument(
        "--roof", type=within(0, 1e9), metavar="V",
        help="instead of --initial: volume on the roof (m3)",
    )
    group.add_argument(
        "--hours", type=within(1e-9, 1e9), metavar="H",
        help="length of the run in simulated hours (default: N of the site file, 12 h)",
    )
    group.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site file (default: the paper's, config/site.yaml)",
    )
    group.add_argument(
        "--weather", type=Path, metavar="FILE",
        help="weather file: of this project's form, or an hourly bulk file of Environment and "
        "Climate Change Canada (default: config/weather/toronto_2021-07.csv)",
    )
    group.add_argument(
        "--evapotranspiration", metavar="VARIANT",
        help="fao56: computed by FAO-56 Penman-Monteith; or the name of the weather file's own "
        "column, such as published (default: the file's own, fao56 if it has none)",
    )
    group.add_argument(
        "--start", default=None, metavar="ISO",
        help="time of the first tick, such as 2021-07-07T02:00-05:00; without an offset it is in "
        f"the weather file's own (default: {DEFAULT_START}, the paper's window)",
    )
    group.add_argument(
        "--parameters", type=Path, metavar="FILE",
        help="the controller's parameter file, with all that has no option of its own: horizon, "
        "max_command, patience, ... (default: config/ and its name, .yaml)",
    )
    group.add_argument(
        "--weight", type=within(*CONTROLLERS["mpc"]["weight"]), metavar="LAMBDA",
        help="mpc: price of pumping, lambda in the paper, 1e-5 to 0.1 there "
        "(default: that of the parameter file)",
    )
    group.add_argument(
        "--fraction", type=within(*CONTROLLERS["onoff"]["fraction"]), metavar="V",
        help="onoff, anticipating_onoff: command when pumping, v in the paper, 0.2 to 2 there "
        "(default: that of the parameter file)",
    )
    _add_forecast_arguments(group)
    _add_imperfection_arguments(parser)


def _add_forecast_arguments(group: argparse._ArgumentGroup) -> None:
    """Add the options that decide what the controller is told of the weather to come."""
    default = ForecastChoice()
    group.add_argument(
        "--forecast", default=default.model, metavar=f"{{{','.join(MODELS)},FILE.csv}}",
        help="what the controller is told: the weather that comes; that it goes on as it is; the "
        "weather with errors that grow with the lead, or an ensemble of such; or archived "
        "forecasts. All but perfect are issued every 6 hours, a file's when it says "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--forecast-size", type=within(*OPTIONS["size"]), metavar="S",
        help="errors, ensemble: size of the errors; 0.25 is small, 0.5 medium, 1 large "
        f"(default: {default.size:g})",
    )
    group.add_argument(
        "--forecast-seed", type=within(*_whole_range("seed"), int), metavar="N",
        help=f"errors, ensemble: seed of the errors (default: {default.seed})",
    )
    group.add_argument(
        "--forecast-members", type=within(*_whole_range("members"), int), metavar="M",
        help=f"ensemble: number of its members (default: {default.members})",
    )


def _add_imperfection_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that make the site less perfect than the paper's."""
    group = parser.add_argument_group("imperfections of a real site (default: none)")
    group.add_argument(
        "--roof-noise", type=within(*RANGES["roof_noise"]), default=0.0, metavar="M",
        help="standard deviation of the roof's level sensor (m), independent each tick",
    )
    group.add_argument(
        "--roof-offset", type=within(*RANGES["roof_offset"]), default=0.0, metavar="M",
        help="what that sensor reads above the true level (m)",
    )
    low, high = RANGES["noise_seed"]
    group.add_argument(
        "--noise-seed", type=within(int(low), int(high), int), default=0, metavar="N",
        help="seed of the noise (default: %(default)s)",
    )
    group.add_argument(
        "--minimum-on", type=within(*RANGES["minimum_on"]), default=0.0, metavar="S",
        help="once on, the pumps stay on for so long (s), but not in frost, on a full roof or in "
        "an empty cistern",
    )
    group.add_argument(
        "--minimum-off", type=within(*RANGES["minimum_off"]), default=0.0, metavar="S",
        help="once off, the pumps stay off for so long (s)",
    )


def _whole_range(option: str) -> tuple[int, int]:
    low, high = OPTIONS[option]
    return int(low), int(high)


def _speed(text: str) -> float:
    return 0.0 if text == "max" else within(1e-9, 1e9)(text)


_speed.__name__ = "speed: max, or a factor from 1e-9 to 1e9"


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
    controller: str = arguments.controller
    for option in ("weight", "fraction"):
        if getattr(arguments, option) is not None and option not in CONTROLLERS[controller]:
            owners = " and ".join(name for name in CONTROLLERS if option in CONTROLLERS[name])
            raise ConfigurationError(
                f"is an option of {owners}; the controller is {controller}", key=f"--{option}"
            )
    shared = shared_directory()
    site_file: Path = arguments.site or shared / "config" / "site.yaml"
    site = read_site(site_file)
    parameters = read_parameters(
        arguments.parameters or shared / "config" / f"{controller}.yaml", controller
    )
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
        initial, volumes = "custom", (arguments.cistern, arguments.roof)
    else:
        initial = arguments.initial or "low-low"
        volumes = initial_state(site, initial)
    weather = read_weather(
        arguments.weather or shared / "config" / "weather" / "toronto_2021-07.csv",
        site,
        arguments.evapotranspiration,
    )
    return build_run(
        site_file, site, weather, arguments.start or DEFAULT_START,
        count_ticks(site, arguments.hours, "--hours"), controller, parameters, initial, volumes,
        _forecast_choice(arguments),
        Imperfections(**{name: getattr(arguments, name) for name in RANGES}),
    )


def _forecast_choice(arguments: argparse.Namespace) -> ForecastChoice:
    """Return the forecasts that a command line asks for."""
    try:
        choice = choose(arguments.forecast)
    except ValueError as error:
        raise ConfigurationError(
            str(error), key="--forecast", value=arguments.forecast
        ) from error
    given = {option: getattr(arguments, f"forecast_{option}") for option in OPTIONS}
    given = {option: value for option, value in given.items() if value is not None}
    for option in given:
        if option not in choice.options():
            owners = " and ".join(name for name in MODELS if option in MODELS[name])
            raise ConfigurationError(
                f"is an option of {owners}; the forecast is {choice}",
                key=f"--forecast-{option}",
            )
    return replace(choice, **given)


def count_ticks(site: Site, hours: float | None, key: str) -> int:
    """Return N for a run of some hours; the site's own N if it is None.

    Raises:
        ConfigurationError: they are not a whole number of ticks, at least one and not too many; the
            message calls them by ``key``.
    """
    if hours is None:
        return site.N
    seconds = hours * 3600
    steps = round(seconds / site.tau) if math.isfinite(seconds) else 0
    if steps < 1 or not math.isclose(steps * site.tau, seconds, rel_tol=1e-9):
        raise ConfigurationError(
            f"must be a whole number of ticks of {site.tau:g} s, at least one", key=key, value=hours
        )
    if steps > _MOST_STEPS:
        raise ConfigurationError(
            f"makes {steps} ticks of {site.tau:g} s; must be at most {_MOST_STEPS}", key=key
        )
    return steps


def build_run(
    site_file: Path,
    site: Site,
    weather: Weather,
    start: str,
    steps: int,
    controller: str,
    parameters: dict[str, float],
    initial: str,
    volumes: tuple[float, float],
    choice: ForecastChoice,
    imperfections: Imperfections | None = None,
) -> Run:
    """Put a run together and check it.

    Args:
        site_file: where the site was read from.
        site: its parameters.
        weather: hourly records.
        start: time of tick 0, ISO 8601; without an offset from UTC in that of the weather.
        steps: N, its length (ticks).
        controller: its name.
        parameters: its parameters, all of them.
        initial: name of the initial state.
        volumes: of the initial state, in cistern and roof (m3).
        choice: which forecasts the controller is given.
        imperfections: of level sensor and pumps; none unless given.

    Raises:
        ConfigurationError: weather or forecasts do not cover the run, or it has values that the
            nodes would refuse.
    """
    first = read_start(start, weather.first.tzinfo)
    horizon = parameters.get("horizon", 0.0)
    series = WeatherSeries(weather, site, first, steps)
    x1, x2 = volumes
    topics = read_topics()
    for name, largest in (
        ("/cistern/level", site.cistern_level(x1)),
        ("/roof/level", site.roof_level(x2)),
        ("/weather/precipitation", max(series.precipitation)),
        ("/weather/evapotranspiration", max(series.evapotranspiration)),
    ):
        _check_range(topics[name], largest)
    return Run(
        site_file=site_file,
        site=site,
        weather=weather,
        series=series,
        forecast=make_forecast(
            weather, series, site, first, horizon, choice, controller in TAKE_ENSEMBLES
        ),
        start=first,
        steps=steps,
        controller=controller,
        parameters=parameters,
        initial=initial,
        x1=x1,
        x2=x2,
        forecast_choice=choice,
        imperfections=imperfections or Imperfections(),
    )


def _check_range(topic: Topic, largest: float) -> None:
    """Refuse a run whose values the nodes would refuse: both engines give the same numbers."""
    if largest > topic.high:
        raise ConfigurationError(
            f"the run has {largest:g} {topic.unit} on {topic.name}, where at most {topic.high:g} "
            "is accepted (msg_defs/topics.yaml); is a unit wrong?"
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
