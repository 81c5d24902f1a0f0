"""No water appears or vanishes, in any run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, SLOW, exact_flows, field_capacity_sites, run_of_hours, sites
from places import CONFIG

from greenroof_ros.controllers.outlet import OfController
from greenroof_ros.physics.plant import Plant, has_short_ticks
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site, read_site
from greenroof_ros.weather.series import WeatherSeries

FIELD_CAPACITY = replace(read_site(CONFIG / "site_neubrandenburg.yaml"), tau=10.0)
# Rain (m/s), evapotranspiration (m3/s), a command, the flow of an arbitrary pump driver (m3/s), or
# None if the command decides, and the share to which the valve is open.
TICKS = st.lists(
    st.tuples(
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 3),
        st.none() | st.floats(0, 1),
        st.sampled_from([0.0, 1.0]) | st.floats(0, 1),
    ),
    min_size=1,
    max_size=20,
)


@given(
    site=st.just(PAPER_SITE) | sites() | field_capacity_sites(),
    tau=st.sampled_from([0.01, 1.0, 10.0, 60.0, 300.0, 3600.0]) | st.floats(0.01, 3600.0),
    cistern=st.floats(0, 12) | st.just(0.0),
    roof=st.floats(0, 4) | st.just(0.0),
    ticks=TICKS,
)
@example(PAPER_SITE, 1.0, 0.04, 2e-6, [(0.0, 1e-3, 0.0, 0.3, 1.0)] * 5)
@example(replace(PAPER_SITE, a1=5 / 3), 60.0, 2.027, 1.0, [(2e-5, 0.0, 0.0, None, 1.0)] * 5)
@example(replace(PAPER_SITE, K=1e-3), 300.0, 1.0, 1.1, [(0.0, 0.0, 0.0, None, 1.0)] * 5)
def test_each_tank_changes_by_what_flows(
    site: Site, tau: float, cistern: float, roof: float,
    ticks: list[tuple[float, float, float, float | None, float]],
) -> None:
    """Each tick, to rounding; flows are limited only if they would overdraw a tank.

    A field-capacity soil counts with its substrate and drainage layer together. The cistern's
    outflow includes both outlets, Eq. (2) for each: at most what stands above them and flows in,
    with what drains off the roof into the cistern. Pumps fill
    the roof to its target, and rain raises it further.
    """
    site = replace(site, tau=tau)
    plant = Plant(site, cistern * site.a1, roof * site.z_cap)
    assert plant.layer == site.initial_layer
    short, target = has_short_ticks(site), site.a2 * site.z_veg
    kept = site.drainage_to_cistern
    for rain, evaporated, command, external, valve in ticks:
        valve = valve if site.low_outlet_valve else 1.0
        x1, x2, stored = plant.x1, plant.x2, plant.x2 + plant.layer
        demand = exact_flows(site, x1, x2, command, valve)
        commanded = plant.flows(rain, evaporated, command, outlet=valve)
        if short and not commanded.limited:
            assert commanded.pump == pytest.approx(demand[1], rel=1e-9, abs=1e-12)
        pump = demand[1] if short else commanded.pump
        # In a long tick rain and mains can raise the cistern before and while they run.
        raised = rain * site.a_in * site.runoff_coefficient + (site.mains_flow or 0.0)
        _, most, _ = exact_flows(site, x1 if short else x1 + tau * raised, x2, command)
        assert 0 <= pump <= most * (1 + 1e-9)
        assert pump == 0 or pump * tau >= demand[1] * min(1, tau) * (1 - 1e-9)
        pump = pump if external is None else external
        flows = plant.flows(rain, evaporated, command, external, valve)
        plant.step(rain, flows)

        inflow = rain * site.a_in * site.runoff_coefficient
        drained_in = kept * flows.drainage
        into_cistern = inflow + flows.mains + drained_in
        gain_1 = tau * (into_cistern - flows.outflow - flows.pump)
        arrived = rain * site.a2 + flows.pump
        gain_2 = tau * (arrived - flows.evapotranspiration - flows.drainage)
        # Of the largest volumes that were added up.
        precision = 1e-9 * max(1.0, x1 + tau * into_cistern, stored + tau * arrived)
        assert plant.x1 - x1 == pytest.approx(gain_1, abs=precision)
        assert plant.x2 + plant.layer - stored == pytest.approx(gain_2, abs=precision)
        assert min(plant.x1, plant.x2, plant.layer, *flows[:4], flows.mains) >= 0
        assert plant.layer <= site.layer_storage + precision
        assert flows.evapotranspiration <= evaporated
        assert flows.mains <= (site.mains_flow or 0.0) * (1 + 1e-9)
        if flows.mains > 0:
            lowest = min(x1, x1 + gain_1 - tau * (flows.mains + drained_in))
            assert lowest <= site.a1 * (site.mains_level or 0.0) + precision

        assert 0 <= flows.low_outlet <= flows.outflow * (1 + 1e-12)
        assert flows.low_outlet == 0 or (site.low_outlet_level is not None and valve > 0)
        lowest = site.min_outlet_level if valve else site.z_o
        above = x1 + tau * into_cistern - site.a1 * lowest
        overdrawn = 1e-4 * site.a1 if short else 0.0
        assert tau * flows.outflow <= max(0.0, above) + overdrawn + precision
        if not short and flows.pump > 0 and external is None:
            assert plant.x2 <= target + tau * rain * site.a2 + precision
        # What would be left without a limit, in the cistern and then on the roof. In a short tick
        # the drainage comes at its end.
        outflow, late = (demand[0], drained_in) if short else (flows.outflow, 0.0)
        left_1 = x1 + tau * (into_cistern - late - outflow - pump)
        if flows.pump == pump and not flows.limited:
            assert left_1 > -precision
            assert flows.outflow == pytest.approx(outflow, rel=1e-9)
        elif left_1 < -precision:
            if late == drained_in:
                assert plant.x1 == pytest.approx(tau * late, abs=precision)
            if short:
                assert flows.outflow * pump == pytest.approx(demand[0] * flows.pump, rel=1e-9)
        if site.field_capacity is not None:
            continue
        drained = demand[2]
        if drained and 2 * site.K * tau > 1e-4:
            drained = min(drained, (x2 - site.z_cap) / tau + arrived)
        left_2 = x2 + tau * (arrived - evaporated - drained)
        if min(abs(left_1), abs(left_2)) > precision and short:
            assert flows.limited == (left_1 < 0 or left_2 < 0)
        if left_2 > precision:
            assert (flows.evapotranspiration, flows.drainage) == pytest.approx(
                (evaporated, drained), rel=1e-9, abs=precision / tau
            )
        elif left_2 < -precision:
            assert plant.x2 == pytest.approx(0, abs=precision)


@settings(max_examples=40)
@given(
    hours=st.lists(
        st.tuples(st.floats(0, 500), st.floats(0, 50), st.just(False)), min_size=1, max_size=3
    ),
    x1=st.floats(0, 200),
    x2=st.floats(0, 70),
    v=st.floats(0.01, 3),
    site=st.sampled_from([SLOW, FIELD_CAPACITY]),
)
@example([(0.0, 50.0, False)], 0.0, 0.1, 1.0, SLOW)
def test_any_run_balances(
    hours: list[tuple[float, float, bool]], x1: float, x2: float, v: float, site: Site
) -> None:
    """Random hours, from drought to the worst plausible rain, in ticks of 10 s."""
    simulation = Simulation(run_of_hours(hours, x1, x2, site, fraction=v))
    ticks, metrics = list(simulation.ticks()), simulation.metrics
    rain = site.tau * sum(tick.precipitation for tick in ticks[:-1])
    collected = rain * site.a_in * site.runoff_coefficient
    gain_1 = collected - metrics["outflow_m3"] - metrics["pumped_m3"]
    leaves = metrics["drainage_m3"] + metrics["evapotranspiration_m3"]
    gain_2 = rain * site.a2 + metrics["pumped_m3"] - leaves
    assert ticks[-1].x1 - x1 == pytest.approx(gain_1, abs=1e-9)
    stored = ticks[-1].x2 + ticks[-1].layer - x2 - site.initial_layer
    assert stored == pytest.approx(gain_2, abs=1e-9)
    if site.drainage_storage is not None:
        assert metrics["final_layer_m3"] == ticks[-1].layer
    assert metrics["rain_m3"] == pytest.approx(collected + rain * site.a2, rel=1e-9)
    assert (metrics["final_cistern_m3"], metrics["final_roof_m3"]) == (ticks[-1].x1, ticks[-1].x2)
    assert metrics["limited_steps"] == sum(tick.flows.limited for tick in ticks[:-1])


class RandomController:
    """Pumps and opens the valve at random."""

    parameters: ClassVar[tuple[()]] = ()
    needs_forecast: ClassVar[bool] = False

    def __init__(self, seed: int) -> None:
        shares = np.random.default_rng(seed).uniform(-1.0, 2.0, 1000).clip(0.0, 1.0)
        self._shares: Iterator[float] = itertools.cycle(shares.tolist())
        self.outlet = 0.0

    def command(self, *inputs: Any) -> float:
        """Return the next command; two of three are 0 or 1."""
        self.outlet = next(self._shares)
        return next(self._shares)

    def skip(self) -> None:
        """Open the valve at random in frost, too."""
        self.outlet = next(self._shares)

    def statistics(self) -> None:
        """It has no solver."""


# Of each hour: rain (mm/h), evapotranspiration (mm/day), frost, and the minutes in which it rains.
WEATHER = st.lists(
    st.tuples(
        st.sampled_from([0.0, 500.0]) | st.floats(0, 100), st.floats(0, 50), st.booleans(),
        st.none() | st.sets(st.integers(0, 59), min_size=1),
    ),
    min_size=1, max_size=2,
)


@settings(max_examples=100)
@given(
    hours=WEATHER, site=st.just(PAPER_SITE) | sites() | field_capacity_sites(),
    tau=st.sampled_from([1.5, 10.0, 60.0, 90.0, 300.0, 1800.0, 3600.0]), frost=st.booleans(),
    kept=st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0),
    cistern=st.floats(0, 1.5), roof=st.floats(0, 1.2), seed=st.integers(0, 2**32),
)
def test_any_storm_balances(
    hours: list[tuple[float, float, bool, set[int] | None]], site: Site, tau: float, frost: bool,
    kept: float, cistern: float, roof: float, seed: int,
) -> None:
    """What is stored changes by rain and mains, less what evaporates and reaches the sewer.

    With any valve and pump commands, rain by the hour or the minute, and drainage that is kept.
    """
    site = replace(
        site, tau=tau, drainage_to_cistern=kept,
        valve_closed_in_frost=site.low_outlet_valve and frost,
    )
    x1, x2 = cistern * site.a1 * site.z_o, roof * site.z_cap
    run = run_of_hours([hour[:3] for hour in hours], x1, x2, site)
    minutes = np.full((len(hours), 60), np.nan)
    for row, (rain, _, _, wet) in zip(minutes, hours, strict=True):
        if wet is not None:
            row[:] = [60 / len(wet) * rain if minute in wet else 0.0 for minute in range(60)]
    weather = replace(run.weather, minutes=minutes)
    run = replace(
        run, weather=weather, series=WeatherSeries(weather, site, run.start, run.steps)
    )
    controller = RandomController(seed)
    valve = OfController(controller) if site.low_outlet_valve else None
    simulation = Simulation(run, controller, valve)
    ticks, metrics = list(simulation.ticks()), simulation.metrics.results()

    fallen = sum(hour[0] for hour in hours) / 1000
    rain = fallen * (site.a2 + site.a_in * site.runoff_coefficient)
    low_outlet = tau * sum(tick.flows.low_outlet for tick in ticks[:-1])
    drained = metrics["drainage_m3"]
    stored = ticks[-1].x1 + ticks[-1].x2 + ticks[-1].layer - x1 - x2 - site.initial_layer
    gained = metrics["rain_m3"] + metrics.get("mains_m3", 0.0)
    lost = metrics["evapotranspiration_m3"] + metrics["discharge_m3"]
    largest = max(1.0, *(tick.x1 + tick.x2 + tick.layer for tick in ticks))
    precision = 1e-11 * (len(ticks) + 100) * (largest + gained + lost + metrics["pumped_m3"])
    assert metrics["rain_m3"] == pytest.approx(rain, rel=1e-9)
    assert stored == pytest.approx(gained - lost, abs=precision)
    assert metrics["discharge_m3"] == pytest.approx(
        metrics["overflow_m3"] + low_outlet + (1 - kept) * drained, abs=precision
    )
    assert metrics["wet_discharge_m3"] <= metrics["discharge_m3"] + precision
    for tick in ticks:
        if site.low_outlet_valve and (tick.outlet == 0 or (frost and tick.frost)):
            assert tick.flows.low_outlet == 0
