"""How good forecasts are: a file of constants, and what they make of each lead.

Each frequency f (1/h) of the weather is known at a lead l (h) with the coherence

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
from greenroof_ros.common.records import entry, read_record
from greenroof_ros.forecast.climate import Climate

Array = NDArray[np.float64]

REAL = "real"

# Each skill by its name: how many times its own lead a forecast's errors are those of ``real``.
# ``none`` knows nothing but the climate.
SKILLS = {
    "much_better": 0.25, "better": 0.5, REAL: 1.0, "worse": 2.0, "much_worse": 4.0,
    "none": math.inf,
}
# The reach of forecasts that know nothing of the next hour (h).
_NO_REACH = 1e-6


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
