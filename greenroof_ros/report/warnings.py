"""What a reader should know of the runs before their results."""

from __future__ import annotations

from typing import NamedTuple

from greenroof_ros.report.entries import RunEntry
from greenroof_ros.report.results import Report


class RunWarning(NamedTuple):
    """A sentence, what it lists, and the names of the runs that it is about."""

    text: str
    listed: str
    runs: list[str]


def make_warnings(report: Report) -> list[RunWarning]:
    """Return what a reader should know, each with the runs that it is about."""
    found: dict[tuple[str, str], list[str]] = {}

    def warn(text: str, entry: RunEntry, listed: str = "") -> None:
        sentence = f"{text[0].upper()}{text[1:].removesuffix('.')}."
        found.setdefault((sentence, listed), []).append(entry.name)

    for one in report.results:
        if one.assessment.metrics["beyond_hours"] > 0:
            warn(
                "the command was above 1, which asks for more than the pumps have: no real pump "
                "can follow it", one.entry,
            )
        if one.assessment.metrics["excess_starts"] > 0:
            limit = one.entry.site.starts_per_hour
            warn(
                f"the pumps started more than {limit:g} times in an hour, which is all that they "
                "may (starts_per_hour of the site file)", one.entry,
            )
        if one.assessment.frost_hours > 0:
            pumped = one.assessment.frost_pumped_m3 > 0
            warn("there was frost, and in it something was pumped" if pumped
                 else "there was frost; nothing was pumped in it", one.entry)
        for note in one.notes:
            warn(str(note), one.entry, note.listed)
    for entry in report.seeded:
        warn(
            "these runs differ only in the seed of their forecasts' errors from others. They are "
            "judged together, by results.csv: the tables of single runs, with energy, pump starts "
            "and water balance, and the figures of weather, trajectories and balances leave them "
            "out, and these warnings say nothing of their commands and frost", entry,
        )
        for note in entry.notes:
            warn(note.of_many(), entry, note.listed)
    for entry in report.seasons:
        warn(
            "these runs are the same season of several years. They are judged together, by "
            "results.csv; what follows says nothing of their commands and frost", entry,
        )
        for note in entry.notes:
            warn(note.of_many(), entry, note.listed)
    return [RunWarning(text, listed, runs) for (text, listed), runs in found.items()]
