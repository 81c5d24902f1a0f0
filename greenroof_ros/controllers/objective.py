"""What planning controllers look for: apart from their program, whose solver is slow to import."""

from __future__ import annotations

from typing import NamedTuple


class Prices(NamedTuple):
    """What counts beside the deviation."""

    energy: float = 0.0
    """of a kWh of hydraulic energy, as deviation (m3 s, or m6 s where that is squared)"""
    start: float = 0.0
    """of a pump start at full flow, likewise"""


class Ensemble(NamedTuple):
    """How a program looks at several forecasts at once."""

    level: float = 0.0
    """of the conditional value-at-risk: 0 is the mean of all, 0.9 that of the worst tenth"""
    recourse: float = 0.0
    """until then (s) one plan serves all members; later each has its own"""


NO_PRICES = Prices()
MEAN_OF_ALL = Ensemble()
