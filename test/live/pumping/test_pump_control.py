"""The pump's control: states in words, commands, speeds, flows, faults, a manual stop."""

from __future__ import annotations

import itertools
import math

import pytest
from paper import PAPER_SITE
from pump_rig import Rig, settings_for

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.pump_control import Decision
from greenroof_ros.physics.pump import maximum_pump_flow


def warning(decision: Decision) -> str:
    return "; ".join(each.sentence for each in decision.warnings)


def test_states_of_a_run_by_hand() -> None:
    """Half the flow from 2.8 m: s^2 = (0.25 42 + 13.2) / 55.2 = 0.655249^2; a fifth first.

    The first speed is sqrt((0.04 42 + 13.2) / 55.2) = 0.519197, which the drive reaches in three
    seconds. Then it makes up, within a minute, for the minimum pulse that was missed, a fifth for
    10 s: 0.5 + 2 / 60 of the flow is a speed of sqrt((0.284444 42 + 13.2) / 55.2) = 0.674949.
    """
    rig = Rig(x1=70.0)
    rig.run(14, 0.5)
    states = [decision.state for decision in rig.decisions]
    assert states == ["off"] * 10 + ["starting"] * 3 + ["running"]
    first, second = (decision.speed for decision in rig.decisions[10:12])
    assert (first, second) == pytest.approx((0.519197, 0.674949), abs=5e-7)
    assert rig.decisions[13].why == "as commanded"
    rig.run(240, 0.5)
    # The volume missed during the start is made up for.
    assert rig.decisions[-1].speed == pytest.approx(0.6552, abs=0.01)
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
    on = [decision.speed is not None for decision in rig.decisions]
    assert [k for k in range(1, len(on)) if on[k] != on[k - 1]] == [10, 20, 54, 64, 87]
    assert rig.decisions[5].why == "it may start in 5 s: it must stay off for at least 10 s"
    assert rig.decisions[13].why == "it must stay on for at least 10 s"


def test_a_command_above_1() -> None:
    """A command above 1 acts as 1 with a warning; the speed never exceeds the rated one."""
    rig = Rig(x2=0.0)
    decision, before = rig.run(30, 1e300), rig.delivered
    assert (warning(decision), decision.speed) == (
        "the command 1e+300 is above 1, and is treated as 1", 1
    )
    rig.run(30, 1e300)
    assert rig.delivered - before <= 30 * maximum_pump_flow(PAPER_SITE, 70.0)


def test_what_was_missed_is_not_caught_up() -> None:
    """After minutes without contact to the drive, the next pulse is as far away as before."""
    rig = Rig()
    rig.run(15, 0.5)
    rig.change = {"reasons": [Diagnosis("drive_lost", "no answer from 10.0.0.7:502")]}
    decision = rig.step(0.5)
    assert (decision.speed, decision.why) == (None, "no answer from 10.0.0.7:502")
    rig.run(600, 0.01)
    rig.change = {}
    # A fifth of the flow for 10 s is 200 s of a hundredth; 30 s have passed, and a pulse lasts 10.
    assert rig.run(30, 0.01).why == "the next pulse is due in 2.7 min"
    assert rig.run(5, 0.5).state in ("starting", "running")


def test_what_is_unknown_is_reported_so() -> None:
    """A drive that is lost while it runs: neither speed nor flow, until it is sure to stand.

    It stands if seen stopped or silent for the 15 s of its timeout; an invalid answer is no
    silence.
    """
    rig = Rig()
    decision = rig.step(0.0)
    assert (decision.at_rest, decision.delivery_checked) == (True, False)
    decision = rig.run(15, 0.5)
    assert not decision.at_rest and decision.flow
    assert decision.reported_speed is not None and decision.reported_speed > 0.5
    rig.change = {"speed": None, "reasons": [Diagnosis("drive_lost", "connection lost")]}
    rig.run(14, 0.5)
    assert {
        (decision.state, decision.flow, decision.reported_speed, decision.at_rest)
        for decision in rig.decisions[-14:]
    } == {("unknown", None, None, False)}
    assert rig.decisions[-1].why.endswith("; it is unknown whether the pump has stopped")
    decision = rig.run(3, 0.5)
    assert (decision.at_rest, decision.why) == (True, "connection lost")
    rig.change = {"speed": 5.0}
    assert not rig.run(60, 0.5).at_rest
    rig.change = {"speed": -0.5}  # the pump is known to turn
    decision = rig.step(0.5)
    assert (decision.at_rest, decision.reported_speed, decision.flow) == (False, -0.5, None)
    rig.change = {}
    rig.reset()
    decision = rig.run(60, 0.0)
    assert (decision.state, decision.at_rest, decision.delivery_checked) == ("off", True, True)
    rig.change = {"speed": None, "roof_level": None}
    decision = rig.step(0.5)  # the pump stood at last contact
    assert (decision.at_rest, decision.reported_speed, decision.flow) == (True, None, 0)
    assert not decision.delivery_checked


@pytest.mark.parametrize(
    ("stuck", "command", "why"),
    [
        (0.0, 0.5, "for 13 s, the pump has been turning at 0.00 of its rated speed although 0.6"),
        (1.0, 0.5, "for 13 s, the pump has been turning at 1.00 of its rated speed although 0.6"),
        (0.5, 0.0, "for 13 s, the pump has been turning at 0.50 of its rated speed although it"),
    ],
)
def test_a_speed_that_does_not_follow(stuck: float, command: float, why: str) -> None:
    """Over a tenth off for more than 12 s latches, after a tenth of the 30 s ramp.

    The ramp counts from the pump's present speed: near the requested speed it is no excuse.
    """
    rig = Rig()
    rig.run(15, command)
    rig.stuck_speed = stuck
    begun = rig.now
    decision = rig.run(60, command, until=lambda decision: decision.state == "fault")
    assert decision.state == "fault"
    assert decision.speed is None
    assert decision.why.startswith(f"the speed does not follow the command: {why}")
    assert 12 <= rig.now - begun <= 17
    rig.stuck_speed = None
    assert rig.run(100, command).state == "fault"


LOST = {"speed": None, "reasons": [Diagnosis("drive_lost", "no connection")]}


@pytest.mark.parametrize(
    ("ramp", "tau", "scenes"),
    [
        # Up to full speed, down, and up again before the pump stands, for any ticks.
        *((ramp, tau, [(60, 1.0, None), (20, 0.0, None), (60, 1.0, None), (80, 0.0, None)])
          for ramp, tau in ((10.0, 1.0), (30.0, 10.0))),
        # The minimum time off of 10 s, then 8 s in which the drive gets ready.
        (30.0, 1.0, [(18, 1.0, 0.0), (50, 1.0, None), (60, 0.0, None)]),
        # It does not receive the stop; its own timeout acts 15 s later; then a ramp of 30 s.
        (30.0, 1.0, [(60, 1.0, None), (15, 1.0, 1.0), (40, 0.0, None)]),
    ],
)
def test_a_ramp_that_is_allowed_is_no_fault(
    ramp: float, tau: float, scenes: list[tuple[float, float, float | None]]
) -> None:
    """Scenes: seconds, command, and the speed at which the drive stays, silent if above 0."""
    rig = Rig(drive_ramp=1 / ramp, tau=tau)
    for seconds, command, stuck in scenes:
        rig.stuck_speed, rig.change = stuck, dict(LOST) if stuck else {}
        rig.run(seconds, command)
    assert max(decision.speed or 0.0 for decision in rig.decisions) == pytest.approx(1.0)
    assert not [decision for decision in rig.decisions if decision.state == "fault"]
    assert rig.decisions[-1].at_rest


@pytest.mark.parametrize(("runs_after", "states"), [(9, {"off", "fault"}), (2, {"off"})])
def test_a_failed_start_is_a_start_and_the_third_in_a_row_a_fault(
    runs_after: int, states: set[str]
) -> None:
    """Each start is given up after 2 s, and the next one waits for the minimum time off."""
    rig = Rig(settings=settings_for(PAPER_SITE, min_off=60.0))
    failed = "the drive failed to start: it has no voltage"
    begun, on_for = [], 0
    rig.stuck_speed = 0.0
    for _ in range(1200):
        gives_up = on_for == 2 and len(begun) % (runs_after + 1) != 0
        rig.stuck_speed = 0.0 if len(begun) % (runs_after + 1) else None
        rig.change = {"reasons": [Diagnosis("start_failed", failed)]} if gives_up else {}
        decision = rig.step(0.5 if on_for < 30 else 0.0)
        if decision.speed is not None and on_for == 0:
            begun.append(rig.now)
        on_for = on_for + 1 if decision.speed is not None else 0
        if decision.state == "fault":
            break
    assert all(next_start - start >= 60 for start, next_start in itertools.pairwise(begun))
    assert {decision.state for decision in rig.decisions if decision.interlocks} == states
    if "fault" in states:
        assert decision.why.startswith(f"the pump was started 3 times, and each time {failed}")
        assert list(decision.interlocks) == ["speed_not_followed", "start_failed"]
        assert len(begun) == 3
        rig.reset()
        rig.change = {}
        assert rig.run(70, 0.5, until=lambda decision: decision.speed is not None).speed
    else:
        assert len(begun) > 6


