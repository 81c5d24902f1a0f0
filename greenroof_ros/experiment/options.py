"""The options that several commands share: of a run, of its output, and of a graph of nodes."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import (
    Parser,
    add_foxglove,
    add_site,
    make_number_type,
    parse_namespace,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import DEFAULT_START
from greenroof_ros.controllers.registry import (
    DEFAULT,
    EXTERNAL,
    ControllerChoice,
    controller_names,
    find_controller,
)
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import (
    FILE,
    MODELS,
    NUMBERS,
    OPTIONS,
    ForecastChoice,
    check_skill,
    choose,
)
from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.formats.forecasts import SERVICE_DELAY_H
from greenroof_ros.model.initial_state import (
    INITIAL_STATES,
    SITE_STATE,
    SITE_STATE_KEYS,
    check_volumes,
    default_state,
    initial_state,
)
from greenroof_ros.model.sensor_and_pump import PARAMETERS, SensorAndPump
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.weather.reading import default_weather, find_files, read_weather
from greenroof_ros.weather.series import GAPS, REFUSE

_PARAMETER = "parameter_"  # prefix of the controller's parameters among the arguments


def add_run_arguments(
    parser: Parser, arguments: Sequence[str] | None = None
) -> None:
    """Add the options that decide a run's numbers, the same for ``simulate`` and ``run``.

    Args:
        parser: of the command.
        arguments: the command line that it will parse; ``sys.argv`` if None.

    Raises:
        ConfigurationError: there is no such controller.
    """
    group = parser.add_argument_group("the run")
    add_controller_arguments(parser, group, arguments)
    add_site_arguments(group)
    group = parser.add_argument_group("forecasts")
    group.add_argument(
        "--forecast", default=ForecastChoice().model, metavar=f"{{{','.join(MODELS)},FILE}}",
        help="what the controller knows about the coming weather. perfect: all of it; "
        "persistence: it stays unchanged; errors: a forecast as good as real ones; ensemble: "
        "several of these; a file, or a directory of files: archived forecasts, in this project's "
        "CSV, or CSV or JSON of Open-Meteo. All but perfect are issued every 6 hours, archived "
        "forecasts at their own times (default: %(default)s)",
    )
    add_forecast_options(group)
    _add_parameters(
        parser.add_argument_group("sensor and pumps (default: as in the paper)"),
        PARAMETERS.values(),
    )


def add_controller_arguments(
    parser: Parser, group: argparse._ArgumentGroup,
    arguments: Sequence[str] | None = None, default: str = DEFAULT,
) -> None:
    """Add the options for the controller's name and for the parameters of that controller.

    Args:
        parser: of the command.
        group: for the controller's name; its parameters get a group of their own.
        arguments: the command line that is searched for its name; ``sys.argv`` if None.
        default: the controller if none is named.

    Raises:
        ConfigurationError: there is no such controller.
    """
    group.add_argument(
        "--controller", default=default, metavar="NAME",
        help=f"{', '.join(controller_names())}, or package.module:Class for your own; in a graph "
        "also external, a node that you run yourself (default: %(default)s)",
    )
    # Its parameters are options, so its name is needed before the rest is parsed.
    name = Parser(add_help=False, exit_on_error=False)
    name.add_argument("--controller", nargs="?", default=default)
    controller = find_controller(name.parse_known_args(arguments)[0].controller or default)
    options = ", ".join(_option(parameter) for parameter in controller.parameters)
    parser.hint = f"the parameters of {controller.name} are {options}"
    of_controller = parser.add_argument_group(
        f"parameters of {controller.name}",
        "With another --controller, --help shows its parameters.",
    )
    of_controller.add_argument(
        "--parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file of the controller; what it leaves out has its default",
    )
    _add_parameters(of_controller, controller.kind.parameters, _PARAMETER)


def _add_parameters(
    group: argparse._ArgumentGroup, parameters: Iterable[Parameter], prefix: str = ""
) -> None:
    for parameter in parameters:
        unit = "" if parameter.unit in ("", "1") else f"{parameter.unit}, "
        group.add_argument(
            _option(parameter.name), dest=f"{prefix}{parameter.name}", metavar="X",
            type=make_number_type(parameter.low, parameter.high, type(parameter.default)),
            help=f"{parameter.meaning} ({unit}default: {parameter.default:g})",
        )


def _given_options(
    arguments: argparse.Namespace, names: Iterable[str], prefix: str = ""
) -> dict[str, Any]:
    """Return the options that a command line gives, by their names without the prefix."""
    values = {name: getattr(arguments, f"{prefix}{name}") for name in names}
    return {name: value for name, value in values.items() if value is not None}


def _option(parameter: str) -> str:
    return f"--{parameter.replace('_', '-')}"


def add_site_arguments(group: argparse._ArgumentGroup) -> None:
    """Add the options for site, weather, initial state, start and length."""
    group.add_argument(
        "--start", default=None, metavar="ISO",
        help="time of the first tick, such as 2021-07-07T02:00-05:00; without an offset from "
        f"UTC, the weather file's is used (default: {DEFAULT_START}, the paper's window)",
    )
    group.add_argument(
        "--hours", type=make_number_type(1e-9, 1e9), metavar="H",
        help="length of the run in simulated hours (default: N of the site file, 12 h)",
    )
    group.add_argument(
        "--weather", nargs="+", metavar="FILE",
        help="weather files, joined in order of time, or a pattern in quotes such as "
        "'weather/2021_*.csv': CSV in this project's format, hourly bulk files of Environment and "
        "Climate Change Canada, or hourly CSV of Open-Meteo's archive, whose rain and radiation "
        "are moved from the end of their hour to its start "
        "(default: config/weather/toronto_2021-07.csv)",
    )
    group.add_argument(
        "--gaps", choices=GAPS, default=REFUSE,
        help="what to do if an hour of the run is missing in the weather files and the gap is "
        "not short. refuse: name the hours; fill: treat missing rain as none, and replace other "
        "values by the mean at that time of day over the three days before and after "
        "(default: %(default)s)",
    )
    add_site(group)
    group.add_argument(
        "--initial", choices=list(INITIAL_STATES), default=None,
        help="initial levels of cistern and roof, Table II of the paper (default: from "
        "the site file, low-low if it gives none)",
    )
    group.add_argument(
        "--cistern", type=make_number_type(0, 1e9), metavar="V",
        help="instead of --initial: volume in the cistern (m3); --roof must be given too",
    )
    group.add_argument(
        "--roof", type=make_number_type(0, 1e9), metavar="V",
        help="instead of --initial: volume on the roof (m3)",
    )
    group.add_argument(
        "--evapotranspiration", metavar="METHOD",
        help="fao56: computed by FAO-56 Penman-Monteith; hargreaves: from temperature alone, by "
        "FAO-56 Eq. 52; monthly: the site's monthly_evapotranspiration; or the name of the weather "
        "file's own column, for example published (default: the file's own, otherwise the first of "
        "these three for which it has what is needed)",
    )


def add_forecast_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that only some forecasts have."""
    group.add_argument(
        "--forecast-skill", type=_skill, metavar=f"{{{','.join(SKILLS)},FILE.yaml}}",
        help="errors, ensemble: how good the forecasts are. real: as good as a weather service's; "
        "better: like real ones at half the lead time; worse: at twice the lead time; a "
        f"file: as it states (default: {ForecastChoice().skill})",
    )
    _add_parameters(group, (NUMBERS["seed"], NUMBERS["members"]))
    delay = NUMBERS["delay"]
    group.add_argument(
        "--forecast-delay", type=make_number_type(delay.low, delay.high), metavar="H",
        help="errors, ensemble, a file: hours from an issue's nominal time until it is available "
        f"(default: {SERVICE_DELAY_H:g} for errors and ensemble; for a file, the usual delay of "
        "its kind, 0 for this project's format, which states when it was available)",
    )


