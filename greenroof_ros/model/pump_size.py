"""Whether the pumps suit the roof and the tick, in sentences for readers of results."""

from __future__ import annotations

from collections.abc import Iterator

from greenroof_ros.model.plain_keys import LITRES_PER_HOUR
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

# What a substrate is assumed to let through (mm/h): 0.6 mm/min is quoted as the minimum in the FLL
# guidelines (2018) for extensive roofs, but this was not checked in their text.
_TAKEN_UP = 36.0
# Maximum share of the target that the pumps should lift in a tick.
_MAX_SHARE = 0.1


def note_pumps(site: Site) -> Iterator[str]:
    """Yield a sentence if the pumps are too large for the roof, and one if they are for the tick.

    The first is only for field-capacity soil. On Table I's soil, Eq. (4), water stays on the
    surface until it drains at 0.28 mm/h, so there no pump suits; that is the paper's model, and not
    for this to mend.
    """
    flow = maximum_pump_flow(site, site.a1 * site.z_o)
    depth = flow / site.a2 / LITRES_PER_HOUR
    if site.field_capacity is not None and depth > _TAKEN_UP:
        yield (
            f"the pumps can lift {1000 * flow:.3g} l/s, {depth:.0f} mm/h on {site.a2:g} m2 of "
            f"roof. A substrate is assumed to take up {_TAKEN_UP:g} mm/h; anything above that runs "
            "off, which is not simulated. Is the pump's curve or flow right?"
        )
    share = site.tau * flow / site.x2_star
    if share > _MAX_SHARE:
        yield (
            f"in a tick of {site.tau:g} s the pumps can lift {share:.0%} of the target: simulated "
            "pumps stop at the target within the tick, as with a float switch, and real pumps need "
            f"one; alternatively, use ticks of up to {_MAX_SHARE * site.x2_star / flow:.3g} s"
        )
