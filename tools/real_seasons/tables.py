"""What the runs of real seasons give, number by number, with intervals from blocks of weeks."""

from __future__ import annotations

import csv
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from real_seasons.inputs import AUTUMN, BLOCK_WEEKS, Inputs, Period
from real_seasons.runs import (
    CROSSED,
    DRESSED,
    ISSUED,
    NESTED,
    NO_RAIN,
    ONOFF_NAME,
    PERFECT,
    SCALED_BY_ITSELF,
    SOURCES,
    Case,
)

Array = NDArray[np.float64]
Results: TypeAlias = dict[Case, dict[str, Any]]

# Of the bootstrap. It draws blocks of weeks, because a storm's excess lasts longer than one week.
RESAMPLES = 2000

# Length of the sums of forecasts (h).
_SUM_H = 48

ALL = "all weeks"
DRIER, WETTER = "drier half", "wetter half"
OVER_ONOFF, OVER_NO_RAIN, GAINED = "over on/off", "over no rain", "gained"
DEVIATION = "mean deviation (mm)"

Metric: TypeAlias = Callable[[dict[str, float]], float]
_DEVIATION, _EVAPORATED, _PUMPED, _RAIN = map(operator.itemgetter, (
    "total_deviation_m3", "evapotranspiration_m3", "pumped_m3", "rain_roof_m3",
))

# What an owner sees of a run: a metric, and if it is a ratio the one below it. Both are sums over
# time, so that weeks can be drawn.
OWNERS: dict[str, tuple[Metric, Metric | None]] = {
    DEVIATION: (_DEVIATION, lambda row: _DEVIATION(row) / row["mean_deviation_mm"]),
    "water stress (h)": (operator.itemgetter("stress_hours"), None),
    "actual over potential evapotranspiration": (
        _EVAPORATED, lambda row: _EVAPORATED(row) / row["evapotranspiration_ratio"],
    ),
    "pumped (m³)": (_PUMPED, None),
    "share of it drained": (
        lambda row: row["drainage_m3"] - (1 - row["rain_kept_share"]) * _RAIN(row), _PUMPED,
    ),
    "mains water (m³)": (operator.itemgetter("mains_m3"), None),
    "rain kept": (lambda row: row["rain_kept_share"] * _RAIN(row), _RAIN),
}
STORMS = {
    "rain kept above 20 mm/h": "rain_kept_share_hour",
    "rain kept above 10 mm in 24 h": "rain_kept_share_day",
}


class Row(NamedTuple):
    """A number of a run, as a row of ``real_seasons.csv``.

    Attributes:
        roof: name of the roof.
        period: when the run was.
        weeks: which of its weeks count.
        forecast: the source of its forecasts, or on/off.
        form: how they were used.
        measure: what the number is, with its unit.
        value: the number.
        low: lower end of its 95 % interval; None if it has none.
        high: upper end.
    """

    roof: str
    period: str
    weeks: str
    forecast: str
    form: str
    measure: str
    value: float
    low: float | None = None
    high: float | None = None


