"""The choice of the forecasts that a run's controller receives.

Their skill rests on constants for the rain at a location, and for the errors of its forecasts.

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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.base.errors import ConfigurationError, describe_choices, rename_keys
from greenroof_ros.base.files import find_shipped, read_yaml, shared_directory
from greenroof_ros.base.parameter import entry, make_record, parameters_of
from greenroof_ros.forecast.issue import SERVICE_DELAY_H, SUFFIXES
from greenroof_ros.site.horizon import MAX_MEMBERS, Array

SKILLS = REAL, NONE = ("real", "none")
"""the skill of a weather service, and forecasts that know only the climate"""


@dataclass(frozen=True)
class Climate:
    """Model of the hourly rain at a location.

    Attributes:
        wet_share: share of hours with rain (1).
        scale: scale k of hourly rain (mm).
        growth: exponent b of the increase of rain with the normal variable z (1).
        memory: time lag T at which the autocorrelation of z is 1/e (h).
    """

    wet_share: float
    scale: float
    growth: float
    memory: float

    @property
    def threshold(self) -> float:
        """The threshold c, which is the z of the lightest rain (1)."""
        # Imported here because it is slow: every command reads skills, and few need this.
        from scipy.special import ndtri

        return float(-ndtri(self.wet_share))

    def rain(self, normal: Array) -> Array:
        """Return the hourly rain (mm) for values of z (1), in an array of any shape."""
        above = np.maximum(normal - self.threshold, 0.0)
        return np.asarray(self.scale * np.expm1(self.growth * above))

    def normal(self, rain: Array) -> Array:
        """Return z (1) of hours from their rain (mm), in any shape; c for a dry hour."""
        return np.asarray(self.threshold + np.log1p(rain / self.scale) / self.growth)

    def spectrum(self, hours: int) -> Array:
        """Return the power of z at every frequency of a periodic series of ``hours`` hours.

        The power has shape (hours // 2 + 1,), and its mean over all frequencies is 1, the variance
        of z.
        """
        apart = np.minimum(np.arange(hours), hours - np.arange(hours))
        return np.asarray(np.fft.rfft(np.exp(-apart / self.memory)).real)


@dataclass(frozen=True)
class Skill:
    """A climate, and the errors of forecasts for this climate, which grow with lead time.

    ``wetness``, ``amount`` and ``evapotranspiration`` have their full effect if nothing is known.
    Otherwise, their effect is proportional to the unknown part of z (a standard deviation), which
    is 0 at lead 0.

    Attributes:
        climate: climate of the rain.
        reach: lead time L at which the coherence has fallen to 1/e (h).
        fading: exponent p, the steepness of the decay of coherence with lead time (1).
        timing: standard deviation sigma_1 of the timing error one day ahead (h).
        timing_growth: exponent q of the growth of the timing error with lead time (1).
        wetness: shift of z toward rain if nothing is known (1).
        amount: factor applied to the rain if nothing is known (1).
        persistence: time between the issue of two forecasts at which the correlation of their
            errors is 1/e (h).
        evapotranspiration: relative error of evapotranspiration if nothing is known (1).
    """

    climate: Climate
    reach: float
    fading: float
    timing: float
    timing_growth: float
    wetness: float
    amount: float
    persistence: float
    evapotranspiration: float

    def coherence(self, leads: Array, frequencies: Array) -> Array:
        """Return the coherence s (1), shape (leads, frequencies).

        Args:
            leads: lead times (h).
            frequencies: frequencies (1/h).
        """
        large = np.exp(-((leads / self.reach) ** self.fading))
        timing = self.timing * (leads / 24) ** self.timing_growth
        small = np.exp(-((2 * math.pi * np.outer(timing, frequencies)) ** 2) / 2)
        return np.asarray(large[:, None] * small)


@cache
def read_skill(name: str) -> Skill:
    """Return one of :data:`SKILLS`.

    ``config/forecasts/skill.yaml`` contains the constants of ``real``, and their origin. With
    ``none``, it rains at random times, with the frequency given by the climate.
    """
    content = read_yaml(shared_directory() / "config" / "forecasts" / "skill.yaml")
    real = Skill(Climate(**content["climate"]), **content["errors"])
    if name == REAL:
        return real
    return replace(real, reach=1e-6, timing=0.0, wetness=0.0, amount=1.0)


MODELS = PERFECT, ERRORS, ENSEMBLE = "perfect", "errors", "ensemble"
"""the models; an archive is named by its path"""
FILE = "file"
# The models that have an option, by its name.
_MODELS_WITH = {
    "skill": (ERRORS, ENSEMBLE), "seed": (ERRORS, ENSEMBLE), "members": (ENSEMBLE,),
    "delay": (ERRORS, ENSEMBLE, FILE),
}


@dataclass(frozen=True)
class ForecastChoice:
    """The choice of the forecasts that a run's controller receives.

    Attributes:
        model: one of :data:`MODELS`, or ``file``.
        file: forecast file, or directory of forecast files; None for a model.
        skill: one of :data:`greenroof_ros.forecast.choice.SKILLS`.
        seed: random seed of the forecast errors.
        members: number of members of the ensemble.
        delay: time from the nominal time of a forecast until the forecast is available (h); None
            for the usual delay of the file format or, with errors, of weather services.
    """

    model: str = PERFECT
    file: Path | None = None
    skill: str = entry(
        "skill of errors and ensemble: real for that of a weather service, none for rain at random "
        "times", choices=SKILLS, default=REAL,
    )
    seed: int = entry(
        "random seed of errors and ensemble", 0, 2**31 - 1, default=0,
    )
    members: int = entry("number of members of an ensemble", 1, MAX_MEMBERS, default=10)
    delay: float | None = entry(
        "time from the nominal time of a forecast until it is available; by default "
        f"{SERVICE_DELAY_H:g} h, but for a file in this project's format the time that it states, "
        "or 0", 0.0, 48.0, unit="h", default=None,
    )

    def __str__(self) -> str:
        """Return the name of the model or the path of the file, as in the option ``--forecast``."""
        return self.model if self.file is None else str(self.file)

    def options(self) -> dict[str, str | float]:
        """Return those :data:`OPTIONS` of the model that are set, each with its value."""
        own = [name for name, models in _MODELS_WITH.items() if self.model in models]
        values = {name: getattr(self, name) for name in own}
        return {name: value for name, value in values.items() if value is not None}


OPTIONS = {parameter.name: parameter for parameter in parameters_of(ForecastChoice)}
"""the options of forecasts, by name"""
INPUTS = {
    f"forecast_{name}": replace(parameter, name=f"forecast_{name}")
    for name, parameter in OPTIONS.items()
}
"""the same, by the names of a run's inputs"""


def choose(text: str, options: Mapping[str, Any] | None = None) -> ForecastChoice:
    """Return the choice of a model by its name, or of an archive by its path.

    Args:
        text: the input ``forecast`` of a run.
        options: values of :data:`OPTIONS`.

    Raises:
        ConfigurationError: if there is no such model, or if the model has no such option or value;
            the error's key is ``forecast``, or one of :data:`INPUTS`.
    """
    model, options = text if text in MODELS else FILE, options or {}
    if model == FILE and not (
        text.lower().endswith((*SUFFIXES, "/")) or (text and Path(text).is_dir())
    ):
        files = f", or forecasts: a file ({', '.join(SUFFIXES)}) or a directory of files"
        raise ConfigurationError(describe_choices(MODELS, text, files), key="forecast", value=text)
    with rename_keys({name: f"forecast_{name}" for name in OPTIONS}):
        checked = make_record(ForecastChoice, options)
        for name, value in options.items():
            if model not in _MODELS_WITH[name]:
                owners = " and ".join(_MODELS_WITH[name])
                raise ConfigurationError(f"is an option of {owners}", key=name, value=value)
    return replace(checked, model=model, file=find_shipped(Path(text)) if model == FILE else None)
