"""The entry point of all commands, for ``greenroof`` and ``python -m greenroof_ros``."""

from __future__ import annotations

import sys

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)  # before the imports that take long

import importlib
from dataclasses import dataclass
from typing import Any

from greenroof_ros.base.command_line import EXIT_DONE, Parser, command
from greenroof_ros.base.errors import suggest_names
from greenroof_ros.base.versions import __version__


@dataclass(frozen=True)
class Command:
    """A command, whose module is imported only when the command is chosen.

    Attributes:
        module: name of a module in ``greenroof_ros.commands``, or the name including the folder for
            a module in another folder; the module provides ``main`` and ``make_parser``.
        about: description of the command in one line, for the help.
        part: name of the object in the module that provides ``main`` and ``make_parser``, if the
            module has more than one command; otherwise empty.
    """

    module: str
    about: str
    part: str = ""

    def load(self) -> Any:
        """Import and return the object that provides ``main`` and ``make_parser``."""
        folder = "" if "." in self.module else "commands."
        module = importlib.import_module(f"greenroof_ros.{folder}{self.module}")
        return getattr(module, self.part) if self.part else module


# Commands by name, in groups of what a user wants to do.
GROUPS = {
    "run the roof": {
        "run": Command("bringup.simulated", "run the node graph of a simulated site"),
        "live": Command("live.live_site", "operate a real site with sensors and a pump"),
        "fetch-forecast": Command("fetch_forecast", "fetch a forecast from the internet"),
        "hold": Command("requests", "hold the pump off until a release or a given "
        "time", "HOLD"),
        "release": Command("requests", "end the pump's hold", "RELEASE"),
        "reset": Command("requests", "clear a latched fault of the pump", "RESET"),
        "dose": Command("requests", "pump a specified volume now", "DOSE"),
        "outlet open": Command("requests", "open the outlet valve for a time", "OUTLET_OPEN"),
        "outlet close": Command("requests", "close and hold the outlet valve", "OUTLET_CLOSE"),
        "outlet release": Command("requests", "end the valve's hold", "OUTLET_RELEASE"),
        "outlet reset": Command("requests", "clear a latched fault of the valve", "OUTLET_RESET"),
        "stop-drive": Command("stop_drive", "stop a drive whose program has died"),
    },
    "monitor and evaluate runs and sites": {
        "watch": Command("watch", "show a run or a site in a web browser"),
        "status": Command("status", "print the current state, with an exit code for scripts"),
        "bridge": Command("bridge", "publish a graph over MQTT, with a stop switch for the pump"),
        "report": Command("report", "create figures and tables from runs, studies and bags"),
        "recover": Command("recover", "restore a bag after a crash or a full disk"),
    },
    "compare controllers, without ROS": {
        "simulate": Command("simulate", "run in one process, with the same results as the graph"),
        "study": Command("study", "run a study: the paper's 30 runs, or a grid of your own"),
        "district": Command("district", "compute the discharge of many buildings into a sewer"),
        "bound": Command("bound", "compute the minimum possible deviation"),
    },
    "adapt the model to your site": {
        "new-site": Command("new_site", "write a site file from a few numbers"),
        "size": Command("size", "choose a cistern, a target and an outlet over all seasons"),
        "storm": Command("storm", "make design storms, and compute their peaks and volumes"),
        "calibrate": Command("calibrate", "fit the roof to measurements"),
        "fetch-weather": Command("fetch_weather", "download years of weather from the internet"),
        "weather": Command("weather_file", "describe a weather file, or write it as plain CSV"),
        "verify": Command("verify", "compare rain forecasts with records"),
    },
    "connect your own parts": {
        "simulators live": Command("simulated_live", "try a live site on simulated devices"),
        "check-controller": Command("check_controller", "check a controller class or a controller "
        "node"),
        "check-pump": Command("check_pump", "check whether a pump driver conforms to the "
        "interface"),
        "simulators site": Command("simulators", "simulate a site's sensors, and its drive or "
        "relay"),
    },
}
COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}


def make_parser() -> Parser:
    """Return the parser that prints the help and rejects unknown commands."""
    groups = (
        "\n".join([
            f"{title}:", *(f"  {name:20}{entry.about}" for name, entry in group.items())
        ])
        for title, group in GROUPS.items()
    )
    parser = Parser(
        prog="greenroof",
        usage="%(prog)s COMMAND [options]",
        description="\n\n".join([
            "Water a green roof from its rainwater cistern, and keep storm water out of the sewer.",
            *groups,
        ]),
        epilog="greenroof COMMAND --help shows the options of a command, and examples.",
    )
    parser.add_argument(
        "--version", action="version", version=f"greenroof_ros {__version__}",
        help="print the version and exit",
    )
    return parser


def main() -> None:
    """Run the command named on the command line."""
    words = sys.argv[1:]
    name = _name(words)
    if name not in COMMANDS:
        _explain()
    sys.argv = [f"greenroof {name}", *words[len(name.split()):]]
    COMMANDS[name].load().main()


def _name(words: list[str]) -> str:
    """Return the name of the command at the beginning of the words, even if it does not exist."""
    two = any(name.startswith(f"{word} ") for name in COMMANDS for word in words[:1])
    return " ".join(word for word in words[:2 if two else 1] if word not in ("-h", "--help"))


@command
def _explain() -> int:
    """Print the commands or the version, or an error message about an unknown command."""
    parser = make_parser()
    name = _name(sys.argv[1:])
    if name.startswith("-"):
        parser.parse_args()
    elif name and not any(entry.startswith(f"{name} ") for entry in COMMANDS):
        parser.error(f"there is no command {name}; {suggest_names(name, COMMANDS)}")
    parser.print_help()
    return EXIT_DONE


if __name__ == "__main__":
    main()
