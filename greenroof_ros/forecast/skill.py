"""How good forecasts are: a file of constants, of the rain of a place and of what they have wrong.

**Climate.** An hour's rain r (mm) is a standard normal number z in another form: dry where z is at
most a threshold c, and above it

    r = k (exp(b (z - c)) - 1)

so that small amounts are the most frequent and large ones fall off as a lognormal's do. From hour
to hour z is a first-order autoregression with the correlation exp(-h / T) at h hours apart. So rain
comes in spells, and what an hour's forecast may have wrong is a matter of correlated normal
numbers. A censored Gaussian process of this kind is a usual model of rain: Sigrist, Kuensch and
Stahel, Annals of Applied Statistics 6(4):1452 (2012); Bardossy and Plate, Water Resources Research
28(5):1247 (1992).

**Skill.** Each frequency f (1/h) of the weather is known at a lead l (h) with the coherence

    s(f, l) = exp(-(l / L)^p) exp(-(2 pi f sigma)^2 / 2),  sigma = sigma_1 (l / 24)^q

The first factor is what a forecast knows of the weather at large; the second is an error of timing,
which takes the short showers first. That small scales are lost first is how rain forecasts fade
(Bowler, Pierce and Seed, Quarterly Journal of the Royal Meteorological Society 132:2127, 2006).
At the lead 0 all is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.parameter import entry, read_record

Array = NDArray[np.float64]

REAL = "real"

# Each skill by its name: at how many times the lead ``real`` has the same errors.
# ``none`` knows nothing but the climate.
SKILLS = {
    "much_better": 0.25, "better": 0.5, REAL: 1.0, "worse": 2.0, "much_worse": 4.0,
    "none": math.inf,
}
# The reach of forecasts that know nothing of the next hour (h).
_NO_REACH = 1e-6


@dataclass(frozen=True)
class Climate:
    """The rain of a place, hour by hour.

    ``config/forecasts/skill.yaml`` has the constants of Toronto City Centre, May to October 2015 to
    2025.
    """

    wet_share: float = entry("share of the hours with rain (1)", 1e-4, 0.9)
    scale: float = entry("k, scale of an hour's rain (mm)", 1e-3, 100.0)
    growth: float = entry("b, how much faster than z rain grows (1)", 0.1, 5.0)
    memory: float = entry("T, hours after which z is correlated by 1/e", 0.5, 24.0)

    @property
    def threshold(self) -> float:
        """c: z of the least rain (1)."""
        # Here, since every command reads skills and few need this: it takes long to import.
        from scipy.special import ndtri

        return float(-ndtri(self.wet_share))

    def rain(self, normal: Array) -> Array:
        """Return the rain (mm) of hours from their z (1), any shape."""
        above = np.maximum(normal - self.threshold, 0.0)
        rain: Array = self.scale * np.expm1(self.growth * above)
        return rain

    def normal(self, rain: Array) -> Array:
        """Return z (1) of hours with rain (mm), any shape; the threshold where there is none."""
        normal: Array = self.threshold + np.log1p(rain / self.scale) / self.growth
        return normal

    def spectrum(self, hours: int) -> Array:
        """Return the power of z at each frequency of so many hours in a circle.

        Its mean over all frequencies is 1, the variance of z; shape (hours // 2 + 1,).
        """
        apart = np.minimum(np.arange(hours), hours - np.arange(hours))
        power: Array = np.fft.rfft(np.exp(-apart / self.memory)).real
        return power


@dataclass(frozen=True)
class Errors:
    """What forecasts have wrong, and how that grows with the lead.

    What does not grow with the lead itself grows with the share of z that is unknown, as a standard
    deviation: from nothing at the lead 0 to all of the constant where nothing is known.
    """

    reach: float = entry("L, lead at which a weather's coherence is down by 1/e (h)", 1.0, 1e6)
    fading: float = entry("p, how suddenly that comes (1)", 0.1, 10.0)
    timing: float = entry("sigma_1, error of timing one day ahead (h)", 0.0, 24.0)
    timing_growth: float = entry("q, exponent of its growth with the lead (1)", 0.0, 2.0)
    wetness: float = entry("by how much too often it rains, where nothing is known (1)", -2.0, 2.0)
    amount: float = entry(
        "by which what falls is multiplied, where nothing is known (1)", 0.0, 10.0
    )
    persistence: float = entry(
        "hours after which an issue's errors are correlated by 1/e", 1.0, 240.0
    )
    evapotranspiration: float = entry(
        "relative error of evapotranspiration, where nothing is known (1)", 0.0, 2.0
    )


@dataclass(frozen=True)
class Skill:
    """A climate, and how good forecasts are in it.

    Attributes:
        climate: of the rain.
        errors: of the forecasts.
    """

    climate: Climate = entry("the rain of the place")
    errors: Errors = entry("what forecasts of it have wrong")

    def times_lead(self, factor: float) -> Skill:
        """Return a skill whose errors at each lead are this one's at so many times that lead.

        At infinitely many nothing is known from the next hour on but the climate: it rains at
        random, as often as there.
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
        """Return s (1), shape (leads, frequencies).

        Args:
            leads: h.
            frequencies: 1/h.
        """
        errors = self.errors
        large = np.exp(-((leads / errors.reach) ** errors.fading))
        timing = errors.timing * (leads / 24) ** errors.timing_growth
        small: Array = np.exp(-((2 * math.pi * np.outer(timing, frequencies)) ** 2) / 2)
        return large[:, None] * small


def read_skill(text: str) -> Skill:
    """Return a skill by its name, one of :data:`SKILLS`, or from a file.

    Raises:
        ConfigurationError: the file is wrong; the message names the line and value.
    """
    path = shared_directory() / "config" / "forecasts" / "skill.yaml"
    if text not in SKILLS:
        path = Path(text)
    skill = read_record(Skill, path, read_yaml(path))
    return skill.times_lead(SKILLS.get(text, 1.0))
