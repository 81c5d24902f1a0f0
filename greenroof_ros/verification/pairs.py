"""Sums of rain as forecast and as observed, by lead."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.verification.issued import IssuedForecasts
from greenroof_ros.verification.scores import Tally

Array = NDArray[np.float64]

# How many forecasts are added up at once.
_AT_ONCE = 200
# To how many digits after the point sums are rounded (mm): tenths of a millimetre do not add up to
# whole ones in binary numbers, and an event begins at one.
_DIGITS = 6


class Sum(NamedTuple):
    """A length of sums, and what counts as an event among them."""

    hours: int
    event: float
    """mm, from which on there is one"""


class Class(NamedTuple):
    """What is scored together: leads from one (h) to before another, and sums."""

    low: int
    high: int
    sum: Sum

    @property
    def lead(self) -> str:
        """The leads in words: ``day 2``, or ``6 to 12 h``."""
        if self.low % 24 == 0 and self.high == self.low + 24:
            return f"day {self.high // 24}"
        return f"{self.low} to {self.high} h"


def tally(
    forecasts: IssuedForecasts, observed: Array, lead: int, sums: Sequence[Sum],
    done: Callable[[int], None],
) -> dict[Class, Tally]:
    """Add up all pairs of some forecasts and the records.

    A pair is a sum over hours of an issue that follow one another, and that over the same hours of
    the records. An issue is parted from its start on: with sums of 12 h into its first 12 hours,
    the next 12, and so on, each in the class of leads in which it lies whole. A sum with an hour
    that the issue or the records lack is left out.

    Args:
        forecasts: any number.
        observed: records (mm/h), shape (hours,); NaN where missing.
        lead: how many hours make a class of leads; a multiple of each of the sums.
        sums: their lengths and events.
        done: is called with how many more forecasts were added.

    Returns:
        What adds up in each class, in the order of leads and sums.
    """
    classes = math.ceil(forecasts.hours / lead)
    found = {
        Class(number * lead, (number + 1) * lead, one): Tally(one.event, forecasts.members)
        for number in range(classes) for one in sums
    }
    issues = forecasts.each()
    while batch := list(itertools.islice(issues, _AT_ONCE)):
        rain = np.full((len(batch), forecasts.members, classes * lead), np.nan)
        fallen = np.empty((len(batch), classes * lead))
        for place, issue in enumerate(batch):
            length = min(forecasts.hours, issue.rain.shape[1])
            rain[place, :, :length] = issue.rain[:, :length]
            fallen[place] = _window(observed, issue.hour, classes * lead)
        _add(found, rain, fallen)
        done(len(batch))
    return found


def _add(found: dict[Class, Tally], rain: Array, fallen: Array) -> None:
    """Add the pairs of some forecasts, shape (forecasts, members, hours), to their classes."""
    for one, total in found.items():
        leads = slice(one.low, one.high)
        total.add(
            _sums(rain[:, :, leads].swapaxes(0, 1), one.sum.hours),
            _sums(fallen[None, :, leads], one.sum.hours)[0],
        )


def _sums(rain: Array, hours: int) -> Array:
    """Return the sums of so many hours (mm), shape (members, pairs)."""
    members = len(rain)
    sums: Array = np.round(rain.reshape(members, -1, hours).sum(axis=2), _DIGITS)
    return sums


def _window(observed: Array, start: int, length: int) -> Array:
    """Return records from an hour on; NaN before the first and after the last."""
    hours = np.arange(start, start + length)
    inside = (hours >= 0) & (hours < len(observed))
    return np.where(inside, observed[np.clip(hours, 0, len(observed) - 1)], np.nan)
