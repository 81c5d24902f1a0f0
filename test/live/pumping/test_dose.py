"""A dose is delivered once and in full, or it is refused or given up with a stated reason."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest
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


def end(rig: Rig) -> tuple[str, str]:
    dose = rig.control.doses.last
    assert dose is not None
    return dose.over, dose.why


@pytest.mark.parametrize(("volume", "valve"), [(0.05, 1.0), (0.5, 1.0), (0.1, 0.0)])
def test_a_dose_is_delivered_once(rig: Rig, volume: float, valve: float) -> None:
    """By the plant's balance, within 3 % and what flows in a tick at the minimum flow.

    Then the controller commands on. Behind a closed valve it is no endless dose: a meter that reads
    0 is ignored.
    """
    before, rig.arriving, rig.leaving = rig.x2, valve, valve
    rig.change = {} if valve else {"flow": 0.0}
    assert ask(rig, volume) == ""
    rig.run(600, 0.0, until=lambda decision: end(rig)[0] != "")
    assert end(rig)[0] == "done"
    assert f"a dose of {1000 * volume:.0f} litres" in {decision.why for decision in rig.decisions}
    rig.run(100, 0.0)
    min_flow = 0.2 * rig.plant_flow(1.0)
    assert rig.x2 - before == pytest.approx(valve * volume, rel=0.03, abs=min_flow)
    assert rig.decisions[-1].state == "off" and rig.control.doses.last is None
    assert rig.run(20, 0.5).why == "as commanded"


@pytest.mark.parametrize(
    ("volume", "age", "words"),
    [
        *((volume, 0.0, "a dose is from 17 to 500 litres") for volume in (math.nan, 0.51, 0.01)),
        (0.2, 61.0, "61 s ago: it must be newer than 60 s"),
        (0.2, -70.0, "synchronize the clocks"),
        (0.2, math.nan, "synchronize the clocks"),
        (0.2, 30.0, "the start of the pump node"),
    ],
)
def test_what_is_refused(rig: Rig, volume: float, age: float, words: str) -> None:
    assert words in ask(rig, volume, age)
    assert rig.control.doses.last is None
    assert rig.run(30, 0.0).request is None


def test_a_site_that_does_not_allow_it_gives_none() -> None:
    assert ask(Rig()) == "the site file does not allow doses (max_dose)"
    assert "the pump must not run now" in ask(Rig(site=SITE))  # before anything is known


def test_a_request_counts_once(rig: Rig) -> None:
    """Neither a repeated request counts nor an older one, even if the newer one was refused."""
    now = time.time()
    for at, volume, words in (
        (now, 0.1, ""), (now + 0.1, 0.3, "another dose is under way: a dose: 7 of 100 litres"),
        (now, 0.1, "the previous request"), (now - 0.001, 0.1, "the previous request"),
        (now + 1, 0.001, "a dose is from"), (now + 1, 0.1, "the previous request"),
    ):
        answer = rig.control.doses.request(at, volume, time.time())
        assert (answer == "") == (words == "") and words in answer
        rig.run(100 if "under way" in words else 5, 0.0)


@pytest.mark.parametrize(("min_off", "over"), [(90.0, "ended"), (40.0, "")])
def test_what_cannot_begin_within_a_minute_expires(min_off: float, over: str) -> None:
    rig = Rig(x2=0.5, site=SITE, settings=settings_for(SITE, min_off=min_off))
    rig.run(2, 0.0)
    assert ask(rig) == ""
    rig.run(62, 0.0)
    assert (end(rig)[0], rig.decisions[-1].request is None) == (over, bool(over))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"reasons": [LOST]}, "no connection"),
        # Even an interlock from the controller's command, which is ignored otherwise.
        ({"command": None}, "there is no command"),
        (None, "there is no command"),
        ({"roof_level": SITE.z_veg}, "the roof is at its target"),
    ],
    ids=["lost drive", "no command", "suspend", "full roof"],
)
def test_what_stops_the_pump_ends_it_for_good(
    rig: Rig, change: dict[str, object] | None, why: str
) -> None:
    assert ask(rig, 0.5) == ""
    assert rig.run(5, 0.0).request is not None
    rig.change = change or {}
    rig.step(0.0) if change else rig.suspend(30.0)
    rig.change = {}
    over, because = end(rig)
    assert over == "ended" and why in because
    rig.run(15, 0.0)  # the minimum time on
    assert rig.run(50, 0.0, until=lambda decision: decision.request is not None).request is None
