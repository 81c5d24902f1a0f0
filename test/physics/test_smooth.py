"""The smooth plant and its linear model, Eqs. (5)-(10)."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from paper import ANY_SITE, linear_model, smooth_rates

from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.smooth import linearise
from greenroof_ros.site.site import Site


@st.composite
def states(draw: st.DrawFn, site: Site) -> tuple[float, float]:
    """Draw volumes anywhere, and often at or near a kink or the middle of a sigmoid."""
    anywhere = st.floats(0, 1)
    near = st.sampled_from([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])
    lift = site.d - site.c_hat
    suction = site.z_pump + site.z_H
    kinks = [site.z_o, site.z_o + site.epsilon, lift, lift + site.epsilon, suction]
    if site.low_outlet_level is not None:
        kinks += [site.low_outlet_level, site.low_outlet_level + site.epsilon]
    cistern = draw(
        anywhere.map(lambda share: share * 3 * (site.z_o + site.epsilon))
        | st.builds(float.__add__, st.sampled_from([float(kink) for kink in kinks]), near)
    )
    roof = draw(
        anywhere.map(lambda share: share * 2 * site.z_soil)
        | st.builds(float.__add__, st.sampled_from([site.z_veg, site.z_soil]), near)
    )
    return max(cistern, 0) * site.a1, max(roof, 0) * site.a2


@settings(max_examples=60)
@given(
    data=st.data(),
    site=ANY_SITE,
    command=st.floats(0, 3),
    rain=st.floats(0, 1e-3),
    evaporated=st.floats(0, 1),
)
def test_linear_model_equals_complex_steps(
    data: st.DataObject, site: Site, command: float, rain: float, evaporated: float
) -> None:
    """A, B, C and b of Eq. (10) at random states of random sites, to 1e-9 of each one's largest."""
    point = (*data.draw(states(site)), command, rain, evaporated)
    if site.mains_level is not None and site.mains_flow is not None:
        # The reference's valve does not open or close within a tick.
        missing = abs(site.a1 * site.mains_level - point[0])
        rate = abs(smooth_rates(site, *point)[0])
        assume(missing > site.tau * (rate + site.mains_flow))
    model = linearise(plant_parameters(site), *point)
    slope, B, C, b = linear_model(site, *point)
    computed = np.array(model.A) - np.eye(2)
    # The identity costs A's entries up to two units in the last place of 1.
    np.testing.assert_allclose(computed, slope, rtol=0, atol=1e-9 * np.abs(slope).max() + 5e-16)
    # Complex steps lose digits if a derivative is near the smallest float.
    np.testing.assert_allclose(model.B, B, rtol=0, atol=1e-9 * np.abs(B).max() + 1e-250)
    # On a field-capacity soil 1 - S^beta cancels.
    cancels = 0.0 if site.field_capacity is None else 1e-15 * site.tau * site.a2 + 1e-250
    np.testing.assert_allclose(model.C, C, rtol=1e-12, atol=cancels)
    # The terms of f cancel; the rest is right to 1e-9 of the terms.
    terms = np.abs(C) @ np.abs(point[3:]) + np.abs(B * point[2]) + np.abs(b)
    np.testing.assert_allclose(model.b, b, rtol=0, atol=1e-9 * terms.max())
