"""Print the current state of the run or the site in this ROS domain.

It consists of levels, pump, rain and forecast, controller and alarms, with the same wording as the
page of 'greenroof watch'. The command publishes nothing. It listens for 2 s after it has found a
node, or for 5 s if values are missing or no graph is running.

Examples:
  greenroof status
  ssh pi@roof greenroof status          from another machine
  greenroof status --namespace site1

Exit codes, as used by monitoring plug-ins: 0 all is well, 1 warning, 2 alarm, 3 no graph is
running, the command failed, or bad usage
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from greenroof_ros.base.command_line import EXIT_DONE, Parser, command
from greenroof_ros.commands.watch import open_store
from greenroof_ros.interface.states import VALVE
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.store import GraphStore

WARNING, ALARM, NOTHING = 1, 2, 3

# Shortest time for which it subscribes once it has found a node, and longest time in all (s). Every
# node reports at least once a second, but the middleware may take seconds to find it.
_SETTLED_S, _MAX_S = 2.0, 5.0
_POLL_S = 0.1
_TILES = "roof", "cistern", "pump", VALVE, "watering", "rain", "temperature"
_LEVELS = {"error": "Alarm", "warn": "Warning"}


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("status", __doc__)
    add_namespace(parser)
    return parser


@partial(command, failed=NOTHING)
def main() -> int:
    """Print the status, and return its severity as an exit code."""
    arguments = make_parser().parse_args()
    store = open_store(arguments.namespace)
    with Feed(store):
        shown = _read_status(store)
    code = _judge(shown)
    print("\n".join(_write_lines(shown, code)))
    return code


def _read_status(store: GraphStore) -> dict[str, Any]:
    """Return the document once all values are known, or once the time limit has passed."""
    end, settled = time.monotonic() + _MAX_S, math.inf
    while True:
        time.sleep(_POLL_S)
        now = time.monotonic()
        shown = make_document(store, now)
        if shown["mode"] != "none":
            settled = min(settled, now + _SETTLED_S)
        complete = now >= settled and shown["known"] and not _find_unknown(shown)
        if complete or now >= end:
            return shown


def _find_unknown(shown: Mapping[str, Any]) -> set[str]:
    """Return the names of the tiles whose values are unknown."""
    tiles = shown["tiles"]
    return {name for name in _TILES if name in tiles and tiles[name]["state"] == "unknown"}


def _judge(shown: Mapping[str, Any]) -> int:
    """Return the exit code: of the alarms, of unknown values, or of a live site that is gone.

    At a live site, unknown values without known alarms are an alarm, since the pump may be running.
    A level outside its range is not in itself an alarm, since a controller that is waiting for rain
    lets the roof dry out.
    """
    mode, level = shown["mode"], shown["tiles"]["summary"]["level"]
    unknown = _find_unknown(shown) - {"rain", "temperature"}
    if mode == "ended" or (mode == "none" and level != "error"):
        return NOTHING
    if level == "error" or (unknown and mode == "live" and not shown["known"]):
        return ALARM
    return WARNING if unknown or shown["alarms"] or not shown["known"] else EXIT_DONE


def _write_lines(shown: Mapping[str, Any], code: int) -> list[str]:
    tiles, summary, advice = shown["tiles"], shown["tiles"]["summary"]["text"], shown["advice"]
    if code == NOTHING:
        return [f"{summary} {advice}"]
    where = filter(None, (shown["heading"], shown["namespace"], shown["time"]["text"]))
    lines = [summary, f"What to do: {advice}", "; ".join(where)]
    for tile in [tiles[name] for name in _TILES if name in tiles]:
        lines.append(f"{tile['label']:14} {tile['value']:14} {tile['sentence']}".rstrip())
    lines += [
        f"{_LEVELS[row['level']]}. {row['what']} since {row['since_text']}. {row['do']}"
        for row in shown["alarms"]
    ]
    return [*lines, *filter(None, [shown["contact"]]), *shown["notes"]]
