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
    return ready(Rig(x2=0.5, site=SITE))


def ready(rig: Rig) -> Rig:
    rig.run(15, 0.0)
    return rig


def ask(rig: Rig, volume: float = 0.2, age: float = 0.0) -> str:
    return rig.control.doses.request(time.time() - age, volume, time.time())


def end(rig: Rig) -> tuple[str, str]:
    dose = rig.control.doses.last
    assert dose is not None
    return dose.over, dose.why


@pytest.mark.parametrize("volume", [0.05, 0.5])
def test_a_dose_is_delivered_once(rig: Rig, volume: float) -> None:
    """By the plant's balance, within 3 % and what flows in a tick at the minimum flow.

    Then the controller commands on.
    """
    before = rig.x2
    assert ask(rig, volume) == ""
    decision = rig.run(600, 0.0, until=lambda decision: decision.state == "running")
    assert decision.why == f"a dose of {volume:g} m3"
    rig.run(600, 0.0, until=lambda decision: end(rig)[0] != "")
    assert end(rig)[0] == "done"
    rig.run(100, 0.0)
    min_flow = 0.2 * rig.plant_flow(1.0)
    assert rig.x2 - before == pytest.approx(volume, rel=0.03, abs=min_flow)
    assert rig.x2 - before >= volume - 1e-6
    assert rig.decisions[-1].state == "off"
    assert rig.control.doses.last is None
    assert rig.run(20, 0.5).why == "as commanded"


@pytest.mark.parametrize(
    ("volume", "age", "words"),
    [
        (math.nan, 0.0, "must be from 0.0"),
        (0.51, 0.0, " to 0.5 m3 (max_dose)"),
        (0.0, 0.0, "must be from 0.0"),
        (0.01, 0.0, "must be from 0.0"),
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
    rig = ready(Rig(x2=0.5))
    assert ask(rig) == rig.control.doses.refusal == "the site file does not allow doses (max_dose)"
    assert "the pump must not run now" in ask(Rig(site=SITE))  # before anything is known


def test_a_request_counts_once(rig: Rig) -> None:
    """Neither a repeated request counts nor an older one, even if the newer one was refused."""
    now = time.time()

    def request(at: float, volume: float) -> str:
        return rig.control.doses.request(at, volume, time.time())

    assert request(now, 0.1) == ""
    rig.run(5, 0.0)
    assert "another dose is under way: a dose: 0.0" in request(now + 0.1, 0.3)
    rig.run(100, 0.0)
    assert "the previous request" in request(now, 0.1)
    assert "the previous request" in request(now - 0.001, 0.1)
    assert "must be from" in request(now + 1, 0.001)
    assert "the previous request" in request(now + 1, 0.1)


def test_what_cannot_begin_within_a_minute_expires() -> None:
    """The minimum time off is longer than a minute. A dose that waits for less begins."""
    for min_off, over in ((90.0, "ended"), (40.0, "")):
        rig = Rig(x2=0.5, site=SITE, settings=settings_for(SITE, min_off=min_off))
        rig.run(2, 0.0)
        assert ask(rig) == ""
        decision = rig.run(50, 0.0)
        assert (decision.request is None) == bool(over)
        rig.run(12, 0.0)
        assert end(rig)[0] == over


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"reasons": [LOST]}, "no connection"),
        # Even an interlock from the controller's command, which is ignored otherwise.
        ({"command": None}, "there is no command"),
        ("suspend", "there is no command"),
    ],
)
def test_what_stops_the_pump_ends_it_for_good(
    rig: Rig, change: dict[str, object] | str, why: str
) -> None:
    assert ask(rig, 0.5) == ""
    assert rig.run(5, 0.0).request is not None
    if isinstance(change, str):
        rig.suspend(30.0)
    else:
        rig.change = change
        assert rig.step(0.0).request is None
    rig.change = {}
    over, because = end(rig)
    assert over == "ended" and why in because
    assert rig.run(50, 0.0, until=lambda decision: decision.request is not None).request is None


def test_it_ends_at_the_roofs_target() -> None:
    rig = ready(Rig(x2=SITE.x2_star - 0.1, site=SITE))
    assert ask(rig, 0.5) == ""
    rig.run(200, 0.0, until=lambda decision: bool(end(rig)[0]))
    assert end(rig) == ("ended", "the roof is at its target")
    assert rig.x2 < SITE.x2_star + 0.06  # what the pump still delivers until it stands
    assert "the roof is at its target" in ask(rig, 0.1)


def test_a_closed_valve_is_no_endless_dose(rig: Rig) -> None:
    """A meter that reads 0 is ignored: the flow computed from the speed counts."""
    rig.change, rig.arriving, rig.leaving = {"flow": 0.0}, 0.0, 0.0
    assert ask(rig) == ""
    rig.run(120, 0.0, until=lambda decision: bool(end(rig)[0]))
    assert end(rig)[0] == "done"
