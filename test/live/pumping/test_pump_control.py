"""The pump's control: states in words, commands, speeds, flows, faults, a manual stop."""

from __future__ import annotations

import math

import pytest
from paper import PAPER_SITE
from pump_rig import LOST, Rig, settings_for

from greenroof_ros.physics.pump import maximum_pump_flow

SILENT = {"speed": None, "reasons": [LOST]}


def test_states_of_a_run_by_hand() -> None:
    """Half the flow from 2.8 m: s^2 = (0.25 42 + 13.2) / 55.2 = 0.65525^2, in four seconds."""
    rig = Rig(x1=70.0)
    rig.run(14, 0.5)
    states = [decision.state for decision in rig.decisions]
    assert states == ["off"] * 10 + ["starting"] * 3 + ["running"]
    assert rig.decisions[10].request == pytest.approx(0.65525, abs=5e-6)
    assert rig.decisions[13].why == "as commanded"
    rig.run(240, 0.5)
    assert rig.decisions[-1].request == pytest.approx(0.6552, abs=0.01)
    rig.run(7, 0.0)
    assert [decision.state for decision in rig.decisions[-7:]] == ["stopping"] * 4 + ["off"] * 3
    assert rig.decisions[-1].why == "the command is 0"
    rig = Rig(x2=PAPER_SITE.x2_star)
    assert rig.run(300, 1.0).why == "the roof is at its target"
    assert rig.delivered == 0


def test_minimum_times() -> None:
    """10 s off before the first start, at least 10 s on, at least 10 s off."""
    rig = Rig()
    for seconds, command in ((11, 1.0), (43, 0.0), (3, 1.0), (30, 0.0), (15, 1.0)):
        rig.run(seconds, command)
    on = [decision.request is not None for decision in rig.decisions]
    assert [k for k in range(1, len(on)) if on[k] != on[k - 1]] == [10, 20, 54, 64, 87]
    assert rig.decisions[5].why == "it may start in 5 s: it must stay off for at least 10 s"
    assert rig.decisions[13].why == "it must stay on for at least 10 s"


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
    assert rig.decisions[-1].why == "no connection; it is unknown whether the pump has stopped"
    decision = rig.run(60, 1.0)
    assert (decision.at_rest, decision.why, decision.flow) == (True, "no connection", 0)
    most = 15 * 1.29646769e-3 * 6.708204
    assert rig.state_file.state.day_volume - before == pytest.approx(most, rel=0.08)
    rig.change = {}
    assert rig.run(60, 0.0).why == "the command is 0"


@pytest.mark.parametrize(
    ("stuck", "command", "why"),
    [
        (0.0, 0.5, "for 13 s, the pump has been turning at 0.00 of its rated speed although 0.6"),
        (1.0, 0.5, "for 13 s, the pump has been turning at 1.00 of its rated speed although 0.6"),
        (0.5, 0.0, "for 13 s, the pump has been turning at 0.50 of its rated speed although it"),
    ],
)
def test_a_speed_that_does_not_follow(stuck: float, command: float, why: str) -> None:
    """Over a tenth off for more than 12 s latches, if it comes no nearer."""
    rig = Rig()
    rig.run(15, command)
    rig.stuck_speed = stuck
    begun = rig.now
    decision = rig.run(60, command, until=lambda decision: decision.state == "fault")
    assert decision.state == "fault"
    assert decision.request is None
    assert decision.why.startswith(f"the speed does not follow the command: {why}")
    assert 12 <= rig.now - begun <= 17
    rig.stuck_speed = None
    assert rig.run(100, command).state == "fault"


@pytest.mark.parametrize(
    ("ramp", "tau", "scenes"),
    [
        # Up to full speed, down, and up again before the pump stands, for any ticks.
        *((ramp, tau, [(60, 1.0, None), (20, 0.0, None), (60, 1.0, None), (80, 0.0, None)])
          for ramp, tau in ((10.0, 1.0), (30.0, 10.0), (30.0, 0.1))),
        # The minimum time off of 10 s, then 8 s in which the drive gets ready.
        (30.0, 1.0, [(18, 1.0, 0.0), (50, 1.0, None), (60, 0.0, None)]),
        # It does not receive the stop; its own timeout acts 15 s later; then a ramp of 30 s.
        (30.0, 1.0, [(60, 1.0, None), (15, 1.0, 1.0), (40, 0.0, None)]),
    ],
)
def test_a_ramp_is_no_fault(
    ramp: float, tau: float, scenes: list[tuple[float, float, float | None]]
) -> None:
    """Scenes: seconds, command, and the speed at which the drive stays, silent if above 0."""
    rig = Rig(drive_ramp=1 / ramp, tau=tau)
    for seconds, command, stuck in scenes:
        rig.stuck_speed, rig.change = stuck, dict(SILENT) if stuck else {}
        rig.run(seconds, command)
    assert max(decision.request or 0.0 for decision in rig.decisions) == pytest.approx(1.0)
    assert not [decision for decision in rig.decisions if decision.state == "fault"]
    assert rig.decisions[-1].at_rest


