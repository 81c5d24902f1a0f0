"""The table of the campaign, for doc/faults.md."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

_BEGIN, _END = "<!-- measured: make faults -->\n", "<!-- end of table -->"


def put_table(text: str, file: Path) -> None:
    """Put a table between its markers in a page."""
    before, begin, rest = file.read_text().partition(_BEGIN)
    _, end, after = rest.partition(_END)
    assert begin and end, f"{file} has no {_BEGIN.strip()} with {_END}"
    file.write_text(f"{before}{begin}\n{text}\n\n{end}{after}")


def _percentile(values: list[float], share: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(share * len(ordered)))]


def table(results: Iterable[dict[str, Any]]) -> str:
    """Return the results in Markdown: a row for each fault and way."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault((_name(result), result["way"]), []).append(result)
    lines = [
        "| fault | way | cases | time to safe, worst (s) | 99 % (s) | bound (s) | lost, worst "
        "| outcome |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (name, way), those in sorted(groups.items()):
        times = [one["to_safe"] for one in those if one["to_safe"] is not None]
        bounds = [one["bound"] for one in those if one["to_safe"] is not None]
        lost = [one["lost"] for one in those if one["lost"] is not None]
        failed = sum(bool(one["wrong"]) for one in those)
        unit = "ticks" if way == "simulated" else "s"
        lines.append(
            f"| {name} | {way} | {len(those)} | "
            + (f"{max(times):.1f} | {_percentile(times, 0.99):.1f} | {max(bounds):.1f}"
               if times else "runs on | | ")
            + f" | {f'{max(lost):.3g} {unit}' if lost else ''} | "
            + (f"{failed} failed" if failed else _outcome(those)) + " |"
        )
    total = len([one for those in groups.values() for one in those])
    failed = len([one for those in groups.values() for one in those if one["wrong"]])
    return "\n".join([*lines, "", f"{total} cases, {failed} failed."])


def _name(result: dict[str, Any]) -> str:
    kind = result["id"].partition("/")[0].partition(":")[0]
    where = {"pump": "pump node alone: "}.get(kind, "")
    return f"{where}{result['fault']}, {result['target']}"


def _outcome(those: list[dict[str, Any]]) -> str:
    words = {one["recovery"].split(" after")[0].split(":")[0] for one in those if one["recovery"]}
    reset = any("~/reset" in one["recovery"] for one in those)
    if reset:
        return "latched until `~/reset`"
    return "; ".join(sorted(words)) or "as specified"
