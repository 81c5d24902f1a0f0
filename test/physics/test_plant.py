"""The exact plant, Eqs. (1)-(4), and the affinity laws: by hand with the values of Table I."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from paper import PAPER_SITE, site_with, sites, tick_of
from places import CONFIG

from greenroof_ros.physics.cistern import low_outlet_flow, overflow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import flow_at, maximum_pump_flow, pump_flow, speed_for
from greenroof_ros.physics.soil import percolation
from greenroof_ros.physics.tick import command_to
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

FIELD_CAPACITY = read_site(CONFIG / "site_neubrandenburg.yaml")
# Its thresholds are binary fractions, so tests can hit them exactly: the target at x2 = 4 m3, the
# soil's capacity at 32 m3; the suction level stays at 18.75 m3.
ROUND_SITE = site_with(a2=64.0, z_veg=0.0625, z_soil=0.5)


LOW_OUTLET = site_with(low_outlet_level=1.0, low_outlet_radius=0.025)
"""1/5 of the main outlet's radius, 1/25 of its area"""
OUT = 0.1326322799584


@pytest.mark.parametrize(("site", "x1", "flow"), [
    # A head of 1 m gives 0.61 pi 0.125^2 sqrt(2 9.81); a head of 1/4 m half of it.
    (PAPER_SITE, 100.0, OUT), (PAPER_SITE, 81.25, OUT / 2),
    (PAPER_SITE, 75.0, 0.0), (PAPER_SITE, 0.0, 0.0),
    # At 4 m, 1 m above the main outlet, both take water.
    (LOW_OUTLET, 50.0, OUT / 25), (LOW_OUTLET, 31.25, OUT / 50), (LOW_OUTLET, 25.0, 0.0),
    (LOW_OUTLET, 100.0, (25 + math.sqrt(3)) * OUT / 25),
])
def test_outlet_flow_by_hand(site: Site, x1: float, flow: float) -> None:
    """Eq. (2): > z_o. The smallest step above 75 m3, or 25 m3, already gives about 3e-9 m3/s."""
    p, above = plant_parameters(site), math.nextafter(x1, math.inf)
    assert overflow(p, x1) + low_outlet_flow(p, x1) == pytest.approx(flow, rel=1e-12)
    if not flow and x1:
        assert 0 < overflow(p, above) + low_outlet_flow(p, above) < 1e-8


WEAK = replace(PAPER_SITE, c_hat=15.0)
"""15 m of head against 16 m of height deliver nothing from less than 1 m of water"""


@pytest.mark.parametrize(("site", "x1", "flow"), [
    # b = 1 / sqrt(328.12 / (19.62 (0.01 pi)^2) + 5.78e5) = 1.29646769e-3, times sqrt(42.2).
    (PAPER_SITE, 75.0, 0.00842205211502804),
    (WEAK, 24.0, 0.0), (WEAK, 25.0, 0.0), (WEAK, 26.0, 1.29646769313485e-3 * 0.2),
])
def test_maximum_pump_flow_by_hand(site: Site, x1: float, flow: float) -> None:
    assert maximum_pump_flow(site, x1) == pytest.approx(flow, rel=1e-12)


@pytest.mark.parametrize(("x1", "x2", "runs"), [
    (75.0, math.nextafter(4.0, 0.0), True),
    (75.0, 4.0, False),
    (18.75, 0.0, True),
    (math.nextafter(18.75, 0.0), 0.0, False),
])
def test_pumps_run_between_the_thresholds_only(x1: float, x2: float, runs: bool) -> None:
    """Eq. (3a): none at x2/a2 >= z_veg, none at x1/a1 < z_pump + z_H."""
    expected = 0.5 * maximum_pump_flow(ROUND_SITE, x1) if runs else 0.0
    assert pump_flow(plant_parameters(ROUND_SITE), x1, x2, 0.5) == expected
    assert tick_of(ROUND_SITE, x1, x2, command=0.5)[1].pump == expected


@pytest.mark.parametrize("site", [PAPER_SITE, FIELD_CAPACITY])
def test_the_command_to_a_volume_leads_there(site: Site) -> None:
    """A litre more in a tick, in rain and sun; 0 if it rains enough or pumps are too weak."""
    start, weather = (75.0, 0.5 * site.x2_star), (1e-6, 2e-6)
    target = start[1] + 1e-3
    command = command_to(plant_parameters(site), *start, target, *weather)
    assert tick_of(site, *start, *weather, command)[0].roof == pytest.approx(target, rel=1e-12)
    assert command_to(plant_parameters(site), *start, start[1], *weather) == 0
    weak = plant_parameters(replace(site, c_hat=15.0))
    assert command_to(weak, 24.0, 1.0, 2.0, *weather) == 0


