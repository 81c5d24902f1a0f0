"""The field-capacity soil: by hand, where its differential equation has a solution, and by scipy.

Controllers predict the same soil in arrays.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE, site_with, tick_of
from scipy.integrate import solve_ivp

from greenroof_ros.controllers.roof import RoofPrediction
from greenroof_ros.physics.parameters import PlantParameters, State, plant_parameters
from greenroof_ros.physics.soil import (
    filled_share,
    layer_outflow,
    percolation,
    retained_share,
    water_stress,
    water_to_raise,
)
from greenroof_ros.physics.tick import OWN_PUMPS, step

# 100 m2 and 100 mm of substrate: 2 m3 at the wilting point, 6 m3 at field capacity, stress below 4
# m3. Its layer holds 1 m3 and then loses 1 m3 in 100 s.
ROOF = replace(
    site_with(a2=100.0, z_soil=0.1, z_veg=0.045), z_cap=6.0,
    field_capacity=0.6, wilting_point=0.2, depletion_fraction=0.5,
    drainage_storage=0.01, drainage_time=100.0,
)
BARE = replace(ROOF, drainage_storage=None, drainage_time=None)
SOIL, PAPER_SOIL = plant_parameters(ROOF), plant_parameters(PAPER_SITE)
ROOM, PAPER_ROOM = RoofPrediction(SOIL), RoofPrediction(PAPER_SOIL)
EXPONENTS = (1.0, 1.5, 2.0, 5.0, 10.0)


@pytest.mark.parametrize(("x2", "filled", "retained", "cubed", "stress"), [
    (0.0, 0.0, 1.0, 1.0, 0.0), (2.0, 0.0, 1.0, 1.0, 0.0),
    (3.0, 0.25, 0.9375, 0.984375, 0.5), (4.0, 0.5, 0.75, 0.875, 1.0),
    (5.0, 0.75, 0.4375, 0.578125, 1.0), (6.0, 1.0, 0.0, 0.0, 1.0), (9.0, 1.0, 0.0, 0.0, 1.0),
])
def test_shares_by_hand(
    x2: float, filled: float, retained: float, cubed: float, stress: float
) -> None:
    """S, 1 - S^2, 1 - S^3, and FAO-56's Eq. 84 with TAW = 4 m3: at D_r = 3 m3 it is (4 - 3) / 2."""
    third = SOIL._replace(percolation_exponent=3.0)
    found = filled_share(SOIL, x2), retained_share(SOIL, x2), retained_share(third, x2)
    assert found == pytest.approx((filled, retained, cubed), abs=1e-15)
    assert water_stress(SOIL, x2) == pytest.approx(stress, abs=1e-15)
    assert (x2 < SOIL.stress_volume) == (stress < 1)
    assert (retained_share(PAPER_SOIL, x2), water_stress(PAPER_SOIL, x2)) == (1.0, 1.0)


def test_percolation_by_hand() -> None:
    """At 5 m3 9/16 of what arrives; above field capacity all of it, plus the excess, in a tick.

    In any step water first fills the soil to the wilting point; then S becomes
    tanh(artanh S + i/4), or with an exponent of 1, 1 - (1 - S) exp(-i/4).
    """
    assert percolation(SOIL, 5.0, 0.01, 1e-5) == pytest.approx(0.005625, rel=1e-6)
    assert percolation(SOIL, 6.5, 0.01, 10.0) == pytest.approx(0.06, rel=1e-12)
    first = SOIL._replace(percolation_exponent=1.0)
    for soil, x2, arriving, stays in (
        (SOIL, 3.0, 1e-3, 4 * math.tanh(math.atanh(0.25) + 0.25) - 1), (SOIL, 1.5, 2e-4, 0.2),
        (SOIL, 1.5, 1e-3, 0.5 + 4 * math.tanh(0.125)), (first, 3.0, 1e-3, 3 - 3 * math.exp(-0.25)),
    ):
        passed = 1000 * percolation(soil, x2, arriving, 1000.0)
        assert passed == pytest.approx(1000 * arriving - stays, rel=1e-9, abs=1e-12)


