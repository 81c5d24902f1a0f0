"""Checks of the pump size, relative to the roof and to the duration of a tick."""

from __future__ import annotations

from collections.abc import Iterator

from greenroof_ros.physics.plant import maximum_pump_flow
from greenroof_ros.site.plain_keys import LITRES_PER_HOUR
from greenroof_ros.site.site import Site

# What a substrate is assumed to let through (mm/h): 0.6 mm/min is quoted as the minimum in the FLL
# guidelines (2018) for extensive roofs, but this was not checked in their text.
_TAKEN_UP = 36.0
# Maximum share of the target that the pumps should lift in a tick.
_MAX_SHARE = 0.1


def note_pumps(site: Site) -> Iterator[str]:
    """Yield a warning if the pumps are too large for the roof or for the duration of a tick.

    The size relative to the roof is checked only for a field-capacity soil. On the soil of Table I,
    Eq. (4), water stays on the surface until it drains at 0.28 mm/h, so every pump would fail this
    check.
    """
    flow = maximum_pump_flow(site, site.a1 * site.z_o)
    depth = flow / site.a2 / LITRES_PER_HOUR
    if site.field_capacity is not None and depth > _TAKEN_UP:
        yield (
            f"the pumps can deliver {1000 * flow:.3g} l/s, or {depth:.0f} mm/h on {site.a2:g} m2 "
            f"of roof. A substrate is assumed to absorb {_TAKEN_UP:g} mm/h; the excess runs off "
            "the surface, which is not simulated. Is the pump curve or the pump flow correct?"
        )
    share = site.tau * flow / site.x2_star
    if share > _MAX_SHARE:
        yield (
            f"in a tick of {site.tau:g} s the pumps can deliver {share:.0%} of the target "
            "volume. Simulated pumps stop at the target within the tick, as with a float switch. "
            "Real pumps need such a switch, or ticks of at most "
            f"{_MAX_SHARE * site.x2_star / flow:.3g} s"
        )
