"""Initial states: the paper's (Table II), a site's own, and the volumes that a site can hold."""

from __future__ import annotations

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site, find_unheld
from greenroof_ros.model.soil import soil_of

# Table II: factors of the volumes at the outlet's level and at the target.
_TABLE_II = {
    "low-low": (1 / 1.3, 1 / 1.3),
    "high-low": (1.3, 1 / 1.3),
    "high-high": (1.3, 1.3),
}
SITE_STATE = "site"
"""name of the state that a site file defines with ``initial_cistern`` and ``initial_roof``"""
INITIAL_STATES = (*_TABLE_II, SITE_STATE)
"""names of the states of a site that defines its own"""


def initial_states(site: Site) -> dict[str, tuple[float, float]]:
    """Return the volumes x1 and x2 (m3) of the states in which runs begin, the default first.

    The default is the site file's own, or else low-low. The drainage layer of field-capacity soil
    always begins with the site file's ``initial_layer``: the states do not include it.
    """
    states = {
        name: (site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof)
        for name, (cistern, roof) in _TABLE_II.items()
    }
    if site.initial_cistern is None or site.initial_roof is None:
        return states
    return {SITE_STATE: (site.initial_cistern, site.initial_roof), **states}


def find_state(
    site: Site, name: str | None, volumes: tuple[float, float] | None
) -> tuple[str, tuple[float, float]]:
    """Return the state in which a run begins: its name, and the volumes x1 and x2 (m3).

    Args:
        site: the site.
        name: name of a state of the site, or any other name if volumes are given; None for the
            default.
        volumes: x1 and x2 (m3); None for those of the named state.

    Raises:
        ConfigurationError: if there is no such state, its volumes differ from those given, or the
            site cannot hold them.
    """
    states = initial_states(site)
    if volumes is None:
        name = next(iter(states)) if name is None else name
        if name not in states:
            raise ConfigurationError(
                "needs initial_cistern and initial_roof in the site file" if name == SITE_STATE
                else f"must be one of {', '.join(INITIAL_STATES)}, or the volumes in the cistern "
                "and on the roof must be given (m3)", key="initial", value=name,
            )
        volumes = states[name]
    elif states.get(name or "", volumes) != volumes:
        raise ConfigurationError(
            "has volumes that differ from those given for cistern and roof; remove one of them",
            key="initial", value=name,
        )
    check_volumes(site, *volumes)
    return name or "custom", volumes


def check_volumes(site: Site, cistern: float, roof: float) -> None:
    """Reject initial volumes that the site cannot hold.

    The plant has no rim: rain can raise the water on the roof above the soil's capacity. It then
    drains slowly, or on field-capacity soil in the first tick. A run can begin in any state in
    which another one can end.

    Args:
        site: the site.
        cistern: volume x1 (m3).
        roof: volume x2 (m3).

    Raises:
        ConfigurationError: if no rain can lead to such a state, so that a unit is wrong. The
            error's key is ``cistern`` or ``roof``.
    """
    for key, value, expected in find_unheld(site, cistern, roof):
        raise ConfigurationError(expected, key=key, value=value)


def note_full_roof(site: Site, roof: float) -> list[str]:
    """Return a sentence if a volume on the roof (m3) is more than its soil holds."""
    if roof <= site.z_cap:
        return []
    full = site.roof_level(site.z_cap)
    return [
        f"the run begins with {roof:g} m3 on the roof, more than the {site.z_cap:g} m3 (a level of "
        f"{full:g} m) that the soil holds: {site.roof_level(roof) - full:.3g} m "
        f"{soil_of(site).excess}. It is a volume in m3"
    ]
