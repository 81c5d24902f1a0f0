"""The tick on arrays against the tick of one plant, from the same states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, measured_sites, sites

from greenroof_ros.model.plant import Flows, Plant
from greenroof_ros.model.plants import Plants
from greenroof_ros.model.site import Site
from greenroof_ros.model.sites import Sites

# Rain (m/s), evapotranspiration off a bed (m/s), a command, and the share of the valve.
TICK = st.tuples(
    st.just(0.0) | st.floats(1e-9, 1e-4), st.just(0.0) | st.floats(1e-10, 1e-6),
    st.just(0.0) | st.floats(0.1, 2.0), st.sampled_from([0.0, 1.0]) | st.floats(0.01, 1),
)
# Share of the cistern up to its outlet, and of the roof's capacity.
STATE = st.tuples(st.floats(0, 1.3), st.floats(0, 1.1) | st.just(1.0))


def split(drawn: list[Site]) -> list[list[Site]]:
    """Return the sites of each kind, which can be stepped together."""
    every = Sites.of(drawn)
    kinds = list(zip(every.measured.tolist(), every.has_short_ticks.tolist(), strict=True))
    return [
        [site for site, own in zip(drawn, kinds, strict=True) if own == kind]
        for kind in set(kinds)
    ]


@settings(max_examples=200)
@given(
    drawn=st.lists(st.just(PAPER_SITE) | sites() | measured_sites(), min_size=1, max_size=4),
    tau=st.sampled_from([0.5, 1.0, 10.0, 60.0, 300.0, 3600.0]),
    states=st.lists(STATE, min_size=4, max_size=4),
    ticks=st.lists(st.lists(TICK, min_size=4, max_size=4), min_size=1, max_size=8),
)
def test_each_tick_is_that_of_one_plant(
    drawn: list[Site], tau: float, states: list[tuple[float, float]],
    ticks: list[list[tuple[float, float, float, float]]],
) -> None:
    """To 1e-10 of the largest volume that a tick of the site adds up."""
    for together in split([replace(site, tau=tau) for site in drawn]):
        every = Sites.of(together)
        x1, x2 = np.array(states[: len(together)]).T
        x1, x2 = x1 * every.a1 * every.z_o, x2 * every.z_cap
        single = [Plant(site, *state) for site, state in zip(
            together, zip(x1.tolist(), x2.tolist(), strict=True), strict=True
        )]
        plants = Plants(every, x1, x2)
        for tick in ticks:
            rain, potential, command, valve = np.array(tick[: len(together)]).T
            potential = potential * every.a2
            valve = np.where(every.low_outlet_valve, valve, 1.0)
            for name in ("x1", "x2", "layer"):
                setattr(plants, name, np.array([getattr(plant, name) for plant in single]))
            moved = plants.tick(rain, potential, command, valve)
            for row, plant in enumerate(single):
                flows = plant.flows(
                    float(rain[row]), float(potential[row]), float(command[row]),
                    outlet=float(valve[row]),
                )
                held = plant.x1 + plant.x2 + plant.layer
                plant.step(float(rain[row]), flows)
                held += plant.x1 + plant.x2 + tau * (
                    sum(flows) + rain[row] * every.effective_catchment[row]
                )
                for name in Flows._fields:
                    expected = getattr(flows, name) * (1 if name == "limited" else tau)
                    found = getattr(moved, name)[row]
                    assert abs(found - expected) <= 1e-10 * held, (name, found, expected)
                for name in ("x1", "x2", "layer"):
                    expected, found = getattr(plant, name), getattr(plants, name)[row]
                    assert abs(found - expected) <= 1e-10 * held, (name, found, expected)
