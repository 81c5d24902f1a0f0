"""Forecasts as they were issued, and archives of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ISSUE_HOURS = 6
"""Services start a run of a global model so often (h)."""
SERVICE_DELAY_H = 6.0
"""After its nominal time a service has a run in so many hours. Open-Meteo, Single Runs API:
"typically 4-6 hours for global models"."""


@dataclass(frozen=True)
class Issue:
    """A forecast of a file.

    Attributes:
        issued: its nominal time; its first hour starts then.
        file: that it is from.
        line: of the file, its first; None where none is known.
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


@dataclass(frozen=True)
class Archive:
    """Forecasts as they were issued.

    Attributes:
        source: the file or directory.
        kind: what it is, in words.
        issues: at least one, in the order of time, all with as many members.
        delay: h after its nominal time from which an issue is known.
        verified: by which it is verified, mostly the same; their rain may be NaN.
        finest_lead: by how many hours of lead it can be verified.
    """

    source: Path
    kind: str
    issues: Sequence[Issue]
    delay: float
    verified: Sequence[Issue]
    finest_lead: int = 1

    @property
    def members(self) -> int:
        """How many forecasts an issue is of."""
        return len(self.issues[0].rain)
