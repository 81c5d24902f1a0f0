"""Initial states: the paper's (Table II), a site's own, and the volumes that a site can hold."""

from __future__ import annotations

import functools
import logging

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site, find_unheld
from greenroof_ros.model.soil import soil_of

_log = logging.getLogger(__name__)

# Table II: factors of the volumes at the outlet's level and at the target.
INITIAL_STATES = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}

SITE_STATE = "site"
"""Name of the state that a site file defines by ``initial_cistern`` and ``initial_roof``."""
SITE_STATE_KEYS = ("initial_cistern", "initial_roof")
"""Keys of that state's volumes in the site file."""


def initial_state(site: Site, name: str) -> tuple[float, float]:
    """Return the volumes x1 and x2 (m3) of one of the paper's initial states, Table II."""
    cistern, roof = INITIAL_STATES[name]
    return site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof


def site_state(site: Site) -> tuple[float, float] | None:
    """Return the volumes x1 and x2 (m3) that the site file gives; None if it gives none."""
    if site.initial_cistern is None or site.initial_roof is None:
        return None
    return site.initial_cistern, site.initial_roof


def default_state(site: Site) -> tuple[str, tuple[float, float]]:
    """Return the state that a run begins in by default: its name and its volumes (m3).

    It is the site file's own, or else low-low. The drainage layer of a measured soil always begins
    with the site file's ``initial_layer``: the states do not include it.
    """
    state = site_state(site)
    return ("low-low", initial_state(site, "low-low")) if state is None else (SITE_STATE, state)


@functools.cache  # so that a study warns once, not in each of its runs
def check_volumes(site: Site, cistern: float, roof: float, keys: tuple[str, str]) -> None:
    """Refuse initial volumes that the site cannot hold, and warn of a roof fuller than its soil.

    The plant has no rim: rain can raise the roof above the soil's capacity. It then drains slowly,
    on a measured soil in the first tick. A run can begin in any state in which another one ends.

    Args:
        site: the site.
        cistern: volume x1 (m3).
        roof: volume x2 (m3).
        keys: names of the two volumes in messages.

    Raises:
        ConfigurationError: no rain can lead to such a state; a unit is wrong.
    """
    for place, expected in find_unheld(site, cistern, roof):
        raise ConfigurationError(expected, key=keys[place], value=(cistern, roof)[place])
    full = site.roof_level(site.z_cap)
    if roof > site.z_cap:
        _log.warning(
            "warning: %s = %r: more than the %g m3 (a level of %g m) that the soil holds: %.3g m "
            "%s. It is a volume in m3",
            keys[1], roof, site.z_cap, full, site.roof_level(roof) - full,
            soil_of(site).excess,
        )
