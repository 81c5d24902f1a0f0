"""What controllers that wait for rain share: forecasts, days after them, trust in the sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from paper import PAPER_SITE, lookahead, metrics_of, paper_run, rain_scaled, site_file, site_with
from places import CONFIG, DATA

from greenroof_ros.controllers.anticipating import AfterForecast
from greenroof_ros.controllers.onoff import AnticipatingOnOff
from greenroof_ros.controllers.regret_budget import RegretBudget
from greenroof_ros.controllers.roof import RoofObserver
from greenroof_ros.forecast.models import ForecastModel
from greenroof_ros.forecast.steps import SteppedForecast
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.horizon import growing_steps

EDGES = growing_steps(12)
STEPS = len(EDGES) - 1
DRY = [0.0] * STEPS
FIELD_CAPACITY = ("--site", str(CONFIG / "site_neubrandenburg.yaml"))
Array = NDArray[np.float64]


def anticipating(fraction: float = 1.0, observer_time_constant: float = 0.0) -> AnticipatingOnOff:
    """Return a controller that looks 12 h ahead and waits for rain without limit."""
    return AnticipatingOnOff(
        PAPER_SITE, fraction, horizon=12, days_after=10, waiting_budget=math.inf,
        observer_time_constant=observer_time_constant, waiting_share=0.0,
    )


MADE = pytest.mark.parametrize("make", [anticipating, lookahead])

# --- steps, and the days after them ---------------------------------------------------------------


def test_steps() -> None:
    """They begin with seconds, end at the horizon, and never shrink, except the last."""
    for hours in (0.1, 1.0, 4.0, 12.0, 48.0, 240.0):
        edges = growing_steps(hours)
        lengths = np.diff(edges)
        assert (edges[0], edges[-1], lengths[0]) == (0.0, hours * 3600, 10)
        assert (np.diff(lengths)[:-1] >= 0).all()


def test_after_the_forecast_the_roof_dries_slowly() -> None:
    """Ten days without rain, at 0.3 of the mean evapotranspiration of the past day."""
    after = AfterForecast(site_with(tau=3600.0), 12, 10)
    assert after.edges[: STEPS + 1].tolist() == EDGES.tolist()
    assert np.diff(after.edges[STEPS:]).tolist() == [86_400.0] * 10
    day = [8e-6 * max(0.0, math.sin(math.pi * (hour - 6) / 12)) for hour in range(24)]
    mean = float(np.mean(day))
    ends = []
    for hour in range(240):
        after.read(np.zeros(STEPS), np.full(STEPS, day[hour % 24]), 1)
        rain, evaporated = after.lengthen(np.full((2, STEPS), 1e-6), np.full(STEPS, 3e-6))
        assert rain.shape == (2, STEPS + 10) and not rain[:, STEPS:].any()
        assert evaporated[:STEPS].tolist() == [3e-6] * STEPS
        ends.append(evaporated[STEPS:])
    assert np.ptp(ends[-1]) == 0
    last_day = [float(end[0]) for end in ends[-24:]]
    assert np.mean(last_day) == pytest.approx(0.3 * mean, rel=0.01)
    # A first-order lag of a day leaves 16 % of a daily wave, here of 1.6 times the mean.
    assert np.ptp(last_day) / 2 == pytest.approx(0.3 * mean * 1.57 * 0.157, rel=0.15)


def test_after_the_forecast_the_first_mean_is_the_forecasts_own() -> None:
    """Of its first day, with any later steps."""
    edges = growing_steps(48)
    after = AfterForecast(PAPER_SITE, 48, 10)
    forecast = np.where(edges[1:] <= 86_400, 2e-6, 9e-6)
    forecast[np.searchsorted(edges, 86_400) - 1] = 2e-6
    after.read(0 * forecast, forecast, 1)
    _, evaporated = after.lengthen(np.zeros((1, after.steps)), forecast)
    assert evaporated[-1] == pytest.approx(0.3 * 2e-6, rel=1e-4)


# --- the rule of the on/off controller ------------------------------------------------------------


def medians(values: Array, weights: Array) -> list[float]:
    """Return the lower median up to each step, by its definition."""
    medians = []
    for k in range(1, len(values) + 1):
        order = np.argsort(values[:k], kind="stable")
        reached = np.cumsum(weights[:k][order])
        medians.append(float(values[:k][order][np.searchsorted(reached, reached[-1] / 2)]))
    return medians


@given(
    st.lists(st.floats(-5, 5), min_size=STEPS, max_size=STEPS), st.floats(0.0, 0.05)
)
def test_it_pumps_the_first_volume_of_the_isotonic_regression(
    rates: list[float], roof: float
) -> None:
    """It pumps while the minimum median of the missing volume, over all end steps, is above 0."""
    rain = [max(0.0, rate) / 3.6e6 for rate in rates]
    evaporated = [max(0.0, -rate) / 3.6e6 * PAPER_SITE.a2 for rate in rates]
    command = anticipating(0.8).command(2.3, roof, rain, evaporated)
    after = AfterForecast(PAPER_SITE, 12, 10)
    forecast = after.read(rain, evaporated, 1)
    assert forecast is not None
    (all_rain,), drying = after.lengthen(*forecast)
    changes = (all_rain * PAPER_SITE.a2 - drying) * after.lengths
    ends = np.concatenate([[0.0], np.cumsum(changes)])
    course = roof * PAPER_SITE.a2 + (ends[1:] + ends[:-1]) / 2
    first = min(medians(PAPER_SITE.x2_star - course, after.lengths))
    if abs(first) > 1e-9:
        assert command == (0.8 if first > 0 and roof < PAPER_SITE.z_veg else 0.0)


def test_a_longer_forecast_does_no_harm_on_a_field_capacity_soil(tmp_path: Path) -> None:
    """Twenty days of July with doubled rain, perfect forecasts of two and of ten days.

    So much rain flushes pumped water away: relying on it for ten days would be 4 % worse.
    """
    site = site_file(tmp_path, base="site_neubrandenburg.yaml", tau=600.0)
    totals = []
    for horizon in ("48", "240"):
        run = paper_run(
            "--controller", "anticipating_onoff", "--fraction", "0.001", "--horizon", horizon,
            "--site", str(site), "--evapotranspiration", "fao56",
            "--weather", str(DATA / "en_climate_hourly_07-2021.csv"),
            "--start", "2021-07-01T00:00", "--hours", "480",
        )
        run = rain_scaled(run, 2)
        perfect = SteppedForecast(
            ForecastModel(run.weather), run.weather, run.series, run.site, run.start,
            growing_steps(float(horizon)), run.controller.ensemble,
        )
        totals.append(metrics_of(replace(run, forecast=perfect))["total_deviation_m3"])
    assert totals[1] <= 1.005 * totals[0], totals


@pytest.mark.parametrize(
    "levels", [(0.7, 0.0), (2.3, 0.0457), (2.3, 0.06), (math.nan, 0.0), (2.3, math.nan)]
)
@MADE
def test_pumps_that_do_not_work_are_not_asked_to(
    make: Callable[[], Any], levels: tuple[float, float]
) -> None:
    """Below the suction level, at and above the target, and with levels that are NaN."""
    controller = make()
    assert controller.command(*levels, DRY, DRY) == 0.0
    assert controller.command(2.3, 0.02, DRY, DRY) > 0.9


# --- trust in the level sensor --------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), ("--cistern", "60", "--roof", "34.4"), FIELD_CAPACITY])
def test_estimate_is_the_truth_where_model_and_sensor_are_exact(options: tuple[str, ...]) -> None:
    """With rain, running pumps, a soil that drains, and one that percolates and dries."""
    run = paper_run(
        "--controller", "onoff", "--start", "2021-07-08T05:00", "--hours", "2", *options
    )
    estimate, budget = RoofObserver(run.site, 300.0), RegretBudget(run.site, 1.0, 0.0)
    for tick in Simulation(run).ticks():
        x2 = estimate.correct(tick.roof_level, run.site.tau)
        assert x2 == pytest.approx(tick.x2, abs=1e-9)
        now = tick.precipitation, tick.evapotranspiration
        estimate.predicted = budget.move(tick.x1, x2, 1.0, tick.command, *now).roof


def test_it_begins_with_the_mean() -> None:
    """Each of the first n readings is equally good, so their mean is the best estimate."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    readings = 0.04 + 0.0005 * np.random.default_rng(2).standard_normal(300)
    for number, reading in enumerate(readings.tolist(), start=1):
        estimate.predicted = x2 = estimate.correct(reading, 1.0)
        assert PAPER_SITE.roof_level(x2) == pytest.approx(readings[:number].mean(), abs=1e-12)


