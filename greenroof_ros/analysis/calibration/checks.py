"""Checks of a record and of its fit, and other findings: one function for each check.

The bounds separate the records of two roofs (Neubrandenburg 2014 and 2015, Berlin
2019, April to October, in windows of 30 to 100 days) from the same records with a wrong unit, a
shifted clock or a broken sensor. Bounds for levels do so with simulated levels of these roofs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.record import (
    DAY_S,
    HOUR_S,
    RoofRecord,
    Steps,
    Values,
    greatest_rise,
    outages,
    prolonged,
    storms,
    time_name,
)
from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.quality import Finding, Findings
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import evaporable, extraterrestrial_radiation

FINDINGS = Findings(Path(__file__).with_name("findings.yaml"))
"""all findings of a calibration"""

_FEWEST_VALUES = 100


def check_record(record: RoofRecord, site: Site) -> list[Finding]:
    """Return what is wrong with the sensors, units and clocks of a record.

    Args:
        record: the measurements in the steps that count.
        site: its roof and place.

    Raises:
        ConfigurationError: a column has fewer than 100 values.
    """
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _FEWEST_VALUES:
            raise ConfigurationError(
                f"has {there} values; it must have at least {_FEWEST_VALUES}", file=record.source,
                key=column,
            )
    findings = [
        *_sparse(record), *_stuck(record), *_clock(record), *_evapotranspiration(record, site),
        *_rain(record),
    ]
    level, runoff = record.level, record.runoff
    if level is not None:
        findings += [*_level(record, site, level), *_rise_without_rain(record, level)]
    if runoff is not None:
        findings += [
            *_runoff(record, site, runoff), *_storm_runoff(record, site, runoff),
            *_silence(record, site, runoff), *_runoff_without_rain(record, runoff),
        ]
    return findings


# --- sensors --------------------------------------------------------------------------------------

# A sensor is stuck if its reading stays the same for this long (s) while this much rain falls (mm),
# and in this many steps: with steps of a day, a roof can have equal levels on two wet days.
_STUCK_S, _STUCK_RAIN, _RAIN_STUCK_S, _SAME_STEPS = DAY_S, 10.0, 6 * HOUR_S, 6


def _sparse(record: RoofRecord) -> Iterator[Finding]:
    """Find sensors that are read less often than rows are written: rows between are empty."""
    for column, values in {"rain": record.rain, **record.measured}.items():
        often = float(np.median(np.diff(np.flatnonzero(~np.isnan(values)))))
        if often > 1:
            yield FINDINGS.make(
                "sensor-sparse", "sparse", column,
                seen=time_name(often * record.step_s), step=time_name(record.step_s),
            )


def _stuck(record: RoofRecord) -> Iterator[Finding]:
    """Find sensors that show one value while it must change."""
    fallen = np.concatenate(([0.0], np.cumsum(np.nan_to_num(record.rain))))
    for column, values in (*reversed(record.measured.items()), ("rain", record.rain)):
        longest, most = (_RAIN_STUCK_S, 0.0) if column == "rain" else (_STUCK_S, _STUCK_RAIN)
        of_level = column == "level"
        for low, high in gaps(np.diff(values) == 0):
            same, fell = high - low + 1, fallen[high + 1] - fallen[low]
            if (
                same >= _SAME_STEPS and same * record.step_s >= longest and fell >= most
                and (values[low] != 0 or of_level)
            ):
                yield FINDINGS.make(
                    "sensor-stuck", "stuck", column,
                    value=float(values[low]), unit="m" if of_level else "mm a step",
                    hours=same * record.step_s / HOUR_S, since=record.time(low), fell=float(fell),
                )
                break


def outages_found(record: RoofRecord) -> Iterator[Finding]:
    """Report which steps do not count after outages of rain gauge and pump meter."""
    found = outages(record)
    for column, values in (("rain", record.rain), ("pumped", record.pumped)):
        own = [outage for outage in found if np.isnan(values[outage.first:outage.end]).any()]
        if own:
            steps = {step for outage in own for step in range(outage.first, outage.forgotten)}
            longest = max(own, key=lambda outage: outage.end - outage.first)
            yield FINDINGS.make(
                "outage", "unknown", column, since=record.time(longest.first),
                hours=(longest.end - longest.first) * record.step_s / HOUR_S,
                days=len(steps) * record.step_s / DAY_S,
                others=f", and in {len(own) - 1} more outages" if len(own) > 1 else "",
            )


# --- clocks ---------------------------------------------------------------------------------------

# Water reaches a level sensor within minutes and leaves a roof within hours; a longer delay means a
# shifted clock. So does a response before the rain by more than this many steps, or by two hours:
# clocks can differ by minutes, and a level's rises are between means of half an hour.
_LONGEST_DELAY_S, _MOST_SHIFT_S = 4 * HOUR_S, 26 * HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * HOUR_S
# The minimum correlation that counts, and the minimum ratio of the best correlation to the one
# without a shift. An early response is always wrong: in 64 windows of 30 and 60 days of the two
# roofs this ratio is at most 1.03; with a clock an hour early it is above 1.1 in 47 of
# them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5


def _clock(record: RoofRecord) -> Iterator[Finding]:
    """Find a roof that responds before the rain, or hours after it.

    Only rises of runoff or level count: how long runoff continues after rain indicates nothing
    about clocks. A level's rise is between two means of half an hour, to reduce a sensor's noise.
    """
    column, series = next(iter(record.measured.items()))
    if column == "runoff":
        rises = np.diff(series, prepend=np.nan)
    else:
        count = max(1, round(1800 / record.step_s))
        rises = np.append(_rises(series, count)[1:], np.zeros(count))
    usual_s = (
        -min(_EARLY_STEPS[column] * record.step_s, _EARLY_S), max(_LONGEST_DELAY_S, record.step_s),
    )
    # Square roots reduce the weight of one large storm.
    inflow, answers = (
        roots - roots.mean()
        for roots in (np.sqrt(record.water), np.sqrt(np.maximum(np.nan_to_num(rises), 0.0)))
    )
    scale = np.sqrt(np.sum(inflow**2) * np.sum(answers**2))
    if scale == 0:
        return
    most = int(_MOST_SHIFT_S // record.step_s)
    lags = record.step_s * np.arange(-most, most + 1)
    correlations = np.correlate(np.pad(answers, most), inflow, "valid") / scale
    lag, best = float(lags[np.argmax(correlations)]), float(correlations.max())
    usual = float(correlations[(lags >= usual_s[0]) & (lags <= usual_s[1])].max())
    early = lag < usual_s[0]
    better = _EARLY_BETTER if early else _LATE_BETTER
    if (early or lag > usual_s[1]) and best > _CLEAR and best > better * usual:
        minutes = abs(lag) / 60
        yield FINDINGS.make(
            "clock-shifted", "roof", column,
            span=f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h",
            side="before" if early else "after", best=best, usual=usual, lag_s=lag,
        )


def _rises(values: Values, count: int) -> Values:
    """Return the mean of ``count`` values from each value on, less the mean of as many before it.

    Unknown values and values before the first are treated as 0. Shape (values - count + 1,).
    """
    weights = np.repeat([1.0, -1.0], count) / count
    return np.convolve(np.nan_to_num(values), weights)[count - 1:len(values)]


# --- units ----------------------------------------------------------------------------------------

# More evapotranspiration than any day has (mm). Alfalfa, with 1.15 times the evapotranspiration of
# grass, had 14 mm, weighed, on the windiest days of four years in Texas (Evett, Howell, Todd,
# Schneider and Tolk, Alfalfa reference ET measurement and prediction, 4th Decennial National
# Irrigation Symposium, 2000).
_MOST_A_DAY = 20.0
# Less than the best day of a month has, as a share of what the sun above the atmosphere could
# evaporate. By Hargreaves' equation the best day has at least 0.12 at the roofs in Neubrandenburg
# and Berlin, and 0.08 in eleven years of Toronto, in the coldest months; a twelfth of the right
# value is at most 0.04, in summer. A bound in mm cannot separate the two.
_MIN_OF_SUN, _FEWEST_DAYS = 0.06, 30
# The minimum rain and pumped water for a fit (mm), and more rain than falls in weeks (mm a day).
_MIN_RAIN, _MOST_RAIN_A_DAY = 20.0, 60.0
# The largest excess of runoff over water, summed over storms, as a share of their runoff: at most
# 0.13 for both roofs; with a wrong unit at least 0.21, mostly 0.4. And
# in mm, so that a few drops do not count.
_MOST_EXCESS, _MIN_EXCESS = 0.25, 5.0
# The maximum share of a storm of 5 mm or more that runs off: at least 0.13, and with a wrong unit
# at most 0.08; with three such storms in 90 days. A shorter record can be from a dry month.
_MIN_SHARE, _LARGE, _FEWEST_LARGE, _LONG_DAYS = 0.1, 5.0, 3, 90
# A roof keeps at most the soil's volume and this much more of a storm (mm).
_EXTRA_STORAGE = 20.0
# Rise of levels in storms of 1 mm and more, as a share of their water: 0.4 to 1.1, and with a wrong
# unit at most 0.09 or at least 6; with three such storms.
_MIN_RISE, _MOST_RISE, _COUNTS, _FEWEST_STORMS = 0.1, 2.0, 1.0, 3
# Duration of the means before and after a storm, which reduce a sensor's noise (s).
_MEAN_S = 1800
# More water than this (mm), even from many storms, must cause some runoff if it also exceeds what
# the soil can hold. Both roofs had no runoff from 44 mm in four weeks.
_LEAVES_SOME = 80.0
# Runoff of a record as a share of its water, if there is any: at least 0.0025 in windows of 30 days
# or more, and with runoff in m instead of mm at most 0.0007.
_MIN_OF_WATER = 0.001
# Neither roof is watered: they dry out, and bounds allow for
# evaporation meanwhile. A watered roof evaporates at the full rate, at most 1.3 times the rate of
# the reference grass (FAO-56, Eq. 72: 1.05 to 1.3).
_WATERED_S, _FULL_RATE = 7 * DAY_S, 1.3


def _days(record: RoofRecord) -> float:
    """Return the duration of known rain in days."""
    return float(np.count_nonzero(~np.isnan(record.rain))) * record.step_s / DAY_S


def _watered(record: RoofRecord) -> Steps:
    """Return the steps with water pumped onto the roof within the last week."""
    return prolonged(np.nan_to_num(record.pumped) > 0, math.ceil(_WATERED_S / record.step_s))


def _gain_without_runoff(record: RoofRecord, site: Site, runoff: Values) -> Values:
    """Return the gain of a roof without runoff up to each step (mm), shape (steps + 1,).

    A dry roof must be able to hold the maximum rise of this gain. Water in steps with unknown
    runoff does not count. From a roof with a pump, evapotranspiration is subtracted at its full
    rate, because a good controller pumps no more than that, and nothing while it rains often
    enough.
    """
    rate = max(_FULL_RATE, site.crop_coefficient) * bool(np.nansum(record.pumped) > 0)
    inflow = np.where(np.isnan(runoff), 0.0, record.water)
    return np.concatenate(([0.0], np.cumsum(inflow - rate * record.reference)))


def _most_storage(site: Site) -> float:
    """Return the most water that a roof can hold without any runoff (mm)."""
    return max(_LEAVES_SOME, 1000 * site.z_soil)


def _evapotranspiration(record: RoofRecord, site: Site) -> Iterator[Finding]:
    """Find impossible evapotranspiration: a day with too much, or no day with enough.

    Too little is found only if the site has a latitude, and in records of 30 days or more.
    """
    column = record.reference_column
    if not column:
        return
    numbers, day = np.unique(record.seconds // DAY_S, return_inverse=True)
    days, totals = numbers.astype("datetime64[D]"), np.bincount(day, record.reference)
    surplus = np.flatnonzero(totals > _MOST_A_DAY)
    if len(surplus):
        yield FINDINGS.make(
            "unit-error", "day", column,
            most=float(totals[surplus[0]]), day=str(days[surplus[0]]), bound=_MOST_A_DAY,
        )
    if site.latitude is None or record.steps * record.step_s < _FEWEST_DAYS * DAY_S:
        return
    minimum = _MIN_OF_SUN * evaporable(extraterrestrial_radiation(site.latitude, days))
    if np.all(totals < minimum):
        best = int(np.argmax(totals))
        yield FINDINGS.make(
            "unit-error", "month", column,
            most=float(totals[best]), day=str(days[best]), bound=float(minimum[best]),
        )


def _rain(record: RoofRecord) -> Iterator[Finding]:
    rain, days = float(np.nansum(record.rain)), _days(record)
    if rain + float(np.nansum(record.pumped)) < _MIN_RAIN:
        yield FINDINGS.make(
            "unit-error", "little rain", "rain", rain=rain, days=days, bound=_MIN_RAIN,
        )
    if days > 7 and rain / days > _MOST_RAIN_A_DAY:
        yield FINDINGS.make("unit-error", "much rain", "rain", rain=rain, days=days)


def _level(record: RoofRecord, site: Site, level: Values) -> Iterator[Finding]:
    """Find levels above the soil, or rises in storms that are far from the storms' water.

    A rise is between the means of half an hour before a storm's first rain and after its last.
    """
    highest = float(np.nanmax(level))
    if highest > site.highest_roof_level:
        yield FINDINGS.make(
            "unit-error", "high level", "level",
            highest=highest, soil=site.z_soil, when=record.time(int(np.nanargmax(level))),
        )
    mean_steps = max(1, round(_MEAN_S / record.step_s))
    water, rises = record.rain + record.pumped, []
    for storm in storms(record):
        if storm.first < mean_steps or storm.dry + mean_steps > record.steps:
            continue
        inflow = float(np.sum(water[storm.first - mean_steps:storm.dry + mean_steps]))
        # Levels are at the beginning of steps: the level of the first step is before its rain.
        before = level[storm.first + 1 - mean_steps:storm.first + 1]
        rise = 1000 * float(np.mean(level[storm.dry:storm.dry + mean_steps]) - np.mean(before))
        if inflow >= _COUNTS and not np.isnan(rise):
            rises.append((inflow, rise))
    inflow, risen = (sum(depths) for depths in zip(*rises, strict=True)) if rises else (1.0, 1.0)
    if len(rises) >= _FEWEST_STORMS and not _MIN_RISE < risen / inflow < _MOST_RISE:
        yield FINDINGS.make(
            "unit-error", "rises", "level",
            risen=risen, came=inflow, least=_MIN_RISE, most=_MOST_RISE,
        )


def _runoff(record: RoofRecord, site: Site, runoff: Values) -> Iterator[Finding]:
    """Find records with almost no runoff, but some.

    A watered roof may have so little if its soil could hold all the water.
    """
    known = ~np.isnan(runoff) & ~np.isnan(record.rain)
    inflow, outflow = float(np.sum(record.water[known])), float(np.sum(runoff[known]))
    if 0 < outflow < _MIN_OF_WATER * inflow and (
        not _watered(record).any()
        or greatest_rise(_gain_without_runoff(record, site, runoff)) > _most_storage(site)
    ):
        yield FINDINGS.make("unit-error", "little runoff", "runoff", gone=outflow, came=inflow)


def _storm_runoff(record: RoofRecord, site: Site, runoff: Values) -> Iterator[Finding]:
    """Find runoff that exceeds the water of storms, or is less than any roof lets run off.

    Water and runoff are of a storm and the day after it (mm). Storms with gaps do not count. The
    minimum share of runoff is not checked in storms on a watered roof, because a controller can
    make room for a storm.
    """
    water, watered, capacity = record.rain + record.pumped, _watered(record), 1000 * site.z_soil
    balances = []
    for storm in storms(record):
        span = slice(storm.first, storm.end)
        inflow, outflow = float(np.sum(water[span])), float(np.sum(runoff[span]))
        if not math.isnan(inflow + outflow):
            balances.append((outflow - inflow, outflow, inflow, storm.first))
    excess = sum(max(0.0, surplus) for surplus, *_ in balances)
    if excess > max(_MIN_EXCESS, _MOST_EXCESS * sum(outflow for _, outflow, *_ in balances)):
        _, outflow, inflow, first = max(balances)
        yield FINDINGS.make(
            "unit-error", "excess", "runoff", gone=outflow, came=inflow, when=record.time(first),
            excess=excess, storms=len(balances),
        )
    for surplus, outflow, inflow, first in balances:
        if surplus < -capacity - _EXTRA_STORAGE:
            yield FINDINGS.make(
                "unit-error", "held", "runoff", gone=outflow, came=inflow, when=record.time(first),
                held=capacity,
            )
            return
    shares = [
        outflow / inflow for _, outflow, inflow, first in balances
        if inflow >= _LARGE and not watered[first]
    ]
    if len(shares) >= _FEWEST_LARGE and _days(record) >= _LONG_DAYS and max(shares) < _MIN_SHARE:
        yield FINDINGS.make(
            "unit-error", "shares", "runoff", percent=100 * max(shares), storms=len(shares),
            large=_LARGE,
        )


# --- water that is missing ------------------------------------------------------------------------

# More runoff than this (mm), after this long (s) without rain, has no explanation.
_UNEXPLAINED, _DRY_S = 5.0, 3 * DAY_S
# A level rises without rain if means of this duration (s), of at least this many values, differ by
# this much (mm) and by this many times the maximum fall, after a day without rain. Noise of 2 mm
# makes a rise of 2 mm; a sensor that is warmed by the sun rises and falls equally.
_RISE_S, _RISE_VALUES, _RISE, _RISE_TO_FALL = 6 * HOUR_S, 6, 5.0, 3.0


def _silence(record: RoofRecord, site: Site, runoff: Values) -> Iterator[Finding]:
    """Find a flow meter that shows 0 for more water than soil and evapotranspiration take.

    A meter that never shows anything else is judged by the whole record, despite gaps.
    """
    zero, most = runoff == 0, _most_storage(site)
    gained = _gain_without_runoff(record, site, runoff)
    for low, high in gaps(zero) if np.any(runoff > 0) else [(0, record.steps)]:
        if greatest_rise(gained[low:high + 1]) > most:
            yield FINDINGS.make(
                "sensor-dead", "silent", "runoff",
                days=(high - low) * record.step_s / DAY_S, since=record.time(low),
                came=float(np.sum((record.water * zero)[low:high])), most=most,
            )
            return


def _wet(record: RoofRecord) -> Steps:
    """Return the steps with water, or in which it is unknown."""
    return np.asarray((record.water > 0) | np.isnan(record.rain) | np.isnan(record.pumped))


def _runoff_without_rain(record: RoofRecord, runoff: Values) -> Iterator[Finding]:
    since = math.ceil(_DRY_S / record.step_s)
    for low, high in gaps(~prolonged(_wet(record), since)):
        outflow = float(np.nansum(runoff[low:high]))
        if low > 0 and outflow > _UNEXPLAINED:
            yield FINDINGS.make(
                "gauge-blocked", "runoff", "rain",
                days=(high - low + since - 1) * record.step_s / DAY_S, when=record.time(high),
                gone=outflow,
            )
            return


def _rise_without_rain(record: RoofRecord, level: Values) -> Iterator[Finding]:
    count = max(_RISE_VALUES, round(_RISE_S / record.step_s))
    before = max(count, round(DAY_S / record.step_s))
    if record.steps <= before + count:
        return
    at = np.arange(before, record.steps - count)
    there, rained = (
        np.concatenate(([0], np.cumsum(marks))) for marks in (~np.isnan(level), _wet(record))
    )
    known = there[at + count] - there[at - count] == 2 * count
    dry = known & (rained[at + count] == rained[at - before])
    rise = 1000 * _rises(level, count)[at]
    most = int(np.argmax(np.where(dry, rise, 0.0)))
    fall = float(np.max(np.where(dry, -rise, 0.0)))
    if dry[most] and rise[most] > max(_RISE, _RISE_TO_FALL * fall):
        yield FINDINGS.make(
            "gauge-blocked", "rise", "rain",
            dry=time_name(before * record.step_s), when=record.time(int(at[most])),
            rise=float(rise[most]),
        )


# --- fits -----------------------------------------------------------------------------------------

# If the volume of runoff is wrong by more than this share, the fit is poor.
_VOLUME_OFF = 0.5


def check_fit(scores: Sequence[FitScores]) -> list[Finding]:
    """Return the objections to a fit.

    It is refused if it is worse than the mean of the measurements in every respect: every NSE is
    below 0, of hours (or of longer steps) and of days, in the fit and in the validation, and of
    every series. It is refused, too, if nothing that was measured changes in the validation, as can
    be if nothing runs off a well-kept roof: then no NSE judges it. A warning follows if, in the
    validation, the NSE of days is below 0 (of hours or longer steps if there are too few days), or
    the volume of runoff is wrong by more than half.
    """
    lines, best, worse, off, judged = [], [], [], [], False
    for row in scores:
        nses = {
            f"{nse:.2f} ({time_name(span_s)})": nse for span_s, nse in row.nse.items()
            if span_s >= HOUR_S and not math.isnan(nse)
        }
        lines.append(f"{row.quantity}, {row.part}: {' and '.join(nses)}")
        best.append(max(nses.values(), default=-math.inf))
        if row.part == "validation":
            judged = judged or bool(nses)
            name, nse = [*nses.items()][-1] if nses else ("", 0.0)
            if nse < 0:
                worse.append(f"NSE of {row.quantity} {name}")
            if row.quantity == "runoff" and abs(row.volume_error) > _VOLUME_OFF:
                off.append(f"volume of runoff {100 * row.volume_error:+.0f} %")
    if max(best) < 0:
        return [FINDINGS.make("no-fit", "no roof", "fit", scores="; ".join(lines))]
    if not judged:
        return [FINDINGS.make("unjudged", "constant", "validation")]
    if not worse and not off:
        return []
    verdict = "worse than the mean of what was measured" if worse else "far off"
    why = ", ".join(worse + off)
    return [FINDINGS.make("poor-fit", "poor", "fit", what=verdict, why=why)]


# --- level sensors --------------------------------------------------------------------------------

# From a day after the last water, a roof's level does not change at night.
_STILL_S, _SHORTEST_NIGHT_S, _FEWEST_NIGHTS = DAY_S, 3 * HOUR_S, 5


def level_sensor(record: RoofRecord, simulated: Values) -> Finding:
    """Return noise and drift of the level sensor, from nights without rain or evapotranspiration.

    Noise is the deviation of the level from its mean within a night. Drift is the slope of a line
    through the differences between the nights' mean measured and simulated levels. An offset cannot
    be separated from the wilting point, which absorbs it.

    Args:
        record: with a level.
        simulated: level (m), shape (steps,).
    """
    assert record.level is not None
    recent = prolonged(record.water > 0, math.ceil(_STILL_S / record.step_s))
    times, errors, variances = [], [], []
    for low, high in gaps(~recent & (record.reference == 0) & ~np.isnan(record.level)):
        if high - low > 1 and (high - low) * record.step_s >= _SHORTEST_NIGHT_S:
            times.append((low + high) / 2 * record.step_s / DAY_S)
            errors.append(float(np.mean(record.level[low:high] - simulated[low:high])))
            variances.append(float(np.var(record.level[low:high], ddof=1)))
    if len(times) < _FEWEST_NIGHTS:
        return FINDINGS.make("level-sensor", "unseen", "level sensor")
    from scipy import stats  # half of all import time, and not needed for a refusal

    line = stats.linregress(times, errors)
    drift = 30 * 1000 * float(line.slope)
    half = 30 * 1000 * float(line.stderr * stats.t.ppf(0.975, len(times) - 2))
    return FINDINGS.make(
        "level-sensor", "drift" if abs(drift) > half else "still", "level sensor",
        noise=1000 * float(np.sqrt(np.mean(variances))), drift=drift, half=half, nights=len(times),
    )