def test_a_ramp_that_is_slower_than_it_is_reported_to_be_is_a_fault() -> None:
    """30 s instead of the 5 s in drive_ramp: a tenth off after 0.6 s, and 12 s more are allowed."""
    rig = Rig(drive_ramp=1 / 30, settings=settings_for(PAPER_SITE, drive_ramp=5.0))
    assert rig.run(40, 1.0).state == "fault"
    assert "is requested, and a ramp of 5 s does not explain" in rig.decisions[-1].why


def test_a_drive_that_does_not_stop_behind_a_bad_line() -> None:
    """Its speed is unknown for 1 s of every 3 s; it must be known for 15 s, 3 s for its ramp."""
    rig = Rig()
    rig.run(30, 0.8)
    rig.stuck_speed = 0.8
    for second in range(200):
        rig.change = {} if second % 3 else dict(LOST)
        if rig.step(0.0).state == "fault":
            break
    assert second <= 36
    assert rig.decisions[-1].why.startswith("the speed does not follow")


@pytest.mark.parametrize(
    ("change", "flow", "source"),
    [
        ({"flow": 0.003, "drive_flow": 0.004}, 0.003, "flow meter"),
        ({"flow": None, "drive_flow": -1.0, "speed": 0.8}, 0.00609864,
         "computed from the speed"),
        ({"speed": None}, None, "unknown, assumed 0"),
        ({"speed": 0.0, "flow": 0.003}, 0.003, "flow meter"),
        # A meter that gives litres.
        ({"flow": 5.7, "drive_flow": 0.004}, 0.004, "the drive's own"),
    ],
)
def test_flow_and_how_it_is_known(
    change: dict[str, object], flow: float | None, source: str
) -> None:
    """At 80 % of the speed from 2.8 m: b sqrt(0.64 55.2 - 13.2) = 1.29646769e-3 sqrt(22.128)."""
    rig = Rig(x1=70.0)
    rig.run(15, 0.5)
    rig.x1 = 70.0
    rig.change = change
    decision = rig.step(0.5)
    assert decision.flow == pytest.approx(flow, abs=5e-9)
    assert decision.source == source
    assert warning(decision) == (
        "flow meter: a flow of 5.7 m3/s is implausible: the pump delivers at most 0.0084 m3/s"
        if change.get("flow") == 5.7 else ""
    )


def test_no_flow_once_the_pump_stands() -> None:
    """Even if the meter has an offset; while the pump comes to rest, the meter counts.

    A speed below zero is noise, as of a drive's 16 bits; beyond that it turns backwards.
    """
    rig = Rig()
    rig.speed = 0.8  # it already runs, as after a crash of its node
    decision = rig.step(1.0)
    assert (decision.speed, decision.state) == (None, "stopping")
    assert decision.flow > 0
    rig.run(15, 0.5)
    rig.change = {"flow": 1e-4}
    rig.run(8, None)
    assert [decision.flow for decision in rig.decisions[-8:]] == [1e-4] * 4 + [0.0] * 4
    rig.change = {"speed": -0.019}
    assert rig.run(9, 0.0).source == "the pump is stopped"
    rig.change = {}
    assert rig.run(15, 1.0).state in ("starting", "running")
    rig.change = {"speed": -0.021}
    assert rig.step(1.0).why == "the pump is turning backwards at 0.02 of its rated speed"