def integrated(
    p: PlantParameters, x2: float, arriving: float, potential: float, seconds: float
) -> tuple[float, float]:
    """Return the volume after a time and the water that has passed (m3), by scipy."""

    def rates(_: float, state: Any) -> list[float]:
        filled = min(1.0, max(0.0, (state[0] - p.wilting_volume) / p.available_volume))
        passed = arriving * filled**p.percolation_exponent
        evaporated = potential * min(1.0, filled / p.stress_onset)
        return [arriving - passed - evaporated, passed]

    run = solve_ivp(rates, (0, seconds), [x2, 0.0], method="LSODA", rtol=1e-9, atol=1e-11)
    return float(run.y[0, -1]), float(run.y[1, -1])


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_any_exponent_in_a_tick(exponent: float) -> None:
    """To 2e-5 of what plants can take up, in ticks of a second to an hour, up to 100 mm.

    Controllers predict it to 1e-4, and the water that raises a soil is the inverse.
    """
    random = np.random.default_rng(round(10 * exponent))
    p = SOIL._replace(percolation_exponent=exponent)
    room = RoofPrediction(p)
    for seconds in (1.0, 60.0, 300.0, 3600.0) * 20:
        x2 = random.choice([random.uniform(0, 6), 6 - 10 ** random.uniform(-8, 0)])
        arrives = random.choice([10 * random.random(), 10 ** random.uniform(-6, 0)])
        passed = seconds * percolation(p, x2, arrives / seconds, seconds)
        after, expected = integrated(p, x2, arrives / seconds, 0.0, seconds)
        assert passed == pytest.approx(expected, abs=8e-5)
        assert room.predict_volume(x2, arrives, 0.0, seconds) == pytest.approx(after, abs=4e-4)
        needed = water_to_raise(p, x2, after)
        raised = x2 + needed - seconds * percolation(p, x2, needed / seconds, seconds)
        assert raised == pytest.approx(after, abs=8e-5)


@given(st.floats(1.0, 10.0), st.floats(0.0, 5.99))
def test_filling_an_empty_roof(exponent: float, x2: float) -> None:
    """Controllers and the tick need the same water, and its inverse leads back.

    Up to 2 m3 all water stays; then S = tanh(i/4) with an exponent of 2.
    """
    needed = x2 if x2 <= 2 else 2 + 4 * math.atanh((x2 - 2) / 4)
    assert ROOM.water_to_fill(x2) == pytest.approx(needed, rel=1e-9)
    assert ROOM.fill_empty(np.array(needed)) == pytest.approx(x2, rel=1e-9, abs=1e-12)
    p = SOIL._replace(percolation_exponent=exponent)
    room, needed = RoofPrediction(p), water_to_raise(p, 0.0, x2)
    assert room.water_to_fill(x2) == pytest.approx(needed, abs=1e-3)
    assert room.fill_empty(room.water_to_fill(np.array(x2))) == pytest.approx(x2, rel=1e-9)
    assert PAPER_ROOM.water_to_fill(x2) == water_to_raise(PAPER_SOIL, 0.0, x2) == x2


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_drainage_of_a_season(exponent: float) -> None:
    """Forty days: to 0.1 % in ticks of 15 minutes, and the error shrinks with the tick."""
    random, hours = np.random.default_rng(5), np.arange(40 * 24)
    rain = np.where(random.random(len(hours)) < 0.06, random.exponential(3.0, len(hours)), 0.0)
    # 4 mm a day from 100 m2, between 6:00 and 18:00.
    potential = np.maximum(0, np.sin((hours % 24 - 6) / 12 * math.pi)) * 0.4 * math.pi / 86400
    weather = list(zip((rain / 3.6e6).tolist(), potential.tolist(), strict=True))
    p, x2, expected = plant_parameters(BARE)._replace(percolation_exponent=exponent), 4.0, 0.0
    for rate, evaporated in weather:
        x2, passed = integrated(p, x2, 100.0 * rate, evaporated, 3600.0)
        expected += passed
    errors = []
    for tau in (3600.0, 900.0, 225.0):
        ticks, state, drained = p._replace(tau=tau), State(50.0, 4.0, 0.0), 0.0
        for rate, evaporated in weather:
            for _ in range(round(3600 / tau)):
                state, flows = step(ticks, state, rate, evaporated, 0.0, 1.0, OWN_PUMPS)
                drained += tau * flows.drainage
        errors.append(abs(drained / expected - 1))
    assert errors[1] < 1e-3 and errors[2] < 0.4 * errors[1] < 0.16 * errors[0]


def test_a_tick_by_hand() -> None:
    """5 m3 on the roof, 0.01 m3/s of rain for 2 s, demand 1e-3 m3/s, and all of it evaporates.

    At first 7/16 of the rain stay, and S becomes tanh(artanh(3/4) + 0.02/4).
    """
    after, flows = tick_of(replace(ROOF, tau=2.0), 50.0, 5.0, 1e-4, 1e-3)
    assert (flows.evapotranspiration, flows.limited) == (1e-3, False)
    wet = 2 + 4 * math.tanh(math.atanh(0.75) + 0.005)
    assert wet == pytest.approx(5 + 0.02 * 7 / 16, abs=1e-4)
    assert after.roof == pytest.approx(wet - 2e-3, rel=1e-12)
    assert after.layer == pytest.approx(5 + 0.02 - wet - 2 * flows.drainage, rel=1e-9)


