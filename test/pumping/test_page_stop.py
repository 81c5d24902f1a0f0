"""What the page may do: release what it stopped, and clear a fault that nobody has to look at."""

from __future__ import annotations

import pytest
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.pumping.interlocks import INTERLOCKS, LATCHED
from greenroof_ros.pumping.limits import settings_for

DAY_S = 86_400


def test_the_page_releases_what_it_stopped_and_nothing_else() -> None:
    rig = Rig(x2=0.5)
    rig.run(15, 0.5)
    rig.control.stop_on_page(True)
    assert rig.step(0.5).state == "held"
    rig.control.stop(True)
    rig.control.stop_on_page(False)
    assert list(rig.step(0.5).interlocks) == ["operator_stop"]
    rig.control.stop_on_page(True)
    assert list(rig.step(0.5).interlocks) == ["operator_stop", "page_stop"]
    rig.control.stop(False)  # at the pump node, whoever it was
    assert rig.run(60, 0.5).state == "running"


def test_it_starts_no_pump_sooner_than_it_may() -> None:
    """Not within 120 s, by a release and by clearing a fault."""
    rig = Rig(x2=0.5, settings=settings_for(PAPER_SITE, least_off=120.0))
    assert rig.run(200, 1.0, until=lambda one: one.state == "running").speed is not None
    rig.control.stop_on_page(True)
    rig.ledger.fault("it turns at another speed", "speed_not_followed")
    assert rig.run(5, 1.0).speed is None
    rig.control.stop_on_page(False)
    rig.control.clear_on_page()
    assert rig.run(114, 1.0, until=lambda one: one.speed is not None).speed is None
    assert rig.run(5, 1.0).speed is not None


@pytest.mark.parametrize("code", [code for code, one in INTERLOCKS.items() if one.kind == LATCHED])
def test_a_fault_is_cleared_once_in_a_day_and_some_never(code: str) -> None:
    """One of delivery or drive needs somebody who has looked, and so does an unknown one."""
    rig = Rig(x2=0.5)
    rig.run(2, 0.0)
    assert rig.control.page_may_not_clear == "there is no fault"
    rig.ledger.fault("why", code)
    if code in ("delivery", "drive_fault", "fault_unknown"):
        assert "somebody who has looked" in rig.control.page_may_not_clear
        return
    rig.control.clear_on_page()
    assert rig.ledger.record.fault == ""
    rig.ledger.fault("why", code)
    assert "once in 24 h" in rig.control.page_may_not_clear
    rig.ledger.count(DAY_S - 10.0, 0.0, 0.0)
    assert rig.control.page_may_not_clear
    rig.ledger.count(10.0, 0.0, 0.0)
    assert rig.control.page_may_not_clear == ""
