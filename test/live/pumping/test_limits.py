"""Times, starts, daily use, water and frost by hand; pulses by hand, and over long commands."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import LOST, NOT_READY, OVERLOAD, Rig, settings_for

from greenroof_ros.live.pumping.limits import Pulses, PumpLimits, PumpSettings
from greenroof_ros.live.pumping.state_file import StateFile
from greenroof_ros.physics.pump import maximum_pump_flow, pump_flow

# A fifth of the maximum flow at 3 m, 0.00842205 m3/s, for 10 s.
MIN_PULSE = 0.0168441


def test_defaults_by_hand() -> None:
    """An empty roof takes 3.14416 m3, and 10 mm on 68.8 m2 are 0.688 m3: times 1.5, 5.748 m3.

    At the suction level the maximum flow is b sqrt(0.75 + 55.2 - 16) = 0.00819436 m3/s; a fifth of
    it delivers 3.14416 m3 in 1918 s.
    """
    settings = settings_for(PAPER_SITE)
    assert settings.max_volume_per_day == pytest.approx(5.748, abs=5e-4)
    assert settings.max_run == pytest.approx(1918, abs=1)
    assert settings.starts_per_hour == PAPER_SITE.starts_per_hour


@pytest.mark.parametrize(("min_speed", "expected"), [(0.3, 0.1), (0.2, 0.1), (0.05, 0.025)])
def test_the_minimum_speed_is_never_within_the_tolerance_of_rest(
    min_speed: float, expected: float
) -> None:
    assert settings_for(PAPER_SITE, min_speed=min_speed).follow_tolerance == expected


@settings(max_examples=30)
@given(times=st.lists(st.integers(1, 2000), min_size=1, max_size=200), allowed=st.integers(1, 50))
def test_as_many_starts_in_any_hour_as_are_allowed(times: list[int], allowed: int) -> None:
    """With starts wanted at any times: never more, and no start waits longer than necessary."""
    state_file = StateFile(None)
    settings = settings_for(PAPER_SITE, starts_per_hour=allowed, min_off=0.0)
    limits = PumpLimits(PAPER_SITE, settings, state_file)
    starts: list[float] = []
    for passed in times:
        state_file.count(passed, 0.0)
        wait, why = limits.wait()
        assert why == (f"it may start at most {allowed} times an hour" if wait else "")
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
    rig.run(20, 1.0)
    assert rig.decisions[-1].state == "running"
    rig.x1 = 19.24
    decision = rig.step(1.0)
    assert (decision.request, decision.state) == (None, "held")
    assert decision.why.startswith("the cistern's level is 0.770 m, but must be above 0.77 m")
    rig.x1 = 19.7
    rig.run(60, 1.0)
    assert rig.decisions[-1].why == "the cistern's level is 0.788 m, but must be above 0.79 m"
    rig.x1 = 19.8
    assert rig.run(60, 1.0).state == "running"
    rig.change = {"cistern_level": 0.77}
    assert rig.step(1.0).why.startswith("the cistern's level is 0.770 m, but must be above 0.77 m")


def test_volume_per_day() -> None:
    """Frozen controller and frozen roof sensor: 1 m3, and again when that slot is a day old."""
    limits = settings_for(PAPER_SITE, max_volume_per_day=1.0)
    rig = Rig(x2=0.0, settings=limits)
    rig.run(600, 1.0)
    assert rig.decisions[-1].state == "held"
    assert "the limit is 1 m3, and the pump may run again in 24.3 h" in rig.decisions[-1].why
    # Beyond it: a step at maximum flow, and what flows while the pump comes to rest.
    assert 1.0 <= rig.delivered <= 1.03
    rig.state_file.count(1800 + 86_400 - 600 - 10, 0.0)
    assert rig.run(8, 1.0).state == "held"
    assert rig.run(4, 1.0).request is not None


def test_a_run_without_a_break() -> None:
    """100 s without a break, then 100 s of rest, whatever is commanded meanwhile."""
    rig = Rig(x2=0.0, settings=settings_for(PAPER_SITE, max_run=99.5))
    rig.run(200, 0.3, until=lambda decision: decision.state == "held")
    assert rig.decisions[-1].why.startswith(
        "the pump has run for 1.7 min without a break, and now rests for 1.7 min"
    )
    begun = rig.now
    rig.run(20, 0.0)
    rig.run(200, 0.3, until=lambda decision: decision.request is not None)
    assert 95 <= rig.now - begun <= 110


CHANGES: list[dict[str, object]] = [
    {}, {"frost": 1.0}, {"frost": None}, {"cistern_level": None}, {"roof_level": None},
    {"reasons": [NOT_READY]}, {"speed": None}, {"reasons": [LOST]}, {"reasons": [OVERLOAD]},
]


@settings(max_examples=40)
@given(
    scenes=st.lists(
        st.tuples(
            st.sampled_from([*CHANGES, {}, {}, {}]),
            st.one_of(st.none(), st.floats(0, 1), st.floats(0, 0.3), st.floats(0, 1e300)),
            st.integers(1, 60),
        ),
        min_size=1, max_size=12,
    ),
    x1=st.floats(18.5, 75),
    limits=st.builds(
        settings_for, st.just(PAPER_SITE), min_on=st.floats(0, 30), min_off=st.floats(0, 30),
        starts_per_hour=st.floats(1, 100), min_speed=st.floats(0.11, 0.9),
    ),
)
def test_never_runs_while_anything_speaks_against_it(
    scenes: list[tuple[dict[str, object], float | None, int]], x1: float, limits: PumpSettings
) -> None:
    """After any history; nor above the rated speed, nor after a fault, nor too soon again."""
    rig = Rig(x1=x1, settings=limits)
    fault, off_for = False, 0
    for change, command, seconds in scenes:
        rig.change = change
        for _ in range(seconds):
            against = bool(change) or rig.levels()[0] <= 0.77 or command is None
            decision = rig.step(command)
            fault = fault or change.get("reasons") == [OVERLOAD]
            if against or fault:
                assert decision.request is None
                assert decision.state in ("off", "stopping", "held", "fault", "unknown")
            if fault:
                assert decision.state == "fault"
            if decision.request is not None:
                assert limits.min_speed <= decision.request <= 1
                assert not off_for or off_for >= limits.min_off
            off_for = off_for + 1 if decision.request is None else 0
            assert 0 <= (decision.flow or 0.0) < 0.03
            assert decision.why


# --- pulses ---------------------------------------------------------------------------------------


def pulses(**changes: float) -> Pulses:
    """Return pulses for the paper's site."""
    return Pulses(PAPER_SITE, settings_for(PAPER_SITE, **changes))


