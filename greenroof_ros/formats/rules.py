"""Rules that detect implausible measurements of weather and of roofs.

The weather command, runs, studies and calibration apply the same rules. Each rule yields one
sentence per finding, and none for a record that lacks the columns needed by the rule. To add a
rule, add a function, a row of :data:`RULES` and a test. The modules :mod:`.cells` and
:mod:`.quantities` define the permitted content of a single cell. The bounds separate the records of
two roofs (Neubrandenburg 2014 and 2015, Berlin 2019, April to October, in windows of 30 to 100
days) from the same records with a wrong unit, a shifted clock or a defective sensor. The bounds for
levels separate simulated levels of these roofs in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta

import numpy as np

from greenroof_ros.base.times import to_minutes
from greenroof_ros.formats.hourly import Records, find_gaps, number_days
from greenroof_ros.formats.quantities import (
    DEW_POINT,
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    RADIATION,
    TEMPERATURE,
)
from greenroof_ros.formats.step_record import (
    DAY_S,
    HOUR_S,
    StepRecord,
    Steps,
    Values,
    find_storms,
    name_time,
    prolong_steps,
)
from greenroof_ros.formats.sun import MM_PER_MJ, extraterrestrial_radiation
from greenroof_ros.site.site import Place, Site


def check_steps(record: StepRecord, site: Place) -> list[str]:
    """Return one sentence about each implausible finding in a record, which is used unchanged.

    Args:
        record: the measurements; NaN for measurements that are not checked.
        site: site with the roof and its location.
    """
    return [sentence for find in RULES for sentence in find(record, site)]


def check_hours(records: Records, site: Place, hours: range) -> list[str]:
    """Return one sentence about each implausible finding in given hours; see :func:`check_steps`.

    If the records state their location, it takes precedence over the site's location.
    """
    for latitude, longitude in [*records.places.values()][:1]:
        site = replace(site, latitude=latitude, longitude=longitude)
    nothing = np.zeros(records.hours)
    given = records.values.get(EVAPOTRANSPIRATION, nothing) if records.method else nothing
    steps = np.zeros(records.hours, dtype=bool)
    steps[hours.start : hours.stop] = True
    record = StepRecord(
        records.files[0], records.first, HOUR_S, records.values[PRECIPITATION],
        np.nan_to_num(given) / 24, nothing, None, None, records.values.get(TEMPERATURE),
        reference_column=f"{records.method} {EVAPOTRANSPIRATION}" * (given is not nothing),
        dew_point=records.values.get(DEW_POINT), radiation=records.values.get(RADIATION),
        wind=records.values.get("wind speed"),
    )
    return check_steps(record.select(steps), site)


# --- units ----------------------------------------------------------------------------------------

# More rain than falls almost anywhere on earth in a week or longer (mm a day).
_MAX_A_DAY, _MIN_DAYS = 60.0, 7.0
# More evapotranspiration than on any day (mm). Alfalfa, with 1.15 times the evapotranspiration of
# grass, had 14 mm, by weighing, on the windiest days of four years in Texas (Evett, Howell, Todd,
# Schneider and Tolk, Alfalfa reference ET measurement and prediction, 4th Decennial National
# Irrigation Symposium, 2000).
_MAX_EVAPORATED = 20.0
# Less movement of a level (m) than any roof shows in 20 mm of water.
_MIN_MOVEMENT = 0.002
# Median of dew point minus temperature (K) that sensor errors can explain.
_MAX_ABOVE = 1.0


def find_much_rain(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find amounts of rain and pumped water that are too large for the length of the record."""
    days = float(np.count_nonzero(~np.isnan(record.rain))) * record.step_s / DAY_S
    water, limit = float(record.water.sum()), _MAX_A_DAY * max(days, _MIN_DAYS)
    if water > limit:
        yield (
            f"rain is {water:.4g} mm in {days:.3g} days, including pumped water; more than "
            f"{limit:.4g} mm is rare: is the unit of the column right?"
        )


