"""The environment: commands from outside give what a controller with the same commands gives."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from paper import IMPERFECT, LIMITED_SOIL, LIMITED_VALVE, LIMITED_WHOLE, VALVE, four_days
from places import refusal

import greenroof_ros as gr
from greenroof_ros.simulation.loop import Simulation


def test_a_loop_of_five_lines_is_on_off() -> None:
    """Every metric of a run is equal, digit for digit."""
    roof = gr.Environment(hours=2)
    while not roof.done:
        state = roof.state
        roof.step(1.0 if state.roof_level < roof.site.z_veg else 0.0)
    assert roof.metrics == gr.simulate("onoff", hours=2).metrics


def test_what_a_step_returns() -> None:
    """The ticks are the trajectory's; reset begins the same run again.

    Metrics on the way are those of a run that ends there.
    """
    roof = gr.Environment(hours=0.1, initial="high-high")
    run = gr.simulate(lambda state, forecast: 0.3, hours=0.1, initial="high-high")
    expected, longer = run.trajectory, gr.Environment(hours=1, initial="high-high")
    first = roof.state
    assert first.time.isoformat() == "2021-07-07T02:00:00-05:00"
    for _ in range(2):
        ticks = []
        while not roof.done:
            ticks.append(roof.step(0.3))
        assert len(ticks) == 360
        assert [tick.x2 for tick in ticks] == expected["roof_m3"][:-1].to_list()
        assert [tick.flows.outflow for tick in ticks] == expected["outflow_m3_per_s"][:-1].to_list()
        assert roof.state.roof_level == expected["roof_level_m"][-1]
        assert roof.reset() == first
    for _ in range(360):
        longer.step(0.3)
    assert longer.metrics == run.metrics


def test_seeds() -> None:
    """They change forecasts with errors, and nothing else."""
    roof = gr.Environment(hours=1, forecast="errors", horizon=48)
    drawn = []
    for seed in (1, 2, 1):
        roof.reset(seed)
        drawn.append(roof.forecast.rain.tolist())
    assert drawn[0] == drawn[2] != drawn[1]


def test_what_is_wrong_is_named() -> None:
    """A refused command changes nothing."""
    roof = gr.Environment(hours=4 / 3600, site=gr.read_site(**VALVE))
    for command in (-0.1, 1.2, math.nan, math.inf):
        refusal(roof.step, command, match="command.*must be a number from 0 to 1")
        refusal(roof.step, 0.0, command, match="outlet.*: must be a number from 0 to 1")
    for _ in range(4):
        roof.step(0.0)
    refusal(roof.step, 0.0, match="the run: has ended; call reset")
    refusal(lambda: gr.Environment(horizon=0), match="horizon = 0: must be")


def test_a_program_commands_the_valve() -> None:
    """With nothing from it the policy does, as in simulate, bit for bit."""
    inputs = {"site": gr.read_site(**VALVE), "hours": 3, "start": "2021-07-08T05:00"}
    for outlet in ("drain", "open", "plan"):
        roof = gr.Environment(**inputs, outlet=outlet)
        while not roof.done:
            roof.step(0.0)
        expected = gr.simulate(lambda state, forecast: 0.0, outlet=outlet, **inputs)
        assert roof.metrics == expected.metrics
    roof = gr.Environment(**inputs)
    # Eq. (2) at the outlet's level.
    full = 0.61 * math.pi * 0.02**2 * math.sqrt(2 * 9.81 * (roof.state.cistern_level - 1.0))
    for share in (1.0, 0.25, np.float32(0.5), 0):
        tick = roof.step(0.0, share)
        assert tick.outlet == share
        assert tick.flows.low_outlet == pytest.approx(share * full, rel=1e-3)
    # Drain, two hours after rain, of which the record has the last at 10:00, or earlier.
    for start, opening in {"2021-07-07T12:00": 1.0, "2021-07-07T11:59": 0.0}.items():
        assert gr.Environment(**{**inputs, "start": start}).step(0.0).outlet == opening


def test_no_command_to_a_valve_that_is_not_there() -> None:
    refusal(gr.Environment(hours=1).step, 0.0, 0.5, match="outlet = 0.5: needs a site with a valve")
    sentence = "is a parameter of the valve of the low outlet, which this site does not have"
    refusal(lambda: gr.Environment(outlet="drain"), match=sentence)
    refusal(lambda: gr.simulate("onoff", outlet_reserve=1.0), match=sentence)


COMMANDS = np.random.default_rng(3).random((3000, 2))


class Program:
    """A controller that issues these commands, and notes the ticks that it has to skip."""

    parameters = ()
    outlet = 0.0

    def __init__(self, site: Any) -> None:
        self.tick, self.skipped = -1, []

    def command(self, *inputs: Any) -> float:
        self.tick += 1
        share, self.outlet = COMMANDS[self.tick].tolist()
        return share

    def skip(self) -> None:
        self.command()
        self.skipped.append(self.tick)

    def statistics(self) -> None:
        return None


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("inputs", [
    {"site": LIMITED_VALVE, "start": "2021-03-13T23:57-05:00", "hours": 40, "initial": "high-high"},
    {"site": LIMITED_SOIL, "start": "2021-03-12T19:20:30-05:00", "hours": 37, **IMPERFECT},
    {"site": LIMITED_WHOLE, "start": "2021-03-13T23:57-05:00", "hours": 40, "initial": "high-high"},
    {"site": gr.read_site(tau=240.0, M=1), "start": "2021-03-13T00:00Z", "hours": 60},
    {"site": replace(LIMITED_VALVE, irrigation="none"), "start": "2021-03-13T00:00Z", "hours": 30},
])
def test_the_ticks_are_those_of_a_simulation(inputs: dict[str, Any], way: None) -> None:
    """Bit for bit, of a controller with the same commands, which is not asked in frost.

    From 97.5 m3 on, the first cistern overflows for six minutes, on two days.
    """
    frame = four_days(5 if inputs["site"].tau == 240 else 60)
    result = gr.simulate(Program, weather=frame, **inputs)
    program = Program(None)
    expected = [*Simulation(result.run, program).ticks()]
    roof, ticks, has_valve = gr.Environment(weather=frame, **inputs), [], inputs["site"].c_low > 0
    while not roof.done:
        share, outlet = COMMANDS[len(ticks)].tolist()
        ticks.append(roof.step(share, *[outlet] * has_valve))
    assert ticks == expected[:-1]
    assert roof.state[1:3] == (expected[-1].cistern_level, expected[-1].roof_level)
    assert roof.metrics == result.metrics
    assert roof.metrics["overflow_days"] == (2 if "initial" in inputs else 0)
    stopped = [tick.k for tick in ticks if tick.command == 0]
    assert stopped == [k for k in program.skipped if k < len(ticks)]
    assert 100 < len(stopped) < len(ticks) / 2 or not inputs["site"].irrigated
