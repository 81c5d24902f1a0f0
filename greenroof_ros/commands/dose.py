"""Deliver a given volume now: ``greenroof dose``."""

from __future__ import annotations

import math
import sys
import time
from contextlib import closing
from typing import Any

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    add_namespace,
    command,
    within,
)
from greenroof_ros.common.states import PUMP
from greenroof_ros.graph.domain import importing_ros
from greenroof_ros.watch import wire
from greenroof_ros.watch.graph_client import DIAGNOSTICS, GraphClient, PumpRequestError
from greenroof_ros.watch.registry import Registry

_PATIENCE_S = 20.0
# If the pump node is silent for longer than this (s), the fate of the dose is unknown.
_SILENT_S = 5.0
_POLL_S = 0.1


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof dose",
        description="Deliver a given volume now, regardless of the controller's command, if the "
        "site file allows it (max_dose) and no interlock is active, but never above the "
        "roof's target. An interlock ends a dose for good; a dose that cannot begin within a "
        "minute ends, too. Ctrl-C ends this command but not the dose: to end that, stop the pump.",
        epilog="example:\n  greenroof dose --volume 0.2\n\n"
        "exit codes: 0 delivered, 1 refused or ended early, 2 bad usage",
    )
    parser.add_argument(
        "--volume", type=within(0.001, 1e6), required=True, metavar="M3",
        help="volume to deliver (m3)",
    )
    add_namespace(parser)
    return parser


class _Progress:
    """What the pump node reports about a dose.

    Attributes:
        dose: its last report; None before the first.
        last_message: time of the node's last message (steady clock, s).
        accepted: time when the dose was accepted (steady clock, s).
        lost: whether the node no longer knows the dose, because it was restarted.
    """

    def __init__(self, namespace: str, requested_at: float) -> None:
        self.dose: dict[str, Any] | None = None
        self.last_message, self.accepted, self.lost = time.monotonic(), math.inf, False
        self._reports, self._requested_at = Registry(namespace), requested_at

    def receive(self, name: str, message: bytes, *_: Any) -> None:
        """Handle a message of the graph."""
        if name != DIAGNOSTICS or (received := wire.statuses(message)) is None:
            return
        now = time.monotonic()
        self._reports.receive(now, received[1])
        pump = self._reports.node(PUMP)
        if pump is None or pump.received_at != now:
            return
        self.last_message, dose = now, pump.values.get("dose")
        if isinstance(dose, dict) and dose.get("id") == self._requested_at:
            self.dose = dose
        elif self.dose is not None or now > self.accepted + _SILENT_S:
            self.lost = True


@command
def main() -> int:
    """Request a dose, and print its progress until it ends."""
    arguments = make_parser().parse_args()
    pump = f"{arguments.namespace}/pump"
    with importing_ros():
        requested_at, shown = time.time(), ""
        progress = _Progress(arguments.namespace, requested_at)
        with closing(GraphClient(arguments.namespace, progress.receive)) as client:
            client.find_pumps([pump])
            try:
                client.request_dose(arguments.volume, requested_at, _PATIENCE_S)
            except PumpRequestError as failure:
                print(f"error: {failure}", file=sys.stderr)
                return EXIT_FAILED
            progress.last_message = progress.accepted = time.monotonic()
            print(f"dose {requested_at:.6f} of {arguments.volume:g} m3 is accepted", flush=True)
            while progress.dose is None or not progress.dose.get("over"):
                client.receive(_POLL_S)
                if progress.lost:
                    print(f"{pump} was restarted, which ended the dose", flush=True)
                    return EXIT_FAILED
                if time.monotonic() - progress.last_message > _SILENT_S:
                    print(f"{pump} no longer responds: it is unknown whether the dose continues")
                    return EXIT_FAILED
                said = "" if progress.dose is None else str(progress.dose.get("said", ""))
                if said != shown:
                    shown = said
                    print(shown, flush=True)
    return EXIT_DONE if progress.dose.get("over") == "done" else EXIT_FAILED