def _skill(text: str) -> str:
    try:
        check_skill(text, "")
    except ConfigurationError as error:
        raise argparse.ArgumentTypeError(f"{error.expected}, not {text}") from error
    return text


_skill.__name__ = f"skill: {', '.join(SKILLS)}, or a FILE.yaml"


def add_output_arguments(parser: Parser) -> argparse._ArgumentGroup:
    """Add the options that decide where a run goes and how fast; return their group.

    Args:
        parser: of the command.
    """
    group = parser.add_argument_group("output and pace")
    group.add_argument(
        "--output", type=Path, metavar="DIR",
        help="directory of the run, new or empty (default: a dated one under runs/)",
    )
    group.add_argument(
        "--speed", type=make_number_type(1e-9, 1e9, word="max"), default=0.0,
        metavar="{max|FACTOR}",
        help="simulated time per wall time; 1 is real time (default: max)",
    )
    group.add_argument(
        "--json", action="store_true", help="print the summary as JSON instead of a table"
    )
    return group


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of a graph, the same for ``run`` and ``live``.

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
        "--namespace", type=parse_namespace, default="", metavar="NAME",
        help="put the whole graph, including its clock, under /NAME, so that several run side by "
        "side in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=make_number_type(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, at least 2 s: joining nodes listen for one "
        "second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a browser, whose address is printed; a run, at a --speed "
        "of at most 60. The page ends with "
        "the graph; the graph does not need it. The page of greenroof watch stays. Needs "
        "the extra [watch]",
    )
    add_foxglove(
        group, "serve the graph to Foxglove or Lichtblick on this machine, at the address that is "
        "printed, until the graph ends; the graph does not need it.",
    )
    group.add_argument(
        "--node-parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file for what bringup does not decide, such as the pump node's "
        "limits; each node's --help lists its parameters; unknown ones are refused",
    )


