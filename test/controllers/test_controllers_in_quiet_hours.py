"""Controllers during quiet hours: all command 0, and lookahead plans for them."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from paper import SLOW, run_in, weather_of

from greenroof_ros.controllers.lookahead import Lookahead
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.loop import Simulation, Tick
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site

# The pump may run only from 17:00 to 19:00, as where people use the roof by day.
EVENING = replace(SLOW, quiet_hours=("19:00-17:00",), time_zone="America/Toronto")
# A run of 20 h from 18:00 on.
START, HOURS = datetime.fromisoformat("2021-07-07T18:00-04:00"), 20
BEGINS = 360  # ticks from the start to the quiet hours


def run_of(controller: str, rain: dict[int, float], site: Site = EVENING, **changes: float) -> Run:
    """Build a run on a roof at three quarters of its target, with a perfect forecast.

    Args:
        controller: its name.
        rain: by the hour of the run (mm/h).
        site: of the run.
        changes: parameters of the controller.
    """
    weather = weather_of([rain.get(hour, 0.0) for hour in range(60)], 4.0, START)
    return run_in(
        weather, site, 70.0, 0.75 * site.x2_star, choice=find_controller(controller),
        length_h=HOURS, **changes,
    )


def ticks_of(run: Run, site: Site | None = None) -> list[Tick]:
    """Run it; a given site is the one that the controller is made for."""
    controller = run.controller.make(site or run.site, run.parameters)
    return list(Simulation(run, controller).ticks())


def deviation(ticks: list[Tick]) -> float:
    return sum(abs(tick.x2 - SLOW.x2_star) for tick in ticks)


@pytest.mark.parametrize(
    "controller", ["onoff", "anticipating_onoff", "mpc", "lookahead"]
)
def test_no_controller_pumps_in_quiet_hours(controller: str) -> None:
    """Each begins to pump before, on a roof that is never full, and continues afterwards."""
    changes = {"days_after": 0} if controller in ("lookahead", "anticipating_onoff") else {}
    if controller == "onoff":
        changes["fraction"] = 0.001
    site = replace(EVENING, quiet_hours=("18:30-19:00",), a_hat=-9e8)  # a weak pump
    run = replace(run_of(controller, {}, site, **changes), steps=720)
    commands = [tick.command for tick in ticks_of(run)]
    # mpc need not begin at once.
    assert max(commands[:180]) > 0
    assert commands[180:360] == [0.0] * 180
    assert max(commands[360:]) > 0


LOOKAHEAD = {
    "horizon": 24.0, "days_after": 0, "observer_time_constant": 0.0, "waiting_budget": 1e6,
}


def test_lookahead_fills_the_roof_before_quiet_hours() -> None:
    """They bring a little rain, and a dry day: a roof that is not filled now stays so all day.

    Without quiet hours in its plan it leaves room for that rain, and plans to fill up later, when
    it must not pump. On/off fills all of it, too.
    """
    rain = {4: 2.0}
    run = run_of("lookahead", rain, **LOOKAHEAD)
    knows, alone = ticks_of(run), ticks_of(run, replace(EVENING, quiet_hours=None))
    onoff = ticks_of(run_of("onoff", rain))
    assert not any(tick.command for tick in [*knows[BEGINS:], *alone[BEGINS:], *onoff[BEGINS:]])
    assert alone[BEGINS].x2 < 0.99 * min(knows[BEGINS].x2, onoff[BEGINS].x2)
    assert deviation(knows) < 0.95 * deviation(alone)
    assert deviation(knows) < deviation(onoff)


def test_its_plans_pump_nothing_in_quiet_hours() -> None:
    """No row with its step in quiet hours has a flow; a plan is also made at their ends."""
    site = replace(EVENING, quiet_hours=("19:00-20:00",), starts_per_hour=3600.0)
    run = replace(run_of("lookahead", {1: 1.0, 3: 3.0}, site, **LOOKAHEAD), steps=1080)
    controller = run.make_controller()
    assert isinstance(controller, Lookahead)
    planned, flows = set(), []
    for tick in Simulation(run, controller).ticks():
        if not len(controller.plan):
            continue
        planned.add(tick.k)
        ends = 10 * tick.k + np.concatenate(([0.0], controller.plan[:, 0]))
        within = (ends[:-1] >= 3600) & (ends[1:] <= 7200)
        assert not controller.plan[within, 1].any(), tick.k
        flows += controller.plan[~within, 1].tolist()
    assert {0, 360, 720} <= planned
    assert max(flows) > 0
