"""Requests to the node of the pump or of the outlet valve.

They are ``greenroof hold``, ``release``, ``reset`` and ``dose``, and those that begin with
``greenroof outlet``.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    command,
    make_number_type,
)
from greenroof_ros.base.times import parse_time, to_people
from greenroof_ros.interface.states import PUMP, VALVE
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.ros.reports import Reports
from greenroof_ros.watch.graph_client import (
    DIAGNOSTICS,
    GraphClient,
    RequestError,
    read_message,
)

# Longest wait for the node (s), as its discovery takes seconds.
_PATIENCE_S = 20.0
# How long its reports are awaited (s), before a reset asks for confirmation and during a dose.
_REPORT_S = 5.0
_POLL_S = 0.1
# Longest hold with an end (s): ten years.
_MAX_HOLD_S = 87_600 * 3600.0
# Units of a duration (s), which is in hours without one.
_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0, "": 3600.0}
_QUESTION = (
    "The {what} as soon as the fault is cleared. Have you remedied its cause, and made sure that "
    "no one is working on the {role}? [y/N] "
)
_MAY = {PUMP: "pump may start", VALVE: "valve may open"}


@dataclass(frozen=True)
class Request:
    """A command that sends one request to a node, and prints the outcome.

    Attributes:
        name: name of the command.
        done: state of the pump or the valve after a successful request, as worded in the list of
            exit codes.
        description: description for the help.
        request: function that makes the request, given the command line and the nodes' reports, and
            returns the outcome.
        add_options: function that adds the command's own options.
        examples: examples for the help.
    """

    name: str
    done: str
    description: str
    request: Callable[[GraphClient, argparse.Namespace, Reports], str]
    add_options: Callable[[Parser], object] = lambda parser: None
    examples: str = ""

    def make_parser(self) -> Parser:
        """Return the command's parser."""
        parser = Parser(
            prog=f"greenroof {self.name}", description=self.description,
            epilog=f"{self.examples}exit codes: 0 {self.done}, 1 not {self.done}, or not "
            "confirmed, 2 bad usage",
        )
        self.add_options(parser)
        add_namespace(parser)
        return parser

    def main(self) -> NoReturn:
        """Make the request, print the answer, and exit."""
        command(self._run)()

    def _run(self) -> int:
        arguments = self.make_parser().parse_args()
        reports = Reports(arguments.namespace)

        def receive(name: str, message: bytes, *_: Any) -> None:
            if name == DIAGNOSTICS and (received := read_message(name, message)) is not None:
                reports.receive(time.monotonic(), received[1])

        try:
            with closing(GraphClient(arguments.namespace, receive)) as client:
                print(self.request(client, arguments, reports))
        except RequestError as failure:
            print(f"error: {failure}", file=sys.stderr)
            return EXIT_FAILED
        return EXIT_DONE


def _add_hold_options(parser: Parser) -> None:
    end = parser.add_mutually_exclusive_group()
    end.add_argument(
        "--until", type=_parse_future_time, metavar="TIME",
        help="end the hold at this future time (ISO 8601), such as 2026-12-24T08:00-05:00; a "
        "time without a UTC offset is this machine's local time (default: no end)",
    )
    end.add_argument(
        "--for", dest="seconds", type=_parse_duration, metavar="TIME",
        help="end the hold after this time, such as 30min, 2h or 3d; a number without a unit is in "
        "hours (default: no end)",
    )
    parser.add_argument(
        "--reason", default="", metavar="TEXT",
        help="state this reason for the hold (default: none)",
    )


def _parse_future_time(text: str) -> float:
    """Return a future time (s since 1970); if the clock shows it twice, return the later one."""
    try:
        end = max(parse_time(text).replace(fold=fold).astimezone() for fold in (0, 1))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be a time such as 2026-12-24T08:00, not {text}"
        ) from None
    if end.timestamp() <= time.time():
        now = to_people(end.now().astimezone().replace(microsecond=0))
        raise argparse.ArgumentTypeError(
            f"must be in the future, not {text}; the time is now {now}"
        )
    return end.timestamp()


_parse_future_time.__name__ = "TIME"  # argparse and the documentation show this


def _parse_duration(text: str) -> float:
    """Return a duration (s) such as ``30min``; a number without a unit is in hours."""
    match = re.fullmatch(r"(\d+\.?\d*) ?(s|min|h|d|)", text)
    seconds = float(match[1]) * _UNITS[match[2]] if match else 0.0
    if not 1.0 <= seconds <= _MAX_HOLD_S:
        raise argparse.ArgumentTypeError(
            f"must be a time such as 45s, 30min, 2h or 3d, at least 1 s, not {text}"
        )
    return seconds


_parse_duration.__name__ = "TIME"


def _hold(
    client: GraphClient, arguments: argparse.Namespace, _: Reports, role: str = PUMP
) -> str:
    until = arguments.until
    if arguments.seconds is not None:
        until = time.time() + arguments.seconds
    end = {} if until is None else {"until": until}
    return client.request(
        "stop", _PATIENCE_S, role, owner="the command line", reason=arguments.reason, **end
    )


def _release(
    client: GraphClient, _: argparse.Namespace, __: Reports, role: str = PUMP
) -> str:
    return client.request("release", _PATIENCE_S, role)


def _add_open_options(parser: Parser) -> None:
    parser.add_argument(
        "--for", dest="seconds", type=_parse_duration, required=True, metavar="TIME",
        help="open the valve for this time, such as 30min or 2h; a number without a unit is in "
        "hours",
    )


def _open(client: GraphClient, arguments: argparse.Namespace, _: Reports) -> str:
    until = time.time() + arguments.seconds
    return client.request("open", _PATIENCE_S, VALVE, owner="the command line", until=until)


