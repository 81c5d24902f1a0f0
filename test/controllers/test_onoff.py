"""The on/off controller, Eq. (12)."""

from __future__ import annotations

import math

import pytest
from paper import PAPER_SITE

from greenroof_ros.controllers.onoff import OnOff

NO_WEATHER = [0.0] * 10


@pytest.mark.parametrize(("cistern", "roof", "pumps"), [
    (0.75, math.nextafter(0.0457, 0), True),
    (0.75, 0.0457, False),
    (math.nextafter(0.75, 0), 0.0, False),
    (3.0, 0.0, True),
    (math.nan, 0.0, False),
    (3.0, math.nan, False),
])
def test_thresholds(cistern: float, roof: float, pumps: bool) -> None:
    """v if x2/a2 < 0.0457 m and x1/a1 >= 0.15 + 0.6 m, else 0; 0 for NaN."""
    controller = OnOff(PAPER_SITE, 1.5)
    assert controller.command(cistern, roof, NO_WEATHER, NO_WEATHER) == (1.5 if pumps else 0.0)


def test_a_level_below_the_target() -> None:
    """With 0.75 it pumps below 0.034275 m, and not at or above it."""
    controller = OnOff(PAPER_SITE, 1.5, 0.75)
    assert controller.command(3.0, 0.034274, NO_WEATHER, NO_WEATHER) == 1.5
    assert controller.command(3.0, 0.034276, NO_WEATHER, NO_WEATHER) == 0.0
