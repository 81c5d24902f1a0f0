"""The options of a run and of its output, shared by more than one command."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import Parser, add_option, add_site, option_of
from greenroof_ros.base.errors import rename_keys
from greenroof_ros.controllers.registry import BUILT_IN, DEFAULT, ControllerChoice, find_controller
from greenroof_ros.forecast import choice
from greenroof_ros.forecast.choice import MODELS
from greenroof_ros.physics.pump import PARAMETERS
from greenroof_ros.physics.start import INITIAL_STATES
from greenroof_ros.simulation.inputs import INPUTS, make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.climate import CLIMATE


def add_run_arguments(parser: Parser, arguments: Sequence[str] | None = None) -> None:
    """Add the options that determine a run's results, for both ``simulate`` and ``run``.

    Args:
        parser: parser of the command.
        arguments: command line that the parser will receive; ``sys.argv`` if None.

    Raises:
        ConfigurationError: if there is no such controller.
    """
    group = parser.add_argument_group("the run")
    add_controller_arguments(parser, group, arguments)
    add_site_arguments(group)
    group = parser.add_argument_group("forecasts")
    add_option(group, INPUTS["forecast"], metavar=f"{{{','.join(MODELS)},FILE}}")
    for parameter in choice.INPUTS.values():
        add_option(group, parameter)
    group = parser.add_argument_group("sensor and pumps (default: as in the paper)")
    for parameter in PARAMETERS.values():
        add_option(group, parameter)


def add_controller_arguments(
    parser: Parser, group: argparse._ArgumentGroup,
    arguments: Sequence[str] | None = None, default: str = DEFAULT,
) -> None:
    """Add the options for the name of the controller and for its parameters.

    Args:
        parser: the command's parser.
        group: group for the controller's name; its parameters have a group of their own.
        arguments: command line that is searched for the name; ``sys.argv`` if None.
        default: name of the controller if the command line contains none.

    Raises:
        ConfigurationError: if there is no such controller.
    """
    group.add_argument(
        "--controller", default=default, metavar="NAME",
        help=f"{', '.join(BUILT_IN)}, or package.module:Class for your own controller; in a graph, "
        "also external for a node that you run yourself (default: %(default)s)",
    )
    # The controller's parameters are options, so its name is needed before the rest is parsed.
    name = Parser(add_help=False, exit_on_error=False)
    name.add_argument("--controller", nargs="?", default=default)
    given = name.parse_known_args(arguments)[0].controller or default
    with rename_keys(_OPTIONS):
        controller = find_controller(given)
    options = ", ".join(map(option_of, controller.parameters))
    parser.hint = f"the parameters of {controller.name} are {options}"
    of_controller = parser.add_argument_group(
        f"parameters of {controller.name}",
        "To see the parameters of another controller, add --controller to --help.",
    )
    of_controller.add_argument(
        "--parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file of the controller; parameters that are not in the file keep "
        "their defaults",
    )
    for parameter in controller.parameters.values():
        add_option(of_controller, parameter)


def add_site_arguments(group: argparse._ArgumentGroup) -> None:
    """Add the options for site, weather, initial state, start and length."""
    add_site(group)
    add_option(group, INPUTS["weather"], nargs="+", metavar="FILE")
    add_option(group, INPUTS["start"], metavar="ISO")
    add_option(group, INPUTS["initial"], choices=INITIAL_STATES)
    for name in ("hours", "cistern", "roof", "gaps", *CLIMATE):
        add_option(group, INPUTS[name])
    add_option(group, INPUTS["evapotranspiration"], metavar="METHOD")


# Names of the inputs in messages about a command line.
_OPTIONS = {name: option_of(name) for name in ("controller", *INPUTS)}


def add_output_arguments(parser: Parser) -> argparse._ArgumentGroup:
    """Add the options for the output of a run, and return their group.

    Args:
        parser: the command's parser.
    """
    group = parser.add_argument_group("output")
    group.add_argument(
        "--output", type=Path, metavar="DIR",
        help="write the run to DIR, which must be new or empty (default: a dated directory in "
        "runs/)",
    )
    group.add_argument(
        "--json", action="store_true", help="print the summary as JSON instead of a table"
    )
    return group


def read_controller(arguments: argparse.Namespace) -> tuple[ControllerChoice, dict[str, Any]]:
    """Return the controller and the parameters that a command line specifies.

    Raises:
        ConfigurationError: if an option, or a file named by an option, is invalid.
    """
    controller = find_controller(arguments.controller)
    given = {}
    if arguments.parameters is not None:
        namespace = getattr(arguments, "namespace", "")  # without a graph there is none
        given = controller.read_parameters(arguments.parameters, namespace)
    options = {name: getattr(arguments, name) for name in controller.parameters}
    return controller, given | {
        name: value for name, value in options.items() if value is not None
    }


def build_run(arguments: argparse.Namespace) -> Run:
    """Build and check the run that a command line specifies.

    For a command without ``--controller``, only the site, the weather and the initial state matter.

    Raises:
        ConfigurationError: if an option, or a file named by an option, is invalid.
    """
    controller, parameters = find_controller(DEFAULT), dict[str, Any]()
    with rename_keys(_OPTIONS):
        if "controller" in arguments:
            controller, parameters = read_controller(arguments)
        given = {name: getattr(arguments, name, None) for name in INPUTS}
        return make_inputs(controller, given | parameters).build()
