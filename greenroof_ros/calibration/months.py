"""Which months of a record count: a winter's snow is nothing that the model of the roof knows."""

from __future__ import annotations

import re

import numpy as np

from greenroof_ros.calibration.halves import Steps
from greenroof_ros.calibration.record import Record
from greenroof_ros.common.errors import ConfigurationError

_SPAN = re.compile(r"(\d{1,2})-(\d{1,2})")


class Months:
    """Months from a first to a last one, both of which count, over new year if the last is less."""

    def __init__(self, text: str) -> None:
        """Read them.

        Args:
            text: such as ``4-10`` or ``11-3``.

        Raises:
            ConfigurationError: it is no such span.
        """
        match = re.fullmatch(_SPAN, text)
        first, last = map(int, match.groups()) if match else (0, 0)
        if not (1 <= first <= 12 and 1 <= last <= 12):
            raise ConfigurationError(
                "must be the first and the last month that count, such as 4-10, or 11-3 over new "
                "year", key="--months", value=text,
            )
        self.text = text
        self._numbers = [(first - 1 + more) % 12 + 1 for more in range((last - first) % 12 + 1)]

    def steps(self, record: Record) -> Steps:
        """Return which steps of a record begin in them, by its own clock.

        Raises:
            ConfigurationError: none does.
        """
        number = record.times.astype("datetime64[M]").astype(np.int64) % 12 + 1
        within = np.isin(number, self._numbers)
        if not within.any():
            raise ConfigurationError(
                f"has no row in the months {self.text} of --months: it is from "
                f"{str(record.times[0])[:10]} to {str(record.times[-1])[:10]}", file=record.source,
            )
        return within


def counted(record: Record, months: Months | None) -> Steps:
    """Return which steps of a record count: those of some months, or all.

    Raises:
        ConfigurationError: none does.
    """
    return np.full(record.steps, True) if months is None else months.steps(record)
