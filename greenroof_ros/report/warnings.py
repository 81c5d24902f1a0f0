"""What a reader should know of the runs before their results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from greenroof_ros.report.entries import FailedRun, RunEntry, counted
from greenroof_ros.report.results import Report
from greenroof_ros.report.seasons import seasons
from greenroof_ros.report.seeds import spreads

# Two-sided, a sign test of five years that all say the same has 6 %, of six 3 %.
_LEAST_YEARS = 6
# A tenth of less is no whole run.
_LEAST_SEEDS = 10


class RunWarning(NamedTuple):
    """A sentence, what it lists, and the names of the runs that it is about."""

    text: str
    listed: str
    runs: list[str]


def cautions(report: Report, failed: Sequence[FailedRun]) -> list[str]:
    """Return what changes how the numbers are to be read, each in a few words."""
    runs = report.results
    total = len(report.entries)
    found = []
    broken = [one.entry for one in runs if one.entry.ending is not None]
    if broken and total == 1:
        assert broken[0].ending is not None
        found.append(f"this run {broken[0].ending.sentence}: what follows is of what was recorded")
    elif broken:
        found.append(
            f"{len(broken)} of {total} runs are not done: what follows of them is of what was "
            "recorded"
        )
    if failed:
        count = counted(len(failed), "run")
        found.append(f"{count} failed or did not run, and left nothing to show")
    hurt = [one.entry.incident_count for one in runs if one.entry.incidents]
    if hurt:
        of = "" if total == 1 else f" in {len(hurt)} of {total} runs"
        found.append(
            f"{counted(sum(hurt), 'incident')}{of}: something was lost while the run went on"
        )
    return [*found, *filter(None, (few_years(report), few_seeds(report)))]


def few_years(report: Report) -> str:
    """Say that there are too few years to tell controllers apart, where that is so."""
    years = min((len(one.years) for one in seasons(report)), default=_LEAST_YEARS)
    if years >= _LEAST_YEARS:
        return ""
    return f"only {years} years: with fewer than {_LEAST_YEARS}, a lead in all may be chance"


def few_seeds(report: Report) -> str:
    """Say that there are too few seeds for a tenth of them, where that is so."""
    seeds = min((len(one.totals) for one in spreads(report)), default=_LEAST_SEEDS)
    if seeds >= _LEAST_SEEDS:
        return ""
    return f"only {seeds} seeds: with fewer than {_LEAST_SEEDS}, the worst tenth is a single run"


def make_warnings(report: Report) -> list[RunWarning]:
    """Return what a reader should know, each with the runs that it is about."""
    found: dict[tuple[str, str], list[str]] = {}

    def warn(text: str, entry: RunEntry, listed: str = "") -> None:
        sentence = f"{text[0].upper()}{text[1:].removesuffix('.')}."
        found.setdefault((sentence, listed), []).append(entry.name)

    for one in report.results:
        if one.entry.ending is not None:
            warn(f"{one.entry.ending.sentence}; what follows is of what was recorded", one.entry)
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
        if one.entry.incidents:
            warn(
                f"{one.entry.ended}: something was lost while the run went on; the table of "
                "incidents says what, when and why", one.entry,
            )
        for note in one.notes:
            warn(str(note), one.entry, note.listed)
    too_few = few_seeds(report)
    for entry in report.seeded:
        if too_few:
            warn(too_few, entry)
        warn(
            "these runs differ only in the seed of their forecasts' errors from others. They are "
            "judged together, by results.csv: the tables of single runs, with energy, pump starts "
            "and water balance, and the figures of weather, trajectories and balances leave them "
            "out, and these warnings say nothing of their commands and frost", entry,
        )
        for note in entry.notes:
            warn(note.of_many(), entry, note.listed)
    too_few = few_years(report)
    for entry in report.seasons:
        if too_few:
            warn(too_few, entry)
        warn(
            "these runs are the same season of several years. They are judged together, by "
            "results.csv; what follows says nothing of their commands and frost", entry,
        )
        for note in entry.notes:
            warn(note.of_many(), entry, note.listed)
    return [RunWarning(text, listed, runs) for (text, listed), runs in found.items()]
