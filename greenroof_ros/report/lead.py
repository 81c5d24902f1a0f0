"""How a report begins: what was run, what came out, and the figure that shows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from greenroof_ros.model.metrics import METRICS
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.report.entries import counted
from greenroof_ros.report.results import Best, Report, Result, best_runs, heading
from greenroof_ros.report.season_tables import season_windows
from greenroof_ros.report.seasons import (
    MAY_BE_LUCK,
    Comparison,
    Seasons,
    comparisons,
    least_deviation,
    plain_onoff,
    seasons,
)
from greenroof_ros.report.seeds import Spread, seeded_windows, spreads
from greenroof_ros.report.settings import controller_name
from greenroof_ros.report.sizing import is_sizing, size_of

# The figure of a report is the first of these that it has.
LEADING = (
    "sizing", "season-comparisons", "seasons", "forecast-errors", "total-deviation-1",
    "trajectories-1-1",
)
# So many results are named one by one.
_MOST_NAMED = 3
_FORMS = {metric.name: metric.form for metric in METRICS}


def sentences(report: Report) -> list[str]:
    """Return three sentences: what was run, what came out, and what else is worth knowing."""
    if report.seasons:
        return _of_seasons(report)
    if report.seeded:
        return _of_seeds(report)
    if len(report.results) == 1:
        return _of_one(report, report.results[0])
    return _of_several(report)


def windows(report: Report) -> list[str]:
    """Name all windows of weather in which something ran."""
    return [
        *map(report.heading, report.windows), *seeded_windows(report), *season_windows(report),
    ]


def _and(parts: Iterable[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _m3(name: str, value: float) -> str:
    return f"{value:{_FORMS[name]}} m³"


def _deviation(value: float) -> str:
    return _m3("total_deviation_m3", value)


def _over_least(ratio: float | None) -> str:
    return "" if ratio is None else f", {ratio:.4g} times the least possible"


def _settings(report: Report, controller: str) -> str:
    """Name a controller, with its setting, or how many it has."""
    count = len(report.settings[controller].labels)
    name = controller_name(controller)
    return f"{name} ({count} settings)" if count > 1 else name


def _runs(report: Report, where: Sequence[str], initials: Sequence[str] = ()) -> str:
    """Say how many runs there are of whom, where."""
    of = _and(_settings(report, name) for name in report.controllers)
    if initials:
        many = len(initials) > _MOST_NAMED
        of += f", from {f'{len(initials)} initial states' if many else _and(initials)}"
    place = where[0] if len(where) == 1 else f"{len(where)} windows of weather"
    return f"{len(report.entries)} runs of {of}: {place}."


def _of_one(report: Report, one: Result) -> list[str]:
    totals, entry = one.assessment.metrics, one.entry
    who = controller_name(entry.controller)
    if entry.parameters:
        who += f" ({report.settings[entry.controller].full_label(entry)})"
    return [
        f"A run of {who}: {heading(one.window.facts, ['site'])}, from {entry.initial}: "
        f"{entry.ended}.",
        f"The roof's total deviation from its target was {_deviation(totals['total_deviation_m3'])}"
        f"{_over_least(one.ratio_to_bound)}; it was near the target for "
        f"{one.assessment.band_hours:.2f} of {shortest(round(one.assessment.hours, 2))} h.",
        f"The pumps started {counted(int(totals['pump_starts']), 'time')} and lifted "
        f"{_m3('pumped_m3', totals['pumped_m3'])}, {_m3('outflow_m3', totals['outflow_m3'])} went "
        f"to the sewer, and {_m3('drainage_m3', totals['drainage_m3'])} drained off the roof.",
    ]


def _of_several(report: Report) -> list[str]:
    cases: dict[tuple[object, str], list[Best]] = {}
    for one in best_runs(report):
        cases.setdefault((one.window, one.initial), []).append(one)
    for found in cases.values():
        found.sort(key=_total)
    totals = [one.assessment.metrics for one in report.results]
    least, most = (
        [end(each[name] for each in totals) for name in ("total_deviation_m3", "pumped_m3")]
        for end in (min, max)
    )
    return [
        _runs(report, windows(report), report.initials),
        _least(report, list(cases.values())),
        f"Over all runs the total deviation was {least[0]:.2f} to {_deviation(most[0])}, and "
        f"{least[1]:.4g} to {_m3('pumped_m3', most[1])} were pumped.",
    ]


def _winners(controllers: Iterable[str]) -> str:
    """Say in how many places which controller was the best."""
    wins = Counter(map(controller_name, controllers)).most_common()
    return _and(f"that of {name} in {count}" for name, count in wins)


def _total(best: Best) -> float:
    return best.run.assessment.metrics["total_deviation_m3"]


def _least(report: Report, cases: Sequence[Sequence[Best]]) -> str:
    """Say which run had the least total deviation, or of many windows which controller how often.

    Args:
        report: all results.
        cases: for each window and initial state the best run of each controller, the least first.
    """
    if len(cases) > _MOST_NAMED:
        return (
            f"Of {len(cases)} windows and initial states the least total deviation was "
            f"{_winners(found[0].run.entry.controller for found in cases)}."
        )
    parts = []
    for first, *others in cases:
        facts = {name: first.window.facts[name] for name in report.apart}
        where = [f"in {heading(facts, report.apart)}"] if facts else []
        where += [f"from {first.initial}"] if len(report.initials) > 1 else []
        alike = bool(others) and _total(others[-1]) == _total(first)
        who = "whatever the controller" if alike else _who(first)
        text = f"{' '.join([_deviation(_total(first)), *where])} ({who}"
        text += _over_least(first.run.ratio_to_bound)
        if others and not alike:
            text += f"; {_who(others[0])} had {_total(others[0]):.2f}"
        parts.append(f"{text})")
    return f"The least total deviation was {_and(parts)}."


def _who(best: Best) -> str:
    name = controller_name(best.run.entry.controller)
    return name if best.setting == "all alike" else f"{name} {best.setting}"


def _of_seeds(report: Report) -> list[str]:
    found = spreads(report)
    initials = list(dict.fromkeys(one.place.initial for one in found))

    def named(one: Spread) -> str:
        who = f"{controller_name(one.controller)} {one.setting}".strip()
        return f"{who} from {one.place.initial}, forecasts of skill {one.skill}"

    cases: dict[object, list[Spread]] = {}
    for one in found:
        cases.setdefault((one.place, one.skill), []).append(one)
    best = [min(of, key=lambda one: one.mean) for of in cases.values()]
    if len(best) > _MOST_NAMED:
        second = (
            f"Of {len(best)} windows, initial states and skills the least mean total deviation was "
            f"{_winners(one.controller for one in best)}."
        )
    else:
        text = _and(f"{_deviation(one.mean)} ({named(one)})" for one in best)
        second = f"The least mean total deviation over the seeds was {text}."
    worst = max(found, key=lambda one: one.worst_tenth / one.mean if one.mean else 0.0)
    return [
        _runs(report, windows(report), initials),
        second,
        f"Luck counts most for {named(worst)}: {_deviation(worst.mean)} in the mean, "
        f"{_deviation(worst.worst_tenth)} in the worst tenth.",
    ]


def _of_seasons(report: Report) -> list[str]:
    found = seasons(report)
    first = _runs(report, season_windows(report))  # which name the initial states
    if is_sizing(found):
        return [first, *_of_sizes(found)]
    least = least_deviation(found)
    compared = [
        one for one in comparisons(found, plain_onoff(found)) if one.of is least[one.of.place]
    ]
    return [
        first,
        "The least mean deviation of a season was "
        + _and(f"{_deviation(one.mean('total_deviation_m3'))}{_over_least(one.ratio_to_bound)} "
               f"({_season(one)})" for one in list(least.values())[:_MOST_NAMED]) + ".",
        *(
            ["Over that of on/off in the same years it is "
             f"{_and(map(_over_onoff, compared[:_MOST_NAMED]))}."] if compared else []
        ),
    ]


def _season(one: Seasons) -> str:
    who = f"{controller_name(one.controller)} {one.setting}".strip()
    return f"{who}, forecast {one.forecast}"


def _over_onoff(one: Comparison) -> str:
    low, value, high = (f"{each:.3f}" for each in (one.mean.low, one.mean.value, one.mean.high))
    luck = ", which may be luck" if one.mean.verdict == MAY_BE_LUCK else ""
    return f"{value} (95 %: {low} to {high}{luck}; less in {one.better} of {one.years} years)"


def _of_sizes(found: Sequence[Seasons]) -> list[str]:
    saved = sorted(found, key=lambda one: one.mean("saved_m3"))

    def named(one: Seasons) -> str:
        size = size_of(one.site)
        return (
            f"{one.mean('saved_m3'):.4g} m³ a season with a cistern of {size.cistern_m3:.4g} m³ "
            f"for {size.roof_m2:.4g} m² of green roof ({controller_name(one.controller)})"
        )

    spilt = [one.mean("outflow_m3") for one in found]
    return [
        f"Mains water saved was from {named(saved[0])} to {named(saved[-1])}.",
        f"From {min(spilt):.4g} to {max(spilt):.4g} m³ a season went to the sewer.",
    ]