def _add_dose_options(parser: Parser) -> None:
    parser.add_argument(
        "--litres", type=make_number_type(1.0, 1e9), required=True, metavar="L",
        help="deliver this volume (litres)",
    )


def _dose(client: GraphClient, arguments: argparse.Namespace, reports: Reports) -> str:
    """Request a dose, and print its progress until the dose ends."""
    requested_at, sentence = time.time(), ""
    client.request("dose", _PATIENCE_S, volume=arguments.litres / 1000, asked_at=requested_at)
    accepted = time.monotonic()
    print(f"dose {requested_at:.6f} of {arguments.litres:g} litres was accepted", flush=True)
    while True:
        time.sleep(_POLL_S)
        client.receive()
        now, pump = time.monotonic(), reports.node(PUMP)
        if now - max(accepted, pump.received_at if pump else 0.0) > _REPORT_S:
            raise RequestError(
                "it is unknown whether the dose continues: the pump node is silent"
            )
        dose = None if pump is None else pump.values.get("dose")
        if isinstance(dose, dict) and dose.get("id") == requested_at:
            before, sentence = sentence, str(dose.get("sentence", ""))
            if dose.get("over") == "done":
                return sentence
            if dose.get("over"):
                raise RequestError(sentence)
            if sentence != before:
                print(sentence, flush=True)
        elif sentence or now > accepted + _REPORT_S:
            raise RequestError("the pump node was restarted, which ended the dose")


def _add_reset_options(parser: Parser) -> None:
    parser.add_argument(
        "--yes", action="store_true", help="do not ask for confirmation, for use in scripts"
    )


def _reset(
    client: GraphClient, arguments: argparse.Namespace, reports: Reports, role: str = PUMP
) -> str:
    if not arguments.yes:
        until = time.monotonic() + _REPORT_S
        while (node := reports.node(role)) is None and time.monotonic() < until:
            time.sleep(_POLL_S)
            client.receive()
        if node is not None and (fault := node.values.get("fault")):
            print(f"The fault: {fault}", file=sys.stderr)
        if not _ask_to_confirm(role):
            raise RequestError("not cleared: the request was not confirmed")
    return client.request("reset", _PATIENCE_S, role)


def _ask_to_confirm(role: str) -> bool:
    """Ask for confirmation on the terminal; treat a missing answer as no."""
    try:
        return input(_QUESTION.format(what=_MAY[role], role=role)).strip().lower() in ("y", "yes")
    except EOFError:
        print(file=sys.stderr)
        return False


HOLD = Request(
    "hold", "held",
    "Keep the pump off, regardless of its command and even after a restart, until 'greenroof "
    "release' or a given time. There is only one hold at a time: a new hold replaces the owner "
    "and the reason of the earlier hold, but never ends before the earlier hold would have ended.",
    _hold, _add_hold_options,
    "examples:\n  greenroof hold --reason 'the roof is being repaired'\n"
    "  greenroof hold --until 2026-12-24T08:00\n  greenroof hold --for 48\n\n",
)
RELEASE = Request(
    "release", "released",
    "End the hold of the pump, whoever requested it. The pump then starts automatically when the "
    "controller requires it and nothing else keeps it off. A fault is not cleared.",
    _release,
)
RESET = Request(
    "reset", "cleared",
    "Clear a latched fault of the pump, in the pump node and in the drive, once the cause of the "
    "fault has been remedied. The command is intended for a person standing at the pump, and asks "
    "for confirmation first. A hold stays in force until 'greenroof release'. After a reset, the "
    "pump starts when the controller requires it and nothing else keeps it off.",
    _reset, _add_reset_options,
)
DOSE = Request(
    "dose", "delivered",
    "Deliver a volume now, regardless of the controller's command, if the site file allows "
    "doses (max_dose) and no interlock is active. A dose never fills the roof above its target. "
    "If an interlock becomes active, or if the pump cannot start within a minute, the dose is "
    "abandoned and does not resume. Ctrl-C ends this command but not the dose; to end the dose, "
    "stop the pump.",
    _dose, _add_dose_options, "example:\n  greenroof dose --litres 200\n\n",
)
OUTLET_OPEN = Request(
    "outlet open", "opened",
    "Open the valve of the cistern's low outlet for a limited time, regardless of the controller's "
    "command. The interlocks stay in force: the valve closes earlier if anything requires it to be "
    "closed. 'greenroof outlet close' ends the opening.",
    _open, _add_open_options, "example:\n  greenroof outlet open --for 30min\n\n",
)
OUTLET_CLOSE = Request(
    "outlet close", "closed",
    "Close the valve of the cistern's low outlet, and keep it closed by a hold, regardless of its "
    "command and even after a restart, until 'greenroof outlet release' or a given time. The "
    "overflow above the outlet stays open.",
    partial(_hold, role=VALVE), _add_hold_options,
    "examples:\n  greenroof outlet close --reason 'the sewer is being repaired'\n"
    "  greenroof outlet close --for 2d\n\n",
)
OUTLET_RELEASE = Request(
    "outlet release", "released",
    "End the hold of the outlet valve, whoever requested it. The valve then opens automatically "
    "when the controller requires it and nothing else keeps it closed. A fault is not cleared.",
    partial(_release, role=VALVE),
)
OUTLET_RESET = Request(
    "outlet reset", "cleared",
    "Clear a latched fault of the outlet valve, such as valve_stuck_open, once its cause has been "
    "remedied. The command is intended for a person standing at the valve, and asks for "
    "confirmation first. A hold stays in force until 'greenroof outlet release'.",
    partial(_reset, role=VALVE), _add_reset_options,
)
