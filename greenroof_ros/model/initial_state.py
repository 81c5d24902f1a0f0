"""The paper's initial states, Table II."""

from __future__ import annotations

from greenroof_ros.model.site import Site

# Table II: the volumes at which the outlet and the target are, times these.
INITIAL_STATES = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}


def initial_state(site: Site, name: str) -> tuple[float, float]:
    """Return the volumes x1 and x2 (m3) of one of the paper's initial states, Table II."""
    cistern, roof = INITIAL_STATES[name]
    return site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof
