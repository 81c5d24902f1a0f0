"""What the page may do: release what it stopped, and clear a fault that nobody has to look at."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.pumping.interlocks import INTERLOCKS, LATCHED
from greenroof_ros.pumping.ledger import Ledger
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


def test_a_stop_on_the_page_is_kept_and_an_older_file_has_none(tmp_path: Path) -> None:
    file = tmp_path / "state.json"
    first = Ledger(file, time.time)
    assert not first.record.page_stop
    first.stop_on_page(True)
    assert first.close() == ""
    again = Ledger(file, time.time)
    assert (again.record.page_stop, again.record.operator_stop) == (True, "")
    again.close()


@pytest.mark.parametrize("action", ["release", "clear"])
def test_neither_starts_a_pump_sooner_than_it_may(action: str) -> None:
    rig = Rig(x2=0.5, settings=settings_for(PAPER_SITE, least_off=120.0))
    assert rig.run(200, 1.0, until=lambda one: one.state == "running").speed is not None
    if action == "release":
        rig.control.stop_on_page(True)
    else:
        rig.ledger.fault("it turns at another speed", "speed_not_followed")
    rig.run(5, 1.0)
    assert rig.decisions[-1].speed is None
    stood = len(rig.decisions) - 5
    if action == "release":
        rig.control.stop_on_page(False)
    else:
        assert rig.control.page_may_not_clear == ""
        rig.control.clear_on_page()
    rig.run(300, 1.0)
    speeds = [one.speed for one in rig.decisions[stood:]]
    assert speeds.index(next(one for one in speeds if one is not None)) >= 119


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