def test_drainage_by_hand() -> None:
    """Eq. (4): 0 if x2 < z_cap; at x2/a2 = z_soil it is 2 K a2, and at 0.6 m it is 2.2 K a2."""
    for site, x2, flow in (
        (PAPER_SITE, PAPER_SITE.z_cap, 1.077408e-5), (PAPER_SITE, 41.28, 1.1851488e-5),
        (ROUND_SITE, math.nextafter(32.0, 0.0), 0.0), (ROUND_SITE, 32.0, 2 * 7.83e-8 * 64),
    ):
        drained = percolation(plant_parameters(site), x2, 0.01, site.tau)
        assert drained == pytest.approx(flow, rel=1e-12)


DRAINS = 1.077408e-5
"""Eq. (4) at 34.4 m3"""


@pytest.mark.parametrize(("x1", "x2", "inputs", "expected"), [
    # 1 m3 and 0.1 m3/s of rain, with a demand of 2.2 m3/s: half of it flows.
    (1.0, 0.0, (0.1 / PAPER_SITE.a_in, 0.0, 2.2), (0.0, 1.1, 0.0, 0.0, True)),
    # OUT m3/s to the sewer and 200 - OUT m3/s pumped make 200 from 100 m3: half of each.
    (100.0, 0.0, (0.0, 0.0, 200 - OUT), (OUT / 2, 100 - OUT / 2, 0.0, 0.0, True)),
    # 2e-6 m3 cannot lose 3e-6 m3 in a second; drainage and evapotranspiration share alike.
    (10.0, 2e-6, (0.0, 3e-6, 0.0), (0.0, 0.0, 0.0, 2e-6, True)),
    (10.0, 34.4, (0.0, 68.8 - DRAINS, 0.0), (0.0, 0.0, DRAINS / 2, 34.4 - DRAINS / 2, True)),
    # Exactly what is there is no limit: 1 m3 pumped, and evaporated from what was pumped.
    (1.0, 0.0, (0.0, 1.0, 1.0), (0.0, 1.0, 0.0, 1.0, False)),
])
def test_a_tank_that_holds_too_little_shares_it_out(
    x1: float, x2: float, inputs: tuple[float, float, float], expected: tuple[float, ...]
) -> None:
    """And nothing is left in it."""
    after, flows = tick_of(PAPER_SITE, x1, x2, *inputs[:2], pumped=inputs[2])
    assert flows == pytest.approx((*expected, 0.0, 0.0, 0.0, 0.0), rel=1e-12)
    assert 0.0 in after[:2]


@pytest.mark.parametrize(("site", "speed", "level", "flow"), [
    # At 80 % from 3 m: b sqrt(0.64 55.2 - 13) = 1.29646769e-3 sqrt(22.328).
    (PAPER_SITE, 0.8, 3.0, 0.00612614),
    # 13 m of lift need sqrt(13 / 55.2) = 0.48529 of the speed.
    (PAPER_SITE, 0.4852, 3.0, 0.0), (PAPER_SITE, 0.4854, 3.0, 9.913047e-5),
    (WEAK, 1.0, 0.5, 0.0),
    # Without rotation nothing flows, not even from 20 m of water to a roof at 16 m.
    (PAPER_SITE, 0.0, 3.0, 0.0), (PAPER_SITE, 0.0, 20.0, 0.0),
])
def test_flow_by_hand(site: Site, speed: float, level: float, flow: float) -> None:
    assert flow_at(site, speed, level) == pytest.approx(flow, rel=1e-6, abs=0)


@given(
    site=st.just(PAPER_SITE) | sites(),
    above_suction=st.floats(0, 5),
    share=st.floats(1e-3, 1) | st.just(0.0),
)
@example(WEAK, 0.0, 1.0)
def test_flow_and_speed_are_inverse(site: Site, above_suction: float, share: float) -> None:
    """The speed for a share gives that share of the maximum flow, and no speed exceeds 1."""
    level = site.suction_level + above_suction
    assume(level <= site.d)
    speed = speed_for(site, share, level)
    most = maximum_pump_flow(site, level * site.a1)
    assert (speed > 0) == (share * most > 0)
    assert speed <= 1 + 1e-12
    # Near zero flow, rounding s^2 by 2e-16 changes q^2 by d 2e-16.
    assert flow_at(site, speed, level) == pytest.approx(share * most, rel=1e-6, abs=1e-7 * most)