@pytest.mark.parametrize("meter", ["flow", "drive_flow"])
@pytest.mark.parametrize("follow_time", [5.0, 12.0, 60.0])
def test_a_flow_while_the_pump_stands_is_a_contact_that_is_welded(
    meter: str, follow_time: float
) -> None:
    """More than a fifth of the maximum flow (min_flow) for more than 12 s, whatever follow_time is.

    Then the drive's report of rest is wrong. What the meter shows counts as pumped, but for its
    first second: 11 of 12 s, and 12 of 13 s.
    """
    rig = Rig(x1=70.0, settings=settings_for(PAPER_SITE, follow_time=follow_time))
    minimum = 0.2 * maximum_pump_flow(PAPER_SITE, 70.0)
    rig.change = {meter: 0.95 * minimum}
    assert rig.run(60, 0.0).state == "off"
    rig.change = {meter: 1.05 * minimum}
    assert rig.run(12, 0.0).state == "off"
    rig.change = {}
    assert rig.run(1, 0.0).state == "off"
    rig.change = {meter: 1.05 * minimum}
    decision = rig.run(13, 0.0)
    assert (decision.state, [*decision.interlocks]) == ("fault", ["runs_on"])
    assert "perhaps a contact is welded" in decision.why
    assert (decision.at_rest, decision.flows_at_rest) == (False, True)
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
    assert not rig.run(12, 1.0).interlocks
    assert list(rig.run(2, 1.0).interlocks) == ["speed_not_followed"]
    assert list(rig.run(10, 1.0).interlocks) == ["speed_not_followed"]
    assert next(iter(rig.run(4, 1.0).interlocks)) == "runs_on"


@pytest.mark.parametrize(("seconds", "counted"), [(5.0, 5.0), (3600.0, 15.0)])
def test_what_may_be_pumped_in_a_suspend_counts_at_worst(seconds: float, counted: float) -> None:
    """As from a full cistern, until the drive must have stopped: 15 s; then it is seen again."""
    rig = Rig(x1=70.0, settings=settings_for(PAPER_SITE, max_run=3600.0))
    rig.run(60, 0.5)
    before, volume = rig.state_file.state, rig.x1
    rig.x1 = rig.site.a1 * rig.site.z_o
    most = counted * rig.plant_flow(rig.speed)
    rig.x1 = volume
    rig.suspend(seconds, runs_on=10.0)
    after = rig.state_file.state
    assert after.elapsed - before.elapsed == seconds
    assert after.day_run - before.day_run == counted
    assert after.day_volume - before.day_volume == pytest.approx(most, rel=1e-3)
    assert not after.on
    rig.change = LOST
    assert not rig.step(0.5).at_rest
    rig.change = {}
    rig.run(60, 0.0)
    assert rig.decisions[-1].why == "the command is 0"
    # A pump that stands cannot have run.
    before = rig.state_file.state
    rig.suspend(3600.0)
    after = rig.state_file.state
    assert (after.day_run, after.day_volume) == (before.day_run, before.day_volume)
    assert rig.run(15, 0.5).state in ("starting", "running")


def test_what_may_be_pumped_in_a_suspend_is_part_of_a_run() -> None:
    """On for 49 s, then suspended for 15 s: over a minute without a break."""
    rig = Rig(x2=0.0, settings=settings_for(PAPER_SITE, max_run=60.0))
    assert rig.run(60, 1.0).state == "running"
    rig.suspend(15.0, runs_on=15.0)
    assert "max_run" in rig.step(1.0).interlocks


def test_what_is_not_responding_counts_at_worst() -> None:
    """Run time and volume count until the drive must have stopped: 15 s, not the minute after.

    Nothing counts if the pump stood and was not asked to run.

    From 2.8 m the pump delivers b sqrt(2.8 + 55.2 - 13) = 1.29646769e-3 6.708204 m3/s at most.
    """
    flow = 1.29646769e-3 * math.sqrt(2.8 + 55.2 - 13.0)
    rig = Rig(x1=70.0)
    no_drive = LOST | {"cistern_level": 2.8}
    rig.step(0.0)
    rig.change = no_drive
    rig.run(60, 1.0)
    assert (rig.state_file.state.day_run, rig.state_file.state.day_volume) == (0, 0)
    rig.change = {}
    rig.run(60, 1.0)
    before = rig.state_file.state
    rig.change = no_drive
    rig.run(75, 1.0)
    after = rig.state_file.state
    assert after.day_run - before.day_run == pytest.approx(15, abs=1)
    assert after.day_volume - before.day_volume == pytest.approx(15 * flow, rel=0.08)
    assert {decision.flow for decision in rig.decisions[-75:]} == {None, 0.0}
    rig.change = {}
    rig.run(60, 0.0)
    assert "fault" not in {decision.state for decision in rig.decisions}
