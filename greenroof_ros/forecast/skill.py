"""The skill of forecasts: constants for the rain at a location and for the errors of its forecasts.

**Climate.** The rain r of an hour (mm) is a transformed standard normal variable z. The hour is dry
if z is at most a threshold c; above c,

    r = k (exp(b (z - c)) - 1)

so that small amounts are the most frequent, and large amounts become rarer as in a lognormal
distribution. From hour to hour, z is a first-order autoregression, with the correlation exp(-h / T)
between values h hours apart. Rain therefore comes in spells, and the errors of an hour's forecast
can be described by correlated normal variables. A censored Gaussian process of this kind is a
common model of rain: Sigrist, Kuensch and Stahel, Annals of Applied Statistics 6(4):1452 (2012);
Bardossy and Plate, Water Resources Research 28(5):1247 (1992).

**Skill.** Each frequency f (1/h) of the weather is known at a lead time l (h) with the coherence

    s(f, l) = exp(-(l / L)^p) exp(-(2 pi f sigma)^2 / 2),  sigma = sigma_1 (l / 24)^q

The first factor is the general skill of the forecast; the second factor is an error of timing,
which affects short showers first. In real rain forecasts, small scales are also lost first (Bowler,
Pierce and Seed, Quarterly Journal of the Royal Meteorological Society 132:2127, 2006). At lead time
0, everything is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.files import shared_directory
from greenroof_ros.base.parameter import entry, read_record

Array = NDArray[np.float64]

REAL = "real"

# Every skill by its name: its errors at a lead are the errors of ``real`` at this many times the
# lead. ``none`` knows only the climate.
SKILLS = {
    "much_better": 0.25, "better": 0.5, REAL: 1.0, "worse": 2.0, "much_worse": 4.0,
    "none": math.inf,
}
# The reach of forecasts that know nothing about any hour (h).
_NO_REACH = 1e-6


@dataclass(frozen=True)
class Climate:
    """Model of the hourly rain at a location.

    ``config/forecasts/skill.yaml`` contains the constants for Toronto City Centre, May to October
    of 2015 to 2025.
    """

    wet_share: float = entry("share of hours with rain (1)", 1e-4, 0.9)
    scale: float = entry("scale k of hourly rain (mm)", 1e-3, 100.0)
    growth: float = entry(
        "exponent b of the increase of rain with the normal variable z (1)", 0.1, 5.0,
    )
    memory: float = entry("time lag T at which the autocorrelation of z is 1/e (h)", 0.5, 24.0)

    @property
    def threshold(self) -> float:
        """The threshold c, which is the z of the lightest rain (1)."""
        # Imported here because it is slow: every command reads skills, and few need this.
        from scipy.special import ndtri

        return float(-ndtri(self.wet_share))

    def rain(self, normal: Array) -> Array:
        """Return the hourly rain (mm) for values of z (1), in an array of any shape."""
        above = np.maximum(normal - self.threshold, 0.0)
        rain: Array = self.scale * np.expm1(self.growth * above)
        return rain

    def normal(self, rain: Array) -> Array:
        """Return z (1) of hours from their rain (mm), in any shape; c for a dry hour."""
        normal: Array = self.threshold + np.log1p(rain / self.scale) / self.growth
        return normal

    def spectrum(self, hours: int) -> Array:
        """Return the power of z at every frequency of a periodic series of ``hours`` hours.

        The power has shape (hours // 2 + 1,), and its mean over all frequencies is 1, the variance
        of z.
        """
        apart = np.minimum(np.arange(hours), hours - np.arange(hours))
        power: Array = np.fft.rfft(np.exp(-apart / self.memory)).real
        return power


@dataclass(frozen=True)
class Errors:
    """The errors of forecasts, and the growth of these errors with lead time.

    ``wetness``, ``amount`` and ``evapotranspiration`` have their full effect if nothing is known.
    Otherwise, their effect is proportional to the unknown part of z (a standard deviation), which
    is 0 at lead 0.
    """

    reach: float = entry("lead time L at which the coherence has fallen to 1/e (h)", 1.0, 1e6)
    fading: float = entry(
        "exponent p, the steepness of the decay of coherence with lead time (1)", 0.1, 10.0,
    )
    timing: float = entry(
        "standard deviation sigma_1 of the timing error one day ahead (h)", 0.0, 24.0,
    )
    timing_growth: float = entry(
        "exponent q of the growth of the timing error with lead time (1)", 0.0, 2.0,
    )
    wetness: float = entry(
        "shift of z toward rain at a lead time at which nothing is known (1)", -2.0, 2.0,
    )
    amount: float = entry(
        "factor applied to the rain at a lead time at which nothing is known (1)", 0.0, 10.0
    )
    persistence: float = entry(
        "time between the issue of two forecasts at which the correlation of their errors is 1/e "
        "(h)", 1.0, 240.0
    )
    evapotranspiration: float = entry(
        "relative error of evapotranspiration at a lead time at which nothing is known "
        "(1)", 0.0, 2.0
    )


@dataclass(frozen=True)
class Skill:
    """A climate, and the errors of forecasts for that climate.

    Attributes:
        climate: climate of the rain.
        errors: errors of the forecasts.
    """

    climate: Climate = entry("climate of the rain at a location")
    errors: Errors = entry("errors of the forecasts for this location")

    def times_lead(self, factor: float) -> Skill:
        """Return a skill whose errors at lead time l are those of this skill at ``factor`` times l.

        With an infinite factor, only the climate is known, and it rains at random times, with the
        frequency given by the climate.
        """
        errors = replace(self.errors, reach=_NO_REACH, timing=0.0, wetness=0.0, amount=1.0)
        if math.isfinite(factor):
            errors = replace(
                self.errors,
                reach=self.errors.reach / factor,
                timing=self.errors.timing * factor**self.errors.timing_growth,
            )
        return replace(self, errors=errors)

    def coherence(self, leads: Array, frequencies: Array) -> Array:
        """Return the coherence s (1), shape (leads, frequencies).

        Args:
            leads: lead times (h).
            frequencies: frequencies (1/h).
        """
        errors = self.errors
        large = np.exp(-((leads / errors.reach) ** errors.fading))
        timing = errors.timing * (leads / 24) ** errors.timing_growth
        small: Array = np.exp(-((2 * math.pi * np.outer(timing, frequencies)) ** 2) / 2)
        return large[:, None] * small


def read_skill(text: str) -> Skill:
    """Return a skill by its name in :data:`SKILLS`, or from a file.

    Raises:
        ConfigurationError: if the file is invalid; the message names the line and the value.
    """
    path = shared_directory() / "config" / "forecasts" / "skill.yaml"
    if text not in SKILLS:
        path = Path(text)
    skill = read_record(Skill, path)
    return skill.times_lead(SKILLS.get(text, 1.0))
