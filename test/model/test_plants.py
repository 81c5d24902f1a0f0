"""The tick on arrays against the tick of one plant, from the same states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, field_capacity_sites, sites
from places import CONFIG

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.model.plants import Moved, Plants
from greenroof_ros.model.sites import Sites
from greenroof_ros.physics.plant import Flows, Plant
from greenroof_ros.site.site import Site, read_site

VALVE = read_site(CONFIG / "site_valve.yaml")
NO_MAINS = replace(VALVE, mains_level=None, mains_flow=None)
DRIP = replace(VALVE, a_hat=-1e9)  # 12 l in a minute
KEPT = replace(VALVE, drainage_to_cistern=0.7, a1=1.0)

KINDS = [PAPER_SITE, VALVE, NO_MAINS, KEPT, DRIP]
MOST = 6


def split(drawn: list[Site]) -> list[list[Site]]:
    """Return the sites of each kind, which are stepped together."""
    every = Sites.of(drawn)
    kinds = list(zip(
        every.has_field_capacity.tolist(), every.has_short_ticks.tolist(),
        (every.drainage_to_cistern > 0).tolist(), strict=True,
    ))
    return [
        [site for site, own in zip(drawn, kinds, strict=True) if own == kind]
        for kind in set(kinds)
    ]


def some(random: np.random.Generator, share: float, values: np.ndarray) -> np.ndarray:
    """Return a share of values at random, and 0 for the others."""
    return np.where(random.random(len(values)) < share, values, 0.0)


@settings(max_examples=60)
@given(
    drawn=st.lists(
        st.sampled_from(KINDS) | sites() | field_capacity_sites(), min_size=1, max_size=MOST,
    ),
    tau=st.sampled_from([1.0, 10.0, 60.0, 60.0, 300.0, 3600.0]),
    seed=st.integers(0, 2**32 - 1),
)
@example(KINDS, 60.0, 1)
@example(KINDS, 60.0, 2)
@example(KINDS, 300.0, 3)
def test_each_tick_is_that_of_one_plant(drawn: list[Site], tau: float, seed: int) -> None:
    """To 1e-10 of what a tick of the site adds up. The weather lasts for some ticks."""
    random = np.random.default_rng(seed)
    for together in split([replace(site, tau=tau) for site in drawn]):
        every, n = Sites.of(together), len(together)
        x1 = every.a1 * random.choice([every.z_o * random.random(n) * 1.3, every.mains_level])
        x2 = every.x2_star * random.choice([
            random.uniform(0, 2, n), 1 - 10 ** random.uniform(-6, -1, n)
        ])
        fraction, level = random.choice([1.0, 0.1, 1.5], n), random.choice([1.0, 0.9], n)
        plants = Plants(every, x1, x2, fraction, level)
        single = [
            Plant(site, float(x1[row]), float(x2[row])) for row, site in enumerate(together)
        ]
        onoff = [
            OnOff(site, float(fraction[row]), float(level[row]))
            for row, site in enumerate(together)
        ]
        for _ in range(10):
            rain = some(random, random.choice([0.0, 0.6]), 10 ** random.uniform(-9, -4, n))
            evaporation = some(random, 0.9, 10 ** random.uniform(-9, -6, n))
            weather = rain, evaporation * every.a2
            plants.set_weather(*weather)
            valve = random.choice([0.0, 1.0, 0.3], n)
            valve = np.where(every.low_outlet_valve, valve, 1.0)
            allowed = None if random.random() < 0.5 else random.random(n) < 0.7
            for _ in range(int(random.integers(1, 6))):
                moved = plants.tick(valve, allowed)
                for row, plant in enumerate(single):
                    command = 0.0
                    if allowed is None or allowed[row]:
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
