"""Hold the pump, even if nodes restart: ``greenroof hold``."""

from __future__ import annotations

import time

from greenroof_ros.commands.pump_request import request_of_pump
from greenroof_ros.common.command_line import (
    Parser,
    add_namespace,
    command,
    within,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import parse_time, to_people

# Hours of the longest hold with an end: ten years.
_MOST_H = 87_600


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof hold",
        description="Keep the pump off, regardless of the command, even after a restart: until "
        "'greenroof release', or until a time. There is one hold at a time: this one replaces the "
        "owner and the reason of an earlier one, and never ends sooner than that.",
        epilog="examples:\n  greenroof hold --reason 'the roof is being repaired'\n"
        "  greenroof hold --until 2026-12-24T08:00\n  greenroof hold --for 48\n\n"
        "exit codes: 0 held, 1 the pump node did not confirm it, 2 bad usage",
    )
    end = parser.add_mutually_exclusive_group()
    end.add_argument(
        "--until", metavar="TIME",
        help="its end, a future time (ISO 8601), by this machine's clock unless it has an offset "
        "from UTC: 2026-12-24T08:00-05:00 (default: no end)",
    )
    end.add_argument(
        "--for", dest="hours", type=within(0.001, _MOST_H), metavar="HOURS",
        help="its length (h; default: no end)",
    )
    parser.add_argument(
        "--reason", default="", metavar="TEXT",
        help="why; shown with the hold (default: none)",
    )
    add_namespace(parser)
    return parser


def _read_until(text: str) -> float:
    """Return a future time (s since 1970).

    Raises:
        ConfigurationError: it is not one.
    """
    try:
        end = parse_time(text).astimezone()
    except ValueError:
        raise ConfigurationError(
            "must be a time such as 2026-12-24T08:00", key="--until", value=text
        ) from None
    if end.timestamp() <= time.time():
        now = to_people(end.now().astimezone().replace(microsecond=0))
        raise ConfigurationError(
            f"must be in the future; it is now {now}", key="--until", value=text
        )
    return end.timestamp()


@command
def main() -> int:
    """Hold the pump, and print what the pump node answers."""
    arguments = make_parser().parse_args()
    until = None if arguments.until is None else _read_until(arguments.until)
    if arguments.hours is not None:
        until = time.time() + arguments.hours * 3600
    return request_of_pump(arguments.namespace, lambda client, timeout_s: client.hold_pump(
        "the command line", arguments.reason, until, timeout_s,
    ))
