"""Requests to the node of the pump or of the outlet valve.

They are ``greenroof hold``, ``release``, ``reset`` and ``dose``, and those that begin with
``greenroof outlet``. The docstring of each request is its help, in which the words of the device
are left open.
"""

from __future__ import annotations

import argparse
import inspect
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NoReturn

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.base.text import escape
from greenroof_ros.interface.states import PUMP, VALVE
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.ros.reports import Reports
from greenroof_ros.watch.graph_client import DIAGNOSTICS, GraphClient, RequestError, read_message

# Longest wait for the node (s), as its discovery takes seconds.
_PATIENCE_S = 20.0
# How long its reports are awaited (s), before a reset asks for confirmation and during a dose.
_REPORT_S = 5.0
_POLL_S = 0.1
# The number in a duration, at most ten years in hours; and the units (s), hours if there is none.
_read_number = make_number_type(0.001, 87_600)
_UNITS = {"s": 1.0, "min": 60.0, "d": 86_400.0, "h": 3600.0, "": 3600.0}
_OWNER = "the command line"
# The words of each device in the help.
_WORDS = {
    PUMP: {"device": "pump", "off": "off", "starts": "starts", "group": "greenroof"},
    VALVE: {
        "device": "outlet valve", "off": "closed", "starts": "opens", "group": "greenroof outlet"
    },
}


@dataclass(frozen=True)
class Request:
    """A command that sends one request to a node, and prints the outcome.

    Attributes:
        name: name of the command.
        request: function that makes the request, given the command line and the nodes' reports, and
            returns the outcome; its docstring is the help.
        add_options: function that adds the command's own options.
        role: role of the node.
    """

    name: str
    request: Callable[[GraphClient, argparse.Namespace, Reports], str]
    add_options: Callable[[Parser], object] = lambda parser: None
    role: str = PUMP

    def make_parser(self) -> Parser:
        """Return the command's parser."""
        text = inspect.getdoc(self.request) or ""
        parser = Parser.of(
            self.name, text.format(prog=f"greenroof {self.name}", **_WORDS[self.role])
            + "\n\nExit codes: 0 done, 1 not done, or not confirmed, 2 bad usage"
        )
        self.add_options(parser)
        add_namespace(parser)
        return parser

    def main(self) -> NoReturn:
        """Make the request, print the answer, and exit."""
        command(self._run)()

    def _run(self) -> None:
        arguments = self.make_parser().parse_args(namespace=argparse.Namespace(role=self.role))
        reports = Reports(arguments.namespace)

        def receive(name: str, message: bytes, *_: Any) -> None:
            if name == DIAGNOSTICS and (received := read_message(name, message)) is not None:
                reports.receive(time.monotonic(), received[1])

        with closing(GraphClient(arguments.namespace, receive)) as client:
            print(self.request(client, arguments, reports))


def _parse_duration(text: str) -> float:
    """Return a duration (s) such as ``30min``; a number without a unit is in hours."""
    unit = next(unit for unit in _UNITS if text.endswith(unit))
    return _read_number(text.removesuffix(unit)) * _UNITS[unit]


# argparse and the documentation show this name.
_parse_duration.__name__ = "TIME"


def _add_duration(parser: Parser, *, required: bool) -> None:
    parser.add_argument(
        "--for", dest="seconds", type=_parse_duration, required=required, metavar="TIME",
        help="length, such as 30min, 48h, 2d or 48 (hours)",
    )


def _add_hold_options(parser: Parser) -> None:
    _add_duration(parser, required=False)
    parser.add_argument("--reason", default="", metavar="TEXT", help="reason for the hold")


def _hold(client: GraphClient, arguments: argparse.Namespace, _: Reports) -> str:
    """Keep the {device} {off} until '{group} release' or for a given time.

    It stays {off} regardless of its command, and even after a restart. There is only one hold at a
    time: a new hold replaces the owner and the reason of the earlier hold, but never ends before
    the earlier hold would have ended.

    Examples:
      {prog} --reason 'the roof is being repaired'
      {prog} --for 48h
    """
    seconds = arguments.seconds
    end = {} if seconds is None else {"until": time.time() + seconds}
    return client.request(
        "stop", _PATIENCE_S, arguments.role, owner=_OWNER, reason=arguments.reason, **end
    )


