"""The affinity laws on the site's curve: by hand with Table I, and by the equations."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from paper import PAPER_SITE, sites

from greenroof_ros.physics.pump import flow_at, maximum_pump_flow, speed_for
from greenroof_ros.site.site import Site

# 15 m of head against 16 m of height less half a metre of water.
WEAK = replace(PAPER_SITE, c_hat=15.0)


@pytest.mark.parametrize(
    ("site", "speed", "level", "flow"),
    [
        # At 80 % from 3 m: b sqrt(0.64 55.2 - 13) = 1.29646769e-3 sqrt(22.328).
        (PAPER_SITE, 0.8, 3.0, 0.00612614),
        # 13 m of lift need sqrt(13 / 55.2) = 0.48529 of the speed.
        (PAPER_SITE, 0.4852, 3.0, 0.0), (PAPER_SITE, 0.4854, 3.0, 9.913047e-5),
        (WEAK, 1.0, 0.5, 0.0),
        # Without rotation nothing flows, not even from 20 m of water to a roof at 16 m.
        (PAPER_SITE, 0.0, 3.0, 0.0), (PAPER_SITE, 0.0, 20.0, 0.0),
    ],
)
def test_flow_by_hand(site: Site, speed: float, level: float, flow: float) -> None:
    assert flow_at(site, speed, level) == pytest.approx(flow, rel=1e-6, abs=0)


@given(
    site=st.just(PAPER_SITE) | sites(),
    above_suction=st.floats(0, 5),
    share=st.floats(1e-3, 1) | st.just(0.0),
)
@example(WEAK, 0.0, 1.0)
def test_flow_and_speed_are_inverse(site: Site, above_suction: float, share: float) -> None:
    """The speed for a share gives that share of the maximum flow, and no speed exceeds 1."""
    level = site.suction_level + above_suction
    assume(level <= site.d)
    speed = speed_for(site, share, level)
    most = maximum_pump_flow(site, level * site.a1)
    assert (speed > 0) == (share * most > 0)
    assert speed <= 1 + 1e-12
    # Near zero flow, rounding s^2 by 2e-16 changes q^2 by d 2e-16.
    assert flow_at(site, speed, level) == pytest.approx(share * most, rel=1e-6, abs=1e-7 * most)
