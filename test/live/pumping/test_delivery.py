"""The delivery check: what it finds and how soon; weather and noise cause no alarm."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE, site_with
from places import CONFIG
from pump_rig import LOST, Rig

from greenroof_ros.live.pumping.input_rules import InputRules, LevelRule, cistern_bounds
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

FIELD_CAPACITY = read_site(CONFIG / "site_neubrandenburg.yaml")
LOW_OUTLET = site_with(low_outlet_level=1.0, low_outlet_radius=0.025)
"""At 2.8 m it takes 0.61 pi 0.025^2 sqrt(2 9.81 1.8) = 0.00712 m3/s, at 2 m 0.00531 m3/s."""
# Mains that give more than the pump takes; an outlet with 1.4 times the area in the site file.
MAINS = replace(PAPER_SITE, mains_level=2.9, mains_flow=0.009)
WIDE = replace(LOW_OUTLET, low_outlet_radius=0.025 * math.sqrt(1.4))
SLOW: dict[str, Any] = {"tau": 10.0, "noise": 0.0015}
"""for hours: ticks of 10 s, with a mean as exact as for 5 mm each second"""
SITES = [(site, site) for site in (PAPER_SITE, MAINS, FIELD_CAPACITY, site_with(a_in=500.0))]


@given(
    st.sampled_from([*SITES, (LOW_OUTLET, WIDE)]), st.floats(25.0, 80.0), st.floats(0.0, 3.0),
    st.lists(st.tuples(
        st.integers(5, 40), st.sampled_from([0.0, 0.005, 0.15, 1.0]),
        st.sampled_from([0.0, 2.0, 20.0, 100.0]), st.floats(0.0, 1.0),
    ), max_size=4),
)
def test_no_weather_and_no_schedule_is_an_alarm(
    sites: tuple[Site, Site], cistern: float, roof: float,
    scenes: list[tuple[int, float, float, float]],
) -> None:
    """In ticks of 10 s with noise. Scenes: minutes, command, rain, evapotranspiration (mm/h)."""
    rig = Rig(cistern, roof, site=sites[0], **SLOW)
    rig.plant = plant_parameters(replace(sites[1], tau=10.0))
    for minutes, command, rain, loss in scenes:
        for _ in range(6 * minutes):
            decision = rig.step(command, rain / 3.6e6, loss / 3.6e6 * rig.site.a2)
            assert decision.state != "fault", f"{rig.now:.0f} s: {decision.why}"


# What tells the person at the pump what to look for.
BURST, CLOSED, RUNS, LEAK = "burst pipe", "closed valve", "only the main switch stops", "a leak, or"
HALF_DRY = {"x2": 0.5}
SILENT = {"speed": None, "reasons": [LOST]}
STILL = {"noise": 0.0, "x2": 0.688}
SPIKES = {"x2": 0.5, "noise": 0.002}


@pytest.mark.parametrize(
    ("settings", "before", "broken", "command", "within", "cause"),
    [
        # Half of 0.0083 m3/s makes 0.413 m3 in 100 s. In addition the mean lags by 60 s, and noise
        # can hide twice its standard deviation of 0.03 m3.
        (HALF_DRY, 0.01, {"arriving": 0.0}, 1.0, 200, BURST),
        # No water moves at all, and the meter agrees.
        (HALF_DRY, 0.01, {"arriving": 0.0, "leaving": 0.0, "change": {"flow": 0.0}}, 1.0, 200,
         CLOSED),
        # Levels without noise stand still: 0.15 m3 in 18 s, and 0.413 m3 in 49 s.
        (STILL, 0.0, {"change": {"cistern_level": 2.8, "roof_level": 0.01}}, 1.0, 30, CLOSED),
        (STILL, 0.0, {"change": {"roof_level": 0.01}}, 1.0, 60, BURST),
        # 0.15 m3 in 18 s, plus the lag. An allowed 7e-6 m3/s is subtracted from the loss.
        (HALF_DRY, 0.0, {"contactor_stuck": True}, 0.0, 70, RUNS),
        ({"x2": 3.2}, 0.3, {"leak": 0.01}, 0.3, 65, LEAK),
        # A low outlet takes less than the pump's 0.0084 m3/s, and is not treated as a burst pipe.
        ({"site": LOW_OUTLET}, 0.0, {"contactor_stuck": True}, 0.0, 400, RUNS),
        # The drive's timeout does not stop it: its flow is treated as lost after 15 s.
        (HALF_DRY, 0.0, {"stuck_speed": 1.0, "change": SILENT}, 0.0, 90, RUNS),
        # A spike every half minute makes both levels unknown for the 10 s of recovery. The pump
        # runs for 10 of every 30 s, so the 160 s of a burst pipe become 480.
        (SPIKES, 0.01, {"arriving": 0.0}, 1.0, 520, BURST),
    ],
)
def test_what_breaks_is_found(
    settings: dict[str, Any], before: float, broken: dict[str, Any], command: float, within: float,
    cause: str,
) -> None:
    """The first ten minutes have no fault."""
    rig = Rig(**({"noise": 0.005} | settings))
    rig.run(600, before)
    assert rig.decisions[-1].state != "fault"
    for name, value in broken.items():
        setattr(rig, name, value)
    for second in range(int(within / rig.tau)):
        if settings is SPIKES:
            rig.change = dict.fromkeys(("cistern_level", "roof_level") if second % 30 < 11 else ())
        if rig.step(command).state == "fault":
            break
    assert (rig.decisions[-1].request, rig.decisions[-1].state) == (None, "fault")
    assert next(iter(rig.decisions[-1].active)) == ("runs_on" if cause is RUNS else "delivery")
    assert cause in rig.decisions[-1].why
    assert rig.state_file.state.day_volume < 2.3


def test_a_level_that_jumped_is_no_evidence() -> None:
    """A sensor drifts up by 1 mm/s, while the pump lowers the level by 0.34 mm/s, and jumps back.

    What the balances counted before the jump is forgotten, since those readings may be wrong;
    otherwise the drift would latch a fault 40 s after its end.
    """
    rig = Rig(x2=0.2)
    level = LevelRule(cistern_bounds(rig.site), 0.01, 0.02)
    rules = InputRules(rig.now, 5.0, 10.0, level=level)
    unfit = 0
    for second in range(-100, 350):
        rig.cistern_offset = 0.001 * second if 0 <= second < 30 else 0.0
        rules.receive(rig.now, rig.levels()[0] + rig.cistern_offset)
        rig.change = {"displacements": (level.displacement, 0.0)}
        if rules.check(rig.now) is not None:
            rig.change["cistern_level"] = None
            unfit += second >= 0
        command = 1.0 if second > -50 else 0.0
        assert rig.step(command).state != "fault", (second, rig.decisions[-1].why)
    assert unfit >= 10 and rig.delivered > 1.0


@pytest.mark.parametrize(
    ("site", "x2", "command", "drift", "dry_for"),
    [
        (PAPER_SITE, 0.5, 0.02, 0.0, 0),
        # Mains that are shut at this reading, and a soil that keeps more than at its target.
        (replace(PAPER_SITE, mains_level=0.7, mains_flow=0.009), 0.5, 1.0, 0.0, 0),
        (FIELD_CAPACITY, 0.2, 1.0, 0.0, 0),
        # At full flow the pump is dry for a minute. Half of that flow would exceed what the drift
        # adds, so the roof has to show it.
        (PAPER_SITE, 0.5, 1.0, 0.010, 60), (PAPER_SITE, 0.5, 0.2, 0.010, 0),
    ],
)
def test_a_cisterns_sensor_that_is_stuck_or_drifts_up_latches_before_the_pump_runs_dry(
    site: Site, x2: float, command: float, drift: float, dry_for: int
) -> None:
    """60 mm above the suction level: stuck apart from noise, or with a drift (m per minute)."""
    rig = Rig(x1=site.a1 * (site.suction_level + 0.06), x2=x2, noise=0.0002, site=site)
    stuck_at, dry = rig.x1, 0
    for second in range(3600):
        fell = (stuck_at - rig.x1) / site.a1
        rig.cistern_offset = drift * second / 60 if drift else fell
        if rig.step(command).state == "fault":
            break
        empty = rig.x1 / site.a1 < site.suction_level
        rig.arriving = rig.leaving = 0.0 if empty else 1.0
        dry += empty and rig.speed > 0
    assert rig.decisions[-1].state == "fault"
    assert drift or "perhaps its sensor is stuck or drifting" in rig.decisions[-1].why
    assert dry <= dry_for
