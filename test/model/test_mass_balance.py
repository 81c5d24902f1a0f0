"""No water appears or vanishes, in any run."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, SLOW, exact_flows, measured_sites, run_of_hours, sites
from places import CONFIG

from greenroof_ros.experiment.closed_loop import Simulation
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import Site, read_site

MEASURED = replace(read_site(CONFIG / "site_neubrandenburg.yaml"), tau=10.0)
# Rain (m/s), evapotranspiration (m3/s), a command, and the flow of an arbitrary pump driver (m3/s),
# or None if the command decides.
TICKS = st.lists(
    st.tuples(
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 3),
        st.none() | st.floats(0, 1),
    ),
    min_size=1,
    max_size=20,
)


@given(
    site=st.just(PAPER_SITE) | sites() | measured_sites(),
    cistern=st.floats(0, 12) | st.just(0.0),
    roof=st.floats(0, 4) | st.just(0.0),
    ticks=TICKS,
)
@example(site=PAPER_SITE, cistern=0.04, roof=2e-6, ticks=[(0.0, 1e-3, 0.0, 0.3)] * 5)
def test_each_tank_changes_by_what_flows(
    site: Site, cistern: float, roof: float, ticks: list[tuple[float, float, float, float | None]]
) -> None:
    """Each tick, to 1e-9 m3; flows are limited only if they would overdraw a tank.

    A measured soil counts with its substrate and drainage layer together. The cistern's outflow
    includes both outlets, Eq. (2) for each.
    """
    plant = Plant(site, cistern * site.a1, roof * site.z_cap)
    assert plant.layer == site.initial_layer
    tau = site.tau
    for rain, evaporated, command, external in ticks:
        x1, x2, stored = plant.x1, plant.x2, plant.x2 + plant.layer
        demand = exact_flows(site, x1, x2, command)
        assert plant.pump_flow(command) == pytest.approx(demand[1], rel=1e-9, abs=1e-12)
        pump = plant.pump_flow(command) if external is None else external
        flows = plant.flows(rain, evaporated, pump)
        plant.step(rain, flows)

        into_cistern = rain * site.a_in * site.runoff_coefficient
        if site.mains_flow is not None and x1 / site.a1 < (site.mains_level or 0.0):
            into_cistern += site.mains_flow
        gain_1 = tau * (into_cistern - flows.outflow - flows.pump)
        leaves = flows.evapotranspiration + flows.drainage
        gain_2 = tau * (rain * site.a2 + flows.pump - leaves)
        assert plant.x1 - x1 == pytest.approx(gain_1, abs=1e-9)
        assert plant.x2 + plant.layer - stored == pytest.approx(gain_2, abs=1e-9)
        assert min(plant.x1, plant.x2, plant.layer, *flows[:4]) >= 0
        assert plant.layer <= site.layer_storage * (1 + 1e-12)
        assert flows.evapotranspiration <= evaporated

        # What would be left without a limit, in the cistern and then on the roof.
        left_1 = x1 + tau * (into_cistern - demand[0] - pump)
        if left_1 > 1e-9:
            assert (flows.outflow, flows.pump) == pytest.approx((demand[0], pump), rel=1e-9)
        elif left_1 < -1e-9:
            assert plant.x1 == pytest.approx(0, abs=1e-9)
            assert flows.outflow * pump == pytest.approx(demand[0] * flows.pump, rel=1e-9)
        if site.field_capacity is not None:
            continue
        left_2 = x2 + tau * (rain * site.a2 + flows.pump - evaporated - demand[2])
        if min(abs(left_1), abs(left_2)) > 1e-9:
            assert flows.limited == (left_1 < 0 or left_2 < 0)
        if left_2 > 1e-9:
            expected = (evaporated, demand[2])
            assert (flows.evapotranspiration, flows.drainage) == pytest.approx(expected, rel=1e-9)
        elif left_2 < -1e-9:
            assert plant.x2 == pytest.approx(0, abs=1e-9)


@settings(max_examples=40)
@given(
    hours=st.lists(
        st.tuples(st.floats(0, 500), st.floats(0, 50), st.just(False)), min_size=1, max_size=3
    ),
    x1=st.floats(0, 200),
    x2=st.floats(0, 70),
    v=st.floats(0.01, 3),
    site=st.sampled_from([SLOW, MEASURED]),
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
