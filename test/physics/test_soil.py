"""The field-capacity soil, by hand: its differential equations have solutions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, field_capacity_sites, site_with

from greenroof_ros.physics.plant import Plant
from greenroof_ros.physics.soil import FieldCapacitySoil, soil_of
from greenroof_ros.site.site import Site

# 100 m2 and 100 mm of substrate: 2 m3 at the wilting point, 6 m3 at field capacity, stress below 4
# m3. Its layer holds 1 m3 and then loses 1 m3 in 100 s.
ROOF = replace(
    site_with(a2=100.0, z_soil=0.1, z_veg=0.045), z_cap=6.0,
    field_capacity=0.6, wilting_point=0.2, depletion_fraction=0.5,
    drainage_storage=0.01, drainage_time=100.0,
)
SOIL, PAPER_SOIL = FieldCapacitySoil(ROOF), soil_of(PAPER_SITE)


@pytest.mark.parametrize(
    ("x2", "filled", "retained", "stress"),
    [
        (0.0, 0.0, 1.0, 0.0),
        (2.0, 0.0, 1.0, 0.0),
        (3.0, 0.25, 0.9375, 0.5),
        (4.0, 0.5, 0.75, 1.0),
        (5.0, 0.75, 0.4375, 1.0),
        (6.0, 1.0, 0.0, 1.0),
        (9.0, 1.0, 0.0, 1.0),
    ],
)
def test_shares_by_hand(x2: float, filled: float, retained: float, stress: float) -> None:
    """S, 1 - S^2, and FAO-56's Eq. 84 with TAW = 4 m3: at D_r = 3 m3 it is (4 - 3) / 2."""
    assert SOIL.filled_share(x2) == pytest.approx(filled, abs=1e-15)
    assert SOIL.retained_share(x2) == pytest.approx(retained, abs=1e-15)
    assert SOIL.water_stress(x2) == pytest.approx(stress, abs=1e-15)
    assert (x2 < SOIL.stress_volume) == (stress < 1)
    assert (PAPER_SOIL.retained_share(x2), PAPER_SOIL.water_stress(x2)) == (1.0, 1.0)