def controller_from_arguments(
    arguments: argparse.Namespace, site: Site
) -> tuple[ControllerChoice, dict[str, float]]:
    """Return the controller that a command line asks for, and all of its parameters on a site.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong.
    """
    controller = find_controller(arguments.controller)
    parameters = controller.defaults(site)
    if arguments.parameters is not None:
        parameters = controller.read_parameters(arguments.parameters, site)
    return controller, parameters | _given_options(arguments, parameters, _PARAMETER)


def run_from_arguments(arguments: argparse.Namespace) -> Run:
    """Build and check the run that a command line asks for.

    For a command without ``--controller``, only site, weather and initial state matter.

    Raises:
        ConfigurationError: an option, or a file that it names, is wrong.
    """
    site_file: Path = arguments.site
    site = read_site(site_file)
    if "controller" in arguments:
        controller, parameters = controller_from_arguments(arguments, site)
        choice = forecast_from_arguments(arguments, arguments.forecast, "--forecast")
        sensor_and_pump = SensorAndPump(**_given_options(arguments, PARAMETERS))
    else:
        controller = find_controller("onoff")
        parameters, choice = controller.defaults(site), ForecastChoice()
        sensor_and_pump = SensorAndPump()
    if (arguments.cistern is None) != (arguments.roof is None):
        raise ConfigurationError("must be given together", key="--cistern and --roof")
    if arguments.cistern is not None:
        if arguments.initial is not None:
            raise ConfigurationError(
                "cannot be combined with --cistern and --roof", key="--initial"
            )
        initial, volumes = "custom", (arguments.cistern, arguments.roof)
    elif arguments.initial is not None:
        initial, volumes = arguments.initial, initial_state(site, arguments.initial)
    else:
        initial, volumes = default_state(site)
    check_volumes(
        site, *volumes, keys=SITE_STATE_KEYS if initial == SITE_STATE else ("--cistern", "--roof")
    )
    weather = read_weather(
        find_files(arguments.weather or [str(default_weather())], "--weather"),
        site,
        arguments.evapotranspiration, arguments.gaps,
    )
    return build_run(
        site_file, site, weather, arguments.start or DEFAULT_START,
        count_ticks(site, arguments.hours, "--hours"), controller, parameters, initial, volumes,
        choice, sensor_and_pump,
    )


def forecast_from_arguments(
    arguments: argparse.Namespace, text: str, key: str
) -> ForecastChoice:
    """Return the forecasts that a command line asks for.

    Args:
        arguments: parsed with the options of :func:`add_forecast_options`.
        text: which forecasts: a model or a path.
        key: the option or argument that gives it, for messages.

    Raises:
        ConfigurationError: there are no such forecasts, or an option does not apply to them.
    """
    choice = choose(text, key)
    chosen = _given_options(arguments, OPTIONS, "forecast_")
    for option in chosen:
        if option not in choice.option_names:
            owners = [
                "a file" if name == FILE else name
                for name in (*MODELS, FILE) if option in ForecastChoice(name).option_names
            ]
            raise ConfigurationError(
                f"is an option of {' and '.join(owners)}; the forecast is {choice}",
                key=f"--forecast-{option}",
            )
    return replace(choice, **chosen)
