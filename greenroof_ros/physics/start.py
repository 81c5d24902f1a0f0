"""Initial states of a run: those of the paper (Table II), and the state defined in a site file."""

from __future__ import annotations

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.site import HIGH, Site, describe_max_volume

# Table II: factors of the volumes at the outlet's level and at the target.
_TABLE_II = {
    "low-low": (1 / HIGH, 1 / HIGH),
    "high-low": (HIGH, 1 / HIGH),
    "high-high": (HIGH, HIGH),
}
SITE_STATE = "site"
"""name of the state that a site file defines with ``initial_cistern`` and ``initial_roof``"""
INITIAL_STATES = (*_TABLE_II, SITE_STATE)
"""names of the states of a site whose file defines a state"""


def initial_states(site: Site) -> dict[str, tuple[float, float]]:
    """Return the volumes x1 and x2 (m3) of each initial state, with the default state first.

    The default is the state defined in the site file or, if the file defines none, low-low. The
    states do not include the drainage layer of a field-capacity soil, which always starts with
    ``initial_layer``.
    """
    states = {
        name: (site.a1 * site.z_o * cistern, site.a2 * site.z_veg * roof)
        for name, (cistern, roof) in _TABLE_II.items()
    }
    if site.initial_cistern is None or site.initial_roof is None:
        return states
    return {SITE_STATE: (site.initial_cistern, site.initial_roof), **states}


def find_state(
    site: Site, name: str | None = None, cistern: float | None = None, roof: float | None = None
) -> tuple[str, float, float]:
    """Return the name of a run's initial state, and its volumes x1 and x2 (m3).

    Args:
        site: the site.
        name: name of an initial state, or an arbitrary name if volumes are given; None for the
            default.
        cistern: volume x1 (m3); None for that of the named state.
        roof: volume x2 (m3); None for that of the named state.

    Raises:
        ConfigurationError: if the state does not exist, if only one volume is given, if the given
            volumes are not those of the state, or if the site cannot hold the volumes.
    """
    states = initial_states(site)
    if cistern is None and roof is None:
        name = next(iter(states)) if name is None else name
        if name not in states:
            raise ConfigurationError(
                "requires initial_cistern and initial_roof in the site file" if name == SITE_STATE
                else f"must be one of {', '.join(INITIAL_STATES)}, or volumes (m3) must be "
                "given for the cistern and the roof", key="initial", value=name,
            )
        return name, *states[name]
    if cistern is None or roof is None:
        lacking = "cistern" if cistern is None else "roof"
        raise ConfigurationError("is missing; set both cistern and roof", key=lacking)
    if states.get(name or "", (cistern, roof)) != (cistern, roof):
        raise ConfigurationError(
            "differs from the volumes given for the cistern and the roof; remove either the name "
            "or the volumes", key="initial", value=name,
        )
    check_volumes(site, cistern, roof)
    return name or "custom", cistern, roof


def check_volumes(site: Site, cistern: float, roof: float) -> None:
    """Reject initial volumes that the site cannot hold; see :attr:`.Site.max_volumes`.

    Args:
        site: the site.
        cistern: volume x1 (m3).
        roof: volume x2 (m3).

    Raises:
        ConfigurationError: if a volume is too large; the error's key is ``cistern`` or ``roof``.
    """
    for (key, most), value in zip(site.max_volumes.items(), (cistern, roof), strict=True):
        if value > most:
            raise ConfigurationError(describe_max_volume(most), key=key, value=value)
