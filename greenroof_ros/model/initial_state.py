"""Initial states: the paper's, Table II, and the volumes that a place can hold."""

from __future__ import annotations

import functools
import logging

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site

_log = logging.getLogger(__name__)

# Table II: the volumes at which the outlet and the target are, times these.
INITIAL_STATES = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}

# Eq. (4) has what the soil does not hold stand on it until it drains. No more stands there than the
# most rain that ever fell in a day: Foc-Foc, La Reunion, 1966 [WMO] (m).
_MOST_PONDED = 1.825
# A cistern lies below the roof; where its outlet does not, it holds what Table II asks of it.
_ABOVE_OUTLET = 1.3


def initial_state(site: Site, name: str) -> tuple[float, float]:
    """Return the volumes x1 and x2 (m3) of one of the paper's initial states, Table II."""
    cistern, roof = INITIAL_STATES[name]
    return site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof


@functools.cache  # so that a study says what it warns of once, not for each of its runs
def check_volumes(site: Site, cistern: float, roof: float, keys: tuple[str, str]) -> None:
    """Refuse initial volumes that the place cannot hold, and warn of a roof fuller than its soil.

    The plant has no rim: rain raises the roof above the soil's capacity, from where it drains
    slowly, a measured one in the first tick. Whatever state a run ends in, another can begin in.

    Args:
        site: the place.
        cistern: volume x1 (m3).
        roof: volume x2 (m3).
        keys: what the two volumes are called where they were given.

    Raises:
        ConfigurationError: no rain could have made such a state; a unit is wrong.
    """
    full = site.roof_level(site.z_cap)
    for key, volume, area, level, why in (
        (
            keys[0], cistern, site.a1, max(site.d, _ABOVE_OUTLET * site.z_o),
            f"its outlet is at {site.z_o:g} m, the roof {site.d:g} m above its base",
        ),
        (
            keys[1], roof, site.a2, full + _MOST_PONDED,
            f"the soil holds {site.z_cap:g} m3, {full:g} m, and at most {_MOST_PONDED:g} m "
            "stand on it",
        ),
    ):
        if volume > level * area:
            raise ConfigurationError(
                f"must be at most {level * area:g} m3, a level of {level:g} m ({why}); is a unit "
                f"wrong? It is a volume in m3; a level of {volume:g} mm is "
                f"{volume / 1000 * area:g} m3",
                key=key, value=volume,
            )
    if roof > site.z_cap:
        _log.warning(
            "warning: %s = %r: more than the %g m3 (a level of %g m) that the soil holds: %.3g m "
            "%s. It is a volume in m3",
            keys[1], roof, site.z_cap, full, site.roof_level(roof) - full,
            "stand on it" if site.field_capacity is None else "drain at once",
        )
