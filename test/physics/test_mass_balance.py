"""No water appears or vanishes, in any tick of any site, and in any run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paper import ANY_SITE, PAPER_SITE, exact_flows, run_in, weather_of

from greenroof_ros.controllers.outlet import POLICIES
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site

# Mains water flows in while the pumps empty the cistern.
KEPT = replace(
    PAPER_SITE, a1=1.0, mains_level=0.5, mains_flow=0.01, drainage_to_cistern=1.0,
    z_cap=13.76, field_capacity=0.4, wilting_point=0.0, depletion_fraction=0.5,
)
# Rain (m/s), evapotranspiration (m3/s), a command, the flow of an arbitrary pump driver (m3/s), or
# NaN if the command decides, and the share to which the valve is open.
TICKS = st.lists(
    st.tuples(
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 1e-3) | st.just(0.0),
        st.floats(0, 3),
        st.just(OWN_PUMPS) | st.floats(0, 1),
        st.sampled_from([0.0, 1.0]) | st.floats(0, 1),
    ),
    min_size=1,
    max_size=20,
)


@given(
    site=ANY_SITE,
    tau=st.sampled_from([0.01, 1.0, 10.0, 60.0, 300.0, 3600.0]) | st.floats(0.01, 3600.0),
    cistern=st.floats(0, 12) | st.just(0.0),
    roof=st.floats(0, 4) | st.just(0.0),
    ticks=TICKS,
    other=st.just(0.0) | st.floats(0, 1e-3),
)
@example(PAPER_SITE, 1.0, 0.04, 2e-6, [(0.0, 1e-3, 0.0, 0.3, 1.0)] * 5, 2e-3)
@example(replace(PAPER_SITE, a1=5 / 3), 60.0, 2.027, 1.0, [(2e-5, 0, 0, OWN_PUMPS, 1.0)] * 5, 0.0)
@example(KEPT, 60.0, 1.25, 0.02, [(4.8e-6, 0.0, 0.0, 1.0, 1.0)], 0.0)
@example(replace(PAPER_SITE, K=1e-3), 300.0, 1.0, 1.1, [(0, 0, 0, OWN_PUMPS, 1.0)] * 5, 0.0)
def test_each_tank_changes_by_what_flows(
    site: Site, tau: float, cistern: float, roof: float,
    ticks: list[tuple[float, float, float, float, float]], other: float,
) -> None:
    """Each tick, to rounding. A field-capacity soil counts with its layer."""
    site = replace(site, tau=tau)
    p, state = plant_parameters(site), State(cistern * site.a1, roof * site.z_cap, 0.0)
    state = state._replace(layer=site.initial_layer)
    for rain, evaporated, command, pumped, valve in ticks:
        valve = valve if site.low_outlet_valve else 1.0
        after, flows = step(p, state, rain, evaporated, command, valve, pumped, other)
        into_cistern = rain * site.a_in * site.runoff_coefficient + flows.mains
        into_cistern += site.drainage_to_cistern * flows.drainage
        gain_1 = tau * (into_cistern - flows.outflow - flows.pump - flows.other)
        arrived = rain * site.a2 + flows.pump
        gain_2 = tau * (arrived - flows.evapotranspiration - flows.drainage)
        # Of the largest volumes that were added up.
        stored = state.roof + state.layer
        precision = 1e-9 * max(1.0, state.cistern + tau * into_cistern, stored + tau * arrived)
        assert after.cistern - state.cistern == pytest.approx(gain_1, abs=precision)
        assert after.roof + after.layer - stored == pytest.approx(gain_2, abs=precision)
        assert min(*after, *flows) >= 0
        assert after.layer <= site.layer_storage + precision
        assert flows.evapotranspiration <= evaporated
        # Other uses take all that they need from what is above the suction level, or the mains'.
        suction = site.a1 * (site.z_pump + site.z_H)
        assert flows.other == 0 or after.cistern >= suction - precision
        assert flows.other == other or after.cistern <= suction + precision
        check_cistern(site, state.cistern, flows, valve, state.cistern + tau * into_cistern)
        if pumped != pumped:
            check_pumps(site, state, after, flows, rain, command)
        state = after


def check_cistern(site: Site, x1: float, flows: Flows, valve: float, arrived: float) -> None:
    """No outlet takes more than what is above it and flows in, mains fill up to their level only.

    Euler's method, in short ticks, takes up to 0.1 mm more.
    """
    tau, precision = site.tau, 1e-9 * max(1.0, arrived)
    overdrawn = 1e-4 * site.a1 if plant_parameters(site).has_short_ticks else 0.0
    low, upper = flows.low_outlet, flows.outflow - flows.low_outlet
    assert tau * upper <= max(0.0, arrived - site.a1 * site.z_o) + overdrawn + precision
    lowest = site.min_outlet_level if valve else site.z_o
    assert tau * flows.outflow <= max(0.0, arrived - site.a1 * lowest) + overdrawn + precision
    assert low <= flows.outflow * (1 + 1e-12)
    assert low == 0 or (site.low_outlet_level is not None and valve > 0)
    assert flows.mains <= (site.mains_flow or 0.0) * (1 + 1e-9)
    without = min(x1, arrived - tau * (flows.outflow + flows.pump + flows.mains))
    if flows.mains > 0 and site.drainage_to_cistern == 0:
        assert without <= site.a1 * (site.mains_level or 0.0) + precision


def check_pumps(
    site: Site, state: State, after: State, flows: Flows, rain: float, command: float
) -> None:
    """The site's own pumps deliver at most their flow, for a second or more, up to the target."""
    short, tau = plant_parameters(site).has_short_ticks, site.tau
    # In a long tick rain and mains can raise the cistern before and while they run.
    raised = rain * site.a_in * site.runoff_coefficient + (site.mains_flow or 0.0)
    raised += site.drainage_to_cistern * flows.drainage
    now, most = (
        exact_flows(site, state.cistern + more, state.roof, command)[1]
        for more in (0.0, 0.0 if short else tau * raised)
    )
    assert flows.pump <= most * (1 + 1e-9)
    if short:
        assert flows.limited or flows.pump == pytest.approx(now, rel=1e-9, abs=1e-12)
    elif flows.pump > 0:
        assert flows.pump * tau >= now * min(1, tau) * (1 - 1e-9)
        # The solution for an exponent other than 2 has an error.
        precision = 1e-9 * max(1.0, tau * flows.pump)
        precision += 3e-5 * site.available_volume * (site.percolation_exponent != 2)
        assert after.roof <= site.a2 * site.z_veg + tau * rain * site.a2 + precision


