"""Forecasts as they were issued, and archives of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import hours_since_1970

ISSUE_HOURS = 6
"""Services start a run of a global model so often (h): at 00, 06, 12 and 18 UTC."""
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


def newest_issue(first: datetime, hour: int) -> tuple[int, int]:
    """Return when the newest forecast in an hour of the records was made.

    It is known from its time of issue on, or so many hours later as a service takes to compute it,
    and is the newest until the next is. Where records do not begin on a whole hour of UTC, an issue
    counts from the first hour of the records that begins after it. The issue that is the newest
    where the records begin was made before them: it keeps its own time, and the first record stands
    for the hours before it.

    Args:
        first: start of hour 0.
        hour: index of the hour.

    Returns:
        Hours since 1970, and the index of the first hour of the records from then on, which is
        negative for one made before them.
    """
    since_1970 = hours_since_1970(first)
    issue = (since_1970 + hour) // ISSUE_HOURS * ISSUE_HOURS
    return issue, issue - since_1970
