"""Forecasts as they were issued, and what an archive holds of them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Issue:
    """A forecast of a file.

    Attributes:
        issued: its nominal time; its first hour starts then.
        file: that it is from.
        line: of the file, its first; None where the file has no lines.
        rain: mm/h, shape (members, hours).
        evapotranspiration: mm/day, shape (hours,); None where the file has none.
        temperature: of the air (degC), likewise.
    """

    issued: datetime
    file: Path
    line: int | None
    rain: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64] | None = None
    temperature: NDArray[np.float64] | None = None

    @property
    def hours(self) -> int:
        """How many it has."""
        return len(self.rain[0])

    def evapotranspiration_at(self, ahead: NDArray[np.intp]) -> NDArray[np.float64] | None:
        """Return evapotranspiration so many hours ahead (mm/day); None where the file has none.

        After the last hour it is that of the same hour of the last day, or that of the last hour
        where the issue is shorter than a day.
        """
        if self.evapotranspiration is None:
            return None
        last = self.hours - 1
        index = ahead - 24 * np.maximum(-((last - ahead) // 24), 0)
        return self.evapotranspiration[np.where(index < 0, last, index)]


class Contents(NamedTuple):
    """What is in the files of an archive."""

    kind: str
    """of the archive, in words"""
    issues: list[Issue]
    """at least one"""
    delay: float
    """h after their nominal time from which issues of this kind usually are available"""
    verified: list[Issue] | None = None
    """by which it is verified, where those are others: their rain may be NaN"""
    finest_lead: int = 1
    """by how many hours of lead it can be verified"""
