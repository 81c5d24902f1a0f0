"""A dose is delivered once and in full, or it is refused or given up with a stated reason."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import LOST, Rig, settings_for

SITE = replace(PAPER_SITE, max_dose=0.5)


@pytest.fixture
def rig() -> Rig:
    """Return a pump that has stood long enough to start, on a roof with room for 2.6 m3."""
    rig = Rig(x2=0.5, site=SITE)
    rig.run(15, 0.0)
    return rig


def ask(rig: Rig, volume: float = 0.2, age: float = 0.0) -> str:
    return rig.control.doses.request(time.time() - age, volume, time.time())


def end(rig: Rig) -> str:
    dose = rig.control.doses.last
    assert dose is not None
    return dose.over


@pytest.mark.parametrize(("volume", "valve"), [(0.05, 1.0), (0.5, 1.0), (0.1, 0.0)])
def test_a_dose_is_delivered_once(rig: Rig, volume: float, valve: float) -> None:
    """By the plant's balance, within 3 % and what flows in a tick at the minimum flow.

    Then the controller commands on. Behind a closed valve it is no endless dose: a meter that reads
    0 is ignored.
    """
    before, rig.arriving, rig.leaving = rig.x2, valve, valve
    rig.change = {} if valve else {"flow": 0.0}
    assert ask(rig, volume) == ""
    rig.run(600, 0.0, until=lambda decision: end(rig) != "")
    assert end(rig) == "done"
    rig.run(100, 0.0)
    min_flow = 0.2 * rig.plant_flow(1.0)
    assert rig.x2 - before == pytest.approx(valve * volume, rel=0.03, abs=min_flow)
    assert rig.decisions[-1].state == "off" and rig.control.doses.last is None
    assert rig.run(20, 0.5).why == "as commanded"


@given(st.floats(0.0, 1.0) | st.floats(), st.floats(-90.0, 10.0) | st.floats())
def test_a_dose_that_is_too_small_too_large_or_of_another_time_is_refused(
    volume: float, age: float
) -> None:
    """It is from 17 to 500 litres, and asked for after the start of the node, which was just now.

    By a clock that is at most 60 s ahead.
    """
    rig = Rig(x2=0.5, site=SITE)
    rig.run(15, 0.0)
    refused = ask(rig, volume, age)
    assert bool(refused) == (rig.control.doses.last is None)
    assert refused or (0.016 < volume <= 0.5 and -60.0 <= age < 5.0)
    assert not refused or not (0.017 <= volume <= 0.5 and -59.0 < age < 0.0)


def test_where_none_is_allowed_or_the_pump_must_not_run_none_is_given() -> None:
    assert ask(Rig()) and ask(Rig(site=SITE))  # not allowed; before anything is known


def test_a_request_counts_once(rig: Rig) -> None:
    """Neither a repeated request counts nor an older one, even if the newer one was refused."""
    now = time.time()
    for after, volume, seconds, accepted in (
        (0.0, 0.1, 5, True), (0.1, 0.3, 100, False), (0.0, 0.1, 5, False), (-0.001, 0.1, 5, False),
        (1.0, 0.001, 5, False), (1.0, 0.1, 5, False),
    ):
        assert (rig.control.doses.request(now + after, volume, time.time()) == "") == accepted
        rig.run(seconds, 0.0)


@pytest.mark.parametrize(("min_off", "over"), [(90.0, "ended"), (40.0, "")])
def test_what_cannot_begin_within_a_minute_expires(min_off: float, over: str) -> None:
    rig = Rig(x2=0.5, site=SITE, settings=settings_for(SITE, min_off=min_off))
    rig.run(2, 0.0)
    assert ask(rig) == ""
    rig.run(62, 0.0)
    assert (end(rig), rig.decisions[-1].request is None) == (over, bool(over))


@pytest.mark.parametrize("change", [
    # Even an interlock from the controller's command, which is ignored otherwise.
    {"reasons": [LOST]}, {"command": None}, {}, {"roof_level": SITE.z_veg},
], ids=["lost drive", "no command", "suspend", "full roof"])
def test_what_stops_the_pump_ends_it_for_good(rig: Rig, change: dict[str, object]) -> None:
    assert ask(rig, 0.5) == ""
    assert rig.run(5, 0.0).request is not None
    rig.change = change
    rig.step(0.0) if change else rig.suspend(30.0)
    rig.change = {}
    assert end(rig) == "ended"
    rig.run(15, 0.0)  # the minimum time on
    assert rig.run(50, 0.0, until=lambda decision: decision.request is not None).request is None
