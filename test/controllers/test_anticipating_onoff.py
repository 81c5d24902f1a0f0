"""The on/off controller that anticipates the weather: a sum, and the decisions it gives."""

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
from paper import PAPER_SITE, lookahead, metrics_of, paper_run, rain_scaled, site_file
from places import DATA

from greenroof_ros.controllers.anticipating import AfterForecast
from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff
from greenroof_ros.forecast.models import PerfectModel
from greenroof_ros.forecast.resampling import SteppedForecast
from greenroof_ros.site.horizon import growing_steps

STEPS = len(growing_steps(12)) - 1
DRY = [0.0] * STEPS
Array = NDArray[np.float64]


def anticipating(fraction: float = 1.0) -> AnticipatingOnOff:
    """Return a controller that uses readings unfiltered and waits for rain without limit."""
    return AnticipatingOnOff(
        PAPER_SITE, fraction, horizon=12, days_after=10, observer_time_constant=0.0,
        waiting_budget=math.inf, waiting_share=0.0,
    )


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
    controller = anticipating(0.8)
    command = controller.command(2.3, roof, rain, evaporated)
    after = AfterForecast(PAPER_SITE, 12, 10)
    forecast = after.read(rain, evaporated, 1)
    assert forecast is not None
    (all_rain,), drying = after.lengthen(*forecast)
    lengths = after.lengths
    ends = np.concatenate([[0.0], np.cumsum((all_rain * PAPER_SITE.a2 - drying) * lengths)])
    course = roof * PAPER_SITE.a2 + (ends[1:] + ends[:-1]) / 2
    first = min(medians(PAPER_SITE.x2_star - course, lengths))
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
            PerfectModel(run.weather), run.weather, run.series, run.site, run.start,
            growing_steps(float(horizon)), run.controller.ensemble,
        )
        totals.append(metrics_of(replace(run, forecast=perfect))["total_deviation_m3"])
    assert totals[1] <= 1.005 * totals[0], totals


@pytest.mark.parametrize(
    "levels", [(0.7, 0.0), (2.3, 0.0457), (2.3, 0.06), (math.nan, 0.0), (2.3, math.nan)]
)
@pytest.mark.parametrize("make", [anticipating, lookahead])
def test_pumps_that_do_not_work_are_not_asked_to(
    make: Callable[[], Any], levels: tuple[float, float]
) -> None:
    """Below the suction level, at and above the target, and with levels that are NaN."""
    controller = make()
    assert controller.command(*levels, DRY, DRY) == 0.0
    assert controller.command(2.3, 0.02, DRY, DRY) > 0.9