@pytest.mark.parametrize("tau", [1.0, 10.0])
def test_noise_of_any_size_is_noise(tau: float) -> None:
    """It is averaged over 300 s: the error is only the average's, without jumps."""
    site, noise = replace(PAPER_SITE, tau=tau), 0.005
    estimate, errors = RoofObserver(site, 300.0), []
    for deviate in np.random.default_rng(3).standard_normal(43_200 // int(tau)).tolist():
        estimate.predicted = x2 = estimate.correct(0.06 + noise * deviate, tau)
        errors.append(site.roof_level(x2) - 0.06)
    gain = tau / 300
    expected = noise * math.sqrt(gain / (2 - gain))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.25)


@MADE
def test_a_roof_that_filled_unseen_is_not_pumped_on(make: Callable[..., Any]) -> None:
    """Below its target before hours of frost, a millimetre above it afterwards."""
    controller = make(observer_time_constant=300.0)
    assert controller.command(2.3, 0.0375, DRY, DRY) > 0
    for _ in range(3600):
        controller.skip()
    for _ in range(100):
        assert controller.command(2.3, 0.0467, DRY, DRY) == 0.0


@MADE
@pytest.mark.parametrize("strength", [0.3, 3.0])
def test_pumps_of_another_flow(make: Callable[..., Any], strength: float) -> None:
    """A driver obeys the commands, with pumps that deliver more or less than the model's.

    Only the controller stops them. The roof ends near its target: at most a millimetre plus the
    inflow during the fifteen seconds until the sensor is trusted is too much.
    """
    controller, level = make(observer_time_constant=300.0), 0.035
    full = maximum_pump_flow(PAPER_SITE, PAPER_SITE.cistern_volume(2.3)) / PAPER_SITE.a2
    for _ in range(3600):
        level += controller.command(2.3, level, DRY, DRY) * strength * full
    slack = 0.001 + 15 * max(0.0, strength - 1) * full
    assert PAPER_SITE.z_veg - 5e-4 < level < PAPER_SITE.z_veg + slack
