"""Ranges of numbers, the check of a user's number, and the message about an invalid number.

The parameters of sites, controllers, drives, sensors and nodes are checked by this module, and so
are studies, options and topics.
"""

from __future__ import annotations

import math
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from greenroof_ros.base.errors import ConfigurationError

# A limit this close to 0 only excludes 0.
_TINY = 1e-9
_MAXIMUM = sys.float_info.max


def read_number(text: str) -> float:
    """Return the number in a user's text; no other function parses numbers entered by users.

    Raises:
        ValueError: if the text is not a number. Python would also accept ``1_0`` as 10, and digits
            of other scripts.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"is not a number: {text!r}")
    return float(text)


@dataclass(frozen=True)
class Range:
    """A range of valid numbers.

    Attributes:
        low: minimum. A positive minimum of up to 1e-9 means that the number must be greater than 0.
        high: maximum. A negative maximum of -1e-9 or more means that the number must be less than
            0; the largest float means any finite number.
        unit: unit of the numbers; empty or ``1`` if no unit is shown.
        whole: True if the numbers must be integers.
        words: words that are also accepted, for messages.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    whole: bool = False
    words: tuple[str, ...] = ()

    def __contains__(self, value: Any) -> bool:
        if isinstance(value, bool) or not isinstance(value, Real):
            return False
        # NumPy compares its 32-bit infinity with the largest float as equal.
        number: Any = value if isinstance(value, Integral) else float(value)
        return bool(self.low <= number <= self.high and (not self.whole or number % 1 == 0))

    @property
    def limits(self) -> str:
        """The limits as text, such as ``0 to 1``; empty if there are no limits."""
        return self._limits[1]

    @property
    def _limits(self) -> tuple[str, str]:
        """The preposition that follows *a number*, and the limits; either can be empty."""
        low, high = (
            str(end) if isinstance(end, int) else f"{end:.9g}" for end in (self.low, self.high)
        )
        positive, negative = 0 < self.low <= _TINY, -_TINY <= self.high < 0
        above = "greater than 0" if positive else f"at least {low}"
        below = "less than 0" if negative else f"at most {high}"
        ends = [above] * (self.low > -_MAXIMUM) + [below] * (self.high < _MAXIMUM)
        if len(ends) == 2 and not (positive or negative):
            return "from ", f"{low} to {high}"
        return "of " if ends and ends[0].startswith("at") else "", " and ".join(ends)

    def __str__(self) -> str:
        """Return a description of valid values, such as ``a number from 0 to 1 m``."""
        kind = "a finite" if self.high == _MAXIMUM else "a"
        preposition, limits = self._limits
        unit = "" if self.unit == "1" else self.unit
        words = (kind, "whole" * self.whole, "number", preposition + limits, unit)
        return ", or ".join((" ".join(filter(None, words)), *self.words))

    def expected(self, value: object = None) -> str:
        """Return the message about an invalid value, such as ``must be a number from 0 to 1 m``."""
        comma = isinstance(value, str) and re.fullmatch(r"[-+]?\d*,\d+", value.strip())
        return f"must be {self}{', with a decimal point' if comma else ''}"

    def check(self, value: Any) -> float:
        """Check a value, and return it as an int if it must be an integer, otherwise as a float.

        An integer may also be written as 5.0.

        Args:
            value: a Python or NumPy number; true and false are not numbers.

        Raises:
            ValueError: if the value is not a number in this range; the message states the valid
                values.
        """
        if value in self:
            with suppress(OverflowError):
                return int(value) if self.whole else float(value)
        raise ValueError(self.expected(value))

    def parse(self, text: str) -> float:
        """Check the number in a text, and return it; see :meth:`check`."""
        with suppress(ValueError):
            return self.check(read_number(text))
        raise ValueError(self.expected(text))

    def read(self, value: Any, about: str = "", **place: Any) -> float:
        """Check the number of a key, and return it; see :meth:`check`.

        Args:
            value: value of the key.
            about: text to append to the message.
            place: name of the key, with its file and line if any, for the error.

        Raises:
            ConfigurationError: if the value is not a number in this range.
        """
        try:
            return self.check(value)
        except ValueError as error:
            raise ConfigurationError(f"{error}{about}", value=value, **place) from None
