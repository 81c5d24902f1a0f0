"""The pump's control: states, speeds, flows, a suspend; limits by hand; doses, once and in full."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import LOST, Rig, settings_for

from greenroof_ros.live.pumping.limits import PumpLimits
from greenroof_ros.live.pumping.state_file import StateFile
from greenroof_ros.physics.pump import maximum_pump_flow

SILENT = {"speed": None, "reasons": [LOST]}


def test_states_and_minimum_times_of_a_run_by_hand() -> None:
    """Half the flow from 2.8 m: s^2 = (0.25 42 + 13.2) / 55.2 = 0.65525^2, in four seconds.

    The pump is off for 10 s before its first start, then on and off for at least 10 s each.
    """
    rig = Rig(x1=70.0)
    rig.run(14, 0.5)
    states = [decision.state for decision in rig.decisions]
    assert states == ["off"] * 10 + ["starting"] * 3 + ["running"]
    assert rig.decisions[10].request == pytest.approx(0.65525, abs=5e-6)
    rig.run(13, 0.0)
    assert [decision.state for decision in rig.decisions[20:]] == ["stopping"] * 3 + ["off"] * 4
    rig.run(20, 1.0)
    on = [decision.request is not None for decision in rig.decisions]
    assert [k for k in range(1, len(on)) if on[k] != on[k - 1]] == [10, 20, 30]
    rig = Rig(x2=PAPER_SITE.x2_star)  # a roof at its target
    rig.run(300, 1.0)
    assert rig.delivered == 0


def test_what_is_unknown_is_reported_so() -> None:
    """A drive that is lost while it runs: neither speed nor flow, until it is sure to stand.

    It stands if seen stopped or silent for the 15 s of its timeout. What it may have pumped until
    then counts; from 2.8 m at most b sqrt(2.8 + 55.2 - 13) = 1.29646769e-3 6.708204 m3/s.
    """
    rig = Rig(x1=70.0)
    rig.step(0.0)
    rig.change = SILENT
    assert rig.run(60, 1.0).at_rest and rig.state_file.state.day_volume == 0
    rig.change = {}
    decision = rig.run(60, 1.0)
    assert not decision.at_rest and decision.flow and decision.speed == pytest.approx(1.0)
    before = rig.state_file.state.day_volume
    rig.change = SILENT | {"cistern_level": 2.8}
    rig.run(14, 1.0)
    assert {
        (decision.state, decision.flow, decision.speed, decision.at_rest)
        for decision in rig.decisions[-14:]
    } == {("unknown", None, None, False)}
    decision = rig.run(60, 1.0)
    assert (decision.at_rest, decision.flow) == (True, 0)
    most = 15 * 1.29646769e-3 * 6.708204
    assert rig.state_file.state.day_volume - before == pytest.approx(most, rel=0.08)


@pytest.mark.parametrize(("seconds", "counted"), [(5.0, 5.0), (3600.0, 15.0)])
def test_a_suspend_counts_at_worst_and_proves_no_rest(seconds: float, counted: float) -> None:
    """Full flow from a full cistern, until the drive must have stopped: 15 s; then it is read."""
    rig = Rig(x1=70.0)
    rig.run(60, 0.5)
    before = rig.state_file.state
    decision = rig.suspend(seconds, runs_on=10.0)
    assert (decision.at_rest, decision.state) == (False, "held")
    after = rig.state_file.state
    assert after.elapsed - before.elapsed == seconds and not after.on
    head = rig.site.z_o + rig.site.c_hat - rig.site.d
    assert after.day_volume - before.day_volume == pytest.approx(
        counted * rig.site.b * math.sqrt(head), rel=1e-3
    )
    assert rig.run(60, 0.0).at_rest
    volume = rig.state_file.state.day_volume
    rig.suspend(3600.0)  # a pump that stands cannot have run
    assert rig.state_file.state.day_volume == volume
    assert rig.run(15, 0.5).state in ("starting", "running")


@pytest.mark.parametrize(("stuck", "command", "bad_line"), [
    (0.0, 0.5, False), (1.0, 0.5, False), (0.5, 0.0, False), (0.8, 0.0, True),
])
def test_a_speed_that_does_not_follow(stuck: float, command: float, bad_line: bool) -> None:
    """Over a tenth off for more than 12 s latches, if it comes no nearer.

    Behind a bad line the speed is unknown for 1 s of every 3 s; it must be known for 12 s.
    """
    rig = Rig()
    rig.run(30, stuck if bad_line else command)
    rig.stuck_speed = stuck
    for second in range(60):
        rig.change = SILENT if bad_line and second % 3 == 0 else {}
        if rig.step(command).state == "fault":
            break
    assert 12 <= second <= 17 + 20 * bad_line
    code = "runs_on" if command == 0 else "speed_not_followed"
    assert (rig.decisions[-1].request, list(rig.decisions[-1].active)) == (None, [code])
    rig.stuck_speed, rig.change = None, {}
    assert rig.run(100, command).state == "fault"


@pytest.mark.parametrize(("tau", "scenes"), [
    # Up to full speed, down, and up again before the pump stands, for any ticks.
    *((tau, [(60, 1.0, None), (20, 0.0, None), (60, 1.0, None), (80, 0.0, None)])
      for tau in (10.0, 0.1)),
    # It does not receive the stop; its own timeout acts 15 s later; then a ramp of 30 s.
    (1.0, [(60, 1.0, None), (15, 1.0, 1.0), (40, 0.0, None)]),
])
def test_a_ramp_of_30_s_is_no_fault(
    tau: float, scenes: list[tuple[float, float, float | None]]
) -> None:
    """Scenes: seconds, command, and the speed at which the drive stays while it is silent."""
    rig = Rig(drive_ramp=1 / 30, tau=tau)
    for seconds, command, stuck in scenes:
        rig.stuck_speed, rig.change = stuck, dict(SILENT) if stuck else {}
        rig.run(seconds, command)
    assert max(decision.request or 0.0 for decision in rig.decisions) == pytest.approx(1.0)
    assert not [decision for decision in rig.decisions if decision.state == "fault"]
    assert rig.decisions[-1].at_rest


@pytest.mark.parametrize("follow_time", [5.0, 60.0])
def test_a_flow_while_the_pump_stands_is_a_contact_that_is_welded(follow_time: float) -> None:
    """More than a fifth of the maximum flow (min_flow) for more than 12 s, whatever follow_time is.

    Then the drive's report of rest is wrong. What the meter shows counts as pumped, but for its
    first second: 11 of 12 s, and 12 of 13 s.
    """
    rig = Rig(x1=70.0, settings=settings_for(PAPER_SITE, follow_time=follow_time))
    minimum = 0.2 * maximum_pump_flow(PAPER_SITE, 70.0)
    for share, seconds in ((0.95, 60), (1.05, 12), (0.0, 1), (1.05, 13)):
        assert rig.decisions[-1:] == [] or rig.decisions[-1].state == "off"
        rig.change = {"flow": share * minimum}
        decision = rig.run(seconds, 0.0)
    assert (decision.state, [*decision.active]) == ("fault", ["runs_on"])
    assert not decision.at_rest
    assert rig.state_file.state.day_volume == pytest.approx(1.05 * minimum * 23)


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
