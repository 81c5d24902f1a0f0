"""The sentences of a report: its summary, and cautions about its numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from greenroof_ros.analysis.report.groups import (
    SEASONS,
    SEEDS,
    SINGLE,
    TOTAL,
    Report,
    by_place,
    heading,
    lowest,
    who,
)
from greenroof_ros.analysis.report.run import Note, ReportedRun, Row, controller_name
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.recording.results_table import shortest

LEADING = (
    "sizing", "season-comparisons", "seasons", "forecast-errors", "total-deviation-1",
    "trajectories-1-1",
)
"""a report begins with the first of these figures that it has"""

# Up to this many results are named one by one.
_MOST_NAMED = 3
_FORMS = {metric.name: metric.form for metric in METRICS}
# By kind of cases: what can be too few, the minimum number, and why. A two-sided sign test of five
# years that all agree has 6 %, of six years 3 %; a tenth of nine seeds is less than one run.
_FEWEST = {
    SEASONS: ("years", 6, "a lead in all may be chance"),
    SEEDS: ("seeds", 10, "the worst tenth is a single run"),
}


# --- summary --------------------------------------------------------------------------------------


def sentences(report: Report) -> list[str]:
    """Return two or three sentences: what was run, the results, and what else is notable."""
    if report.of(SEASONS):
        return _of_seasons(report)
    if report.of(SEEDS):
        return _of_seeds(report)
    if len(report.runs) == 1:
        return _of_run(report, report.single[0])
    return _of_several(report)


def _windows(report: Report) -> list[str]:
    """Name all sets of conditions of the runs."""
    seeds: dict[str, set[str]] = {}
    for row in report.table.filter(kind=SEEDS).to_dicts():
        named = {**row, "forecast": f"{row['forecast']} skill {row['skill']}"}
        seeds.setdefault(report.heading(named), set()).add(row["seed"])
    return [
        *map(report.heading, report.windows(SINGLE)),
        *(f"{window}, {len(drawn)} seeds" for window, drawn in seeds.items()),
        *_seasons(report),
    ]


def _seasons(report: Report) -> list[str]:
    """Name the seasons, each with its years."""
    apart = [*report.differing_facts(SEASONS), "start", "length"]
    years: dict[str, set[int]] = {}
    for row in report.table.filter(kind=SEASONS).to_dicts():
        years.setdefault(heading(row, apart), set()).add(row["year"])
    return [
        f"{name}, {min(ran)} to {max(ran)}" if max(ran) - min(ran) + 1 == len(ran)
        else f"{name}, {', '.join(map(str, sorted(ran)))}"
        for name, ran in years.items()
    ]


def _and(parts: Iterable[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _m3(name: str, value: float | None) -> str:
    return "an unknown volume" if value is None else f"{value:{_FORMS[name]}} m³"


def _deviation(value: float) -> str:
    return _m3(TOTAL, value)


def _mean_deviation(row: Row) -> str:
    """Write the mean deviation of a season (mm); if that is unknown, the sum over its ticks."""
    mean = row["mean_deviation_mm"]
    return _deviation(row[TOTAL]) if mean is None else f"{mean:{_FORMS['mean_deviation_mm']}} mm"


def _relative_to_best(row: Row) -> str:
    return "" if row["ratio"] is None else f", {row['ratio']:.4g} times the minimum possible"


def _runs(report: Report, where: Sequence[str], initials: Sequence[str] = ()) -> str:
    """State how many runs there are, with their controllers and conditions."""
    counts = {name: len(report.settings[name].labels) for name in report.controllers}
    of = _and(
        controller_name(name) + (f" ({count} settings)" if count > 1 else "")
        for name, count in counts.items()
    )
    if initials:
        many = len(initials) > _MOST_NAMED
        of += f", from {f'{len(initials)} initial states' if many else _and(initials)}"
    place = where[0] if len(where) == 1 else f"{len(where)} sets of conditions"
    return f"{len(report.runs)} runs of {of}: {place}."


def _of_run(report: Report, row: Row) -> list[str]:
    label = controller_name(row["controller"]) + f" ({row['setting']})" * bool(row["setting"])
    near = row["near_target_hours"]
    return [
        f"A run of {label}: {heading(row, ['site'])}, from {row['from']}: {row['ended']}.",
        f"The roof's total deviation from its target was {_deviation(row[TOTAL])}"
        f"{_relative_to_best(row)}; it was near the target for "
        f"{'an unknown part' if near is None else f'{near:.2f}'} "
        f"of {shortest(round(row['hours'], 2))} h.",
        f"The pumps started {counted(int(row['pump_starts'] or 0), 'time')} and lifted "
        f"{_m3('pumped_m3', row['pumped_m3'])}, {_m3('outflow_m3', row['outflow_m3'])} went "
        f"to the sewer, and {_m3('drainage_m3', row['drainage_m3'])} drained off the roof.",
    ]


def _of_several(report: Report) -> list[str]:
    single = report.single
    totals = [row[TOTAL] for row in single]
    pumped = [row["pumped_m3"] for row in single if row["pumped_m3"] is not None] or [0.0]
    return [
        _runs(report, _windows(report), report.initials),
        _smallest(report),
        f"Over all runs the total deviation was {min(totals):.2f} to {_deviation(max(totals))}, "
        f"and {min(pumped):.4g} to {_m3('pumped_m3', max(pumped))} were pumped.",
    ]


def _smallest_of(
    places: Sequence[Sequence[Row]], what: str, deviation: str, named: Callable[..., str]
) -> str:
    """State what had the smallest deviation in each place; for many, which controller how often.

    A tie between controllers is treated as shared.
    """
    if not places:
        return f"All lack years or seeds: it is open which has the smallest {deviation}."
    if len(places) <= _MOST_NAMED:
        return f"The smallest {deviation} was {_and(named(*rows) for rows in places)}."
    wins: Counter[str] = Counter()
    for rows in places:
        names = {controller_name(row["controller"]) for row in lowest(rows)}
        wins[f"with {names.pop()}" if len(names) == 1 else "shared"] += 1
    won = _and(f"{label} in {count}" for label, count in wins.most_common())
    return f"Of {len(places)} {what} the smallest {deviation} was {won}."


def _smallest(report: Report) -> str:
    """State which run had the smallest deviation; for many places, which controller how often."""
    apart = report.differing_facts()

    def named(*here: Row) -> str:
        rows = sorted(here, key=lambda row: row[TOTAL])
        first, best = rows[0], lowest(rows)
        others = rows[len(best):]
        text = _deviation(first[TOTAL])
        if apart:
            text += f" in {heading(first, apart, apart)}"
        if len(report.initials) > 1:
            text += f" from {first['from']}"
        label = _and(map(who, best)) if others or not rows[1:] else "regardless of the controller"
        text += f" ({label}{_relative_to_best(first)}"
        return text + (f"; {who(others[0])} had {others[0][TOTAL]:.2f})" if others else ")")

    return _smallest_of(
        by_place(report.best()), "windows and initial states", "total deviation", named
    )


def _of_seeds(report: Report) -> list[str]:
    cases = report.of(SEEDS)

    def named(*rows: Row) -> str:
        row, label = rows[0], _and(map(who, rows))
        return f"{label} from {row['from']}, forecasts of skill {row['skill']}"

    groups: dict[object, list[Row]] = {}
    for row in cases:
        if not row["missing"]:
            groups.setdefault((row["place"], row["skill"]), []).append(row)
    worst = max(cases, key=lambda row: row["worst_tenth_m3"] / row[TOTAL] if row[TOTAL] else 0.0)
    return [
        _runs(report, _windows(report), list(dict.fromkeys(row["from"] for row in cases))),
        _smallest_of(
            [lowest(rows) for rows in groups.values()], "windows, initial states and skills",
            "mean total deviation over the seeds",
            lambda *rows: f"{_deviation(rows[0][TOTAL])} ({named(*rows)})",
        ),
        f"The seed matters most for {named(worst)}: {_deviation(worst[TOTAL])} on average, "
        f"{_deviation(worst['worst_tenth_m3'])} in the worst tenth.",
    ]


def _of_seasons(report: Report) -> list[str]:
    first = _runs(report, _seasons(report))  # these name the initial states
    if report.sizing:
        return [first, *_of_sizes(report.of(SEASONS))]
    best, apart = by_place(report.smallest), report.differing_facts(SEASONS)
    shown = [row["case"] for row in report.smallest] if len(best) <= _MOST_NAMED else []
    compared = [_relative_to_onoff(row) for row in report.relative_to_onoff if row["case"] in shown]

    def named(*rows: Row) -> str:
        row, label = rows[0], [f"{who(row)}, forecast {row['forecast']}" for row in rows]
        where = f", {heading(row, apart, apart)}" if apart else ""
        return f"{_mean_deviation(row)}{_relative_to_best(row)} ({', and '.join(label)}{where})"

    return [
        first,
        _smallest_of(best, "seasons and initial states", "mean deviation of a season", named),
        *([f"Relative to on/off in the same years it is {_and(compared)}."] if compared else []),
    ]


def _relative_to_onoff(row: Row) -> str:
    has = row["has"]
    value, low, high = (f"{ratio:.3f}" for ratio in has.mean)
    return f"{value} (95 %: {low} to {high}; less in {has.better} of {has.years} years)"


def _of_sizes(cases: Sequence[Row]) -> list[str]:
    saved = sorted(cases, key=lambda row: row["saved_m3"])

    def named(row: Row) -> str:
        return (
            f"{row['saved_m3']:.4g} m³ a season with a cistern of {row['cistern_size_m3']:.4g} m³ "
            f"for {row['roof_m2']:.4g} m² of green roof ({controller_name(row['controller'])}, "
            f"from {row['from']})"
        )

    spilt = [row["outflow_m3"] for row in cases]
    return [
        f"Mains water saved was from {named(saved[0])} to {named(saved[-1])}.",
        f"From {min(spilt):.4g} to {max(spilt):.4g} m³ a season went to the sewer.",
    ]


# --- cautions and warnings ------------------------------------------------------------------------


class RunWarning(NamedTuple):
    """A sentence, the items that it lists, and the names of the runs that it is about."""

    text: str
    listed: str
    runs: list[str]


def counted(number: int, what: str) -> str:
    """Return a number with its noun: ``1 run``, ``2 runs``."""
    return f"{number} {what}{'s' if number != 1 else ''}"


def cautions(report: Report) -> list[str]:
    """Return reasons to read the numbers with caution, each in a few words."""
    runs, total = report.runs.values(), len(report.runs)
    broken = [run.ending for run in runs if run.ending]
    hurt = [run.incident_count for run in runs if run.incidents]
    of = f" in {len(hurt)} of {total} runs" if total > 1 else ""
    return [text for there, text in (
        (broken, f"this run {''.join(broken)}: all results are for the recorded part only"
         if total == 1 else f"{len(broken)} of {total} runs are not complete: their results are "
         "for the recorded part only"),
        (report.failed, f"{counted(len(report.failed), 'run')} failed or did not run, and left "
         "nothing to show"),
        (hurt, f"{counted(sum(hurt), 'incident')}{of}: something was lost while the run went on"),
    ) if there] + list(_too_few(report).values()) + _missing(report)


def _missing(report: Report) -> list[str]:
    """Name the first cases that lack years or seeds that others have, and count the rest."""
    texts = [
        who(row) + (f" (forecast {row['forecast']})" if row["forecast"] != PERFECT else "")
        + f" ran {how} {row[what]} of {row[f'all_{what}']} {what}: its mean is of other {what}"
        for row in report.cases.to_dicts()
        for how, what in (("in", "years"), ("with as few as", "seeds"))
        if row[what] < row[f"all_{what}"]
    ]
    more = f"{len(texts) - _MOST_NAMED} more controllers or settings lack years or seeds"
    return texts[:_MOST_NAMED] + [more] * (len(texts) > _MOST_NAMED)


def _too_few(report: Report) -> dict[str, str]:
    """State if there are too few years or seeds, by kind of cases."""
    fewest = {
        kind: min((row[what] for row in report.of(kind)), default=minimum)
        for kind, (what, minimum, _) in _FEWEST.items()
    }
    return {
        kind: f"only {fewest[kind]} {what}: with fewer than {minimum}, {why}"
        for kind, (what, minimum, why) in _FEWEST.items() if fewest[kind] < minimum
    }


def make_warnings(report: Report) -> list[RunWarning]:
    """Return notes and warnings, each with the runs that it is about."""
    runs_of: dict[tuple[str, str], list[str]] = {}
    too_few = _too_few(report)
    for row in report.table.sort("kind", descending=True, maintain_order=True).to_dicts():
        run, kind = report.runs[row["run"]], row["kind"]
        texts = [*_of_results(row, run), *([too_few[kind]] if kind in too_few else [])]
        for note in (*map(Note, texts), *run.notes):
            text = note.text if kind == SINGLE else note.of_many or note.text
            sentence = f"{text[0].upper()}{text[1:].removesuffix('.')}."
            runs_of.setdefault((sentence, note.listed), []).append(row["run"])
    return [RunWarning(text, listed, runs) for (text, listed), runs in runs_of.items()]


def _of_results(row: Row, run: ReportedRun) -> list[str]:
    """Return the warnings from a run's ending, results and incidents."""
    above_1 = (row["max_command"] or 0) > 1 or (row["beyond_hours"] or 0) > 0
    return [text for there, text in (
        (run.ending, f"{run.ending}; all results are for the recorded part only"),
        (above_1, "the command was above 1, which is more than the pumps' maximum flow: no real "
         "pump can follow it"),
        (row["excess_starts"], f"the pumps started more than {run.site.starts_per_hour:g} times in "
         "an hour, the limit set by starts_per_hour in the site file"),
        ((row["frost_pumped_m3"] or 0) > 0, "water was pumped during frost"),
        (run.incidents, f"{run.ended}: something was lost while the run went on; the table of "
         "incidents lists what, when and why"),
    ) if there]