@pytest.mark.parametrize(("command", "due"), [
    # A minimum pulse is 0.2 10 s = 2 s of the maximum flow, outstanding after 182 s with 2.002.
    # Each second of it takes 0.189: after 11 s -0.077 are outstanding, and 189 s later 2.002.
    (0.011, [182, 193, 382, 393]),
    # 20 starts an hour are one every 180 s, in which 0.1 demands 18 s: each second takes 0.1.
    (0.1, [180, 360, 540]),
])
def test_pulses_by_hand(command: float, due: list[int]) -> None:
    pulse, on, changed = pulses(), False, []
    for second in range(545):
        share = pulse.update(command, 3.0, on)
        if (share > 0) != on:
            changed.append(second)
        on = share > 0
        pulse.count(share * maximum_pump_flow(PAPER_SITE, 75.0), 1.0)
    assert changed == pytest.approx(due, abs=3)


@pytest.mark.parametrize("drive_ramp", [0.1, 1.0])
def test_volume_within_a_minimum_pulse(drive_ramp: float) -> None:
    """Below 0.0112 of the flow 20 starts an hour are enough: 3600 s x 0.0112 = 20 x 2 s.

    The pump comes to rest from half its speed in at most 5 s, but soon delivers nothing. A pulse
    of 10 s, and its ramp, pass before all of it is delivered.
    """
    rig, commanded = Rig(drive_ramp=drive_ramp), 0.0
    for command, seconds in ((0.0105, 1500), (1e-4, 700), (0.004, 1500), (0.0105, 100)):
        for _ in range(seconds):
            rig.step(command)
            # What is commanded in this tick is delivered in the next.
            assert -0.15 * MIN_PULSE <= commanded - rig.delivered <= 1.25 * MIN_PULSE
            commanded += rig.tau * pump_flow(rig.plant, rig.x1, rig.x2, command)
    assert max(decision.flow or 0.0 for decision in rig.decisions) <= maximum_pump_flow(
        rig.site, 75.0
    )
