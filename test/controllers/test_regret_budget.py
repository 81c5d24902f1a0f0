"""What waiting for forecast rain may cost."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import (
    PAPER_SITE,
    advance,
    deviation_of,
    lookahead,
    paper_run,
    rain_scaled,
    site_file,
    virtual_site,
)
from places import CONFIG, DATA

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.controllers.regret_budget import RegretBudget
from greenroof_ros.forecast.steps import SteppedForecast
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import growing_steps, look_ahead_ends
from greenroof_ros.weather.series import Weather

EMPTY_HOUR = 3600 * PAPER_SITE.x2_star  # m3 s
STEPS = len(growing_steps(12)) - 1
# 21.6 mm, none of it in the first two hours.
COMING = [3e-6 if 7200 <= begin < 14_400 else 0.0 for begin in growing_steps(12)[:-1]]

BUDGET_H, SHARE = 6.0, 0.05


def a_week(directory: Path, *options: str) -> Run:
    """Build a run of a week with a tenth of July 2021's rain, in ticks of two minutes.

    Its pumps have a twentieth of the flow: with all of it on/off would overshoot by 14 mm.
    """
    run = paper_run(
        *options, "--site", str(site_file(directory, tau=120.0)),
        "--weather", str(DATA / "en_climate_hourly_07-2021.csv"), "--start", "2021-07-01T00:00",
        "--hours", "168", "--evapotranspiration", "fao56",
    )
    return rain_scaled(run, 0.1)


ALWAYS_RAIN = "always rain"


class Adversary:
    """Hourly forecasts that are made to mislead: rain without end, or all kinds as an ensemble."""

    notes = ()

    def __init__(self, kind: str, weather: Weather) -> None:
        self._kind = kind
        self._weather = weather

    def forecast(
        self, hour: int, hours: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], None]:
        """Return rain (mm/h), shape (members, hours), the true evapotranspiration (mm/day), None.

        The last says that these forecasts have no times of issue.
        """
        records = self._weather.precipitation
        last = len(records) - 1
        ahead = hour + np.arange(hours)
        now = np.minimum(ahead, last)
        tomorrow = (ahead - hour >= 24) & (ahead - hour < 30)
        rain = np.full(hours, 2.0)
        members = [rain] if self._kind == ALWAYS_RAIN else [
            rain, np.zeros(hours), np.where(tomorrow, 8.0, 0.0),
            np.where(records[now] > 0, 0.0, 0.7),
            records[np.minimum(ahead + 24, last)], records[np.maximum(now - 24, 0)],
            records[now] + np.where(ahead % 168 < 6, 8.0, 0.0),
        ]
        return np.stack(members), self._weather.evapotranspiration[now], None

    def check(self, hours: range) -> None:
        """Accept all hours: these forecasts lack nothing."""

    def end(self, hour: int) -> datetime:
        """Return a time after every run: these forecasts have no end."""
        return self._weather.end + timedelta(days=366)


def with_forecasts(run: Run, kind: str) -> Run:
    """Return a run whose controller gets false forecasts."""
    all_members, outlet_horizon = find_needs(run.controller, run.parameters)
    ends = look_ahead_ends(run.site, run.parameters.get("horizon", 0.0), outlet_horizon)
    return replace(run, forecast=SteppedForecast(
        Adversary(kind, run.weather), run.weather, run.series, run.site, run.start, ends,
        all_members,
    ))


@pytest.mark.parametrize(("controller", "strength", "kind"), [
    ("anticipating_onoff", "--fraction", ALWAYS_RAIN),
    ("lookahead", "--max-command", "all kinds"),
])
def test_an_adversary_costs_at_most_the_budget(
    controller: str, strength: str, kind: str, tmp_path: Path
) -> None:
    """On/off plus its share, plus the budget, plus at most the loss until the pumps may start."""
    plain = deviation_of(a_week(tmp_path, "--controller", "onoff", "--fraction", "0.05"))
    run = a_week(tmp_path, "--controller", controller, strength, "0.05", "--horizon", "48")
    false = with_forecasts(run, kind)

    def reached(budget: float) -> float:
        parameters = {**run.parameters, "waiting_budget": budget, "waiting_share": SHARE}
        return deviation_of(false, run.controller.make(run.site, parameters))

    limit = (1 + SHARE) * plain + BUDGET_H * EMPTY_HOUR
    assert reached(BUDGET_H) <= limit + 0.1 * EMPTY_HOUR
    if controller == "anticipating_onoff":
        assert reached(1e6) > 1.5 * limit


@pytest.mark.parametrize("name", ["anticipating_onoff", "lookahead"])
def test_waiting_ends_with_the_budget(name: str) -> None:
    """Forecast rain never comes: in the end it acts as on/off.

    A controller that is made again goes on with the count, and does not begin another wait.
    """
    choice, inputs = find_controller(name), (2.3, 0.04, COMING, [0.0] * STEPS)

    def made(budget: float = 0.01) -> Any:
        given = {"horizon": 12.0, "waiting_budget": budget, "waiting_share": 0.0}
        return choice.make(PAPER_SITE, choice.complete_parameters(PAPER_SITE, given))

    patient, first, afresh, again = made(72.0), made(), made(), made()
    assert first.command(*inputs) == afresh.command(*inputs) == 0.0
    assert not any(patient.command(*inputs) for _ in range(600))
    assert [first.command(*inputs) for _ in range(600)][-1] > 0
    again.learned = first.learned
    assert again.learned == first.learned
    with pytest.raises(KeyError):
        again.learned = {"waiting_loss_m3_s": 0.0}
    assert again.learned == first.learned
    assert again.command(*inputs) > 0


def test_a_low_outlet_limits_the_waiting_by_hand() -> None:
    """On/off pumps 0.00828 m3/s from 40 m3: after 151 s more than the 1.25 m3 that stay.

    A week of the excess costs the limit of 11 319 m3 s when it is 0.0187 m3, 3 s later.
    """
    site = replace(PAPER_SITE, low_outlet_level=0.8, low_outlet_radius=0.06)
    loss = RegretBudget(site, 1.0, 0.0)
    seconds = 0
    while not loss.judge(40.0, 1.0, 1.0, 1.0):
        loss.move(40.0, 1.0, 1.0, 0.0)
        seconds += 1
    assert seconds == pytest.approx(153, abs=1)


def test_ticks_in_frost_count() -> None:
    """Nothing may be pumped in them, but the roof that waited before is worse off in each."""
    controller, inputs = lookahead(), (2.0, 0.03, [COMING], [0.0] * STEPS)
    assert controller.command(*inputs) == 0.0  # on/off pumps for a tick
    for _ in range(999):
        controller.skip()
    controller.command(*inputs)
    more = maximum_pump_flow(PAPER_SITE, 50.0)
    assert controller.learned["waiting_loss_m3_s"] == pytest.approx(1000 * more, rel=1e-6)


def test_the_count_on_a_field_capacity_soil_is_what_onoff_has() -> None:
    """Next to a plant that on/off waters; a roof that was never watered lacks everything.

    Rain falls on two roofs; on the wetter one more of it percolates, so the difference is right
    only if that is followed. While the roof waits, its cistern overflows more. In ticks of ten
    seconds at a tenth of the full flow.
    """
    site = replace(read_site(CONFIG / "site_neubrandenburg.yaml"), tau=10.0)
    watered, dry = virtual_site(80.0, 1.0, site), virtual_site(80.0, 1.0, site)
    budget, rain, potential, lacks = RegretBudget(site, 1e6, 0.0), 1e-6, 2e-6, []
    for _ in range(3600):
        x1, x2, _ = dry.state
        lacks.append(watered.state.roof - x2)
        assert budget._more == pytest.approx(lacks[-1], abs=1e-9)
        assert budget._stored == pytest.approx(watered.state.cistern - x1, abs=1e-9)
        for plant, share in ((watered, 0.1), (dry, 0.0)):
            advance(plant, rain, potential, share)
        budget.move(x1, x2, 0.1, 0.0, rain, potential)
    assert max(lacks) > 0.7
    assert lacks[-1] < 0.7 * max(lacks)


def test_forecasts_count_again() -> None:
    """When the roof is filled, and a tenth of the cost of on/off has made up for the excess.

    That is 100 m3 s: on/off is 0.1 m3 off its target for 10,000 s.
    """
    budget = RegretBudget(PAPER_SITE, 0.01, 0.1)
    ticks = 0
    while not budget.judge(50.0, 2.0, 1.0, 1.0):
        budget.move(50.0, 2.0, 1.0, 0.0)
        ticks += 1
        assert ticks < 1000
    budget.loss = 0.01 * EMPTY_HOUR + 0.1 * budget.onoff_cost
    assert budget.judge(50.0, 2.0, 1.0, 1.0)  # it is not filled
    budget._more = 0.0
    budget.loss += 100.0
    seconds = 0
    while budget.judge(50.0, PAPER_SITE.x2_star - 0.1, 1.0, 1.0):
        seconds += 1
    assert seconds == pytest.approx(10_000, rel=0.01)