# Of each hour: rain (mm/h), evapotranspiration (mm/day), temperature (degC), and the minutes in
# which it rains.
WEATHER = st.lists(
    st.tuples(
        st.sampled_from([0.0, 500.0]) | st.floats(0, 100), st.floats(0, 50),
        st.sampled_from([-1, 1]), st.sets(st.integers(0, 59), min_size=1),
    ),
    min_size=1, max_size=2,
)


@settings(max_examples=60)
@given(
    hours=WEATHER, site=ANY_SITE,
    tau=st.sampled_from([1.5, 10.0, 60.0, 90.0, 300.0, 1800.0, 3600.0]), closed=st.booleans(),
    kept=st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0),
    cistern=st.floats(0, 1.5), roof=st.floats(0, 1.2), policy=st.sampled_from(POLICIES),
    fraction=st.floats(0.01, 3),
)
def test_any_storm_balances(
    hours: list[tuple[float, float, float, set[int]]], site: Site, tau: float, closed: bool,
    kept: float, cistern: float, roof: float, policy: str, fraction: float,
) -> None:
    """What is stored changes by rain and mains, less what evaporates and reaches the sewer.

    With any policy of the valve, frost, rain in some minutes, and drainage that is kept.
    """
    site = replace(
        site, tau=tau, drainage_to_cistern=kept,
        valve_closed_in_frost=site.low_outlet_valve and closed,
    )
    rains = [
        [60 / len(minutes) * depth * (minute in minutes) for minute in range(60)]
        for depth, _, _, minutes in hours
    ]
    x1, x2 = cistern * site.a1 * site.z_o, roof * site.z_cap
    _, evaporation, temperatures, _ = (np.array(part) for part in zip(*hours, strict=True))
    weather = weather_of(rains, evaporation, temperature=temperatures)
    valve = {"outlet": policy} if site.low_outlet_valve else {}
    simulation = Simulation(run_in(weather, site, x1, x2, fraction=fraction, **valve))
    ticks = list(simulation.ticks())
    metrics = simulation.metrics.results(simulation.site.state).metrics

    fallen = sum(hour[0] for hour in hours) / 1000
    collected = fallen * site.a_in * site.runoff_coefficient
    low_outlet = tau * sum(tick.flows.low_outlet for tick in ticks[:-1])
    drained, other = metrics["drainage_m3"], metrics.get("other_m3", 0.0)
    mains = metrics.get("mains_m3", 0.0) - tau * sum(
        tick.flows.other_demand - tick.flows.other for tick in ticks[:-1]
    )
    largest = max(1.0, *(tick.x1 + tick.x2 + tick.layer for tick in ticks))
    moved = metrics["rain_m3"] + mains + metrics["discharge_m3"] + metrics["pumped_m3"] + other
    precision = 1e-11 * (len(ticks) + 100) * (largest + moved + metrics["evapotranspiration_m3"])
    assert metrics["rain_m3"] == pytest.approx(fallen * site.a2 + collected, rel=1e-9)
    assert ticks[-1].x1 - x1 == pytest.approx(
        collected + mains + kept * drained - metrics["outflow_m3"] - metrics["pumped_m3"] - other,
        abs=precision,
    )
    assert ticks[-1].x2 + ticks[-1].layer - x2 - site.initial_layer == pytest.approx(
        fallen * site.a2 + metrics["pumped_m3"] - metrics["evapotranspiration_m3"] - drained,
        abs=precision,
    )
    assert metrics["discharge_m3"] == pytest.approx(
        metrics["overflow_m3"] + low_outlet + (1 - kept) * drained, abs=precision
    )
    assert metrics["wet_discharge_m3"] <= metrics["discharge_m3"] + precision
    assert metrics["limited_steps"] == sum(tick.flows.limited for tick in ticks[:-1])
    for tick in ticks:
        if site.low_outlet_valve and (tick.outlet == 0 or (closed and tick.frost)):
            assert tick.flows.low_outlet == 0