def write(rows: Iterable[Row], file: Path) -> None:
    """Write rows, in all digits."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([Row._fields, *rows])


def drawn_weeks(weeks: int) -> NDArray[np.intp]:
    """Return the weeks of each resample, in blocks, shape (RESAMPLES, weeks)."""
    random = np.random.default_rng(1)
    blocks = -(-weeks // BLOCK_WEEKS)
    begins = random.integers(weeks, size=(RESAMPLES, blocks))
    drawn = (begins[..., None] + np.arange(BLOCK_WEEKS)).reshape(RESAMPLES, -1) % weeks
    return np.asarray(drawn[:, :weeks])


def interval(own: Array, other: Array) -> tuple[float, float, float]:
    """Return the ratio of two sums over weeks, and the ends of its 95 % interval."""
    drawn = drawn_weeks(len(own))
    ratios = own[drawn].sum(axis=1) / other[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(own.sum() / other.sum()), float(low), float(high)


def rows(results: Results, inputs: Inputs, roof: str, period: Period) -> Iterator[Row]:
    """Yield the numbers of all runs of a period on a roof."""
    weeks = {case: np.array(result["weeks"]) for case, result in results.items()}
    yield from _compared({
        case: own for case, own in weeks.items() if case.form not in (CROSSED, NESTED)
    }, ALL, np.full(period.weeks, True))
    if period is not AUTUMN:
        yield from _of_owner({
            case: result for case, result in results.items() if case.form in (ISSUED, DRESSED)
        })
    if any(case.form == CROSSED for case in weeks):
        wet = inputs.wet_weeks(period)
        for words, chosen in ((DRIER, ~wet), (WETTER, wet)):
            yield from _compared({
                case: own for case, own in weeks.items() if case.form in (ISSUED, CROSSED, NESTED)
            }, words, chosen)
    yield from _present_hour(weeks)
    if roof == "measured" and period is not AUTUMN:
        yield from _known(inputs, roof, period)
    for case in results:
        if case.form == SCALED_BY_ITSELF:
            for wet, factor in inputs.factors(roof, case.source, period).items():
                yield _row(case, WETTER if wet else DRIER, "factor", factor)


def _row(case: Case, weeks: str, measure: str, *numbers: float) -> Row:
    """Return a number of a case as a row."""
    words = [case.form] if case.hour else ["the hour as forecast"]
    words += [f"draw {case.draw}"] if case.draw else []
    trusts = case.trusts or case.source not in SOURCES
    return Row(
        case.roof, case.period.words, weeks,
        case.source if trusts else f"{case.source}, trusted in full", ", ".join(words), measure,
        *numbers,
    )


def _compared(weeks: Mapping[Case, Array], words: str, chosen: NDArray[np.bool_]) -> Iterator[Row]:
    """Yield each run's deviation over on/off's and over that without rain, and what it gains.

    What it gains is the share of the gain that perfect forecasts have over a forecast of no rain.

    Args:
        weeks: deviation in each week (m3).
        words: name of the chosen weeks.
        chosen: which weeks count.
    """
    named = {case.source: own[chosen] for case, own in weeks.items()}
    onoff, dry, perfect = (named.get(source) for source in (ONOFF_NAME, NO_RAIN, PERFECT))
    for case, own in weeks.items():
        if onoff is not None:
            yield _row(case, words, OVER_ONOFF, *interval(own[chosen], onoff))
        if case.source in (ONOFF_NAME, NO_RAIN) or dry is None:
            continue
        yield _row(case, words, OVER_NO_RAIN, *interval(own[chosen], dry))
        if perfect is not None and case.source != PERFECT:
            yield _row(case, words, GAINED, *interval(dry - own[chosen], dry - perfect))


def _present_hour(weeks: Mapping[Case, Array]) -> Iterator[Row]:
    """Yield the cost of not knowing the present hour to its end."""
    for case, own in weeks.items():
        if not case.hour:
            known = next(
                result for other, result in weeks.items()
                if other.hour and (other.source, other.form) == (case.source, case.form)
            )
            yield _row(case, ALL, "over the hour known", *interval(own, known))


def _known(inputs: Inputs, roof: str, period: Period) -> Iterator[Row]:
    """Yield the share of the rain's variance that each service forecasts, in sums over two days.

    It is the squared correlation of the members' mean with the gauge. The bias is forecast over
    measured rain.
    """
    halves = {ALL: (False, True), DRIER: (False,), WETTER: (True,)}
    end = period.start + timedelta(hours=period.hours)
    for source in SOURCES:
        for form, archive in (
            (ISSUED, inputs.issued[source]), (DRESSED, inputs.dressed(roof, source))
        ):
            sums = [
                (inputs.is_wet(period, issue.issued), issue.rain[:, :_SUM_H].sum(axis=1).mean(),
                 inputs.measured(issue.issued, _SUM_H))
                for issue in archive.issues
                if period.start <= issue.issued < end and issue.hours >= _SUM_H
            ]
            case = Case(roof, period, source, form)
            for words, chosen in halves.items():
                said, fell = np.array([
                    row[1:] for row in sums if row[0] in chosen and not np.isnan(row[2])
                ]).T
                yield _row(case, words, "r²", float(np.corrcoef(said, fell)[0, 1] ** 2))
                yield _row(case, words, "bias", float(said.sum() / fell.sum()))


def _of_owner(results: Results) -> Iterator[Row]:
    """Yield what an owner sees, with intervals from blocks of weeks; storms have none."""
    for case, result in results.items():
        weeks = len(result["until"])
        for measure, (above, below) in OWNERS.items():
            other = _added(result, below) if below else np.full(weeks, 1 / weeks)
            if not other[drawn_weeks(weeks)].sum(axis=1).all():
                continue  # nothing is pumped in most weeks of the paper's roof
            yield _row(case, ALL, measure, *interval(_added(result, above), other))
        for measure, name in STORMS.items():
            yield _row(case, ALL, measure, result["metrics"][name])


def _added(result: dict[str, Any], metric: Metric) -> Array:
    """Return what each week added to a metric."""
    return np.diff([0.0, *map(metric, result["until"])])
