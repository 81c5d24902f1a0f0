"""The defaults, daily use and dry run by hand; starts at any times."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import Rig, settings_for

from greenroof_ros.live.pumping.limits import PumpLimits
from greenroof_ros.live.pumping.state_file import StateFile


def test_defaults_by_hand() -> None:
    """An empty roof takes 3.14416 m3, and 10 mm on 68.8 m2 are 0.688 m3: times 1.5, 5.748 m3.

    At the suction level the maximum flow is b sqrt(0.75 + 55.2 - 16) = 0.00819436 m3/s; a fifth of
    it delivers 3.14416 m3 in 1918 s.
    """
    settings = settings_for(PAPER_SITE)
    assert settings.max_volume_per_day == pytest.approx(5.748, abs=5e-4)
    assert settings.max_run == pytest.approx(1918, abs=1)


@settings(max_examples=30)
@given(times=st.lists(st.integers(1, 500), min_size=20), allowed=st.integers(1, 10))
def test_as_many_starts_in_any_hour_as_are_allowed(times: list[int], allowed: int) -> None:
    """With starts wanted at any times: never more, and no start waits longer than necessary."""
    state_file, starts = StateFile(None), list[float]()
    site = replace(PAPER_SITE, starts_per_hour=allowed)
    limits = PumpLimits(site, settings_for(site, min_off=0.0), state_file)
    for passed in times:
        state_file.count(passed, 0.0)
        wait, _ = limits.wait()
        state_file.count(wait, 0.0)
        starts.append(state_file.state.elapsed)
        assert sum(starts[-1] - 3600 < start for start in starts) <= allowed
        assert not wait or starts[-1] - 3600 in starts
        limits.switch(True)
        limits.switch(False)


def test_dry_run_with_hysteresis() -> None:
    """Off at 0.77 m (2 cm for the sensor's error) in the same step; on again above 0.79 m.

    A pump that draws air no longer lowers the level: the reading can stay at the limit for ever.
    """
    rig = Rig(x1=19.5)
    for level, seconds, code in (
        (0.78, 20, None), (0.7696, 1, "cistern_low"), (0.788, 60, "cistern_low"), (0.792, 60, None),
    ):
        rig.change = {"cistern_level": level}
        decision = rig.run(seconds, 1.0)
        assert next(iter(decision.active), None) == code
        assert (decision.request is None) == (code is not None)


def test_volume_per_day() -> None:
    """Frozen controller and frozen roof sensor: 1 m3, and again when that slot is a day old."""
    rig = Rig(x2=0.0, settings=settings_for(PAPER_SITE, max_volume_per_day=1.0))
    rig.run(600, 1.0)
    assert [*rig.decisions[-1].active] == ["daily_volume"]
    # Beyond it: a step at maximum flow, and what flows while the pump comes to rest.
    assert 1.0 <= rig.delivered <= 1.03
    rig.state_file.count(1800 + 86_400 - 600 - 10, 0.0)
    assert rig.run(8, 1.0).state == "held"
    assert rig.run(4, 1.0).request is not None
