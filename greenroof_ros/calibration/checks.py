"""What speaks against a record or its fit, and what else is found: one function for each check.

The bounds part the two measured roofs (Neubrandenburg 2014 and 2015, Berlin 2019, April to October,
in windows of 30 to 100 days) from the same records with a wrong unit, a shifted clock or a broken
sensor; bounds of levels part the levels that these roofs would have.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from greenroof_ros.calibration.record import (
    DAY_S,
    HOUR_S,
    Record,
    Steps,
    Values,
    greatest_rise,
    lately,
    storms,
    time_name,
)
from greenroof_ros.calibration.scores import Scores
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.quality import Finding, Findings
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import evaporable, extraterrestrial_radiation

FINDINGS = Findings(Path(__file__).with_name("findings.yaml"))
"""All that a calibration can find."""

_FEWEST_VALUES = 100


def check_record(record: Record, site: Site) -> list[Finding]:
    """Return what is wrong with a sensor, a unit or a clock of a record.

    Args:
        record: what was measured in the steps that count.
        site: its roof and place.

    Raises:
        ConfigurationError: a column has fewer than 100 values.
    """
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _FEWEST_VALUES:
            raise ConfigurationError(
                f"has {there} values; it must have {_FEWEST_VALUES} at least", file=record.source,
                key=column,
            )
    findings = [
        *_sparse(record), *_stuck(record), *_clock(record), *_evapotranspiration(record, site),
        *_rain(record),
    ]
    level, runoff = record.level, record.runoff
    if level is not None:
        findings += _level(record, site, level)
    if runoff is not None:
        findings += [
            *_runoff(record, site, runoff), *_storm_runoff(record, site, runoff),
            *_silence(record, site, runoff), *_runoff_without_rain(record, runoff),
        ]
    if level is not None:
        findings += _rise_without_rain(record, level)
    return findings


# --- sensors --------------------------------------------------------------------------------------

# A reading that is the same for so long (s) while so much rain fell (mm), and in so many steps: on
# two days in a row a roof can be as full, be it wet.
_STUCK_S, _STUCK_RAIN, _RAIN_STUCK_S, _SAME_STEPS = DAY_S, 10.0, 6 * HOUR_S, 6


def _sparse(record: Record) -> Iterator[Finding]:
    """A sensor that is read less often than there are rows: between, all would be gaps."""
    for column, values in {"rain": record.rain, **record.measured}.items():
        often = float(np.median(np.diff(np.flatnonzero(~np.isnan(values)))))
        if often > 1:
            yield FINDINGS.make(
                "sensor-sparse", "sparse", column,
                seen=time_name(often * record.step_s), step=time_name(record.step_s),
            )


def _stuck(record: Record) -> Iterator[Finding]:
    """A sensor that shows one value while it must change."""
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


# --- clocks ---------------------------------------------------------------------------------------

# Water reaches a level sensor within minutes and leaves a roof within hours; more is a clock. So is
# an answer that comes before the rain by more than so many steps, and two hours at most: clocks
# differ by minutes, and a level's rises are between means of half an hour.
_LONGEST_DELAY_S, _MOST_SHIFT_S = 4 * HOUR_S, 26 * HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * HOUR_S
# A correlation that says something, and how many times that without a shift it must be. A roof that
# answers early is wrong for certain: in 64 windows of 30 and 60 days of the two measured roofs the
# best is at most 1.03 times that without a shift; with a clock an hour early it is more than 1.1
# times that in 47 of them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5


def _clock(record: Record) -> Iterator[Finding]:
    """A roof that answers before it rains, or hours after.

    Its rises answer: how long a roof goes on after the rain says nothing about clocks. Those of a
    level are of half an hour's mean over the one before, in which a sensor's noise is less.
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
    # Roots make one great storm less heavy among the others.
    came, answers = (
        roots - roots.mean()
        for roots in (np.sqrt(record.came), np.sqrt(np.maximum(np.nan_to_num(rises), 0.0)))
    )
    scale = np.sqrt(np.sum(came**2) * np.sum(answers**2))
    if scale == 0:
        return
    most = int(_MOST_SHIFT_S // record.step_s)
    lags = record.step_s * np.arange(-most, most + 1)
    correlations = np.correlate(np.pad(answers, most), came, "valid") / scale
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
    """Return the mean of so many values from each on, less the mean of as many before it.

    What is not known counts as 0, what was before the first, too. Shape (values - count + 1,).
    """
    weights = np.repeat([1.0, -1.0], count) / count
    return np.convolve(np.nan_to_num(values), weights)[count - 1:len(values)]


# --- units ----------------------------------------------------------------------------------------

# More evapotranspiration than any day has (mm). Alfalfa, which takes 1.15 times what grass does,
# took 14 mm on the windiest days of four years in Texas, weighed (Evett, Howell, Todd, Schneider
# and Tolk, Alfalfa reference ET measurement and prediction, 4th Decennial National Irrigation
# Symposium, 2000).
_MOST_A_DAY = 20.0
# Less than the best day of a month has, as a share of what the sun above the atmosphere could
# evaporate. By Hargreaves' equation it has 0.12 at least at the two measured roofs, and 0.08 in
# eleven years of Toronto, in their coldest months; a twelfth of it 0.04 at most, in summer. A bound
# in mm cannot part the two.
_LEAST_OF_SUN, _FEWEST_DAYS = 0.06, 30
# Least rain from which anything can be said (mm), and what is no rain of weeks (mm a day).
_LEAST_RAIN, _MOST_RAIN_A_DAY = 20.0, 60.0
# More than a storm's water runs off in it: as a share of all runoff in storms at most 0.13 of the
# measured roofs, and with a wrong unit 0.21 and more, mostly 0.4. And in mm, which a few drops
# never are.
_MOST_EXCESS, _LEAST_EXCESS = 0.25, 5.0
# The greatest share of a storm of 5 mm or more that runs off: 0.13 at least, and with a wrong unit
# 0.08 at most; of three such storms in 90 days. A shorter record may be of a dry month.
_LEAST_SHARE, _LARGE, _FEWEST_LARGE, _LONG_DAYS = 0.1, 5.0, 3, 90
# What runs off of a storm that is more than the soil's volume comes but for this (mm).
_HELD_BESIDES = 20.0
# How much levels rise in storms of 1 mm and more, as a share of their water: 0.4 to 1.1, and with a
# wrong unit 0.09 at most or 6 at least; of three such storms.
_LEAST_RISE, _MOST_RISE, _COUNTS, _FEWEST_STORMS = 0.1, 2.0, 1.0, 3
# Means so long before and after a storm, in which a sensor's noise is less (s).
_BESIDE_S = 1800
# So much water leaves some runoff behind (mm), be it in many storms; and so does all that the soil
# could hold. The measured roofs let nothing run off of 44 mm in four weeks.
_LEAVES_SOME = 80.0
# Nobody waters the measured roofs: they dry out, and their bounds allow for what evaporates then. A
# roof that was watered within a week goes on at the full rate, the rate of the reference grass
# times 1.3 at most (FAO-56, Eq. 72: 1.05 to 1.3).
_WATERED_S, _FULL_RATE = 7 * DAY_S, 1.3


def _days(record: Record) -> float:
    """Return of how many days the rain is known."""
    return float(np.count_nonzero(~np.isnan(record.rain))) * record.step_s / DAY_S


def _watered(record: Record) -> Steps:
    """Return in which steps something was pumped onto the roof within a week."""
    return lately(np.nan_to_num(record.pumped) > 0, math.ceil(_WATERED_S / record.step_s))


def _to_hold(record: Record, site: Site) -> Values:
    """Return what a roof off which nothing runs gains up to each step (mm), shape (steps + 1,).

    Its greatest rise in some steps is what a dry roof must hold in them. Of what comes,
    evapotranspiration takes all that it can while somebody waters the roof: a good controller gives
    it no more than that.
    """
    rate = max(_FULL_RATE, site.crop_coefficient)
    evaporated = np.where(_watered(record), rate * record.reference, 0.0)
    return np.concatenate(([0.0], np.cumsum(record.came - evaporated)))


def _most_held(site: Site) -> float:
    """Return what a roof holds at most before some of its water runs off (mm)."""
    return max(_LEAVES_SOME, 1000 * site.z_soil)


def _evapotranspiration(record: Record, site: Site) -> Iterator[Finding]:
    """A column of evapotranspiration that no place has: a day with too much, no day with enough.

    Too little is seen where the site has its latitude, and in records of 30 days or more.
    """
    column = record.reference_column
    if not column:
        return
    numbers, day = np.unique(record.seconds // DAY_S, return_inverse=True)
    days, totals = numbers.astype("datetime64[D]"), np.bincount(day, record.reference)
    over = np.flatnonzero(totals > _MOST_A_DAY)
    if len(over):
        yield FINDINGS.make(
            "unit-error", "day", column,
            most=float(totals[over[0]]), day=str(days[over[0]]), bound=_MOST_A_DAY,
        )
    if site.latitude is None or record.steps * record.step_s < _FEWEST_DAYS * DAY_S:
        return
    least = _LEAST_OF_SUN * evaporable(extraterrestrial_radiation(site.latitude, days))
    if np.all(totals < least):
        best = int(np.argmax(totals))
        yield FINDINGS.make(
            "unit-error", "month", column,
            most=float(totals[best]), day=str(days[best]), bound=float(least[best]),
        )


def _rain(record: Record) -> Iterator[Finding]:
    rain, days = float(np.nansum(record.rain)), _days(record)
    if rain + float(np.nansum(record.pumped)) < _LEAST_RAIN:
        yield FINDINGS.make(
            "unit-error", "little rain", "rain", rain=rain, days=days, bound=_LEAST_RAIN,
        )
    if days > 7 and rain / days > _MOST_RAIN_A_DAY:
        yield FINDINGS.make(
            "unit-error", "much rain", "rain", rain=rain, days=days,
        )


def _level(record: Record, site: Site, level: Values) -> Iterator[Finding]:
    """Levels above the soil, or that rise by much more or less than what storms bring.

    A storm's rise is from the mean of half an hour before its first rain to that after its last.
    """
    highest = float(np.nanmax(level))
    if highest > site.highest_roof_level:
        yield FINDINGS.make(
            "unit-error", "high level", "level",
            highest=highest, soil=site.z_soil, when=record.time(int(np.nanargmax(level))),
        )
    beside = max(1, round(_BESIDE_S / record.step_s))
    water, rises = record.rain + record.pumped, []
    for storm in storms(record):
        if storm.first < beside or storm.dry + beside > record.steps:
            continue
        came = float(np.sum(water[storm.first - beside:storm.dry + beside]))
        # Levels are of the beginnings of steps: the storm's first is before its rain.
        before = level[storm.first + 1 - beside:storm.first + 1]
        rise = 1000 * float(np.mean(level[storm.dry:storm.dry + beside]) - np.mean(before))
        if came >= _COUNTS and not np.isnan(rise):
            rises.append((came, rise))
    came, risen = (sum(depths) for depths in zip(*rises, strict=True)) if rises else (1.0, 1.0)
    if len(rises) >= _FEWEST_STORMS and not _LEAST_RISE < risen / came < _MOST_RISE:
        yield FINDINGS.make(
            "unit-error", "rises", "level",
            risen=risen, came=came, least=_LEAST_RISE, most=_MOST_RISE,
        )


def _runoff(record: Record, site: Site, runoff: Values) -> Iterator[Finding]:
    """Next to nothing of what came runs off.

    That is what a watered roof may leave, as long as its soil can hold the rest.
    """
    known = ~np.isnan(runoff) & ~np.isnan(record.rain)
    came, gone = float(np.sum(record.came[known])), float(np.sum(runoff[known]))
    if gone < 0.001 * came and (
        not _watered(record).any() or greatest_rise(_to_hold(record, site)) > _most_held(site)
    ):
        code, case = ("unit-error", "little runoff") if gone > 0 else ("sensor-dead", "nothing")
        yield FINDINGS.make(code, case, "runoff", gone=gone, came=came)


def _storm_runoff(record: Record, site: Site, runoff: Values) -> Iterator[Finding]:
    """Runoff that is more than what came storm by storm, or less than any roof lets off.

    What came and what ran off are of a storm and the day after (mm). Storms with gaps do not count.
    From when on a roof leaves some of a storm nobody knows where it is watered: a controller may
    make room for the storm.
    """
    water, watered, capacity = record.rain + record.pumped, _watered(record), 1000 * site.z_soil
    balances = []
    for storm in storms(record):
        span = slice(storm.first, storm.end)
        came, gone = float(np.sum(water[span])), float(np.sum(runoff[span]))
        if not math.isnan(came + gone):
            balances.append((gone - came, gone, came, storm.first))
    excess = sum(max(0.0, over) for over, *_ in balances)
    if excess > max(_LEAST_EXCESS, _MOST_EXCESS * sum(gone for _, gone, *_ in balances)):
        _, gone, came, first = max(balances)
        yield FINDINGS.make(
            "unit-error", "excess", "runoff", gone=gone, came=came, when=record.time(first),
            excess=excess, storms=len(balances),
        )
    for over, gone, came, first in balances:
        if over < -capacity - _HELD_BESIDES:
            yield FINDINGS.make(
                "unit-error", "held", "runoff", gone=gone, came=came, when=record.time(first),
                held=capacity,
            )
            return
    shares = [
        gone / came for _, gone, came, first in balances if came >= _LARGE and not watered[first]
    ]
    if len(shares) >= _FEWEST_LARGE and _days(record) >= _LONG_DAYS and max(shares) < _LEAST_SHARE:
        yield FINDINGS.make(
            "unit-error", "shares", "runoff", percent=100 * max(shares), storms=len(shares),
            large=_LARGE,
        )


# --- water that is missing ------------------------------------------------------------------------

# Water that comes from a roof without any rain on it for so long (mm, s).
_UNEXPLAINED, _DRY_S = 5.0, 3 * DAY_S
# A level that rises without rain: the means of so long before and after (s), and of so many values
# at least, apart by so much (mm), and by so many times more than it ever falls so, with none for a
# day before. Noise of 2 mm makes 2 mm of it; a sensor that feels the sun rises and falls alike.
_RISE_S, _RISE_VALUES, _RISE, _RISE_TO_FALL = 6 * HOUR_S, 6, 5.0, 3.0


def _silence(record: Record, site: Site, runoff: Values) -> Iterator[Finding]:
    """A flow meter that shows none of more water than soil and evapotranspiration can take."""
    most, gained = _most_held(site), _to_hold(record, site)
    for low, high in gaps(runoff == 0):
        if greatest_rise(gained[low:high + 1]) > most:
            yield FINDINGS.make(
                "sensor-dead", "silent", "runoff",
                days=(high - low) * record.step_s / DAY_S, since=record.time(low),
                came=float(np.sum(record.came[low:high])), most=most,
            )
            return


def _wet(record: Record) -> Steps:
    """Return in which steps water came, or may have come."""
    return np.asarray((record.came > 0) | np.isnan(record.rain) | np.isnan(record.pumped))


def _runoff_without_rain(record: Record, runoff: Values) -> Iterator[Finding]:
    since = math.ceil(_DRY_S / record.step_s)
    for low, high in gaps(~lately(_wet(record), since)):
        gone = float(np.nansum(runoff[low:high]))
        if low > 0 and gone > _UNEXPLAINED:
            yield FINDINGS.make(
                "gauge-blocked", "runoff", "rain",
                days=(high - low + since - 1) * record.step_s / DAY_S, when=record.time(high),
                gone=gone,
            )
            return


def _rise_without_rain(record: Record, level: Values) -> Iterator[Finding]:
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

# Simulated too much or too little by this share, runoff is not the roof's.
_VOLUME_OFF = 0.5
_LOOK_AT = (
    "Look at units, at clocks that are shifted, at sensors that are stuck or blocked, and at a2 "
    "and z_soil of the site."
)


def check_fit(scores: Sequence[Scores]) -> list[Finding]:
    """Return what speaks against a fit.

    It is refused where it is worse than the mean of what was measured, wherever one looks: an NSE
    below 0 of hours (or the steps, where they are longer) and of days, in the fit and in the
    validation, of everything that was measured. Nobody should use it where the validation has an
    NSE of days below 0, of hours (or longer steps) where there are too few days, or a volume that
    is wrong by more than half.
    """
    lines, best, worse, off = [], [], [], []
    for row in scores:
        nses = {
            f"{nse:.2f} ({time_name(over_s)})": nse for over_s, nse in row.nse.items()
            if over_s >= HOUR_S and not math.isnan(nse)
        }
        lines.append(f"{row.quantity}, {row.part}: {' and '.join(nses)}")
        best.append(max(nses.values(), default=0.0))
        if row.part == "validation":
            name, nse = [*nses.items()][-1] if nses else ("", 0.0)
            if nse < 0:
                worse.append(f"NSE of {row.quantity} {name}")
            if row.quantity == "runoff" and abs(row.volume_error) > _VOLUME_OFF:
                off.append(f"volume of runoff {100 * row.volume_error:+.0f} %")
    if max(best) < 0:
        return [FINDINGS.make("no-fit", "no roof", "fit", scores="; ".join(lines), look=_LOOK_AT)]
    if not worse and not off:
        return []
    verdict = "worse than the mean of what was measured" if worse else "wrong by much"
    why = ", ".join(worse + off)
    return [FINDINGS.make("poor-fit", "poor", "fit", what=verdict, why=why, look=_LOOK_AT)]


# --- level sensors --------------------------------------------------------------------------------

# A day after the last water nothing moves on a roof at night.
_STILL_S, _SHORTEST_NIGHT_S, _FEWEST_NIGHTS = DAY_S, 3 * HOUR_S, 5


def level_sensor(record: Record, simulated: Values) -> Finding:
    """Return what nights say in which neither rain nor evapotranspiration moves the level.

    The noise is what the level does within a night, about its mean; the drift the line through what
    the nights' means are above the simulated level. An offset cannot be told from the wilting
    point, which takes it up.

    Args:
        record: with a level.
        simulated: level (m), shape (steps,).
    """
    assert record.level is not None
    recent = lately(record.came > 0, math.ceil(_STILL_S / record.step_s))
    times, errors, variances = [], [], []
    for low, high in gaps(~recent & (record.reference == 0) & ~np.isnan(record.level)):
        if high - low > 1 and (high - low) * record.step_s >= _SHORTEST_NIGHT_S:
            times.append((low + high) / 2 * record.step_s / DAY_S)
            errors.append(float(np.mean(record.level[low:high] - simulated[low:high])))
            variances.append(float(np.var(record.level[low:high], ddof=1)))
    if len(times) < _FEWEST_NIGHTS:
        return FINDINGS.make("level-sensor", "unseen", "level sensor")
    from scipy import stats  # half of what the command imports, before it refuses

    line = stats.linregress(times, errors)
    drift = 30 * 1000 * float(line.slope)
    half = 30 * 1000 * float(line.stderr * stats.t.ppf(0.975, len(times) - 2))
    return FINDINGS.make(
        "level-sensor", "drift" if abs(drift) > half else "still", "level sensor",
        noise=1000 * float(np.sqrt(np.mean(variances))), drift=drift, half=half, nights=len(times),
    )
