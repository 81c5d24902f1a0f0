"""The on/off controller, Eq. (12)."""

from __future__ import annotations

import math

import pytest
from paper import PAPER_SITE

from greenroof_ros.controllers.onoff import OnOff


@pytest.mark.parametrize(
    ("level", "cistern", "roof", "pumps"),
    [
        (1.0, 0.75, math.nextafter(0.0457, 0), True),
        (1.0, 0.75, 0.0457, False),
        (1.0, math.nextafter(0.75, 0), 0.0, False),
        (1.0, math.nan, 0.0, False),
        (1.0, 3.0, math.nan, False),
        (0.75, 3.0, 0.034274, True),
        (0.75, 3.0, 0.034276, False),
    ],
)
def test_thresholds(level: float, cistern: float, roof: float, pumps: bool) -> None:
    """v if x2/a2 < 0.0457 m (0.034275 m with a level of 0.75) and x1/a1 >= 0.15 + 0.6 m, else 0."""
    command = OnOff(PAPER_SITE, 1.5, level).command(cistern, roof, [0.0] * 10, [0.0] * 10)
    assert command == (1.5 if pumps else 0.0)