@pytest.mark.parametrize(("soil", "layer", "inflow", "seconds", "outflow"), [
    # Without inflow V / (1 + k V t): a full layer has half of it after the time constant.
    (SOIL, 1.0, 0.0, 100.0, 0.005), (SOIL, 1.0, 0.0, 1e9, 1e-9),
    # With inflow sqrt(i / k) tanh(sqrt(i k) t + artanh(V / sqrt(i / k))), here tanh(1 + ...).
    (SOIL, 0.5, 0.01, 100.0, 0.01 + (0.5 - math.tanh(1 + math.atanh(0.5))) / 100),
    # It holds 1 m3; the rest of 10 m3 that arrive in a second is gone.
    (SOIL, 0.0, 10.0, 1.0, 9.0), (SOIL, 1.0, 10.0, 1.0, 10.0),
    # Without a layer everything passes at once.
    (plant_parameters(BARE), 0.0, 0.125, 1.0, 0.125),
])
def test_a_layer_by_hand(
    soil: PlantParameters, layer: float, inflow: float, seconds: float, outflow: float
) -> None:
    computed = layer_outflow(soil, layer, inflow, seconds)
    assert computed == pytest.approx(outflow, rel=1e-6 if seconds > 1e6 else 1e-12)


@pytest.mark.parametrize(("x2", "rain", "potential", "left"), [
    # First the rain, as above. Then all the potential evaporates down to 4 m3; below it,
    # exp(-e/2) of what is above 2 m3 stays.
    (5.5, 0.0, 0.5, 5.0), (6.0, 2.0, 0.5, 5.5), (1.5, 0.2, 1.0, 1.7),
    (5.0, 0.0, 2.0, 2 + 2 * math.exp(-0.5)),
    (3.0, 1.0, 1.0, 2 + 4 * math.tanh(math.atanh(0.25) + 0.25) * math.exp(-0.5)),
    (1.0, 1.5, 1.0, 2 + 4 * math.tanh(0.125) * math.exp(-0.5)),
])
def test_a_long_step_by_hand(x2: float, rain: float, potential: float, left: float) -> None:
    """With rain and evapotranspiration in m3; predicted for a step, and for several roofs."""
    rates = (np.array([amount / 3600]) for amount in (rain / ROOF.a2, potential))
    (change,) = ROOM.predict_changes(x2, *rates, np.array([3600.0]))
    assert x2 + change == pytest.approx(left, rel=1e-9)
    roofs = ROOM.predict_volume(np.full(2, x2), rain, potential, 3600.0)
    assert roofs.tolist() == pytest.approx([left] * 2, rel=1e-9)


# 4.5 m3 against 3 m3, S of 0.625 and 0.25, in rain of 1 and 2 m3: S = tanh(artanh S + i/4).
WETTER, DRIER = (
    [4 * math.tanh(math.atanh(filled) + rain / 4) for rain in (0, 1, 3)]
    for filled in (0.625, 0.25)
)
ENDS = [(more - less) / 1.5 for more, less in zip(WETTER, DRIER, strict=True)]


@pytest.mark.parametrize(("target", "x2", "rain", "potential", "share"), [
    (4.5, 3.0, [1.0, 2.0], 0.0, [(ENDS[0] + ENDS[1]) / 2, (ENDS[1] + ENDS[2]) / 2]),
    # A storm fills both to field capacity.
    (4.5, 3.0, [100.0, 0.0], 0.0, [0.5, 0.001]),
    # In the sun, all of it while there is no stress; below 4 m3 exp(-e/2) of it.
    (4.5, 4.4, [0.0, 0.0], 0.1, [1.0, 1.0]), (3.5, 2.5, [0.0], 2.0, [(1 + math.exp(-1)) / 2]),
])
def test_what_lasts_of_water_on_a_roof(
    target: float, x2: float, rain: list[float], potential: float, share: list[float]
) -> None:
    """Over hours with this rain and evapotranspiration (m3)."""
    room = RoofPrediction(SOIL._replace(x2_star=target))
    hours = np.full(len(rain), 3600.0)
    weather = np.array(rain) / 3600 / ROOF.a2, np.full(len(rain), potential) / 3600, hours
    lasting = room.predict_lasting_share(x2, room.predict_changes(x2, *weather), *weather)
    assert lasting.tolist() == pytest.approx(share, rel=1e-6)
