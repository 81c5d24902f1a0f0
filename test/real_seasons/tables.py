"""The tables of real seasons, in Markdown, with intervals from blocks of weeks."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from markdown_tables import head, row
from numpy.typing import NDArray
from real_seasons.runs import DRESSED, ISSUED, NO_RAIN, ONOFF_NAME, PERFECT, SOURCES, Case

Array = NDArray[np.float64]
Results: TypeAlias = dict[Case, dict[str, Any]]

# Of the bootstrap. Blocks of weeks, since a storm's excess stays for more than one.
RESAMPLES = 2000
BLOCK_WEEKS = 4

# What an owner sees of a run: heading, form, and of which weekly sums it is the ratio.
OWNERS = {
    "mean deviation (mm)": ("{:.2f}", "total_deviation_m3", "deviated"),
    "water stress (h)": ("{:.0f}", "stress_hours", ""),
    "actual over potential evapotranspiration": ("{:.3f}", "evapotranspiration_m3", "asked"),
    "pumped (m³)": ("{:.1f}", "pumped_m3", ""),
    "of it drained": ("{:.2f}", "lost", "pumped_m3"),
    "mains water (m³)": ("{:.1f}", "mains_m3", ""),
    "rain kept": ("{:.2f}", "kept", "rain_roof_m3"),
}


def drawn_weeks(weeks: int) -> NDArray[np.intp]:
    """Return the weeks of each resample, in blocks, shape (RESAMPLES, weeks)."""
    random = np.random.default_rng(1)
    blocks = -(-weeks // BLOCK_WEEKS)
    begins = random.integers(weeks, size=(RESAMPLES, blocks))
    drawn = (begins[..., None] + np.arange(BLOCK_WEEKS)).reshape(RESAMPLES, -1) % weeks
    return np.asarray(drawn[:, :weeks])


def interval(own: Array, other: Array) -> tuple[float, float, float]:
    """Return a sum over weeks over another's, and the ends of its 95 % interval."""
    drawn = drawn_weeks(len(own))
    ratios = own[drawn].sum(axis=1) / other[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(own.sum() / other.sum()), float(low), float(high)


def ratio(own: Array, other: Array) -> str:
    """Return it as a cell."""
    value, low, high = interval(own, other)
    return f"{value:.3f} ({low:.3f} to {high:.3f})"


def of_period(results: Results) -> Iterator[str]:
    """Yield a row for each source, with the gain over on/off, over no rain, and of perfect's."""
    weeks = {
        (case.source, case.form, case.trusts): np.array(found["weeks"])
        for case, found in results.items()
    }
    onoff = weeks.get((ONOFF_NAME, ISSUED, True))
    dry, perfect = (weeks.get((source, ISSUED, False)) for source in (NO_RAIN, PERFECT))
    if onoff is None or dry is None:
        return
    yield f"on/off {onoff.sum():.0f} m³; over it: no rain {ratio(dry, onoff)}"
    if perfect is None:
        return
    yield f"perfect {ratio(perfect, onoff)}\n"
    columns = ("over on/off", "over no rain", "gained")
    yield head(["forecast", *(f"{form}: {what}" for form in (ISSUED, DRESSED) for what in columns)])
    for source, trusts in dict.fromkeys((source, trusts) for source, _, trusts in weeks):
        if source in SOURCES:
            cells = [source if trusts else f"{source}, trusted in full"]
            for form in (ISSUED, DRESSED):
                own = weeks[source, form, trusts]
                gained = 100 * (dry.sum() - own.sum()) / (dry.sum() - perfect.sum())
                cells += [ratio(own, onoff), ratio(own, dry), f"{gained:.0f} %"]
            yield row(cells)


def trust(results: Results) -> Iterator[str]:
    """Yield how far forecasts as issued were trusted as the days began."""
    for case, found in results.items():
        if case.form == ISSUED and case.trusts and found["trust"][0] is not None:
            days = np.array(found["trust"])
            yield (
                f"- {case.name}: fully trusted on {(days == 1).sum()} of {len(days)} days, at "
                f"least by {days.min():.0%}"
            )


def of_owner(results: Results) -> Iterator[str]:
    """Yield the table of what an owner sees, with intervals from blocks of weeks."""
    yield head(["forecast", *OWNERS])
    for case, found in results.items():
        sums = _weekly_sums(found["until"])
        cells = [case.name]
        for form, above, below in OWNERS.values():
            weeks = len(sums[above])
            other = sums[below] if below else np.full(weeks, 1 / weeks)
            cells.append("{} ({} to {})".format(*map(form.format, interval(sums[above], other))))
        yield row(cells)


def _weekly_sums(until: list[dict[str, float]]) -> dict[str, Array]:
    """Return what each week added to metrics that are sums, and to those that ratios are of."""

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
        "deviated": added(lambda one: one["total_deviation_m3"] / one["mean_deviation_mm"]),
        "asked": added(lambda one: one["evapotranspiration_m3"] / one["evapotranspiration_ratio"]),
        "lost": added(lambda one: (
            one["drainage_m3"] - (1 - one.get("rain_kept_share", 0.0)) * one["rain_roof_m3"]
        )),
        "kept": added(lambda one: one.get("rain_kept_share", 0.0) * one["rain_roof_m3"]),
    }
