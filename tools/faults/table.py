"""The table of the campaign; ``python tools/faults/table.py RESULTS PAGE`` puts it in a page."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from faults.cases import MODES, SIMULATED, WAYS
from markdown_tables import head, row

# Beginnings and end of the tables, each for some rigs: relays, other network devices, and the rest.
_RELAYS, _NETWORK, _REST = (
    f"<!-- measured: make faults{of} -->\n" for of in (", relays", ", network", "")
)
_TABLES = {"relay": _RELAYS, "mqtt": _NETWORK, "service": _NETWORK}
_END = "<!-- end of table -->"
# Row of a fault, by the beginning of its name, or of rig and fault; the first match counts.
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
    "from the start": "a level of -1 mm, or no forecast file, from the start",
    "fails": "a forecast service that fails for six hours",
    "site": "a burst pipe, a closed valve, a leak",
    "state file": "the pump node killed, and its state file lost or broken",
    "timeout rewritten": "another client lengthens the drive's timeout, and orders are refused",
    "flapping": "a level sensor that comes and goes, with a full list of incidents",
    "4000 changes": "4,000 changes of a parameter",
    "use_sim_time": "`use_sim_time` set on a live node",
    "coarse": "a coarse level sensor",
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
    """Return the prefix that selects a result's row."""
    rig, fault = _rig(result), result["fault"]
    return next(
        kind for kind in _KINDS
        if (f"{rig}/{fault}" if "/" in kind else fault).startswith(kind)
    )


def table(results: list[dict[str, Any]]) -> str:
    """Return the results in Markdown: a row for each kind of fault in each way."""
    kinds = list(_KINDS)
    groups: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for result in results:
        place = WAYS.index(result["way"]), kinds.index(_kind(result))
        groups.setdefault(place, []).append(result)
    failed = sum(bool(result["wrong"]) for result in results)
    minutes = sum(result["wall_s"] for result in results) / 60
    return "\n".join([
        head(["way", "fault", "cases", "worst (s)", "nearest to its bound", "lost, worst",
              "outcome"]),
        *(row([WAYS[way], _KINDS[kinds[kind]], *_cells(WAYS[way], group)])
          for (way, kind), group in sorted(groups.items(), key=lambda item: item[0])),
        "", f"{len(results)} cases, {failed} failed; together {minutes:.0f} minutes, side by side.",
    ])


def _cells(way: str, results: list[dict[str, Any]]) -> list[str]:
    times = [(result["to_safe"], result["bound"]) for result in results
             if result["to_safe"] is not None]
    bounded = [time for time in times if time[1]]
    near = max(bounded, key=lambda time: time[0] / time[1], default=None)
    lost = [result["lost"] for result in results if result["lost"] is not None]
    failed = sum(bool(result["wrong"]) for result in results)
    return [
        str(len(results)),
        f"{max(times)[0]:.1f}" if times else "",
        f"{near[0]:.1f} of {near[1]:.1f} s" if near else "",
        f"{max(lost):.3g} {'ticks' if way == SIMULATED else 's'}" if lost else "",
        f"**{failed} failed**" if failed else _outcome(results),
    ]


# A pump that runs again this soon after the fault has run on (s).
_AT_ONCE_S = 1.0


def _outcome(results: list[dict[str, Any]]) -> str:
    """Return the most frequent recovery, then the others."""
    counts = Counter(
        "ran on" if result["to_safe"] is None and result["recovered"] is not None
        and result["recovered"] < _AT_ONCE_S else result["recovery"] for result in results
    )
    return ", ".join(text for text, _ in counts.most_common() if text) or "as specified"


def insert_table(page: Path, mark: str, results: list[dict[str, Any]]) -> None:
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
        insert_table(written, mark, [
            result for result in every if _TABLES.get(_rig(result), _REST) == mark
        ])
