"""Fits a skill to verified forecasts: a climate to records, and errors to scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import keys
from greenroof_ros.forecast.models import NormalRecords
from greenroof_ros.forecast.skill import REAL, Climate, Errors, Skill, read_skill
from greenroof_ros.formats.records import gaps
from greenroof_ros.verification.pairs import Class, Sum
from greenroof_ros.verification.scores import Tally

Array = NDArray[np.float64]

# Most sets of errors that are tried.
MOST_TRIALS = 300
# Lags at which wet and dry hours are compared (h).
_LAGS = (1, 2, 3, 4, 6, 9, 12, 18, 24)
# Range in which their correlations are sought.
_LEAST_RHO, _MOST_RHO = -0.5, 0.999
# Records shorter than this do not show a climate (h).
_LEAST_HOURS = 1000
# Draws of noise; each score is the mean over them.
_DRAWS = 8
# Fitted errors, and the first steps of the search. More wetness and a smaller amount give nearly
# the same scores, so the amount is not fitted; the other errors do not show in r, POD and FAR.
_STEPS = {"reach": 300.0, "fading": 0.4, "timing": 0.3, "timing_growth": 0.1, "wetness": 0.15}
# Loss of an invalid value, and weight of the distance beyond the range of the services; the
# distance from their mean has weight 1.
_INVALID, _BEYOND = 100.0, 30.0


def fit_skill(
    tallies: Mapping[Class, Tally], older: float, observed: Array, done: Callable[[int], None]
) -> Skill:
    """Fit a climate to records, and errors to the scores of forecasts of them.

    ``amount``, ``persistence`` and ``evapotranspiration`` cannot be fitted to the scores, and are
    taken from skill ``real``.

    Args:
        tallies: the tally of each class.
        older: by how much (h) values are on average older than the middle of their class.
        observed: records (mm/h), shape (hours,); NaN if missing.
        done: called with the number of trials just made; :data:`MOST_TRIALS` in all, or fewer.

    Raises:
        ConfigurationError: there are too few records, fewer than two classes of leads have scores,
            or wet hours never follow one another.
    """
    step = max(key.high - key.low for key in tallies)
    spells = _spells(observed, step)
    if sum(map(len, spells)) < _LEAST_HOURS:
        raise ConfigurationError(
            f"needs at least {_LEAST_HOURS} h of records, in pieces of {step} h or more",
            key="--fit",
        )
    sums = list(dict.fromkeys(key.sum for key in tallies))
    goals = {}
    for low in dict.fromkeys(key.low for key in tallies):
        of_lead = [tally for key, tally in tallies.items() if key.low == low]
        scores = np.array([tally.scores()[2:5] for tally in of_lead])
        if not np.isnan(scores).any():
            goals[low + step / 2 + older] = scores[None]
    if len(goals) < 2:
        raise ConfigurationError(
            "needs at least two classes of leads with forecast and observed events for each "
            f"sum; there are {len(goals)}: see --horizon and --lead",
            key="--fit",
        )
    wet = observed[observed > 0]
    climate = fit_climate(spells, float(wet.min()))
    sample = Sample(climate, spells, sums)
    return Skill(climate, fit_errors(sample, goals, read_skill(REAL).errors, done))


def _spells(observed: Array, step: int) -> list[Array]:
    """Return the records between missing hours, each a whole number of steps long (h)."""
    return [
        observed[low : low + (high - low) // step * step]
        for low, high in gaps(~np.isnan(observed)) if high - low >= step
    ]


def fit_climate(spells: Sequence[Array], tip: float) -> Climate:
    """Fit a climate to records of rain (mm).

    The share of wet hours is counted. k and b have the largest likelihood, given that amounts are
    counted in tips. T fits the tetrachoric correlations of wet and dry hours up to a day apart
    (least squares). All are within the limits of a skill file. A lag is left out if it shows no
    correlation, for example if no two hours that far apart are wet.

    Args:
        spells: uninterrupted hours, each spell of 1 h or more.
        tip: of the gauge (mm); amounts within half a tip of a reading are counted as that reading.

    Raises:
        ConfigurationError: no lag shows a correlation, or the share of wet hours is outside the
            limits of a climate.
    """
    rain = np.concatenate(spells)
    amounts = rain[rain > 0]
    share = len(amounts) / len(rain)
    tips, counts = np.unique(np.maximum(np.round(amounts / tip), 1) * tip, return_counts=True)

    def unlikely(logarithms: Array) -> float:
        k, b = map(float, np.exp(logarithms))
        climate = Climate(share, k, b, 1.0)

        def more(amount: Array) -> Array:
            return np.asarray(ndtr(-climate.normal(amount)) / share)

        low = np.where(tips <= tip, 1.0, more(tips - tip / 2))
        return -float((counts * np.log(np.maximum(low - more(tips + tip / 2), 1e-300))).sum())

    limits = {key.name: (key.entry.low, key.entry.high) for key in keys(Climate)}
    driest, wettest = limits["wet_share"]
    if not driest <= share <= wettest:
        raise ConfigurationError(
            f"needs records with rain in {driest:.2%} to {wettest:.0%} of their hours, not in "
            f"{share:.3%}", key="--fit",
        )
    likeliest = minimize(
        unlikely, [0.0, 0.4], method="Nelder-Mead",
        bounds=np.log([limits["scale"], limits["growth"]]),
    )
    scale, growth = np.exp(likeliest.x)
    threshold = Climate(share, float(scale), float(growth), 1.0).threshold
    correlation_of = {}
    for lag in _LAGS:
        pairs = np.concatenate([(spell > 0)[:-lag] & (spell > 0)[lag:] for spell in spells])
        joint = float(pairs.sum()) / max(len(pairs), 1)

        def more_often(rho: float, joint: float = joint) -> float:
            pair = multivariate_normal([0, 0], [[1, rho], [rho, 1]])
            return float(pair.cdf([-threshold, -threshold])) - joint

        if more_often(_LEAST_RHO) < 0 < more_often(_MOST_RHO):
            correlation_of[lag] = brentq(more_often, _LEAST_RHO, _MOST_RHO)
    if not correlation_of:
        raise ConfigurationError(
            "needs records with more rain: wet hours must follow one another within a day",
            key="--fit",
        )
    lags, correlations = np.array(list(correlation_of)), np.array(list(correlation_of.values()))
    fitted = minimize_scalar(
        lambda hours: ((np.exp(-lags / hours) - correlations) ** 2).sum(),
        bounds=limits["memory"], method="bounded",
    )
    return Climate(share, float(scale), float(growth), float(fitted.x))


class Sample:
    """Records in a circle, and noise, from which all forecasts of one lead are made at once."""

    def __init__(self, climate: Climate, spells: Sequence[Array], sums: Sequence[Sum]) -> None:
        """Take the climate, spells of rain (mm) that hold whole sums, and the sums to score."""
        self._climate = climate
        self._sums = sums
        self._rain = np.concatenate(spells)
        self._hours = len(self._rain)
        self._power = climate.spectrum(self._hours)
        normal = NormalRecords(climate, self._rain, 0).at(np.arange(self._hours))
        self._records = rfft(normal)
        self._noise = [
            rfft(np.random.default_rng([1, draw]).standard_normal(self._hours))
            * np.sqrt(self._power)
            for draw in range(_DRAWS)
        ]

    def scores(self, errors: Errors, lead: float) -> Array:
        """Return r, POD and FAR of forecasts made ``lead`` hours ahead, shape (sums, 3).

        They are means over all draws of noise.
        """
        skill = Skill(self._climate, errors)
        coherence = skill.coherence(np.array([lead]), rfftfreq(self._hours))[0]
        twice = np.full(len(self._power), 2.0)
        twice[[0, -1]] = 1.0
        unknown = np.sqrt(((1 - coherence**2) * twice * self._power).sum() / self._hours)
        amount = 1 + (errors.amount - 1) * unknown
        scores = []
        for noise in self._noise:
            known = coherence * self._records + np.sqrt(1 - coherence**2) * noise
            normal = irfft(known, self._hours) + errors.wetness * unknown
            forecast = amount * self._climate.rain(normal)
            for hours, event in self._sums:
                tally = Tally(event, 1)
                tally.add(
                    forecast.reshape(1, -1, hours).sum(axis=2),
                    self._rain.reshape(-1, hours).sum(axis=1),
                )
                scores.append(tally.scores()[2:5])
        by_draw = np.reshape(scores, (len(self._noise), len(self._sums), 3))
        return np.asarray(np.mean(by_draw, axis=0))


def fit_errors(
    sample: Sample, goals: Mapping[float, Array], start: Errors, done: Callable[[int], None]
) -> Errors:
    """Fit errors to r, POD and FAR of one or more services.

    Least squares, with weight 1 for the distance from the services' mean, and 30 more for the
    distance beyond their range. The bias is not fitted, because each service has its own.

    Args:
        sample: of the records.
        goals: the services' scores at each lead (h), shape (services, sums, 3).
        start: where the search begins; values that are not fitted are kept.
        done: see :func:`fit_skill`.
    """
    limits = {key.name: key.entry for key in keys(Errors)}

    def errors_of(values: Array) -> Errors:
        return replace(start, **dict(zip(_STEPS, map(float, values), strict=True)))

    def loss(values: Array) -> float:
        done(1)
        entries = [limits[name] for name in _STEPS]
        if not all(e.low <= value <= e.high for e, value in zip(entries, values, strict=True)):
            return _INVALID
        total = 0.0
        for lead, goal in goals.items():
            scores = sample.scores(errors_of(values), lead)
            beyond = np.maximum(0, np.maximum(goal.min(axis=0) - scores, scores - goal.max(axis=0)))
            total += float(((scores - goal.mean(axis=0)) ** 2 + _BEYOND * beyond**2).sum())
        return total

    begin = np.array([getattr(start, name) for name in _STEPS])
    solution = minimize(
        loss, begin, method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([begin, begin + np.diag(list(_STEPS.values()))]),
            "maxfev": MOST_TRIALS, "xatol": 1e-3, "fatol": 1e-4,
        },
    )
    return errors_of(solution.x)


def skill_text(skill: Skill, source: str) -> str:
    """Return the text of a skill file.

    Args:
        skill: what to write.
        source: what it was fitted to, in words.
    """
    lines = ["# Fitted by greenroof_ros.verify to", f"# {source}."]
    for part in fields(skill):
        values = getattr(skill, part.name)
        lines += ["", f"{part.name}:"]
        for key in keys(type(values)):
            lines.append(f"  {key.name}: {getattr(values, key.name):#.5g}  # {key.entry.meaning}")
    return "\n".join([*lines, ""])
