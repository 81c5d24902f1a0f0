"""The table of the campaign; ``python tools/faults/table.py RESULTS PAGE`` puts it in a page."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from faults.cases import MODES, SIMULATED, WAYS

# How the tables begin, each of some rigs, and end: of relays, of what else comes over the network,
# and of the rest.
_RELAYS, _NETWORK, _REST = (
    f"<!-- measured: make faults{of} -->\n" for of in (", relays", ", network", "")
)
_TABLES = {"relay": _RELAYS, "mqtt": _NETWORK, "service": _NETWORK}
_END = "<!-- end of table -->"
# What a reader looks for, by the beginning of a fault's name, or of rig and fault; the first fits.
_KINDS = {
    "kill both": "pump node and bringup killed together",
    "kill": "a process killed (`kill -9`)",
    "term": "a process ended (SIGTERM)",
    "stop short": "a process stopped for 0.2 to 0.6 s",
    "stop long": "a process stopped for longer",
    "rtu/drive": "the drive, on a serial line",
    "relay/broker": "the broker killed, restarted, stopped, or its connection half-open",
    "power cycle": "the drive loses power, then the pump node is killed",
    "drive": "the drive and its line",
    "unstoppable": "a motor that cannot be stopped (time to the alarm)",
    "sensor line": "the line of a level sensor",
    "sensor": "a level sensor",
    "broker": "the broker of the sensors on MQTT",
    "forecast file": "the forecast file",
    "fails": "a forecast service that fails for six hours",
    "site": "a burst pipe, a closed valve, a leak",
    "dry": "a cistern that runs empty",
    "stuck for ever": "a command that never changes",
    "full disk": "a full disk",
    "10000 hostile": "10,000 hostile messages on a topic",
    "intruder": "a second publisher of a topic",
    "second pump": "a second pump node",
    "second controller": "a second controller",
    "second graph": "a second bringup",
    "four readers": "four readers stopped for 6.5 s, 50 times",
    **{mode: f"a topic: *{mode}*" for mode in MODES},
}


def read_results(directory: Path) -> dict[str, dict[str, Any]]:
    """Return the last result of each case."""
    file = directory / "results.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return {result["id"]: result for result in map(json.loads, lines)}


def _rig(result: dict[str, Any]) -> str:
    """Return the kind of a result's rig."""
    return str(result["id"]).partition("/")[0].partition(":")[0]


def _kind(result: dict[str, Any]) -> str:
    """Return the beginning by which a result's row is known."""
    rig, fault = _rig(result), result["fault"]
    return next(
        kind for kind in _KINDS
        if (f"{rig}/{fault}" if "/" in kind else fault).startswith(kind)
    )


def table(results: Iterable[dict[str, Any]]) -> str:
    """Return the results in Markdown: a row for each kind of fault in each way."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault((result["way"], _kind(result)), []).append(result)
    kinds = list(_KINDS)
    lines = [
        "| way | fault | cases | worst (s) | nearest to its bound | lost, worst | outcome |",
        "|---|---|---|---|---|---|---|",
    ]
    for way, kind in sorted(groups, key=lambda one: (WAYS.index(one[0]), kinds.index(one[1]))):
        lines.append(f"| {way} | {_KINDS[kind]} | {_row(way, groups[way, kind])} |")
    every = [one for those in groups.values() for one in those]
    failed = sum(bool(one["wrong"]) for one in every)
    minutes = sum(one["wall_s"] for one in every) / 60
    return "\n".join([
        *lines, "", f"{len(every)} cases, {failed} failed; together "
        f"{minutes:.0f} minutes, side by side.",
    ])


def _row(way: str, those: list[dict[str, Any]]) -> str:
    safe = [one for one in those if one["to_safe"] is not None]
    times = [one["to_safe"] for one in safe]
    near = [f"{one['to_safe']:.1f} of {one['bound']:.1f} s" for one in sorted(
        (one for one in safe if one["bound"]), key=lambda one: one["to_safe"] / one["bound"]
    )]
    lost = [one["lost"] for one in those if one["lost"] is not None]
    failed = sum(bool(one["wrong"]) for one in those)
    unit = "ticks" if way == SIMULATED else "s"
    return " | ".join([
        str(len(those)),
        f"{max(times):.1f}" if times else "",
        near[-1] if near else "",
        f"{max(lost):.3g} {unit}" if lost else "",
        f"**{failed} failed**" if failed else _outcome(those),
    ])


# A pump that runs so soon after the fault (s) has run on.
_AT_ONCE_S = 1.0


def _outcome(those: list[dict[str, Any]]) -> str:
    """Return how most went on, then the others."""
    counts = Counter(
        "ran on" if result["to_safe"] is None and result["recovered"] is not None
        and result["recovered"] < _AT_ONCE_S else result["recovery"] for result in those
    )
    return ", ".join(said for said, _ in counts.most_common() if said) or "as specified"


def put(page: Path, mark: str, results: list[dict[str, Any]]) -> None:
    """Put a table in a page, if there are results for it."""
    before, begin, rest = page.read_text().partition(mark)
    _, end, after = rest.partition(_END)
    assert begin and end, f"{page} has no {mark.strip()} with {_END}"
    if results:
        page.write_text(f"{before}{begin}\n{table(results)}\n\n{end}{after}")


if __name__ == "__main__":
    read, written = map(Path, sys.argv[1:])
    every = read_results(read).values()
    for mark in (_RELAYS, _NETWORK, _REST):
        put(written, mark, [one for one in every if _TABLES.get(_rig(one), _REST) == mark])
