"""Many sites at once against one run each, over days of measured weather."""

from __future__ import annotations

import tracemalloc
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

import numpy as np
import pytest
from places import CONFIG, DATA

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.batch import Batch, BatchResult, BatchWeather, simulate_batch
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.site import Site, read_site

VALVE = replace(read_site(CONFIG / "site_valve.yaml"), tau=60.0, M=1)
NONE = replace(
    VALVE, low_outlet_level=None, low_outlet_radius=None, low_outlet_valve=False
)
TABLE_I = replace(read_site(CONFIG / "site.yaml"), tau=60.0, M=1, **{
    name: getattr(VALVE, name) for name in (
        "a1", "z_o", "a_in", "runoff_coefficient", "z_pump", "z_H", "low_outlet_level",
        "low_outlet_radius", "low_outlet_valve", "mains_level", "mains_flow",
    )
})
SMALL = replace(VALVE, a1=1.0)

CASES: dict[str, tuple[Site, dict[str, Any]]] = {
    "no low outlet": (NONE, {}),
    "no low outlet, no mains": (replace(NONE, a1=0.5, mains_level=None, mains_flow=None), {}),
    "orifice": (replace(VALVE, low_outlet_valve=False), {}),
    "closed": (VALVE, {"outlet": "closed"}),
    "open": (VALVE, {"outlet": "open", "fraction": 0.3}),
    "drain": (VALVE, {"outlet": "drain", "outlet_reserve": 3.0}),
    "drain, small": (SMALL, {"outlet": "drain", "outlet_reserve": 0.7, "level": 0.9}),
    "plan": (VALVE, {"outlet": "plan"}),
    "plan, small": (SMALL, {"outlet": "plan", "outlet_price": 0.1, "outlet_reach": 5.0}),
    "drainage into the cistern": (
        replace(SMALL, drainage_to_cistern=0.8), {"outlet": "drain", "outlet_reserve": 0.7}
    ),
    "quiet hours": (
        replace(SMALL, time_zone="America/Toronto", quiet_hours=("09:00-15:30",)),
        {"outlet": "drain", "outlet_reserve": 0.7},
    ),
    "Table I": (TABLE_I, {"outlet": "drain"}),
    "Table I, plan": (TABLE_I, {"outlet": "plan"}),
    "Table I, coarse soil": (replace(TABLE_I, K=1e-6, z_soil=0.04, z_veg=0.02, z_cap=2.752,
                                     x2_star=1.376), {"outlet": "open"}),
}


def run_of(
    site: Site, parameters: Mapping[str, Any], start: str = "2021-07-07T00:00", hours: float = 96,
    month: str = "07-2021",
) -> Run:
    """Return a run over measured weather, with half a cistern and a roof at its target."""
    return make_inputs(find_controller("onoff"), {
        "site": site, "weather": str(DATA / f"en_climate_hourly_{month}.csv"), "start": start,
        "hours": hours, "cistern": site.a1, "roof": site.x2_star, **parameters,
    }).build()


def simulated(run: Run, outlet: OutletPolicy | None = None) -> dict[str, float]:
    """Return the metrics of a run in the ordinary way."""
    simulation = Simulation(run, outlet=outlet)
    for _ in simulation.ticks():
        pass
    return simulation.metrics.results()


def check(result: BatchResult, row: int, expected: Mapping[str, float]) -> None:
    """Compare the metrics of a site with those of its run, all that both have."""
    compared = result.metrics.keys() & expected.keys()
    assert len(compared) >= 25
    for name in compared:
        found = result.metrics[name][row]
        assert found == pytest.approx(expected[name], rel=1e-9, abs=1e-9), name


def batch_of(runs: Sequence[Run], **choice: Any) -> Batch:
    """Return runs as a batch; those of the same time share the weather of the first."""
    weather: dict[datetime, BatchWeather] = {}
    for run in runs:
        weather.setdefault(run.start, BatchWeather.of_run(run))
    return Batch(
        [run.site for run in runs], list(weather.values()),
        np.array([list(weather).index(run.start) for run in runs]),
        [run.parameters for run in runs], np.array([run.x1 for run in runs]),
        np.array([run.x2 for run in runs]), **choice,
    )


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return [run_of(*case) for case in CASES.values()]


@pytest.fixture(scope="module")
def result(runs: list[Run]) -> BatchResult:
    return simulate_batch(batch_of(runs), groups=np.arange(len(runs)) % 2)


@pytest.mark.parametrize("name", CASES)
def test_metrics_are_those_of_the_run(name: str, runs: list[Run], result: BatchResult) -> None:
    """Four days with 32 mm of rain."""
    row = list(CASES).index(name)
    check(result, row, simulated(runs[row]))


def test_water_balances(runs: list[Run], result: BatchResult) -> None:
    of = result.metrics
    before = np.array([run.x1 + run.x2 + run.site.initial_layer for run in runs])
    after = of["final_cistern_m3"] + of["final_roof_m3"] + of["final_layer_m3"]
    gained = of["rain_m3"] + of["mains_m3"]
    lost = of["discharge_m3"] + of["evapotranspiration_m3"]
    assert before + gained == pytest.approx(after + lost, rel=1e-12)
    assert (of["discharge_m3"] > 0).all()


