"""Compiled seasons: the bits of runs tick by tick, alone and side by side in a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import field_capacity_sites, metrics_of, run_of_hours, sites, weather_of
from places import CONFIG, DATA

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Simulation, record, simulate
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

PAPERS = read_site(CONFIG / "site.yaml")
VALVE = replace(read_site(CONFIG / "site_valve.yaml"), tau=60.0, M=1)
SMALL = replace(
    VALVE, a1=1.0, initial_cistern=1.0, drainage_to_cistern=0.8, percolation_exponent=1.5,
)
NONE = replace(
    VALVE, low_outlet_level=None, low_outlet_radius=None, low_outlet_valve=False, a1=0.5,
    initial_cistern=0.5, mains_level=None, mains_flow=None,
)
FROSTY = replace(VALVE, valve_closed_in_frost=True, time_zone="America/Toronto")
WHOLE = replace(SMALL, valve_moves_per_hour=4.0)
QUIET = replace(VALVE, time_zone="America/Toronto", quiet_hours=("09:00-15:30",))
MINUTES = np.random.default_rng(5).choice([0.0, 0.0, 0.05, 12.0], (12, 60))
MARCH = {"weather": str(DATA / "en_climate_hourly_03-2021.csv"), "start": "2021-03-13T00:00"}

CASES: dict[str, tuple[Site, dict[str, Any]]] = {
    "the paper's": (PAPERS, {
        "weather": str(CONFIG / "weather" / "toronto_2021-07.csv"), "start": "2021-07-08T09:00",
        "hours": 1, "roof": 2.4, "cistern": 80.0, "fraction": 0.1,
    }),
    "no low outlet": (NONE, {"level": 0.9}),
    "closed": (VALVE, {"outlet": "closed"}),
    "open": (VALVE, {"outlet": "open", "fraction": 1.3}),
    "drain": (SMALL, {"outlet": "drain", "outlet_reserve": 0.7}),
    "plan": (VALVE, {"outlet": "plan", "hours": 72}),
    "plan, errors": (SMALL, {"outlet": "plan", "forecast": "errors", "outlet_price": 0.1}),
    "plan, ensemble": (SMALL, {"outlet": "plan", "forecast": "ensemble", "roof_noise": 0.002}),
    "sensor and pumps": (replace(VALVE, a_hat=-9e8, tau=30.0), {
        "roof_noise": 0.002, "roof_offset": 0.001, "pump_min_on": 600.0, "pump_min_off": 1230.0,
        "roof": 2.6,
    }),
    "quiet hours": (QUIET, {"roof": 1.0, "fraction": 0.001}),
    "frost": (FROSTY, MARCH),
    "rain by the minute": (replace(SMALL, tau=7.0), {
        "weather": weather_of(MINUTES),
        "start": "2021-07-07T00:20Z", "hours": 7,
    }),
    "whole openings": (replace(WHOLE, tau=7.0), {"outlet": "drain", "hours": 35}),
    "whole openings, plan": (WHOLE, {"outlet": "plan"}),
    "whole openings, frost": (replace(FROSTY, valve_moves_per_hour=3.0), MARCH),
    "ticks of an hour": (replace(SMALL, tau=3600.0), {"outlet": "plan"}),
}


def run_of(site: Site, **given: Any) -> Run:
    """Return a run of plain on/off; by default over 36 h with 24 mm of measured rain.

    Half of the cistern is full, and the roof is at its target.
    """
    return make_inputs(find_controller("onoff"), {
        "site": site, "weather": str(DATA / "en_climate_hourly_07-2021.csv"),
        "start": "2021-07-07T18:00", "hours": 36, "cistern": site.a1, "roof": site.x2_star, **given,
    }).build()


@pytest.mark.parametrize("name", CASES)
def test_a_season_is_its_run_tick_by_tick(name: str, way: None) -> None:
    """Each figure of the summary and each value of the trajectory, bit for bit."""
    site, given = CASES[name]
    run = run_of(site, **given)
    simulation, every = Simulation(run), 7
    expected = record(run, simulation.ticks(), every)
    shares: list[float] = []
    summary, trajectory = simulate(run, every=every, progress=shares.append)
    times = {"wall_s": 0.0, "times_real_time": 0.0}
    assert summary | times == simulation.summary() | times
    for each in fields(Trajectory)[1:]:
        np.testing.assert_array_equal(getattr(trajectory, each.name), getattr(expected, each.name))
    assert shares[-1] == 1 and shares == sorted(shares)


@settings(max_examples=20)
@given(
    site=sites() | field_capacity_sites(), fill=st.tuples(st.floats(0, 1.5), st.floats(0, 1.5)),
    hours=st.lists(
        st.tuples(st.floats(0, 200) | st.just(0.0), st.floats(0, 20), st.booleans()), min_size=1,
        max_size=2,
    ), tau=st.sampled_from([5.0, 60.0, 600.0]),
)
def test_any_site(
    way: None, site: Site, fill: tuple[float, float], hours: list[tuple[float, float, bool]],
    tau: float,
) -> None:
    site = replace(site, tau=tau)
    run = run_of_hours(hours, fill[0] * site.a1 * site.z_o, fill[1] * site.z_cap, site)
    assert metrics_of(run).items() <= simulate(run)[0].items()


def test_a_controller_of_another_site() -> None:
    """It fills this roof to the target of its own site, as tick by tick."""
    run, other = run_of(VALVE, outlet="closed", roof=1.0), OnOff(PAPERS, 1.0)
    assert metrics_of(run, other).items() <= simulate(run, other)[0].items()
    assert metrics_of(run, other)["pumped_m3"] != simulate(run)[0]["pumped_m3"]


# --- a batch -------------------------------------------------------------------------------------


def cases_of(runs: Sequence[Run], groups: Sequence[int] = (0,), **choice: bool) -> list[Case]:
    """Return runs as cases; those of the same start share the weather of the first."""
    first: dict[Any, Run] = {}
    for run in runs:
        first.setdefault(run.start, run)
    return [
        Case(run.site, run.parameters, first[run.start], run.x1, run.x2, group=group, **choice)
        for run, group in zip(runs, cycle(groups), strict=False)
    ]


LARGE = replace(VALVE, a2=100.0, x2_star=3.9, z_cap=100.0 / VALVE.a2 * VALVE.z_cap)
BATCH = (
    (NONE, {}), (VALVE, {"outlet": "drain"}), (SMALL, {"outlet": "plan"}),
    (LARGE, {"outlet": "plan"}), (QUIET, {"outlet": "open"}), (FROSTY, MARCH),
    (WHOLE, {"outlet": "drain"}),
)


def test_a_batch_has_the_results_of_its_runs(way: None) -> None:
    """A run in March, and roofs of two sizes, in two threads; water balances.

    Evapotranspiration is scaled from the bed of the first site, so the last bits differ.
    """
    runs = [run_of(site, **given) for site, given in BATCH]
    results, hydrograph = simulate_season(cases_of(runs, (0, 1)), threads=2)
    for run, ((of, _), _) in zip(runs, results, strict=True):
        alone = simulate(run)[0]
        assert of == pytest.approx({name: alone[name] for name in of}, rel=1e-9, abs=1e-9)
        gained = run.x1 + run.x2 + run.site.initial_layer + of["rain_m3"] + of.get("mains_m3", 0.0)
        kept = of["final_cistern_m3"] + of["final_roof_m3"] + of.get("final_layer_m3", 0.0)
        lost = of["discharge_m3"] + of["evapotranspiration_m3"]
        assert gained == pytest.approx(kept + lost, rel=1e-12)
    some, of_some = simulate_season(cases_of([runs[row] for row in (4, 0, 2, 6)], (2, 0, 1, 2)))
    assert [each.metrics for each, _ in some] == [results[row][0].metrics for row in (4, 0, 2, 6)]
    # The hydrographs of groups add up those of their sites.
    assert hydrograph[0] == pytest.approx(of_some.sum(axis=0), abs=1e-12)
    for group, (discharge, low) in enumerate(hydrograph.sum(axis=2).tolist()):
        own = [each.metrics for each, _ in results[group::2]]
        assert discharge == pytest.approx(sum(of["discharge_m3"] for of in own))
        assert low == pytest.approx(sum(of["outflow_m3"] - of["overflow_m3"] for of in own))


def test_plan_without_a_forecast(tmp_path: Path) -> None:
    """As with a forecast of no rain, it lets out only what the roof does not need."""
    dry, site = tmp_path / "dry.csv", replace(SMALL, drainage_to_cistern=0.0)
    dry.write_text("issued,time,precipitation [mm/h]\n" + "".join(
        f"2021-07-07T00:00-05:00,2021-07-{7 + hour // 24:02}T{hour % 24:02}:00-05:00,0\n"
        for hour in range(24 * 8)
    ))
    run = run_of(site, outlet="plan", cistern=1.9)
    expected = metrics_of(run_of(site, outlet="plan", cistern=1.9, forecast=str(dry)))
    assert expected["overflow_m3"] > 1.1 * metrics_of(run)["overflow_m3"]
    ((found, _),), _ = simulate_season(cases_of([run], with_forecast=False))
    assert found.metrics == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_batch_that_does_not_fit_together() -> None:
    day = {"start": "2021-07-06T00:00", "hours": 24}
    for other in (run_of(VALVE, **day), run_of(replace(VALVE, tau=30.0), **day)):
        with pytest.raises(ConfigurationError, match="number of steps"):
            simulate_season(cases_of([run_of(VALVE), other]))