def _release(client: GraphClient, arguments: argparse.Namespace, _: Reports) -> str:
    """End the hold of the {device}, whoever requested it.

    The {device} then {starts} automatically when the controller requires it and nothing else keeps
    it {off}. A fault is not cleared.
    """
    return client.request("release", _PATIENCE_S, arguments.role)


def _open(client: GraphClient, arguments: argparse.Namespace, _: Reports) -> str:
    """Open the valve of the cistern's low outlet for a limited time, regardless of its command.

    It closes earlier if an interlock requires that, or by '{group} close'.

    Example:
      {prog} --for 30min
    """
    until = time.time() + arguments.seconds
    return client.request("open", _PATIENCE_S, VALVE, owner=_OWNER, until=until)


def _add_dose_options(parser: Parser) -> None:
    volume = make_number_type(1.0, 1e9)
    parser.add_argument("--litres", type=volume, required=True, metavar="L", help="volume (litres)")


def _dose(client: GraphClient, arguments: argparse.Namespace, reports: Reports) -> str:
    """Deliver a volume now, and print the progress until the dose ends.

    The volume is delivered regardless of the controller's command, if the site file allows doses
    (max_dose) and no interlock is active. A dose never fills the roof above its target. If an
    interlock becomes active, or if the pump cannot start within a minute, the dose is abandoned and
    does not resume. Ctrl-C ends this command but not the dose; to end the dose, stop the pump.

    Example:
      {prog} --litres 200
    """
    requested_at, sentence = time.time(), ""
    client.request("dose", _PATIENCE_S, volume=arguments.litres / 1000, asked_at=requested_at)
    accepted = time.monotonic()
    print(f"dose {requested_at:.6f} of {arguments.litres:g} litres was accepted", flush=True)
    while True:
        time.sleep(_POLL_S)
        client.receive()
        now, pump = time.monotonic(), reports.node(PUMP)
        if now - max(accepted, pump.received_at if pump else 0.0) > _REPORT_S:
            raise RequestError("it is unknown whether the dose continues: the pump node is silent")
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
    parser.add_argument("--yes", action="store_true", help="do not ask, for use in scripts")


def _reset(client: GraphClient, arguments: argparse.Namespace, reports: Reports) -> str:
    """Clear a latched fault of the {device}, in its node and in its drive or relay.

    The command is intended for a person standing at the {device} who has remedied the cause of the
    fault, and asks for confirmation first. A hold stays in force until '{group} release'. After a
    reset, the {device} {starts} when the controller requires it and nothing else keeps it {off}.
    """
    if not arguments.yes:
        until = time.monotonic() + _REPORT_S
        while (node := reports.node(arguments.role)) is None and time.monotonic() < until:
            time.sleep(_POLL_S)
            client.receive()
        if node is not None and (fault := node.values.get("fault")):
            print(escape(f"The fault: {fault}"), file=sys.stderr)
        print(
            f"The {arguments.role} may start moving as soon as the fault is cleared. Have you "
            "remedied its cause, and made sure that no one is working on it? [y/N] ", end="",
            flush=True,
        )
        if sys.stdin.readline().strip().lower() not in ("y", "yes"):
            raise RequestError("not cleared: the request was not confirmed")
    return client.request("reset", _PATIENCE_S, arguments.role)


HOLD = Request("hold", _hold, _add_hold_options)
RELEASE = Request("release", _release)
RESET = Request("reset", _reset, _add_reset_options)
DOSE = Request("dose", _dose, _add_dose_options)
OUTLET_OPEN = Request("outlet open", _open, partial(_add_duration, required=True), VALVE)
OUTLET_CLOSE = replace(HOLD, name="outlet close", role=VALVE)
OUTLET_RELEASE = replace(RELEASE, name="outlet release", role=VALVE)
OUTLET_RESET = replace(RESET, name="outlet reset", role=VALVE)
