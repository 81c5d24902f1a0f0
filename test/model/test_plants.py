"""The tick on arrays against the tick of one plant, from the same states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, measured_sites, sites
from places import CONFIG

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.model.plant import Flows, Plant
from greenroof_ros.model.plants import Moved, Plants
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.model.sites import Sites

VALVE = read_site(CONFIG / "site_valve.yaml")
NO_MAINS = replace(VALVE, mains_level=None, mains_flow=None)
KEPT = replace(VALVE, drainage_to_cistern=0.7, a1=1.0)

# Rain (m/s) and evapotranspiration off a bed (m/s) of a site.
RAIN = st.just(0.0) | st.floats(1e-9, 1e-4)
EVAPORATION = st.just(0.0) | st.floats(1e-10, 1e-6)
# Whether the pumps may run, and the share of the valve.
ALLOWED = st.tuples(st.booleans(), st.sampled_from([0.0, 1.0]) | st.floats(0.01, 1))
# The fraction and the level of on/off control.
CONTROL = st.tuples(st.just(1.0) | st.floats(0.01, 2.0), st.just(1.0) | st.floats(0.5, 1.0))
# Share of the cistern up to its outlet, and of the roof's target.
STATES = st.tuples(
    st.floats(0, 1.3) | st.floats(0, 0.1),
    st.floats(0, 3) | st.floats(0.99, 1.01) | st.floats(0.99999, 1.0),
)
MOST = 4


def each(values: st.SearchStrategy[object]) -> st.SearchStrategy[list[object]]:
    """Return a value for each of the sites."""
    return st.lists(values, min_size=MOST, max_size=MOST)


def split(drawn: list[Site]) -> list[list[Site]]:
    """Return the sites of each kind, which can be stepped together."""
    every = Sites.of(drawn)
    kinds = list(zip(every.measured.tolist(), every.has_short_ticks.tolist(), strict=True))
    return [
        [site for site, own in zip(drawn, kinds, strict=True) if own == kind]
        for kind in set(kinds)
    ]


@settings(max_examples=150)
@given(
    drawn=st.lists(
        st.sampled_from([PAPER_SITE, VALVE, NO_MAINS, KEPT]) | sites() | measured_sites(),
        min_size=1, max_size=MOST,
    ),
    tau=st.sampled_from([0.5, 1.0, 10.0, 60.0, 300.0, 3600.0]),
    states=each(STATES),
    control=each(CONTROL),
    hours=st.lists(
        st.tuples(
            st.just([0.0] * MOST) | each(RAIN), each(EVAPORATION),
            st.lists(st.none() | each(ALLOWED), min_size=1, max_size=4),
        ), min_size=1, max_size=4,
    ),
)
def test_each_tick_is_that_of_one_plant(
    drawn: list[Site], tau: float, states: list[tuple[float, float]],
    control: list[tuple[float, float]],
    hours: list[tuple[list[float], list[float], list[list[tuple[float, float]] | None]]],
) -> None:
    """To 1e-10 of what a tick of the site adds up. The weather lasts for some ticks."""
    for together in split([replace(site, tau=tau) for site in drawn]):
        every, n = Sites.of(together), len(together)
        x1, x2 = np.array(states[:n]).T
        x1, x2 = x1 * every.a1 * every.z_o, x2 * every.x2_star
        single = [
            Plant(site, float(x1[row]), float(x2[row])) for row, site in enumerate(together)
        ]
        fraction, level = np.array(control[:n]).T
        plants = Plants(every, x1, x2, fraction, level)
        onoff = [OnOff(site, *of_site) for site, of_site in zip(together, control, strict=False)]
        for rain, potential, ticks in hours:
            weather = np.array(rain[:n]), np.array(potential[:n]) * every.a2
            plants.set_weather(*weather)
            for tick in ticks:
                allowed, valve = np.array((tick or [(True, 1.0)] * n)[:n]).T
                valve = np.where(every.low_outlet_valve, valve, 1.0)
                moved = plants.tick(valve, None if tick is None else allowed.astype(bool))
                for row, plant in enumerate(single):
                    command = 0.0
                    if allowed[row]:
                        command = onoff[row].command(*plant.levels(), (), ())
                    check(plant, plants, moved, row, *(
                        float(values[row]) for values in weather
                    ), command, float(valve[row]))


def check(
    plant: Plant, plants: Plants, moved: Moved, row: int, rain: float, potential: float,
    command: float, valve: float,
) -> None:
    """Compare a site's tick, and continue with the state of the one plant."""
    site, tau = plant._site, plant._tau
    flows = plant.flows(rain, potential, command, outlet=valve)
    held = plant.x1 + plant.x2 + plant.layer
    plant.step(rain, flows)
    held += plant.x1 + plant.x2 + tau * (sum(flows) + rain * site.effective_catchment)
    for name in Flows._fields:
        expected = getattr(flows, name) * (1 if name == "limited" else tau)
        found = getattr(moved, name)[row]
        assert abs(found - expected) <= 1e-10 * held, (name, found, expected)
    for name in ("x1", "x2", "layer"):
        expected, values = getattr(plant, name), getattr(plants, name)
        assert abs(values[row] - expected) <= 1e-10 * held, (name, values[row], expected)
        values[row] = expected
