"""The rain of a place as a statistician sees it: how often, how much, and how long it lasts.

An hour's rain r (mm) is a standard normal number z in another form: dry where z is at most a
threshold c, and above it

    r = k (exp(b (z - c)) - 1)

so that small amounts are the most frequent and large ones fall off as a lognormal's do. From hour
to hour z is a first-order autoregression with the correlation exp(-h / T) at h hours apart. So rain
comes in spells, and what an hour's forecast may have wrong is a matter of correlated normal
numbers. A censored Gaussian process of this kind is a usual model of rain: Sigrist, Kuensch and
Stahel, Annals of Applied Statistics 6(4):1452 (2012); Bardossy and Plate, Water Resources Research
28(5):1247 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.records import entry

Array = NDArray[np.float64]

# Sweeps over all dry hours, after which next to nothing of the beginning is left: the slowest mode
# of an autoregression with T = 8 h keeps 0.985 of itself in a sweep.
_SWEEPS = 300

# Random numbers are drawn in blocks of so many hours since 1970.
_BLOCK = 512

# A part of the records is so many blocks, and one more on either side, after which nothing is left
# of where it ends.
_PART = 8

# Begins the seeds of what dry hours hide. It belongs to the records and is no forecast's.
_RECORDS = 6158359


@dataclass(frozen=True)
class Climate:
    """The rain of a place, hour by hour.

    The constants of Toronto City Centre, May to October 2015 to 2025, are those of
    ``config/forecasts/skill.yaml``.
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


class NormalRecords:
    """z of each hour of records.

    Hours with rain have theirs. A dry hour's is not known but that it is at most c; it is drawn as
    likely as it is given its neighbours, over and over (Gibbs sampling; Geman and Geman, IEEE
    Trans. PAMI 6:721, 1984), every other hour at a time. A missing hour's is drawn likewise,
    without that limit. So a dry hour amid rain is near to rain, and one amid a dry week is far from
    it.

    What is drawn depends on the hour since 1970 alone, and not on who asks for which hours first,
    nor, three weeks inside of them, on where the records begin and end.
    """

    def __init__(self, climate: Climate, rain: Array, first: int) -> None:
        """Take the records.

        Args:
            climate: of the rain.
            rain: of each hour (mm), NaN where missing, shape (hours,).
            first: hours since 1970 of the first.
        """
        self._climate = climate
        self._rain = rain
        self._first = first
        self._parts: dict[int, Array] = {}

    def at(self, hours: NDArray[np.intp]) -> Array:
        """Return z (1) of some hours by their index, of the first or last beyond the ends."""
        index = np.clip(hours, 0, len(self._rain) - 1)
        parts = (index + self._first) // (_PART * _BLOCK)
        normal = np.empty(len(index))
        for part in np.unique(parts):
            here = parts == part
            begin, values = self._part(int(part))
            normal[here] = values[index[here] - begin]
        return normal

    def _part(self, part: int) -> tuple[int, Array]:
        """Return the index of a part's first hour, and its z with a margin on either side."""
        begin = part * _PART * _BLOCK - self._first
        low = max(begin - _BLOCK, 0)
        high = min(begin + (_PART + 1) * _BLOCK, len(self._rain))
        if part not in self._parts:
            rain = self._rain[low:high].tobytes()
            self._parts[part] = _drawn(self._climate, rain, self._first + low)
        return low, self._parts[part]


@lru_cache(maxsize=64)
def _drawn(climate: Climate, records: bytes, first: int) -> Array:
    """Return z (1) of each hour; see :class:`NormalRecords`.

    It is kept, since a study asks for it for each of its seeds.

    Args:
        climate: of the rain.
        records: rain of each hour (mm), NaN where missing, the bytes of an array.
        first: hours since 1970 of the first.
    """
    from scipy.special import ndtr, ndtri

    rain = np.frombuffer(records)
    missing = np.isnan(rain)
    drawn = missing | (rain == 0)
    ceiling = np.where(missing, np.inf, climate.threshold)
    pull, spread = _given_neighbours(climate, len(rain))
    odd = (np.arange(len(rain)) + first) % 2 == 1
    turns = [np.flatnonzero(drawn & odd), np.flatnonzero(drawn & ~odd)]
    normal = np.zeros(len(rain) + 2)  # and one on either side, of no weight
    normal[1:-1][~drawn] = climate.normal(rain[~drawn])
    uniform = _Uniform(first, len(rain))
    for _ in range(_SWEEPS):
        numbers = uniform.sweep()
        for hours in turns:
            mean = pull[hours] * (normal[hours] + normal[hours + 2])
            share = numbers[hours] * ndtr((ceiling[hours] - mean) / spread[hours])
            # 1e-300: as far below as a normal number can be
            normal[hours + 1] = mean + spread[hours] * ndtri(np.maximum(share, 1e-300))
    return normal[1:-1]


def _given_neighbours(climate: Climate, hours: int) -> tuple[Array, Array]:
    """Return what an hour's mean is of its neighbours' sum, and its standard deviation then (1)."""
    near = np.exp(-1 / climate.memory)
    pull = np.full(hours, near / (1 + near**2))
    spread = np.full(hours, np.sqrt((1 - near**2) / (1 + near**2)))
    ends = [0, -1]
    pull[ends], spread[ends] = near, np.sqrt(1 - near**2)
    return pull, spread


class _Uniform:
    """Random numbers from 0 to 1 of hours since 1970, the same whichever hours are asked for."""

    def __init__(self, first: int, hours: int) -> None:
        """Prepare so many hours from the first on."""
        blocks = range(first // _BLOCK, (first + hours - 1) // _BLOCK + 1)
        self._chances = [np.random.default_rng([_RECORDS, block % 2**32]) for block in blocks]
        self._begin = first - blocks.start * _BLOCK
        self._hours = hours

    def sweep(self) -> Array:
        """Return the next number of each hour, shape (hours,)."""
        numbers = np.concatenate([chance.random(_BLOCK) for chance in self._chances])
        return numbers[self._begin : self._begin + self._hours]
