"""Commands below the least flow: pulses by hand, and volumes over long random commands."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, paper_run
from pump_rig import Rig

from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import maximum_pump_flow, pump_flow
from greenroof_ros.pumping.pulses import Pulses
from greenroof_ros.pumping.settings import settings_for

# A fifth of the maximum flow at 3 m, 0.00842205 m3/s, for 10 s.
LEAST_PULSE = 0.0168441


def pulses(**given: float) -> Pulses:
    """Return pulses of the paper's site."""
    return Pulses(PAPER_SITE, settings_for(PAPER_SITE, **given))


def test_least_pulse_by_hand() -> None:
    """10 s at a fifth of 0.00842205 m3/s."""
    assert pulses().least_share(3.0) == 0.2
    assert pulses().least_pulse(3.0) == pytest.approx(LEAST_PULSE, rel=1e-5)


def test_least_speed_above_the_least_flow() -> None:
    """At 80 % of the speed the flow is sqrt((0.64 55.2 - 13) / 42.2) = 0.727392 of the maximum."""
    assert pulses(least_speed=0.8).least_share(3.0) == pytest.approx(0.727392, abs=5e-7)
    assert pulses(least_speed=0.8).speed(0.2, 3.0) == 0.8


def test_pulses_by_hand() -> None:
    """A command of 0.013, in seconds of the maximum flow: a least pulse is 0.2 10 s = 2 s.

    It begins with 2 - 10 0.013 = 1.87 s owed: after 144 s with 1.872. A second of it takes 0.187:
    after 10 there are 0.002 owed, after 11 there are -0.185, and 159 later, again, 1.882.
    """
    one = pulses()
    on, began, ended = False, [], []
    for second in range(400):
        share = one.ask(0.013, 3.0, on, 1e9)
        if (share > 0) != on:
            (began if share else ended).append(second)
        on = share > 0
        one.account(share * maximum_pump_flow(PAPER_SITE, 75.0), 1.0)
    assert began == [144, 144 + 11 + 159]
    assert ended == [144 + 11, 144 + 11 + 159 + 11]


def test_no_pulse_without_a_command() -> None:
    """What is owed waits for the next command above 0, and it is a least pulse at most."""
    one = pulses()
    for _ in range(100):
        assert one.ask(0.1, 3.0, False, 0.0) == 0
        one.account(0.0, 1.0)
    assert one.owed == pytest.approx(100 * 0.1 * 0.00842205, rel=1e-5)
    assert one.ask(0.0, 3.0, False, 1e9) == 0
    assert one.owed == pytest.approx(LEAST_PULSE, rel=1e-5)


def test_what_is_owed_is_limited() -> None:
    """To 180 s of a fifth of the flow, 0.303194 m3, below it; to a least pulse above it."""
    one = pulses()
    one.ask(0.19, 3.0, False, 0.0)
    one.account(0.0, 3600.0)
    assert one.owed == pytest.approx(180 * 0.2 * 0.00842205, rel=1e-5)
    one.ask(0.5, 3.0, True, 0.0)
    assert one.owed == pytest.approx(LEAST_PULSE, rel=1e-5)
    one.drop()
    assert one.owed == 0
    one.account(0.0, 3600.0)
    assert one.owed == 0


@given(share=st.floats(0, 1), level=st.floats(0.75, 15), least_speed=st.floats(0.05, 1))
def test_speeds_are_the_drives(share: float, level: float, least_speed: float) -> None:
    """Between its least and the rated one, roundings included."""
    one = pulses(least_speed=least_speed, follow_tolerance=least_speed / 2)
    assert least_speed <= one.speed(share, level) <= 1
    assert one.speed(1.0, level) == pytest.approx(1)
    assert least_speed <= one.speed(1.0, level) <= 1


def test_a_running_pump_makes_up_for_what_is_owed() -> None:
    """A least pulse in a minute: 0.0168441 / 60 / 0.00842205 = a thirtieth of the maximum more."""
    one = pulses()
    one.ask(0.5, 3.0, True, 0.0)
    one.account(0.0, 60.0)
    assert one.ask(0.5, 3.0, True, 60.0) == pytest.approx(0.5 + 1 / 30)
    assert one.ask(0.99, 3.0, True, 60.0) == 1


def run_commands(commands: list[tuple[float, int]], rig: Rig) -> tuple[float, float]:
    """Run commands, each for so many seconds; return the largest lead and the largest lag (m3)."""
    commanded = lead = lag = 0.0
    for command, seconds in commands:
        for _ in range(seconds):
            rig.step(command)
            # What was asked for in this tick is delivered in the next.
            lead = max(lead, rig.delivered - commanded)
            lag = max(lag, commanded - rig.delivered)
            commanded += rig.tau * pump_flow(rig.site, rig.plant.x1, rig.plant.x2, command)
    return lead, lag


@settings(max_examples=20, deadline=None)
@given(
    commands=st.lists(
        st.tuples(st.floats(1e-4, 0.0105), st.integers(1, 3000)), min_size=1, max_size=6
    ),
    drive_ramp=st.sampled_from([0.1, 0.2, 1.0]),
)
def test_volume_within_a_least_pulse(
    commands: list[tuple[float, int]], drive_ramp: float
) -> None:
    """Below 0.0112 of the flow 20 starts an hour are enough: 3600 s x 0.0112 = 20 x 2 s."""
    rig = Rig(drive_ramp=drive_ramp)
    lead, lag = run_commands(commands, rig)
    assert lag <= LEAST_PULSE
    # The pump comes to rest from half its speed in 5 s at most, but soon lifts nothing any more.
    assert lead <= 0.1 * LEAST_PULSE
    assert not any(one.warning for one in rig.decisions)
    assert max(one.flow for one in rig.decisions) <= maximum_pump_flow(rig.site, 75.0)


def test_a_day_of_mpc() -> None:
    """24 h of what mpc with weight 1e-3 commands in a simulated run, some rain included."""
    run = paper_run("--controller", "mpc", "--hours", "24", "--start", "2021-07-07T00:00")
    rig: Rig | None = None
    commanded = worst = 0.0
    for tick in closed_loop(run, run.make_controller(), Metrics()):
        rig = rig or Rig(tick.x1, tick.x2)
        # The pump sees the levels of the simulated run, so that both have the same full roof.
        rig.plant.x1, rig.plant.x2 = tick.x1, tick.x2
        rig.step(tick.command)
        worst = max(worst, abs(commanded - rig.delivered))
        commanded += tick.flows.pump
    assert commanded > 0.5
    assert worst <= LEAST_PULSE


def test_too_many_starts_are_said() -> None:
    """At 0.05 of the flow a start is due every 45 s, but only every 180 s is one permitted."""
    rig = Rig()
    rig.run(600, 0.05)
    starts = sum(
        now.speed is not None and before.speed is None
        for before, now in zip(rig.decisions, rig.decisions[1:], strict=False)
    )
    assert starts <= 4
    said = [one.warning for one in rig.decisions if one.warning]
    assert "m3 are owed, more than a least pulse of 0.017 m3: least times and starts" in said[-1]
    assert rig.delivered == pytest.approx(600 * 0.05 * 0.0083, abs=180 * 0.05 * 0.0083)
