"""The table of the campaign; ``python tools/faults/table.py RESULTS PAGE`` puts it in a page."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from faults.cases import MODES
from markdown_tables import head, row

_BEGIN, _END = "<!-- measured: make faults -->\n", "<!-- end of table -->"
# Rows, and how their faults begin, or their rig and fault; the first match decides.
_ROWS = {
    "pump node and bringup killed together": ("kill both",),
    "a motor that cannot be stopped (time to the alarm)": ("unstoppable",),
    "an outlet valve that does not follow (time to the alarm)": ("valve alarm",),
    "a relay, its broker and the pump node": ("relay/",),
    "a user's own pump driver killed, stopped or held": ("own driver/",),
    "an outlet valve, its relay, sensors and processes": (
        "valve/", "valve with switches/", "valve by hand/", "valve max_run/",
        "valve max_volume_per_day/", "valve moves/",
    ),
    "a process killed, ended or stopped": ("kill", "term", "stop"),
    "a drive, its line, power and timeout": ("drive", "power cycle", "timeout rewritten"),
    "level sensors, their lines and broker": (
        "sensor", "broker", "coarse", "from the start", "flapping",
    ),
    "forecast file": ("forecast file",),
    "burst pipe, closed valve, leak, empty cistern, endless command": (
        "site", "dry", "stuck for ever",
    ),
    "disk, state file, parameters": (
        "full disk", "failing disk", "state file", "4000 changes", "use_sim_time",
    ),
    "hostile messages, a second publisher, pump node, controller or bringup": (
        "10000 hostile", "intruder", "second",
    ),
    "four readers stopped, 10 times": ("readers",),
    "values of a topic missing, stuck, wrong or late": MODES,
}


def read_results(directory: Path) -> dict[str, dict[str, Any]]:
    """Return the last result of each case."""
    file = directory / "results.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return {result["id"]: result for result in map(json.loads, lines)}


def _row(result: dict[str, Any]) -> str:
    """Return the row of a result."""
    fault = str(result["fault"])
    rig = str(result["id"]).partition("/")[0].partition(":")[0]
    return next(
        name for name, beginnings in _ROWS.items()
        if any((f"{rig}/" if each.endswith("/") else fault).startswith(each) for each in beginnings)
    )


def table(results: list[dict[str, Any]]) -> str:
    """Return the results in Markdown: a row for each kind of fault."""
    groups: dict[str, list[dict[str, Any]]] = {name: [] for name in _ROWS}
    for result in results:
        groups[_row(result)].append(result)
    return "\n".join([
        head(["fault", "cases", "failed", "closest to its bound"]),
        *(row([name, *_cells(group)]) for name, group in groups.items()),
        row(["together", *_cells(results)]),
    ])


def _cells(results: list[dict[str, Any]]) -> list[str]:
    times = [
        (result["to_safe"], result["bound"]) for result in results
        if result["to_safe"] is not None and result["bound"]
    ]
    near = max(times, key=lambda time: time[0] / time[1], default=None)
    return [
        str(len(results)), str(sum(bool(result["wrong"]) for result in results)),
        f"{near[0]:.1f} of {near[1]:.1f} s" if near else "",
    ]


def insert_table(page: Path, results: list[dict[str, Any]]) -> None:
    """Put the table in a page."""
    before, begin, rest = page.read_text().partition(_BEGIN)
    _, end, after = rest.partition(_END)
    assert begin and end, f"{page} has no {_BEGIN.strip()} with {_END}"
    page.write_text(f"{before}{begin}\n{table(results)}\n\n{end}{after}")


if __name__ == "__main__":
    read, written = map(Path, sys.argv[1:])
    insert_table(written, list(read_results(read).values()))