def test_a_drive_that_does_not_stop_behind_a_bad_line() -> None:
    """Its speed is unknown for 1 s of every 3 s; it must be known for 12 s."""
    rig = Rig()
    rig.run(30, 0.8)
    rig.stuck_speed = 0.8
    for second in range(200):
        rig.change = {} if second % 3 else dict(SILENT)
        if rig.step(0.0).state == "fault":
            break
    assert second <= 36
    assert rig.decisions[-1].why.startswith("the speed does not follow")


@pytest.mark.parametrize(("change", "flow"), [
    ({"flow": 0.003}, 0.003),
    ({"flow": None, "speed": 0.8}, 0.00609864),
    ({"speed": None}, None),
    ({"speed": 0.0, "flow": 0.003}, 0.003),
    ({"flow": 5.7, "speed": 0.8}, 0.00609864),  # a meter that gives litres
    ({"speed": -0.4}, 0.0),
])
def test_flow_is_measured_or_computed(change: dict[str, object], flow: float | None) -> None:
    """At 80 % of the speed from 2.8 m: b sqrt(0.64 55.2 - 13.2) = 1.29646769e-3 sqrt(22.128)."""
    rig = Rig(x1=70.0)
    rig.run(15, 0.5)
    rig.x1 = 70.0
    rig.change = change
    assert rig.step(0.5).flow == pytest.approx(flow, abs=5e-9)


@pytest.mark.parametrize("follow_time", [5.0, 60.0])
def test_a_flow_while_the_pump_stands_is_a_contact_that_is_welded(follow_time: float) -> None:
    """More than a fifth of the maximum flow (min_flow) for more than 12 s, whatever follow_time is.

    Then the drive's report of rest is wrong. What the meter shows counts as pumped, but for its
    first second: 11 of 12 s, and 12 of 13 s.
    """
    rig = Rig(x1=70.0, settings=settings_for(PAPER_SITE, follow_time=follow_time))
    minimum = 0.2 * maximum_pump_flow(PAPER_SITE, 70.0)
    rig.change = {"flow": 0.95 * minimum}
    assert rig.run(60, 0.0).state == "off"
    rig.change = {"flow": 1.05 * minimum}
    assert rig.run(12, 0.0).state == "off"
    rig.change = {}
    assert rig.run(1, 0.0).state == "off"
    rig.change = {"flow": 1.05 * minimum}
    decision = rig.run(13, 0.0)
    assert (decision.state, [*decision.active]) == ("fault", ["runs_on"])
    assert "perhaps a contact is welded" in decision.why
    assert not decision.at_rest
    assert rig.state_file.state.day_volume == pytest.approx(1.05 * minimum * 23)
    rig.change = {}
    assert rig.run(60, 1.0).state == "fault"
    rig.reset()
    assert rig.run(30, 1.0).state == "running"


def test_a_wrong_speed_is_no_pump_that_runs_on_until_it_had_time_to_stop() -> None:
    """A speed read as 2: not followed after 12 s; only if it stays for 12 s more, it runs on."""
    rig = Rig(x1=70.0, settings=settings_for(PAPER_SITE, follow_time=12.0))
    assert rig.run(60, 1.0).state == "running"
    rig.change = {"speed": 2.0}
    assert not rig.run(12, 1.0).active
    assert list(rig.run(2, 1.0).active) == ["speed_not_followed"]
    assert list(rig.run(10, 1.0).active) == ["speed_not_followed"]
    assert next(iter(rig.run(4, 1.0).active)) == "runs_on"


@pytest.mark.parametrize(("seconds", "counted"), [(5.0, 5.0), (3600.0, 15.0)])
def test_what_may_be_pumped_in_a_suspend_counts_at_worst(seconds: float, counted: float) -> None:
    """As from a full cistern, until the drive must have stopped: 15 s; then it is seen again."""
    rig = Rig(x1=70.0)
    rig.run(60, 0.5)
    before, speed = rig.state_file.state, rig.speed
    head = rig.site.z_o + speed**2 * rig.site.c_hat - rig.site.d
    rig.suspend(seconds, runs_on=10.0)
    after = rig.state_file.state
    assert after.elapsed - before.elapsed == seconds
    assert after.day_volume - before.day_volume == pytest.approx(
        counted * rig.site.b * math.sqrt(head), rel=1e-3
    )
    assert not after.on
    rig.run(60, 0.0)
    assert rig.decisions[-1].why == "the command is 0"
    # A pump that stands cannot have run.
    before = rig.state_file.state
    rig.suspend(3600.0)
    assert rig.state_file.state.day_volume == before.day_volume
    assert rig.run(15, 0.5).state in ("starting", "running")
