"""The tables of real seasons, in Markdown, with intervals from blocks of weeks."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import timedelta
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from real_seasons.inputs import BLOCK_WEEKS, Inputs, Period
from real_seasons.runs import (
    CROSSED,
    DRESSED,
    IDEAL,
    ISSUED,
    NESTED,
    NO_RAIN,
    ONOFF_NAME,
    PERFECT,
    SOURCES,
    Case,
)

Array = NDArray[np.float64]
Results: TypeAlias = dict[Case, dict[str, Any]]

# Of the bootstrap. It draws blocks of weeks, because a storm's excess lasts longer than one week.
RESAMPLES = 2000

# Length of the sums of forecasts (h).
_SUM_H = 48

# What an owner sees of a run: heading, format, and the weekly sums whose ratio it is.
OWNERS = {
    "mean deviation (mm)": ("{:.2f}", "total_deviation_m3", "deviated"),
    "water stress (h)": ("{:.0f}", "stress_hours", ""),
    "actual over potential evapotranspiration": ("{:.3f}", "evapotranspiration_m3", "asked"),
    "pumped (m³)": ("{:.1f}", "pumped_m3", ""),
    "of it drained": ("{:.2f}", "lost", "pumped_m3"),
    "mains water (m³)": ("{:.1f}", "mains_m3", ""),
    "rain kept": ("{:.2f}", "kept", "rain_roof_m3"),
}
STORMS = {"rain_kept_share_day": "rain kept of 10 mm in 24 h and more"}


def _weeks(results: Results) -> dict[Case, Array]:
    return {case: np.array(result["weeks"]) for case, result in results.items()}


def _named(weeks: Mapping[Case, Array], source: str) -> Array:
    """Return the weeks of a run without a service; NaN if the run has not been made."""
    missing = np.full_like(next(iter(weeks.values())), np.nan)
    return next((result for case, result in weeks.items() if case.source == source), missing)


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


def ratio(own: Array, other: Array) -> str:
    """Return the ratio and its interval as a cell."""
    value, low, high = interval(own, other)
    return f"{value:.3f} ({low:.3f} to {high:.3f})"


def gained(own: Array, dry: Array, perfect: Array) -> str:
    """Return the share of what perfect forecasts gain over no rain that a forecast gains."""
    gain, most = dry - own, dry - perfect
    if np.isnan(gain.sum() + most.sum()):
        return ""
    drawn = drawn_weeks(len(own))
    shares = gain[drawn].sum(axis=1) / most[drawn].sum(axis=1)
    low, high = 100 * np.percentile(shares, [2.5, 97.5])
    return f"{100 * gain.sum() / most.sum():.0f} % ({low:.0f} to {high:.0f})"


def _head(cells: Sequence[str]) -> Iterator[str]:
    yield f"| {' | '.join(cells)} |"
    yield "|" + "---|" * len(cells)


def _rows(weeks: Mapping[Case, Array], columns: Sequence[str], chosen: Any) -> Iterator[str]:
    """Yield a row for each source, with columns for each form of its forecasts.

    Args:
        weeks: of all runs.
        columns: forms of forecasts.
        chosen: which weeks to include.
    """
    onoff, dry, perfect = (
        _named(weeks, source)[chosen] for source in (ONOFF_NAME, NO_RAIN, PERFECT)
    )
    yield f"on/off {onoff.sum():.0f} m³; over it: no rain {ratio(dry, onoff)}; " + (
        f"perfect {ratio(perfect, onoff)}"
    )
    yield ""
    heads = [
        f"{form.removeprefix(f'{CROSSED} ')}: {what}"
        for form in columns for what in ("over on/off", "over no rain", "gained")
    ]
    yield from _head(["forecast", *heads])
    for source, trusts in dict.fromkeys((case.source, case.trusts) for case in weeks):
        if source not in SOURCES:
            continue
        cells = [source if trusts else f"{source}, trusted in full"]
        for form in columns:
            own = next((
                result[chosen] for case, result in weeks.items()
                if (case.source, case.form, case.trusts, case.hour) == (source, form, trusts, True)
            ), None)
            cells += [""] * 3 if own is None else [
                ratio(own, onoff), ratio(own, dry), gained(own, dry, perfect)
            ]
        yield f"| {' | '.join(cells)} |"


def of_period(results: Results) -> Iterator[str]:
    """Yield the table of all weeks."""
    if any(case.source == ONOFF_NAME for case in results):
        yield from _rows(_weeks(results), (ISSUED, DRESSED), slice(None))


def by_halves(results: Results, wet: NDArray[np.bool_]) -> Iterator[str]:
    """Yield the table of each half, with forecasts dressed by the other half."""
    weeks = _weeks(results)
    forms = [form for form in (CROSSED, NESTED) if any(case.form == form for case in weeks)]
    if forms:
        for words, chosen in (("fit on dry, judged on wet", wet), ("fit on wet, dry", ~wet)):
            yield f"\n{words}, {chosen.sum()} weeks: "
            yield from _rows(weeks, (ISSUED, *forms), chosen)


def resolution(inputs: Inputs, roof: str, period: Period) -> Iterator[str]:
    """Yield the share of the rain's variance that each service forecasts, in sums over two days.

    It is the squared correlation of the members' mean with the gauge. The bias is forecast over
    measured rain.
    """
    halves = {period.words: (False, True), "drier half": (False,), "wetter half": (True,)}
    yield from _head([
        "forecast", *(f"{words}: {what}" for words in halves for what in ("r²", "bias"))
    ])
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
            cells = [f"{source}, {form}"]
            for chosen in halves.values():
                said, fell = np.array([
                    row[1:] for row in sums if row[0] in chosen and not np.isnan(row[2])
                ]).T
                cells += [
                    f"{np.corrcoef(said, fell)[0, 1] ** 2:.2f}", f"{said.sum() / fell.sum():.2f}"
                ]
            yield f"| {' | '.join(cells)} |"


def of_ideal(results: Results) -> Iterator[str]:
    """Yield the table of what the best use of each service gains, beside what it gains."""
    weeks = _weeks(results)
    ideal = [case for case in weeks if case.form == IDEAL]
    if not ideal:
        return
    dry, perfect = (_named(weeks, source) for source in (NO_RAIN, PERFECT))
    draws = dict.fromkeys(case.draw for case in ideal)
    yield from _head(["forecast", ISSUED, DRESSED, *(f"{IDEAL}, draw {draw}" for draw in draws)])
    for source in dict.fromkeys(case.source for case in ideal):
        shown = [
            case for form in (ISSUED, DRESSED, IDEAL) for case in weeks
            if (case.source, case.form, case.trusts, case.hour) == (source, form, True, True)
        ]
        yield f"| {source} | {' | '.join(gained(weeks[case], dry, perfect) for case in shown)} |"


def present_hour(results: Results) -> Iterator[str]:
    """Yield the cost of not knowing the present hour to its end."""
    weeks = _weeks(results)
    for case, own in weeks.items():
        if not case.hour:
            known = next(
                result for other, result in weeks.items()
                if other.hour and (other.source, other.form) == (case.source, case.form)
            )
            yield f"- {case.name}: {ratio(own, known)} of the run that knows it"


def of_owner(results: Results) -> Iterator[str]:
    """Yield the table of what an owner sees, with intervals from blocks of weeks."""
    yield from _head(["forecast", *OWNERS, *STORMS.values()])
    for case, result in results.items():
        if case.form in (IDEAL, NESTED):
            continue
        sums = _weekly_sums(result)
        cells = []
        for form, above, below in OWNERS.values():
            weeks = len(sums[above])
            other = sums[below] if below else np.full(weeks, 1 / weeks)
            cells.append("{} ({} to {})".format(*map(form.format, interval(sums[above], other))))
        cells += [f"{result['metrics'][name]:.2f}" for name in STORMS]
        yield f"| {case.name} | {' | '.join(cells)} |"


def _weekly_sums(result: dict[str, Any]) -> dict[str, Array]:
    """Return what each week added to the metrics that are sums, and to both terms of ratios."""
    until: list[dict[str, float]] = result["until"]

    def added(metric: Callable[[dict[str, float]], float]) -> Array:
        return np.diff([0.0, *map(metric, until)])

    return {
        **{
            name: added(operator.itemgetter(name))
            for name in (
                "total_deviation_m3", "stress_hours", "evapotranspiration_m3", "pumped_m3",
                "mains_m3", "rain_roof_m3",
            )
        },
        "deviated": added(lambda row: row["total_deviation_m3"] / row["mean_deviation_mm"]),
        "asked": added(lambda row: row["evapotranspiration_m3"] / row["evapotranspiration_ratio"]),
        "lost": added(lambda row: (
            row["drainage_m3"] - (1 - row["rain_kept_share"]) * row["rain_roof_m3"]
        )),
        "kept": added(lambda row: row["rain_kept_share"] * row["rain_roof_m3"]),
    }
