"""Pause the pump until a date, even if nodes restart: ``greenroof pause``."""

from __future__ import annotations

import sys
from contextlib import closing
from datetime import datetime

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED, Parser, command, namespace
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_time, to_people
from greenroof_ros.graph.domain import importing_ros
from greenroof_ros.graph.looker import Looker, StopFailedError

_PATIENCE_S = 20.0


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof pause",
        description="Keep the pump off until a date, even after a restart. The pause then ends by "
        "itself; any other reason to keep the pump off remains. If the pump must not run until "
        "somebody has checked it, stop it instead (~/stop).",
        epilog="examples:\n  greenroof pause --until 2026-12-24T08:00\n  greenroof pause --end\n\n"
        "exit codes: 0 done, 1 the pump node did not do so, 2 bad usage",
    )
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument(
        "--until", metavar="TIME",
        help="a future time (ISO 8601), by this machine's clock unless it has an offset from "
        "UTC: 2026-12-24T08:00-05:00",
    )
    choice.add_argument("--end", action="store_true", help="end the pause now")
    parser.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="namespace of the graph, as passed to bringup (default: none)",
    )
    return parser


@command
def main() -> int:
    """Pause the pump, or end its pause."""
    arguments = make_parser().parse_args()
    until, message = "", "the pause is over"
    if not arguments.end:
        try:
            end = parse_time(arguments.until).astimezone()
        except ValueError:
            raise ConfigurationError(
                "must be a time such as 2026-12-24T08:00", key="--until", value=arguments.until
            ) from None
        now = datetime.now().astimezone()
        if end <= now:
            raise ConfigurationError(
                f"must be in the future; it is now {now.isoformat(timespec='minutes')}",
                key="--until", value=arguments.until,
            )
        until = end.isoformat(timespec="seconds")
        message = f"the pump is paused until {to_people(end)}"
    with importing_ros(), closing(Looker(arguments.namespace, lambda *_: None)) as looker:
        looker.prepare_stop(f"{arguments.namespace}/pump")
        try:
            looker.pause_pump(until, _PATIENCE_S)
        except StopFailedError as failure:
            print(f"error: {failure}", file=sys.stderr)
            return EXIT_FAILED
    print(message)
    return EXIT_DONE


if __name__ == "__main__":
    main()