def test_hydrographs_of_groups_add_up(runs: list[Run], result: BatchResult) -> None:
    first = simulate_batch(batch_of(runs[:3]), groups=np.arange(3)).hydrograph
    other = simulate_batch(batch_of(runs[:3]), groups=np.array([1, 0, 1])).hydrograph
    assert first is not None and other is not None and result.hydrograph is not None
    assert first.shape == (3, runs[0].steps)
    assert other == pytest.approx(np.stack((first[1], first[0] + first[2])), abs=1e-15)
    for group in range(2):
        of_group = result.metrics["discharge_m3"][np.arange(len(runs)) % 2 == group]
        assert result.hydrograph[group].sum() == pytest.approx(of_group.sum())
    assert result.low_outlet is not None
    let_out = result.metrics["outflow_m3"] - result.metrics["overflow_m3"]
    for group in range(2):
        of_group = let_out[np.arange(len(runs)) % 2 == group]
        assert result.low_outlet[group].sum() == pytest.approx(of_group.sum())
    assert (result.low_outlet <= result.hydrograph + 1e-12).all()


class WithoutRain:
    """A plan that sees no rain except the present."""

    def __init__(self, plan: OutletPolicy) -> None:
        self._plan = plan

    def command(self, cistern: float, roof: float, rain: Any, evaporated: Any) -> float:
        rain = rain.copy()
        rain[:, 1:] = 0.0
        return self._plan.command(cistern, roof, rain, evaporated)


def test_plan_without_a_forecast() -> None:
    """It lets out only what the roof does not need, so more overflows."""
    run = run_of(SMALL, {"outlet": "plan"})
    policy = run.make_outlet(run.make_controller())
    assert policy is not None
    expected = simulated(run, WithoutRain(policy))
    assert expected["overflow_m3"] > 1.1 * simulated(run)["overflow_m3"]
    check(simulate_batch(batch_of([run], with_forecast=False)), 0, expected)


def test_sites_do_not_depend_on_their_neighbours(runs: list[Run], result: BatchResult) -> None:
    rows = [5, 0, 11]
    alone = simulate_batch(batch_of([runs[row] for row in rows]))
    for name, values in alone.metrics.items():
        assert values == pytest.approx(result.metrics[name][rows], rel=1e-12, nan_ok=True), name


def test_memory_does_not_grow_with_the_length() -> None:
    """Only the weather is kept tick by tick; a number of each site would need 2,400 bytes."""
    peaks = []
    for hours in (24, 120):
        run = run_of(VALVE, {"outlet": "drain"}, hours=hours)
        batch = batch_of([run])
        batch = replace(
            batch, sites=batch.sites * 300, parameters=batch.parameters * 300,
            weather_of=np.zeros(300, int), x1=np.repeat(batch.x1, 300),
            x2=np.repeat(batch.x2, 300),
        )
        tracemalloc.start()
        simulate_batch(batch)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 200 * 96 * 60


def test_seasons_that_start_at_different_times() -> None:
    """Frost in March closes one valve, daylight saving begins, and ticks are not all long."""
    site = replace(VALVE, time_zone="America/Toronto", valve_closed_in_frost=True)
    runs = [
        run_of(site, {"outlet": "drain"}, "2021-03-13T00:00", 48, "03-2021"),
        run_of(SMALL, {"outlet": "open"}, "2021-07-08T06:00", 48),
        run_of(
            replace(VALVE, r_o=0.001, low_outlet_radius=0.001, a_hat=-9e8, initial_layer=0.1),
            {"outlet": "drain"}, "2021-07-08T06:00", 48,
        ),
    ]
    found = simulate_batch(batch_of(runs))
    for row, run in enumerate(runs):
        check(found, row, simulated(run))


def test_ticks_of_seconds() -> None:
    """Table I's tick, an hour of it, with intervals of a minute."""
    site = replace(read_site(CONFIG / "site.yaml"), a_in=300.0, a1=5.0)
    run = run_of(site, {}, "2021-07-08T12:00", 1.0)
    run = replace(run, x1=16.0, x2=run.site.x2_star * 0.98)
    expected = simulated(run)
    found = simulate_batch(batch_of([run]), groups=np.zeros(1, int))
    assert found.hydrograph is not None and found.hydrograph.shape == (1, 60)
    check(found, 0, expected)


@pytest.mark.parametrize(("tau", "hours"), [(7.0, 14.0), (300.0, 96.0), (3600.0, 96.0)])
def test_ticks_of_other_lengths(tau: float, hours: float) -> None:
    """Peaks of windows that are no whole number of intervals, of 63 s or an hour."""
    runs = [
        run_of(replace(site, tau=tau), {"outlet": policy}, "2021-07-08T06:00", hours)
        for site, policy in ((VALVE, "drain"), (SMALL, "plan"), (TABLE_I, "open"))
    ]
    result = simulate_batch(batch_of(runs))
    for row, run in enumerate(runs):
        check(result, row, simulated(run))


def test_a_batch_that_does_not_fit_together(runs: list[Run]) -> None:
    other = run_of(VALVE, {}, "2021-07-06T00:00", 24)
    with pytest.raises(ConfigurationError, match="number of steps"):
        simulate_batch(batch_of([runs[0], other]))
