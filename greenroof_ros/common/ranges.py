"""Ranges of numbers: the only check of a number that a user gives, and the only sentence about it.

Site, controller, drive, sensor and node parameters, studies, options and topics use it.
"""

from __future__ import annotations

import math
import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError

# A limit this near 0 only excludes 0.
_TINY = 1e-9


@dataclass(frozen=True)
class Range:
    """The numbers that a value may be.

    Attributes:
        low: the minimum. Up to 1e-9 above 0 it means greater than 0.
        high: the maximum, likewise. The greatest float means any finite number.
        unit: of the numbers; empty or ``1`` if there is none to show.
        whole: whether they are whole numbers.
        words: texts that are accepted as well, for messages.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    whole: bool = False
    words: tuple[str, ...] = ()

    def __contains__(self, value: object) -> bool:
        return (
            isinstance(value, int if self.whole else (int, float)) and not isinstance(value, bool)
            and self.low <= value <= self.high
        )

    @property
    def limits(self) -> str:
        """Its ends, as in ``0 to 1``; empty if there are none."""
        low, high = (
            str(end) if isinstance(end, int) else f"{end:.9g}" for end in (self.low, self.high)
        )
        if self.high >= sys.float_info.max:
            return f"at least {low}" if self.low > -sys.float_info.max else ""
        return f"{low} to {high}" if self.low > -sys.float_info.max else f"at most {high}"

    def __str__(self) -> str:
        """Return what a value must be: ``a number from 0 to 1 m``."""
        return self._words(self.limits)

    def expected(self, value: object = None) -> str:
        """Return the sentence about a wrong value: ``must be a number from 0 to 1 m``."""
        number = value if isinstance(value, (int, float)) else math.nan
        limits = self.limits
        if 0 < self.low <= _TINY and not number > 0:
            limits = "greater than 0"
        elif -_TINY <= self.high < 0 and not number < 0:
            limits = "less than 0"
        comma = isinstance(value, str) and re.fullmatch(r"[-+]?\d*,\d+", value.strip())
        return f"must be {self._words(limits)}{', with a decimal point' if comma else ''}"

    def _words(self, limits: str) -> str:
        kind = "a whole number" if self.whole else "a number"
        if self.high == sys.float_info.max:
            kind = kind.replace("a ", "a finite ", 1)
        of = " from " if " to " in limits else " of " if limits.startswith("at") else " "
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        return ", or ".join((f"{kind}{of if limits else ''}{limits}{unit}", *self.words))

    def check(self, value: object) -> float:
        """Return a value as a number: an int if it must be whole, otherwise a float.

        Raises:
            ValueError: it is not a number of this range; the message is the sentence about it.
        """
        if value in self:
            with suppress(OverflowError):
                return value if self.whole else float(value)  # type: ignore[return-value,arg-type]
        raise ValueError(self.expected(value))

    def parse(self, text: str) -> float:
        """Return the number in a text; see :meth:`check`."""
        value: object = text
        with suppress(ValueError):
            value = int(text) if self.whole else float(text)
        return self.check(value)

    def read(
        self, value: object, *, file: Path, line: int | None, key: str, about: str = ""
    ) -> float:
        """Return the number under a key of a file; a whole one may be written as 5.0.

        Args:
            value: what the file has.
            file: the file.
            line: of the key.
            key: its name.
            about: end of the message.

        Raises:
            ConfigurationError: it is not a number of this range.
        """
        plain = self.whole and isinstance(value, float) and value.is_integer()
        try:
            return self.check(int(value) if plain else value)  # type: ignore[call-overload]
        except ValueError as error:
            raise ConfigurationError(
                f"{error}{about}", file=file, line=line, key=key, value=value
            ) from None
