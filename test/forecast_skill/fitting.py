"""The fit of a climate to records, and of errors to figures of services."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from greenroof_ros.forecast.climate import Climate, NormalRecords
from greenroof_ros.forecast.skill import Errors, Skill

# A tip of the gauge (mm): what is less than half of it away is the same reading.
TIP = 0.25
# The gauge's least record (mm) is its first tip, however little of it fell in the hour.
LAGS = (1, 2, 3, 4, 6, 9, 12, 18, 24)


def fit_climate(rain: np.ndarray, use: np.ndarray) -> Climate:
    """Fit a climate to the hours ``use`` of rain (mm), NaN where missing.

    The share of wet hours is theirs; k and b are the likeliest, given that amounts are counted in
    tips; T has the correlations of wet and dry hours up to a day apart (least squares).
    """
    known = use & ~np.isnan(rain)
    amounts = rain[known & (rain > 0)]
    share = len(amounts) / known.sum()
    tips, counts = np.unique(np.maximum(np.round(amounts / TIP), 1) * TIP, return_counts=True)

    def unlikely(logarithms: np.ndarray) -> float:
        climate = Climate(share, *np.exp(logarithms), 8.0)

        def more(amount: np.ndarray) -> np.ndarray:
            return ndtr(-climate.normal(amount)) / share

        low = np.where(tips <= TIP, 1.0, more(tips - TIP / 2))
        return -(counts * np.log(np.maximum(low - more(tips + TIP / 2), 1e-300))).sum()

    scale, growth = np.exp(minimize(unlikely, [0.0, 0.4], method="Nelder-Mead").x)
    threshold = Climate(share, scale, growth, 8.0).threshold
    wet = rain > 0
    correlations = []
    for lag in LAGS:
        both = known[:-lag] & known[lag:]
        joint = (wet[:-lag] & wet[lag:])[both].mean()
        correlations.append(brentq(
            lambda rho, joint=joint: multivariate_normal(
                [0, 0], [[1, rho], [rho, 1]]
            ).cdf([-threshold, -threshold]) - joint,
            -0.5, 0.999,
        ))
    memory = minimize_scalar(
        lambda hours: ((np.exp(-np.array(LAGS) / hours) - correlations) ** 2).sum(),
        bounds=(1, 50), method="bounded",
    ).x
    return Climate(float(share), float(scale), float(growth), float(memory))


class Sample:
    """Records in a circle, and noise of which forecasts of one lead are made at a stroke."""

    def __init__(self, climate: Climate, rain: np.ndarray, first: int, draws: int) -> None:
        """Take the records (mm), the hours since 1970 of the first, and how many draws to make."""
        hours = len(rain)
        self.climate, self.hours = climate, hours
        self._frequencies = rfftfreq(hours)
        self._power = climate.spectrum(hours)
        self._records = rfft(NormalRecords(climate, rain, first).at(np.arange(hours)))
        self._noise = [
            rfft(np.random.default_rng([1, draw]).standard_normal(hours)) * np.sqrt(self._power)
            for draw in range(draws)
        ]

    def forecasts(self, errors: Errors, lead: float) -> list[np.ndarray]:
        """Return each draw's rain (mm) of every hour, forecast so many hours before."""
        coherence = Skill(self.climate, errors).coherence(np.array([lead]), self._frequencies)[0]
        twice = np.full(len(self._power), 2.0)
        twice[[0, -1]] = 1.0
        unknown = np.sqrt(((1 - coherence**2) * twice * self._power).mean() / twice.mean())
        amount = 1 + (errors.amount - 1) * unknown
        return [
            amount * self.climate.rain(
                irfft(coherence * self._records + np.sqrt(1 - coherence**2) * noise, self.hours)
                + errors.wetness * unknown
            )
            for noise in self._noise
        ]


def fit_errors(sample: Sample, figures, low, high, mean, leads, start: Errors) -> Errors:
    """Fit errors to the spread and mean of services' r, POD and FAR.

    Least squares: 1 for the distance from their mean, and 30 more beyond their spread.

    Args:
        sample: of the records.
        figures: makes r, POD, FAR and bias of a forecast, shape (sums, 4).
        low: the least of the services, shape (leads, sums, 3).
        high: the greatest.
        mean: their mean.
        leads: h.
        start: where the search begins; its persistence and evapotranspiration are kept.
    """
    names = ("reach", "fading", "timing", "timing_growth", "wetness", "amount")
    steps = (300.0, 0.4, 0.3, 0.1, 0.15, 0.2)
    kept = (start.persistence, start.evapotranspiration)

    def loss(values: np.ndarray) -> float:
        reach, fading, timing, growth, _, amount = values
        if not (reach > 20 and fading > 0.1 and timing >= 0 and growth > -1 and amount > 0.1):
            return 100.0
        errors = Errors(*values, *kept)
        found = np.array([
            np.mean([figures(one) for one in sample.forecasts(errors, lead)], axis=0)[:, :3]
            for lead in leads
        ])
        beyond = np.maximum(0, np.maximum(low - found, found - high))
        return float(((found - mean) ** 2).sum() + 30 * (beyond**2).sum())

    begin = np.array([getattr(start, name) for name in names])
    simplex = np.vstack([begin, begin + np.diag(steps)])
    found = minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 300, "xatol": 1e-3, "fatol": 1e-4},
    )
    return Errors(*(float(value) for value in found.x), *kept)
