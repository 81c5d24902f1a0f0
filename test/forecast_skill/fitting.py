"""The fit of a climate to records, and of errors to figures of services."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from forecast_skill.figures import figures
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from greenroof_ros.forecast.climate import Climate, NormalRecords
from greenroof_ros.forecast.skill import Errors, Skill

# A tip of the gauge (mm): what is less than half of it away is the same reading.
TIP = 0.25
# Hours apart at which wet and dry hours are compared.
LAGS = (1, 2, 3, 4, 6, 9, 12, 18, 24)


def fit_climate(seasons: Sequence[np.ndarray]) -> Climate:
    """Fit a climate to seasons of rain (mm).

    The share of wet hours is theirs; k and b are the likeliest, given that amounts are counted in
    tips; T has the tetrachoric correlations of wet and dry hours up to a day apart (least squares).
    """
    rain = np.concatenate(seasons)
    amounts = rain[rain > 0]
    share = len(amounts) / len(rain)
    tips, counts = np.unique(np.maximum(np.round(amounts / TIP), 1) * TIP, return_counts=True)

    def unlikely(logarithms: np.ndarray) -> float:
        climate = Climate(share, *np.exp(logarithms), 1.0)

        def more(amount: np.ndarray) -> np.ndarray:
            return ndtr(-climate.normal(amount)) / share

        low = np.where(tips <= TIP, 1.0, more(tips - TIP / 2))
        return -(counts * np.log(np.maximum(low - more(tips + TIP / 2), 1e-300))).sum()

    scale, growth = np.exp(minimize(unlikely, [0.0, 0.4], method="Nelder-Mead").x)
    threshold = Climate(share, scale, growth, 1.0).threshold
    found = []
    for lag in LAGS:
        both = np.mean([((one > 0)[:-lag] & (one > 0)[lag:]).mean() for one in seasons])

        def more_often(rho: float, both: float = both) -> float:
            pair = multivariate_normal([0, 0], [[1, rho], [rho, 1]])
            return pair.cdf([-threshold, -threshold]) - both

        found.append(brentq(more_often, -0.5, 0.999))
    memory = minimize_scalar(
        lambda hours: ((np.exp(-np.array(LAGS) / hours) - found) ** 2).sum(),
        bounds=(1, 50), method="bounded",
    ).x
    return Climate(share, float(scale), float(growth), float(memory))


class Sample:
    """Seasons in a circle, and noise of which forecasts of one lead are made at a stroke."""

    def __init__(self, climate: Climate, seasons: Sequence[np.ndarray], draws: int) -> None:
        """Take seasons of rain (mm), and how many draws to make."""
        self._climate = climate
        self.rain = np.concatenate(seasons)
        self._hours = len(self.rain)
        self._power = climate.spectrum(self._hours)
        normal = NormalRecords(climate, self.rain, 0).at(np.arange(self._hours))
        self._records = rfft(normal)
        self._noise = [
            rfft(np.random.default_rng([1, draw]).standard_normal(self._hours))
            * np.sqrt(self._power)
            for draw in range(draws)
        ]

    def figures(self, errors: Errors, lead: float) -> np.ndarray:
        """Return the figures of forecasts made so many hours before, the mean over all draws."""
        skill = Skill(self._climate, errors)
        coherence = skill.coherence(np.array([lead]), rfftfreq(self._hours))[0]
        twice = np.full(len(self._power), 2.0)
        twice[[0, -1]] = 1.0
        unknown = np.sqrt(((1 - coherence**2) * twice * self._power).sum() / self._hours)
        amount = 1 + (errors.amount - 1) * unknown
        found = []
        for noise in self._noise:
            known = coherence * self._records + np.sqrt(1 - coherence**2) * noise
            normal = irfft(known, self._hours) + errors.wetness * unknown
            found.append(figures(amount * self._climate.rain(normal), self.rain))
        return np.mean(found, axis=0)


def fit_errors(sample: Sample, spread: dict[float, np.ndarray], start: Errors) -> Errors:
    """Fit errors to services' r, POD and FAR.

    Least squares: 1 for the distance from their mean, and 30 more for what lies beyond them. The
    bias is what comes of it: it is each service's own. More wetness and a smaller amount have
    nearly the same figures, so the amount is not fitted.

    Args:
        sample: of the records.
        spread: of each lead (h), the services' figures, shape (services, sums, 4).
        start: where the search begins; what is not fitted is kept.
    """
    names = ("reach", "fading", "timing", "timing_growth", "wetness")
    steps = (300.0, 0.4, 0.3, 0.1, 0.15)

    def errors_of(values: np.ndarray) -> Errors:
        return replace(start, **dict(zip(names, map(float, values), strict=True)))

    def loss(values: np.ndarray) -> float:
        reach, fading, timing, growth, _ = values
        if not (reach > 20 and fading > 0.1 and timing >= 0 and growth > -1):
            return 100.0
        total = 0.0
        for lead, services in spread.items():
            of = services[..., :3]
            found = sample.figures(errors_of(values), lead)[:, :3]
            beyond = np.maximum(0, np.maximum(of.min(axis=0) - found, found - of.max(axis=0)))
            total += ((found - of.mean(axis=0)) ** 2 + 30 * beyond**2).sum()
        return total

    begin = np.array([getattr(start, name) for name in names])
    simplex = np.vstack([begin, begin + np.diag(steps)])
    found = minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 300, "xatol": 1e-3, "fatol": 1e-4},
    )
    return errors_of(found.x)