def test_percolation_by_hand() -> None:
    """At 5 m3 9/16 of what arrives; above field capacity all of it, plus the excess, in a tick.

    In any step water first fills the soil to the wilting point; then S becomes
    tanh(artanh S + i/4).
    """
    assert SOIL.drained(5.0, 0.01, 1e-5) == pytest.approx(0.005625, rel=1e-6)
    assert SOIL.drained(6.5, 0.01, 10.0) == pytest.approx(0.06, rel=1e-12)
    for x2, arriving, stays in (
        (3.0, 1e-3, 4 * math.tanh(math.atanh(0.25) + 0.25) - 1), (1.5, 2e-4, 0.2),
        (1.5, 1e-3, 0.5 + 4 * math.tanh(0.125)),
    ):
        passed = 1000 * SOIL.drained(x2, arriving, 1000.0)
        assert passed == pytest.approx(1000 * arriving - stays, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("x2", [1.0, 2.0, 4.0, 5.9, 5.9999])
def test_water_to_fill(x2: float) -> None:
    """Up to 2 m3 all water stays; then S = tanh(i/4), the solution of dS/dt = (1 - S^2) i / 4."""
    needed = x2 if x2 <= 2 else 2 + 4 * math.atanh((x2 - 2) / 4)
    assert SOIL.water_to_fill(x2) == pytest.approx(needed, rel=1e-9)
    assert float(SOIL.fill_empty(np.array(needed))) == pytest.approx(x2, rel=1e-9)
    assert PAPER_SOIL.water_to_fill(x2) == x2


def test_a_step_by_hand() -> None:
    """5 m3 on the roof, 0.01 m3/s of rain for 2 s, demand 1e-3 m3/s, and all of it evaporates.

    At first 7/16 of the rain stay, and S becomes tanh(artanh(3/4) + 0.02/4).
    """
    plant = Plant(replace(ROOF, tau=2.0), 50.0, 5.0)
    flows = plant.flows(1e-4, 1e-3, 0.0)
    assert flows.evapotranspiration == 1e-3
    assert not flows.limited
    plant.step(1e-4, flows)
    wet = 2 + 4 * math.tanh(math.atanh(0.75) + 0.005)
    assert wet == pytest.approx(5 + 0.02 * 7 / 16, abs=1e-4)
    assert plant.x2 == pytest.approx(wet - 2e-3, rel=1e-12)
    assert plant.layer == pytest.approx(5 + 0.02 - wet - 2 * flows.drainage, rel=1e-9)


BARE = replace(ROOF, drainage_storage=None, drainage_time=None)


@pytest.mark.parametrize(
    ("site", "layer", "inflow", "seconds", "outflow"),
    [
        # Without inflow V / (1 + k V t): a full layer has half of it after the time constant.
        (ROOF, 1.0, 0.0, 100.0, 0.005), (ROOF, 1.0, 0.0, 1e9, 1e-9),
        # With inflow sqrt(i / k) tanh(sqrt(i k) t + artanh(V / sqrt(i / k))), here tanh(1 + ...).
        (ROOF, 0.5, 0.01, 100.0, 0.01 + (0.5 - math.tanh(1 + math.atanh(0.5))) / 100),
        # It holds 1 m3; the rest of 10 m3 that arrive in a second is gone.
        (ROOF, 0.0, 10.0, 1.0, 9.0), (ROOF, 1.0, 10.0, 1.0, 10.0),
        # Without a layer everything passes at once.
        (BARE, 0.0, 0.125, 1.0, 0.125),
    ],
)
def test_a_layer_by_hand(
    site: Site, layer: float, inflow: float, seconds: float, outflow: float
) -> None:
    computed = FieldCapacitySoil(site).layer_outflow(layer, inflow, seconds)
    assert computed == pytest.approx(outflow, rel=1e-6 if seconds > 1e6 else 1e-12)


@pytest.mark.parametrize(
    ("x2", "rain", "potential", "left"),
    [
        # First the rain, as above. Then all the potential evaporates down to 4 m3; below it,
        # exp(-e/2) of what is above 2 m3 stays.
        (5.5, 0.0, 0.5, 5.0), (6.0, 2.0, 0.5, 5.5), (1.5, 0.2, 1.0, 1.7),
        (5.0, 0.0, 2.0, 2 + 2 * math.exp(-0.5)),
        (3.0, 1.0, 1.0, 2 + 4 * math.tanh(math.atanh(0.25) + 0.25) * math.exp(-0.5)),
        (1.0, 1.5, 1.0, 2 + 4 * math.tanh(0.125) * math.exp(-0.5)),
    ],
)
def test_a_long_step_by_hand(x2: float, rain: float, potential: float, left: float) -> None:
    """With rain and evapotranspiration in m3; predicted for a step, and for several roofs."""
    rates = (np.array([amount / 3600]) for amount in (rain / ROOF.a2, potential))
    (change,) = SOIL.predict_changes(x2, *rates, np.array([3600.0]))
    assert x2 + change == pytest.approx(left, rel=1e-9)
    roofs = SOIL.predict_volume(np.full(2, x2), rain, potential, 3600.0)
    assert roofs.tolist() == pytest.approx([left] * 2, rel=1e-9)


def lasting(x2: float, rain_m3: list[float], potential_m3: list[float]) -> list[float]:
    """Return the share that lasts over hours with this rain and evapotranspiration."""
    rain = np.array(rain_m3) / 3600 / ROOF.a2
    hours = np.full(len(rain_m3), 3600.0)
    weather = rain, np.array(potential_m3) / 3600, hours
    share = SOIL.predict_lasting_share(x2, SOIL.predict_changes(x2, *weather), *weather)
    return list(share)


def test_what_lasts_of_water_on_a_roof_in_rain() -> None:
    """4.5 m3 against 3 m3, S of 0.625 and 0.25, in rain of 1 and 2 m3: S = tanh(artanh S + i/4)."""
    wet, dry = (
        [4 * math.tanh(math.atanh(filled) + rain / 4) for rain in (0, 1, 3)]
        for filled in (0.625, 0.25)
    )
    ends = [(more - less) / 1.5 for more, less in zip(wet, dry, strict=True)]
    assert lasting(3.0, [1.0, 2.0], [0.0, 0.0]) == pytest.approx(
        [(ends[0] + ends[1]) / 2, (ends[1] + ends[2]) / 2], rel=1e-9
    )
    # A storm fills both to field capacity.
    assert lasting(3.0, [100.0, 0.0], [0.0, 0.0]) == pytest.approx([0.5, 0.001], rel=1e-6)


def test_what_lasts_of_water_on_a_roof_that_dries() -> None:
    """All of it while there is no stress; below 4 m3 exp(-e/2) of it, with a demand e."""
    assert lasting(4.4, [0.0] * 2, [0.1] * 2) == pytest.approx([1.0, 1.0], rel=1e-9)
    dry = FieldCapacitySoil(replace(ROOF, z_veg=0.035, x2_star=3.5))
    weather = np.zeros(1), np.array([2.0 / 3600]), np.array([3600.0])
    share = dry.predict_lasting_share(2.5, dry.predict_changes(2.5, *weather), *weather)
    assert share == pytest.approx([(1 + math.exp(-1)) / 2], rel=1e-9)


@settings(max_examples=30)
@given(
    site=field_capacity_sites(),
    x2=st.floats(0, 1.5),
    ticks=st.lists(
        st.tuples(st.floats(0, 1e-4) | st.just(0.0), st.floats(0, 1e-3)), min_size=1, max_size=20
    ),
)
def test_what_is_followed_is_what_the_plant_did(
    site: Site, x2: float, ticks: list[tuple[float, float]]
) -> None:
    """From the substrate's volumes alone, bit for bit."""
    plant = Plant(site, 0.0, x2 * site.z_cap)
    states, flows = [], []
    for rain, potential in ticks:
        states.append((plant.x2, plant.layer))
        flows.append(plant.flows(rain, potential, 0.0))
        plant.step(rain, flows[-1])
    volumes, layers = zip(*states, strict=True)
    rain, potential = np.array(ticks).T
    evaporated, layer = soil_of(site).reconstruct_losses(
        layers[0], np.array(volumes), rain, np.zeros_like(rain), potential,
        np.array([flow.drainage for flow in flows]), np.full_like(rain, site.tau),
    )
    assert layer.tolist() == list(layers)
    assert evaporated == pytest.approx(
        [flow.evapotranspiration for flow in flows], rel=1e-12, abs=1e-15
    )