def find_wrong_amounts(record: StepRecord, site: Place) -> Iterator[str]:
    """Find evapotranspiration, levels and dew points that do not occur anywhere on Earth."""
    amounts = []
    if record.reference_column:
        _, day = np.unique(record.seconds // DAY_S, return_inverse=True)
        highest = float(np.bincount(day, record.reference).max())
        amounts.append((record.reference_column, "mm in one day", highest, 0.0, _MAX_EVAPORATED))
    if record.dew_point is not None and record.temperature is not None:
        above = _find_median(record.dew_point - record.temperature)
        amounts.append((DEW_POINT, "K above the temperature", above, -math.inf, _MAX_ABOVE))
    if record.level is not None and not np.isnan(record.level).all():
        assert isinstance(site, Site)  # only the record of a roof has a level
        highest, lowest = float(np.nanmax(record.level)), float(np.nanmin(record.level))
        amounts += [
            ("level", "m at its highest", highest, -math.inf, site.max_roof_level),
            ("level", "m from lowest to highest", highest - lowest, _MIN_MOVEMENT, math.inf),
        ]
    for column, what, value, low, high in amounts:
        if value < low or value > high:
            bound = f"no more than {high:.4g}" if value > high else f"at least {low:.4g}"
            yield (
                f"{column}: is {value:.3g} {what}, but must be {bound}: are the units of this "
                "column and of the other columns right?"
            )


# The mean of the hours with rain (mm), over this many of them: up to 5.9 in months of eleven years
# at Toronto, so 8 elsewhere [assumed]; tenths of a millimetre make it ten times as much. In this
# many hours, the wettest has less than 1 mm only if the unit is wrong, or if amounts per row are in
# a column of rates.
_MAX_MEAN_WET, _FEW_WET = 8.0, 20
_MIN_WETTEST, _MANY_WET = 1.0, 100
# Reference evapotranspiration is between these shares of what the sun's energy outside the
# atmosphere could evaporate, in this many days with this much of it (mm) [assumed]; mm/h in a
# column of mm/day would be a twenty-fourth.
_OF_ENERGY, _MIN_ENERGY_DAYS, _MIN_ENERGY = (0.03, 1.0), 1, 1.0
# Radiation at the ground is 0.25 of that outside the atmosphere under clouds, 0.75 without them
# (FAO-56, Eq. 35), so the clearest of this many days has a share between these; J/cm2 in an hour
# make 0.36 of W/m2.
_CLEAREST, _CLEAREST_DAYS = (0.3, 1.0), 10
# The warmest places have a median below this (degC) under this much sun (MJ/m2 a day) [assumed];
# where it is 2 degC in winter, degF would be above it.
_WARMEST, _WARMEST_PER_MJ = 18.0, 0.6


def find_wrong_rain(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find rain in a wrong unit, or given as totals over periods other than its rows."""
    if record.step_s > HOUR_S:
        return
    rain = np.nan_to_num(record.rain if record.all_rain is None else record.all_rain)
    hours = np.bincount(record.seconds // HOUR_S - record.seconds[0] // HOUR_S, rain)
    wet = hours[hours > 0]
    mean = float(wet.mean()) if wet.size else 0.0
    if wet.size >= _FEW_WET and mean > _MAX_MEAN_WET:
        yield (
            f"rain has a mean of {mean:.3g} mm in {wet.size} wet hours; more than "
            f"{_MAX_MEAN_WET:g} mm is rare: is it in tenths of a millimetre?"
        )
    if wet.size >= _MANY_WET and float(wet.max()) < _MIN_WETTEST:
        yield (
            f"rain is at most {wet.max():.3g} mm in each of {wet.size} wet hours: is the unit "
            "right? The unit of an amount per row is [mm], not [mm/h]"
        )
    if wet.size >= _FEW_WET and (wet % 1 == 0).all() and wet.max() > 1:
        yield (
            f"rain is a whole number of millimetres in all {wet.size} wet hours: is it a count of "
            "bucket tips, or in tenths of a millimetre?"
        )
    for what, at in (
        ("falls", np.flatnonzero(hours)), ("changes", np.flatnonzero(np.diff(hours))),
    ):
        every = int(np.gcd.reduce(np.diff(at))) if len(at) >= _FEW_WET else 1
        if every > 1:
            yield f"rain {what} only every {every} h: is each value the total over {every} hours?"
            break


def find_unlike_sun(record: StepRecord, site: Place) -> Iterator[str]:
    """Find evapotranspiration, radiation and temperature that contradict the sun's energy."""
    if site.latitude is None:
        return
    days, day = np.unique(record.seconds // DAY_S, return_inverse=True)
    energy = extraterrestrial_radiation(site.latitude, days.astype("datetime64[D]"))
    sunny = (np.bincount(day) * record.step_s >= DAY_S) & (MM_PER_MJ * energy > _MIN_ENERGY)
    energy, count = energy[sunny], np.count_nonzero(sunny)
    amounts = []
    if record.reference_column and count >= _MIN_ENERGY_DAYS:
        evaporated = np.bincount(day, record.reference)[sunny].sum() / MM_PER_MJ
        amounts.append((
            record.reference_column, evaporated / energy.sum(), "of what the sun could evaporate",
            *_OF_ENERGY,
        ))
    if record.radiation is not None and count >= _CLEAREST_DAYS:
        radiation = np.bincount(day, record.radiation)[sunny] * record.step_s / 1e6
        amounts.append((
            RADIATION, np.fmax.reduce(radiation / energy),
            "of the extraterrestrial radiation on the clearest day", *_CLEAREST,
        ))
    if record.temperature is not None and count >= _MIN_ENERGY_DAYS:
        amounts.append((
            TEMPERATURE, _find_median(record.temperature), "degC as a median, for this latitude "
            "and season",
            -math.inf, _WARMEST + _WARMEST_PER_MJ * energy.mean(),
        ))
    for column, value, what, low, high in amounts:
        if value < low or value > high:
            bound = f"more than {high:.3g}" if value > high else f"less than {low:.3g}"
            yield f"{column} is {value:.3g} {what}; {bound} is rare: is the unit right?"


# The dew point of air does not exceed its temperature by more than sensor errors (K) in this many
# hours; at saturation, the vapour pressure in hPa exceeds the temperature in degC by 2 or more. In
# kPa it stays between 0 and 4.5 up to a dew point of 31 degC. A dew point does not in this many
# hours: in ten days of twelve years at Toronto it moved by 4.3 K or more.
_MAX_SATURATED, _VAPOUR_KPA, _DEW_HOURS = 0.05, 4.5, 240
# No town has a median wind of this (km/h) in this many hours [assumed]; at Toronto it is no more
# than 34 in ten days. Numbers of a wind in km/h are 3.6 times those in m/s.
_WINDIEST, _WIND_HOURS = 43.0, 240


def find_unlike_air(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find vapour pressure in the column of the dew point, and wind speed in a wrong unit."""
    if record.dew_point is not None:
        dew_point = record.dew_point[~np.isnan(record.dew_point)]
        if record.temperature is not None:
            saturated = np.count_nonzero(record.dew_point > record.temperature + _MAX_ABOVE)
            if saturated > _MAX_SATURATED * dew_point.size:
                yield (
                    f"{DEW_POINT} is more than {_MAX_ABOVE:g} K above the temperature in "
                    f"{saturated} rows: is it vapour pressure, or was it measured at a different "
                    "location?"
                )
        if len(dew_point) * record.step_s >= _DEW_HOURS * HOUR_S and (
            dew_point.min() >= 0 and dew_point.max() <= _VAPOUR_KPA
        ):
            yield (
                f"{DEW_POINT} stays between {dew_point.min():.3g} and {dew_point.max():.3g} degC: "
                "is it vapour pressure?"
            )
    if record.wind is not None:
        hours = np.count_nonzero(~np.isnan(record.wind)) * record.step_s / HOUR_S
        median = _find_median(record.wind)
        if hours >= _WIND_HOURS and median > _WINDIEST:
            yield (
                f"wind speed has a median of {median:.3g} km/h; more than {_WINDIEST:g} is rare: "
                "is the unit right?"
            )


def _find_median(series: Values) -> float:
    known = series[~np.isnan(series)]
    return float(np.median(known)) if known.size else math.nan


# The largest excess of runoff over water, summed over storms, as a share of their runoff: up to
# 0.13 for both roofs; with a wrong unit at least 0.21, usually 0.4. A few drops (mm) do not count.
_MAX_EXCESS, _DROPS = 0.25, 5.0
# A roof retains no more of a storm than the soil's volume and this (mm).
_EXTRA_STORAGE = 20.0
# Runoff of a record as a share of its water, if there is any: at least 0.0025 in windows of 30 days
# or more; with runoff in m instead of mm, no more than 0.0007.
_MIN_SHARE = 0.001


def find_imbalance(record: StepRecord, site: Place) -> Iterator[str]:
    """Compare runoff with rain and pumped water, in total and for every storm."""
    if record.runoff is None:
        return
    total = float(np.nansum(record.runoff))
    inflow = float(np.sum(record.water[~np.isnan(record.runoff)]))
    # A watered roof may retain all of it.
    if 0 < total < _MIN_SHARE * inflow and not np.any(record.pumped > 0):
        yield (
            f"runoff is only {total:.2g} mm for {inflow:.4g} mm of rain: is the unit of the "
            "column right?"
        )
    water = record.rain + record.pumped
    sums = np.array([
        (np.sum(water[storm]), np.sum(record.runoff[storm])) for storm in find_storms(record)
    ]).reshape(-1, 2)
    came, gone = sums[~np.isnan(sums).any(axis=1)].T
    excess = float(np.sum(np.maximum(gone - came, 0.0)))
    if excess > max(_DROPS, _MAX_EXCESS * float(np.sum(gone))):
        yield (
            f"runoff is {excess:.3g} mm more than the rain and pumped water that caused it: are "
            "the units and a2 right?"
        )
    if not isinstance(site, Site):
        return
    kept = float(np.max(came - gone, initial=0.0))
    if kept > 1000 * site.z_soil + _EXTRA_STORAGE:
        yield (
            f"rain exceeds runoff by {kept:.3g} mm in one storm, which is more than the soil can "
            "hold: are the units and z_soil right?"
        )


# --- clocks ---------------------------------------------------------------------------------------

# Water reaches a level sensor within minutes and leaves a roof within hours; a longer delay means a
# shifted clock. So does a response more than this many steps before the rain, or two hours: clocks
# can differ by minutes, and a level's rises are between half-hour means.
_MAX_DELAY_S, _MAX_SHIFT_S = 4 * HOUR_S, 26 * HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * HOUR_S
# The minimum correlation that counts, and the minimum ratio of the best correlation to the one
# without a shift. An early response is always wrong: in 64 windows of 30 and 60 days of the two
# roofs this ratio is no more than 1.03; with a clock an hour early it is above 1.1 in 47 of them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5


def find_shifted_clock(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find a roof that responds before the rain, or many hours after it.

    Only the rises of runoff or level are used, since the duration of runoff after rain contains no
    information about clocks. The rise of a level is the difference between two half-hour means,
    which reduces the sensor's noise.
    """
    if not record.measured:
        return
    column, series = next(iter(record.measured.items()))
    if column == "runoff":
        rises = np.diff(series, prepend=np.nan)
    else:
        count = max(1, round(1800 / record.step_s))
        weights = np.repeat([1.0, -1.0], count) / count
        rises = np.convolve(np.nan_to_num(series), weights)[count:len(series)]
        rises = np.append(rises, np.zeros(count))
    usual_s = (
        -min(_EARLY_STEPS[column] * record.step_s, _EARLY_S), max(_MAX_DELAY_S, record.step_s),
    )
    # Square roots reduce the weight of one large storm.
    inflow, answers = (
        roots - roots.mean()
        for roots in (np.sqrt(record.water), np.sqrt(np.maximum(np.nan_to_num(rises), 0.0)))
    )
    scale = np.sqrt(np.sum(inflow**2) * np.sum(answers**2))
    if scale == 0:
        return
    reach = int(_MAX_SHIFT_S // record.step_s)
    lags = record.step_s * np.arange(-reach, reach + 1)
    correlations = np.correlate(np.pad(answers, reach), inflow, "valid") / scale
    lag, best = float(lags[np.argmax(correlations)]), float(correlations.max())
    usual = float(correlations[(lags >= usual_s[0]) & (lags <= usual_s[1])].max())
    early = lag < usual_s[0]
    better = _EARLY_BETTER if early else _LATE_BETTER
    if (early or lag > usual_s[1]) and best > _CLEAR and best > better * usual:
        yield (
            f"{column} responds to the rain {name_time(abs(lag))} "
            f"{'before' if early else 'after'} the rain falls (correlation {best:.2f}, but "
            f"{usual:.2f} without a shift): is a clock wrong, or set to a different time zone?"
        )


# --- sensors --------------------------------------------------------------------------------------

# A sensor is stuck if its reading stays the same for this long (s) while this much rain falls (mm),
# and in this many steps: with steps of a day, a roof can have the same level on two wet days.
_STUCK_S, _STUCK_RAIN, _SAME_STEPS = DAY_S, 10.0, 6
# Rain is stuck above 0 for a day, or for this long (s) in this many steps. In eleven years at
# Toronto it was the same for 9 hours; in models with steps of 3 or 6 hours, for 12.
_RAIN_STUCK_S, _SAME_RAIN_STEPS = 6 * HOUR_S, 24
# More water than this (mm) must cause some runoff if it also exceeds what the soil can hold.
# Neither roof had runoff from 44 mm in four weeks.
_LEAVES_SOME = 80.0
# A watered roof evaporates at the full rate, which is up to 1.3 times the rate of the reference
# grass (FAO-56, Eq. 72: 1.05 to 1.3). The two roofs are not watered, and dry out.
_FULL_RATE = 1.3
# More runoff than this (mm), this long (s) or longer after rain, has no explanation.
_UNEXPLAINED, _DRY_S = 5.0, 3 * DAY_S


def find_stuck_sensor(record: StepRecord, site: Place) -> Iterator[str]:
    """Find sensors that report a constant value, apart from gaps, when the value must change.

    The runoff must change from 0 if more water arrives in any period than the soil can hold. For a
    roof with a pump, evapotranspiration is subtracted at its full rate, because a good controller
    does not pump more than this, and pumps nothing while it rains often enough.
    """
    rate = max(_FULL_RATE, site.crop_coefficient) * bool(np.nansum(record.pumped) > 0)
    gained = record.water - rate * record.reference
    holds = max(_LEAVES_SOME, 1000 * site.z_soil if isinstance(site, Site) else 0.0)
    for column, values in {**record.measured, "rain": record.rain}.items():
        known = np.flatnonzero(~np.isnan(values))
        for low, high in find_gaps(np.diff(values[known]) == 0):
            same, value = known[low:high + 1], values[known[low]]
            same_s = len(same) * record.step_s
            if column == "rain":
                long = same_s >= DAY_S or len(same) >= _SAME_RAIN_STEPS
                stuck = value > 0 and same_s >= _RAIN_STUCK_S and long
            elif column == "runoff" and value == 0:
                sums = np.append(0.0, np.cumsum(gained[same]))
                stuck = float(np.max(sums - np.minimum.accumulate(sums))) > holds
            else:
                stuck = same_s >= _STUCK_S and float(np.nansum(record.rain[same])) >= _STUCK_RAIN
            if stuck and len(same) >= _SAME_STEPS:
                yield (
                    f"{column} is {value:g} {'m' if column == 'level' else 'mm'} for "
                    f"{same_s / HOUR_S:.0f} h from {record.time(int(same[0]))}, although "
                    f"{np.sum(record.water[same]):.3g} mm of water arrived: is the sensor stuck "
                    "or defective? Leave these cells empty"
                )
                break


def find_blocked_gauge(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find runoff without rain or pumped water."""
    if record.runoff is None:
        return
    wet: Steps = (record.water > 0) | np.isnan(record.rain) | np.isnan(record.pumped)
    since = math.ceil(_DRY_S / record.step_s)
    for low, high in find_gaps(~prolong_steps(wet, since)):
        outflow = float(np.nansum(record.runoff[low:high]))
        if low > 0 and outflow > _UNEXPLAINED:
            yield (
                f"rain is 0 for {(high - low + since - 1) * record.step_s / DAY_S:.0f} days before "
                f"{record.time(high)}, although runoff is {outflow:.3g} mm: is the gauge blocked "
                "or stuck, or is the runoff snowmelt? Leave these cells empty"
            )
            return


_PERCENTILE = 95
# Factor of the percentile above which rain is an outlier; the second one is for below 0 degC.
_FACTOR, _FROST_FACTOR = 9.0, 5.0
# Days of the year on either side, and minimum number of wet hours in them for a check.
_DAYS, _MIN_WET = 14, 20
_YEAR = 366


def find_outlying_rain(record: StepRecord, _site: Place) -> Iterator[str]:
    """Find hours with more rain than is plausible according to the station's own records.

    The limit is 9 times the 95th percentile (below 0 degC, 5 times) of the wet hours in all years
    of the records within 14 days of the same day of the year. Hours with fewer than 20 wet hours in
    this period are not checked. The method is the climatological outlier check for daily
    precipitation of GHCN-Daily (Durre, Menne, Gleason, Houston and Vose 2010, J. Appl. Meteor.
    Climatol. 49:1615, doi:10.1175/2010JAMC2375.1), applied to hours.
    """
    if record.step_s > HOUR_S:
        return
    hour = record.seconds // HOUR_S - record.seconds[0] // HOUR_S
    rain, counted = (
        np.bincount(hour, np.nan_to_num(series))
        for series in (record.rain if record.all_rain is None else record.all_rain, record.rain)
    )
    wet = np.flatnonzero(rain > 0)
    first = record.times[0].astype("datetime64[h]")
    days = number_days((first + wet).astype("datetime64[D]"))
    frost = np.zeros(len(rain), dtype=bool)
    if record.temperature is not None:
        frost[hour[record.temperature < 0]] = True
    there = counted[wet] > 0
    outliers: list[tuple[int, float]] = []
    for day in np.unique(days[there]):
        apart = np.abs(days - day)
        near = rain[wet[np.minimum(apart, _YEAR - apart) <= _DAYS]]
        if len(near) < _MIN_WET:
            continue
        usual = float(np.percentile(near, _PERCENTILE))
        outliers += [
            (int(at), usual) for at in wet[there & (days == day)]
            if rain[at] >= (_FROST_FACTOR if frost[at] else _FACTOR) * usual
        ]
    start = record.start.replace(second=0)
    if record.step_s < HOUR_S:
        start = start.replace(minute=0)
    for at, usual in sorted(outliers):
        yield (
            f"rain is {rain[at]:g} mm at {to_minutes(start + at * timedelta(hours=1))}, "
            f"{rain[at] / usual:.1f} times the 95th percentile of wet hours at this time of the "
            f"year, {usual:.3g} mm"
        )


RULES = (
    find_wrong_amounts, find_much_rain, find_wrong_rain, find_unlike_sun, find_unlike_air,
    find_imbalance, find_shifted_clock, find_stuck_sensor, find_blocked_gauge, find_outlying_rain,
)
"""all rules, in the order of their application"""
