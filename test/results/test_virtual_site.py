"""The tick that all simulations share: when its pumps may run, and whose flow it takes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from paper import PAPER_SITE, exact_flows

from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.results.virtual_site import VirtualSite


@pytest.mark.parametrize(
    ("frost", "seconds", "runs"),
    [
        (0.0, 12 * 3600, True), (1.0, 12 * 3600, False), (math.nan, 12 * 3600, False),
        # Quiet from 22:00 to 06:00, to the second; the clock is at UTC.
        (0.0, 22 * 3600 - 1, True), (0.0, 22 * 3600, False), (0.0, 24 * 3600, False),
        (0.0, 6 * 3600 - 1, False), (0.0, 6 * 3600, True),
    ],
)
def test_when_the_pumps_may_run(frost: float, seconds: int, runs: bool) -> None:
    """Not in frost, also if that is unknown, nor in quiet hours; a driver has rules of its own."""
    quiet = replace(PAPER_SITE, quiet_hours=("22:00-06:00",))
    site = VirtualSite(quiet, 75.0, 1.0, (seconds - 1) * 10**9, SensorAndPump())
    site.act(0.0, 0.0, 0.0)
    site.step()
    site.frost = frost
    flow = exact_flows(PAPER_SITE, 75.0, 1.0, 0.5)[1] if runs else 0.0
    assert site.act(0.0, 0.0, 0.5).pump == pytest.approx(flow, rel=1e-12)
    assert site.act(0.0, 0.0, 0.5, pumped=0.003).pump == 0.003
