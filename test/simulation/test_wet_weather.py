"""Wet weather in a run: what the record shows before it, and what valves and metrics make of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import find_wet, run_in, site_with, weather_of

from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.output import write_configuration
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.read import read_weather

# 10 m3 below the upper outlet at 2 m, and a valve at 0.1 m; all water leaves through the cistern.
SITE = site_with(
    a1=5.0, z_o=2.0, a_in=270.0, z_pump=0.0, z_H=0.05, low_outlet_level=0.1,
    low_outlet_radius=0.0125, low_outlet_valve=True, drainage_to_cistern=1.0, tau=60.0,
)
FULL_ROOF = SITE.x2_star


def trajectory_of(run: Run) -> Any:
    return simulate(run, every=1)[1]


def test_a_run_starts_in_dry_weather() -> None:
    """Two hours before a storm, plan lets out 7.89 m3, so that as much less overflows.

    The root of the head falls by 7200 s x c_low / (2 a1) = 7200 x 0.0013263 / 10 = 0.95494 from
    sqrt(1.7), so 5 (0.1 + 0.3489^2) = 1.109 m3 are left of 9 m3.
    """
    storm = weather_of([0.0, 0.0, 25.0, 12.0, 0.0, 0.0])
    (closed, _), (plan, trajectory) = (
        simulate(run_in(storm, SITE, 9.0, FULL_ROOF, outlet=policy), every=1)
        for policy in ("closed", "plan")
    )
    assert trajectory is not None and trajectory.outlet is not None
    assert trajectory.outlet[:120].tolist() == [1.0] * 120
    less = closed["wet_discharge_m3"] - plan["wet_discharge_m3"]
    assert less == pytest.approx(9 - 1.109, abs=0.01)


FIRST = np.zeros((4, 60))
FIRST[0, 10:15] = 6.0


@pytest.mark.parametrize(("rain", "after", "wet_min"), [
    ([1.0, 0, 0, 0, 0], 1.0, 120), ([1.0, 0, 0, 0, 0], 1.5, 90), ([1.0, 0, 0, 0, 0, 0], 3.0, 0),
    ([0.09, 0, 0, 0], 1.0, 0), ([0.1, 0.05, 0, 0, 0], 2.0, 120), ([math.nan, 0, 0, 0], 1.0, 0),
    (FIRST, 0.5, 105), (FIRST, 1.0, 75),
])
def test_the_record_shows_what_fell_before(
    tmp_path: Path, rain: Any, after: float, wet_min: int
) -> None:
    """The weather is wet until two hours after that rain, for the graph's nodes as well."""
    run = run_in(weather_of(rain), SITE, 9.0, FULL_ROOF, after_h=after, outlet="drain")
    assert np.flatnonzero(trajectory_of(run).outlet)[0] == wet_min
    (tmp_path / "configuration").mkdir()
    file = write_configuration(tmp_path, replace(run, records=run.weather), {})
    nodes = yaml.safe_load(file.read_text())
    for node in ("plant", "onoff"):
        seconds = nodes[f"/**/{node}"]["ros__parameters"]["time_without_rain"]
        assert max(0, 7200 - seconds) == 60 * wet_min


def test_a_filled_hour_is_known(tmp_path: Path) -> None:
    """The valve stays open in an hour whose rain was missing, and filled with 0."""
    file, site = tmp_path / "weather.csv", replace(SITE, low_outlet_radius=0.005)
    rows = [f"2021-07-07T{hour:02}:00Z,{'' if hour == 1 else 0.0},2.0" for hour in range(3)]
    header = "time,precipitation [mm/h],published evapotranspiration [mm/day]"
    file.write_text("\n".join([header, *rows, ""]))
    weather = read_weather((file,), site.place, None, "fill")
    run = run_in(weather, site, 9.0, FULL_ROOF, outlet="drain")
    assert run.series.filled_hours == 1
    assert trajectory_of(run).outlet.tolist() == [1.0] * 181


@settings(max_examples=60)
@given(
    spells=st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.0, 0.03, 0.0999, 0.1, 5.0]) | st.floats(0, 0.2),
            st.integers(1, 150),
        ), min_size=1, max_size=10,
    ),
    tau=st.sampled_from([7.0, 60.0, 300.0, 900.0]), wet_after=st.sampled_from([0.0, 0.5, 2.0]),
    policy=st.sampled_from(["drain", "plan"]),
)
def test_no_valve_opens_in_wet_weather(
    spells: list[tuple[float, int]], tau: float, wet_after: float, policy: str
) -> None:
    """Rain and drizzle by the minute, then three dry hours; the metrics have the same rule."""
    fallen = np.concatenate([np.full(minutes, rate) for rate, minutes in spells])
    rain = np.zeros((len(fallen) // 60 + 4, 60))
    rain.ravel()[: len(fallen)] = fallen
    site = replace(SITE, tau=tau, wet_after=wet_after)
    summary, of = simulate(run_in(weather_of(rain), site, 9.0, FULL_ROOF, outlet=policy), every=1)
    assert of is not None and of.low_outlet is not None
    wet = find_wet(3.6e6 * of.precipitation[:-1], tau, wet_after)
    assert of.low_outlet[:-1][~wet].any() and not of.low_outlet[:-1][wet].any()
    assert summary["wet_discharge_m3"] == pytest.approx(tau * of.outflow[:-1][wet].sum(), abs=1e-9)
